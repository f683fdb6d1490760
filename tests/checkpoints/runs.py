"""A tiny training that can be stopped, and what is compared of two of them."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor

from sb3_crc import CRCSAC, make_dmc
from sb3_crc.checkpoints.callback import TrainingCheckpoint
from tests.conftest import POLICY_KWARGS

STEPS = 60
SETTINGS: dict[str, Any] = {
    "batch_size": 16,
    "buffer_size": 40,  # the ring wraps around
    "learning_starts": 20,
    "policy_kwargs": POLICY_KWARGS,
    "device": "cpu",
}


class StoppedError(RuntimeError):
    """What :class:`Stop` raises."""


class Stop(BaseCallback):
    """Ends the training as an error in the environment would."""

    def __init__(self, at: int | None):
        super().__init__()
        self.at = at

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            raise StoppedError
        return True


def cartpole(seed: int) -> gym.Env[Any, Any]:
    return Monitor(make_dmc("cartpole-swingup", seed=seed, image_size=36, render_quality="fast", action_repeat=50))


def train(
    folder: Path,
    *,
    seed: int = 0,
    stop: int | None = None,
    steps: int = STEPS,
    make_env: Any = cartpole,
    overlap: bool = False,
    **own: Any,
) -> CRCSAC:
    model = CRCSAC("CnnPolicy", make_env(seed), seed=seed, overlap=overlap, **SETTINGS)
    checkpoint = TrainingCheckpoint(folder, **{"every": 10, **own})
    try:
        model.learn(steps, callback=[checkpoint, Stop(stop)])
    except StoppedError:
        checkpoint.close()  # what a kill does to an unfinished one is another test's
    return model


def assert_equal(model: CRCSAC, other: CRCSAC) -> None:
    for name, value in model.policy.state_dict().items():
        assert th.equal(value, other.policy.state_dict()[name]), name
    assert [episode["r"] for episode in model.ep_info_buffer] == [episode["r"] for episode in other.ep_info_buffer]
    for name, values in model.replay_buffer.arrays().items():
        assert np.array_equal(values, other.replay_buffer.arrays()[name]), name
    assert (model.num_timesteps, model._n_updates) == (other.num_timesteps, other._n_updates)
