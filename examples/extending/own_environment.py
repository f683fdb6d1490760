"""An environment of one's own: a disc is to be moved into the middle of a square.

python examples/extending/own_environment.py --agent-steps 5000
"""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TimeLimit

from sb3_crc import CRCSAC

SIDE = 40


class CentreTheDisc(gym.Env[np.ndarray, np.ndarray]):
    """
    Pictures are uint8 and channel-first, ``(3, 40, 40)``; an action is a velocity in [-1, 1]^2; the reward is minus the
    distance of the disc from the middle. An episode has no end of its own: the time limit truncates it.

    The place of the disc is all that there is to know, and one picture shows it. Where velocities matter, stack frames:
    SB3's VecFrameStack, or a stack of your own with the attribute ``frame_channels``.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    frame_channels = 3  # of one frame, for the replay buffer
    action_repeat = 1  # environment steps of one step(), for logs and axes

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Box(0, 255, (3, SIDE, SIDE), np.uint8)
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.place = np.zeros(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Put the disc somewhere."""
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1, 1, size=2)
        return self.picture(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Move it."""
        self.place = np.clip(self.place + 0.2 * action, -1, 1)
        return self.picture(), -float(np.linalg.norm(self.place)), False, False, {}

    def picture(self) -> np.ndarray:
        """:return: uint8 ``(3, SIDE, SIDE)``, a new array at each call"""
        centre = (self.place + 1) / 2 * (SIDE - 1)
        rows, columns = np.mgrid[:SIDE, :SIDE]
        disc = (rows - centre[0]) ** 2 + (columns - centre[1]) ** 2 <= 16
        picture = np.zeros((3, SIDE, SIDE), np.uint8)
        picture[0] = 255 * disc
        return picture

    def render(self) -> np.ndarray:
        """:return: uint8 ``(SIDE, SIDE, 3)``, for films"""
        return self.picture().transpose(1, 2, 0)

    # With these two a training that was interrupted goes on bit for bit; without them, at a new episode

    def get_state(self) -> dict[str, Any]:
        """:return: everything on which the future depends: arrays, numbers and strings"""
        return {"place": self.place.copy(), "random": self.np_random.bit_generator.state}

    def set_state(self, state: dict[str, Any]) -> None:
        """:param state: of :meth:`get_state`"""
        self.place = np.array(state["place"])
        self.np_random.bit_generator.state = state["random"]


gym.register("own/CentreTheDisc-v0", CentreTheDisc, max_episode_steps=50)


def main(arguments: list[str] | None = None) -> CRCSAC:
    """Train for a moment in it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agent-steps", type=int, default=250, help="decisions, each of which is an environment step")
    options = parser.parse_args(arguments)
    env = TimeLimit(CentreTheDisc(), 50)
    model = CRCSAC("CnnPolicy", env, augmentation="random_shift", learning_starts=100, batch_size=32, verbose=1, seed=0)
    return model.learn(options.agent_steps, log_interval=1)


if __name__ == "__main__":
    main()
