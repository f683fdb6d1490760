"""200 updates from a committed buffer give the committed losses: nobody changes the algorithm without noticing.

Written by ``python -m tests.test_trace`` on the pinned torch; write it anew only when the algorithm is meant to change, and
say so in the changelog.
"""

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.logger import Logger

from sb3_crc import CRCSAC
from tests.conftest import POLICY_KWARGS

DATA = Path(__file__).parent / "data"
NAMES = ("train/critic_loss", "train/actor_loss", "representation/contrastive", "representation/reconstruction")
NAMES += ("representation/consistency",)
SHAPE = (3, 36, 36)


class Space(gym.Env[np.ndarray, np.ndarray]):
    """Only the spaces: the transitions come from the file."""

    observation_space = gym.spaces.Box(0, 255, SHAPE, np.uint8)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)


def trace() -> list[list[float]]:
    """The five losses at every tenth of 200 updates."""
    settings: dict[str, Any] = {
        "buffer_size": 64,
        "batch_size": 16,
        "seed": 0,
        "device": "cpu",
        "policy_kwargs": POLICY_KWARGS,
    }
    model = CRCSAC("CnnPolicy", Space(), **settings)
    model.set_logger(Logger(None, []))
    with np.load(DATA / "buffer.npz") as data:
        for i in range(64):
            observation, following = data["frames"][i : i + 1], data["frames"][i + 1 : i + 2]
            end = np.array([i % 16 == 15])
            info = [{"TimeLimit.truncated": bool(end[0])}]
            model.replay_buffer.add(observation, following, data["actions"][i : i + 1], data["rewards"][i : i + 1], end, info)
    rows = []
    for _ in range(20):
        model.train(gradient_steps=9, batch_size=16)
        model.train(gradient_steps=1, batch_size=16)
        rows.append([model.logger.name_to_value[name] for name in NAMES])
    return rows


@pytest.mark.skipif(not th.__version__.startswith("2.13.0"), reason="rounding differs between versions of torch")
def test_the_losses_of_200_updates_are_the_committed_ones() -> None:
    expected = json.loads((DATA / "trace.json").read_text())
    assert expected["names"] == list(NAMES)
    np.testing.assert_allclose(trace(), expected["losses"], rtol=1e-4, atol=1e-6)


def write() -> None:
    """Draw a buffer of moving bright squares on noise, and write it and its trace."""
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 100, (65, *SHAPE), dtype=np.uint8)
    for i, frame in enumerate(frames):
        frame[:, i % 30 : i % 30 + 5, (2 * i) % 30 : (2 * i) % 30 + 5] = 255
    actions, rewards = rng.uniform(-1, 1, (64, 2)).astype(np.float32), rng.uniform(0, 1, 64).astype(np.float32)
    DATA.mkdir(exist_ok=True)
    np.savez_compressed(DATA / "buffer.npz", frames=frames, actions=actions, rewards=rewards)
    (DATA / "trace.json").write_text(json.dumps({"names": NAMES, "torch": th.__version__, "losses": trace()}, indent=1))


if __name__ == "__main__":
    th.set_num_threads(1)
    write()
