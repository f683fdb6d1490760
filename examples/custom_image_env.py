"""CRCSAC on an environment of your own: a race track seen from above, in the manner of Gymnasium's CarRacing.

What CRCSAC asks of an environment:

- Observations are uint8 images from 0 to 255, channels last (as here) or first. Actions are a bounded Box.
- One image shows no motion, so several are stacked: by SB3's VecFrameStack, or by the environment itself, which then has an
  attribute ``frame_channels = 3``. Either tells the replay buffer what a single frame is, so that it stores each one once.
- A Monitor is around it, for ``rollout/ep_rew_mean`` in the log. ``make_vec_env`` adds one.

``terminated`` means that nothing more is to be got (here: off the road), ``truncated`` that time is up: SAC bootstraps there.
Measured with seed 0: random actions make 9 per cent of a lap, 2 500 decisions of training 60; full speed allows about 77.

    python examples/custom_image_env.py --steps 2500
"""

import argparse
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack

from sb3_crc import CRCSAC

#: Small networks and batches, so that two CPU cores will do; the constructor's defaults are the paper's, for a GPU
ENCODER = {"channels": [16, 32, 32], "strides": [2, 2, 1], "features_dim": 50}
SMALL: dict[str, Any] = {
    "batch_size": 32,
    "buffer_size": 10_000,
    "learning_starts": 300,
    "augmentation": "random_shift",
    "augmentation_kwargs": {"pad": 2},
    "policy_kwargs": {"net_arch": [128, 128], "features_extractor_kwargs": ENCODER},
}


class TrackEnv(gym.Env[np.ndarray, np.ndarray]):
    """
    Drive round a closed track that is another one in each episode. The camera turns with the car; the bar below is the speed.
    Action: steering (-1 right, 1 left) and gas (-1 stop, 1 full). Reward: progress in per cent of a lap. An episode terminates
    when the car leaves the road and is truncated after 100 steps, in which full speed makes about three quarters of a lap.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 20}
    HALF_WIDTH, TOP_SPEED, TIME_LIMIT = 1.6, 0.5, 100

    def __init__(self, size: int = 40, render_mode: str = "rgb_array"):
        self.observation_space = gym.spaces.Box(0, 255, (size, size, 3), np.uint8)
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.size, self.render_mode = size, render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """A new track, drawn from ``self.np_random``, which ``super().reset`` seeds."""
        super().reset(seed=seed)
        self.bends = self.np_random.uniform(0, [[0.9], [0.5]], (2, 1)), self.np_random.uniform(0, 2 * np.pi, (2, 1))
        self.position = np.array([self._radius(np.zeros(1))[0], 0.0])
        self.heading, self.speed, self.steps = np.pi / 2, 0.0, 0
        return self._draw(self.size), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Turn, accelerate, drive on."""
        steering, gas = np.clip(action, -1, 1)
        before = np.arctan2(*self.position[::-1])
        self.heading += 0.2 * float(steering)
        self.speed += 0.2 * (self.TOP_SPEED * (float(gas) + 1) / 2 - self.speed)
        self.position = self.position + self.speed * np.array([np.cos(self.heading), np.sin(self.heading)])
        self.steps += 1
        turned = (np.arctan2(*self.position[::-1]) - before + np.pi) % (2 * np.pi) - np.pi
        off_road = bool(self._distance(self.position[:, None])[0] > self.HALF_WIDTH)
        return self._draw(self.size), 100 * turned / (2 * np.pi), off_road, self.steps >= self.TIME_LIMIT, {}

    def render(self) -> np.ndarray:
        """A larger picture, for films."""
        return self._draw(240)

    def _radius(self, angle: np.ndarray) -> np.ndarray:
        """Of the middle of the road, seen from the middle of the track."""
        sizes, phases = self.bends
        return 10 + (sizes * np.cos(np.array([[2], [3]]) * angle + phases)).sum(axis=0)

    def _distance(self, points: np.ndarray) -> np.ndarray:
        """Of points (2, N) from the middle of the road."""
        return np.abs(np.hypot(*points) - self._radius(np.arctan2(*points[::-1])))

    def _draw(self, size: int) -> np.ndarray:
        row, column = np.mgrid[:size, :size].reshape(2, -1) / size
        ahead, left = 9 * (0.75 - row), 9 * (0.5 - column)  # where the pixels are, as the driver says
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        points = self.position[:, None] + np.stack([cos * ahead - sin * left, sin * ahead + cos * left])
        distance, even = self._distance(points)[:, None], (np.floor(points).sum(axis=0) % 2 == 0)[:, None]
        grass = np.where(even, (90, 190, 90), (75, 170, 75))
        picture = np.where(distance < self.HALF_WIDTH, (105, 105, 105), grass)
        picture = np.where(distance < 0.08, (235, 235, 235), picture)
        picture[(np.abs(ahead) < 0.5) & (np.abs(left) < 0.25)] = (210, 30, 30)
        picture[(row > 0.94) & (column < self.speed / self.TOP_SPEED)] = (250, 250, 250)
        return picture.reshape(size, size, 3).astype(np.uint8)


def make_track(seed: int = 0) -> VecEnv:
    """Monitor, vector of one environment, three frames stacked: what any image environment needs."""
    return VecFrameStack(make_vec_env(TrackEnv, seed=seed), 3)


def main() -> None:
    """Train, and compare with before."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=2_500, help="decisions to learn from")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    model = CRCSAC("CnnPolicy", make_track(given.seed), seed=given.seed, verbose=1, **SMALL)
    before, _ = evaluate_policy(model, make_track(1_000), n_eval_episodes=10)
    model.learn(given.steps, log_interval=10)
    after, _ = evaluate_policy(model, make_track(1_000), n_eval_episodes=10)
    print(f"per cent of a lap before it leaves the road or time is up: {before:.1f} untrained, {after:.1f} trained")


if __name__ == "__main__":
    main()
