"""The losses of CRC-RL on algorithms that are not CRCSAC: stock TD3, and TQC of sb3-contrib, by a callback.

``AuxiliaryLossCallback`` trains the features extractor of the critic on the algorithm's own replay buffer, after each rollout,
with an optimizer of its own. The algorithm stays as SB3 ships it. Three settings make the most of it:

- ``share_features_extractor=True``: the actor sees through the extractor that the objectives train;
- ``features_extractor_class=PixelEncoder``: its latent is normalised and does not collapse (SB3's NatureCNN works, too);
- ``replay_buffer_class=FrameReplayBuffer``: a stack of three frames takes a sixth of the memory.

From the first ``learn()`` on, ``model.save("model")`` also writes ``model.aux.zip``, from which the objectives go on later:
``AuxiliaryLossCallback.load("model")``.

    python examples/td3_and_tqc.py --steps 1500
"""

import argparse
import importlib.util
from math import log
from typing import Any

from custom_image_env import SMALL, make_track
from stable_baselines3 import TD3
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_crc import AuxiliaryLossCallback, FrameReplayBuffer, PixelEncoder

OBJECTIVES = {"contrastive": 1.0, "reconstruction": 1.0}


def make_model(algorithm: type[OffPolicyAlgorithm], seed: int = 0, **settings: Any) -> OffPolicyAlgorithm:
    """A stock algorithm with our encoder and our memory; ``settings`` are its own."""
    return algorithm(
        "CnnPolicy",
        make_track(seed),
        seed=seed,
        batch_size=SMALL["batch_size"],
        buffer_size=SMALL["buffer_size"],
        learning_starts=SMALL["learning_starts"],
        replay_buffer_class=FrameReplayBuffer,
        replay_buffer_kwargs={"frame_channels": 3},
        policy_kwargs={
            **SMALL["policy_kwargs"],
            "features_extractor_class": PixelEncoder,
            "share_features_extractor": True,
        },
        **settings,
    )


def algorithms() -> dict[str, type[OffPolicyAlgorithm]]:
    """TD3, and TQC where sb3-contrib is installed (rl_zoo3 needs it, so the extra ``zoo`` brings it)."""
    found: dict[str, type[OffPolicyAlgorithm]] = {"TD3": TD3}
    if importlib.util.find_spec("sb3_contrib") is not None:
        from sb3_contrib import TQC

        found["TQC"] = TQC
    return found


def main() -> None:
    """Train each, and say what its extractor has learned."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=1_500, help="decisions each learns from")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()

    for name, algorithm in algorithms().items():
        model = make_model(algorithm, given.seed)
        callback = AuxiliaryLossCallback(OBJECTIVES, augmentation_kwargs={"pad": 2})
        model.learn(given.steps, callback=callback)

        assert callback.learner is not None
        metrics = callback.learner.train()  # one more update, for its numbers; in a training the log has them
        print(f"{name}: {callback.learner.n_updates} auxiliary updates")
        chance = log(SMALL["batch_size"])
        print(f"  contrastive loss {metrics['representation/contrastive']:.2f}; latents that tell nothing: {chance:.2f}")
        print(f"  reconstruction loss {metrics['representation/reconstruction']:.4f}")


if __name__ == "__main__":
    main()
