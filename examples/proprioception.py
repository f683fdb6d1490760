"""Pixels and proprioception: a robot feels its own joints, and sees the rest.

In dm_control's reacher-easy an arm has to reach a ball. ``observation="dict"`` gives the stack of frames and, beside it, each
of the task's own observations. Here the arm keeps what its joints would tell it, positions and velocities; where the ball is
(``to_target``) it has to see. So neither part is enough alone.

``MultiInputPolicy`` is all that changes. The image has an encoder, which critic and objectives train as ever; vectors join its
latent where the heads of actor and critic begin. Objectives are about the image alone.

    python examples/proprioception.py --steps 3000
"""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_crc import CRCSAC, make_dmc

Observation = dict[str, np.ndarray]

SMALL: dict[str, Any] = {
    "batch_size": 32,
    "buffer_size": 5_000,
    "learning_starts": 200,
    "policy_kwargs": {
        "net_arch": [64, 64],
        "features_extractor_kwargs": {"channels": [16, 16], "strides": [2, 2], "features_dim": 32},
    },
}


def make_reacher(seed: int) -> gym.Env[Observation, np.ndarray]:
    """
    Small pictures, drawn fast: for scores that are to be compared, leave both out. Any wrapper of Gymnasium may follow; with
    ``render_mode=None`` nothing is drawn for people.
    """
    env = make_dmc("reacher-easy", seed=seed, observation="dict", image_size=40, render_quality="fast")
    return gym.wrappers.FilterObservation(env, ["pixels", "position", "velocity"])


def moment(seed: int) -> Observation:
    """Of an episode of its own, with the ball where no other moment has it, and joints that move."""
    env = make_reacher(seed)
    env.reset()
    for _ in range(5):
        observation, *_ = env.step(env.action_space.sample())
    return observation


def dependence(model: CRCSAC, observations: list[Observation]) -> dict[str, float]:
    """How much the mean action changes when a part of the observation is taken from another moment, by the part's name."""

    def act(observation: Observation) -> np.ndarray:
        return model.predict(observation, deterministic=True)[0]

    changes: dict[str, list[float]] = {name: [] for name in observations[0]}
    for here, there in zip(observations, np.roll(np.array(observations, dtype=object), 1), strict=True):
        for name, change in changes.items():
            change.append(float(np.abs(act({**here, name: there[name]}) - act(here)).mean()))
    return {name: float(np.mean(change)) for name, change in changes.items()}


def main() -> None:
    """Train, and ask what the policy goes by."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=3_000, help="decisions to learn from")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()

    env = make_reacher(given.seed)
    for name, space in env.observation_space.spaces.items():  # type: ignore[attr-defined]
        print(f"{name}: {space.dtype} {space.shape}")
    model = CRCSAC("MultiInputPolicy", env, seed=given.seed, verbose=1, **SMALL)
    latent, heads = model.actor.features_dim, model.actor.latent_pi[0].in_features
    print(f"heads see {heads} numbers: a latent of {latent} and {heads - latent} of proprioception")
    model.learn(given.steps)

    for name, change in dependence(model, [moment(seed) for seed in range(8)]).items():
        print(f"with {name} of another moment the mean action changes by {change:.3f}")


if __name__ == "__main__":
    main()
