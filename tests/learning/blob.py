"""A task of one decision whose optimum is known: point at the blob."""

from typing import Any

import gymnasium as gym
import numpy as np


class BlobEnv(gym.Env[np.ndarray, np.ndarray]):
    """
    A bright 3x3 blob at a random place on noise that is new in every frame; the reward is 1 - |a - x|, x in [-1, 1] being the
    blob's column. A policy that looks gets almost 1, the best blind one 0.5, a random one 1/3. Each decision is an episode.
    """

    def __init__(self, size: int = 36, noise: int = 160):
        self.observation_space = gym.spaces.Box(0, 255, (3, size, size), np.uint8)
        self.action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
        self.size = size
        self.noise = noise
        self.column = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        frame = self.np_random.integers(0, self.noise, self.observation_space.shape, dtype=np.uint8)
        margin = self.size // 6  # an augmentation must not cut the blob off
        row, column = self.np_random.integers(margin, self.size - margin - 3, 2)
        frame[:, row : row + 3, column : column + 3] = 255
        self.column = 2 * (column - margin) / (self.size - 2 * margin - 4) - 1
        return frame, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        reward = 1 - abs(float(action[0]) - self.column)
        return np.zeros(self.observation_space.shape, np.uint8), reward, True, False, {}
