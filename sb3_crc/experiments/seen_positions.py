"""Cartpole's state as an encoder could deliver it: positions with an error; once the cart has left the picture, only its side.

K frames.
"""

from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np

#: Beyond this distance from the middle of the rail, in metres, the camera shows no cart and hardly any pole
VISIBLE = 1.65


class SeenPositions(gym.ObservationWrapper[np.ndarray, Any, np.ndarray]):
    """
    :param env: ``make_dmc("cartpole-...", observation="state")``, whose observation begins with x, cos and sin of the angle
    :param error: standard deviation of what is read off each frame, in metres of cart and pole tip (the pole is 1 m long)
    :param frames: K, of which the newest is given, and the differences between neighbours; velocities are not given
    :param seed: of the errors
    :raises ValueError: if the observation is not one of cartpole, or ``error`` or ``frames`` is out of range
    """

    def __init__(self, env: gym.Env[np.ndarray, Any], *, error: float, frames: int = 3, seed: int = 0):
        super().__init__(env)
        if env.observation_space.shape != (5,):
            raise ValueError(f"observation of shape {env.observation_space.shape}: only cartpole's, (5,), can be read")
        if not (0 <= error < np.inf and frames >= 1):
            raise ValueError(f"error={error} must be finite and >= 0, frames={frames} >= 1")
        self.error = error
        self._rng = np.random.default_rng(seed)
        self._frames: deque[np.ndarray] = deque(maxlen=frames)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (4 * frames,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Forget the frames."""
        self._frames.clear()
        return super().reset(seed=seed, options=options)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """
        :param observation: ``(5,)``
        :return: ``(4 K,)``: x, cos, sin and 1 of the newest frame, then four times the differences. Out of the picture, x is
            that of its edge and the others are 0
        """
        position, cosine, sine = (float(value) for value in observation[:3])
        angle = np.arctan2(sine, cosine) + self.error * self._rng.normal()
        seen = np.array([position + self.error * self._rng.normal(), np.cos(angle), np.sin(angle), 1.0])
        if abs(position) > VISIBLE:
            seen = np.array([np.sign(position) * VISIBLE, 0.0, 0.0, 0.0])
        while len(self._frames) < (self._frames.maxlen or 1) - 1:
            self._frames.append(seen)
        self._frames.append(seen)
        stack = np.stack(list(self._frames))
        return np.concatenate([stack[-1], 4 * np.diff(stack, axis=0).ravel()]).astype(np.float32)
