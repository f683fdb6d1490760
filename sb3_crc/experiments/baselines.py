"""What a policy that has learned nothing gets: the floor under every learning curve."""

from dataclasses import asdict, dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_crc.envs.dmc import make_dmc


@dataclass(frozen=True)
class Baseline:
    """
    Returns of one policy without learning.

    :param mean: over the episodes
    :param std: over the episodes, with n - 1
    :param returns: of each episode
    """

    mean: float
    std: float
    returns: tuple[float, ...]


class _Untrained:
    """Uniformly random actions, or always the middle of the action space."""

    def __init__(self, action_space: gym.spaces.Box, random: bool):
        self.action_space = action_space
        self.random = random

    def predict(self, observations: np.ndarray, *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        middle = (self.action_space.low + self.action_space.high) / 2
        actions = [self.action_space.sample() if self.random else middle for _ in observations]
        return np.stack(actions), None


def measure_baselines(
    task: str, *, episodes: int = 20, action_repeat: int | None = None, seed: int = 0
) -> dict[str, dict[str, Any]]:
    """
    Measure the returns of the random and of the zero policy. Nothing is rendered: neither looks.

    :param task: as for :func:`~sb3_crc.make_dmc`
    :param episodes: of each policy
    :param action_repeat: environment steps per action; None: the task's own
    :param seed: of initial states and random actions
    :return: ``{"random": {mean, std, returns}, "zero": {...}}``
    """
    baselines = {}
    for name in ("random", "zero"):
        env = Monitor(make_dmc(task, seed=seed, action_repeat=action_repeat, observation="state"))
        policy = _Untrained(env.action_space, random=name == "random")  # type: ignore[arg-type]
        returns, _ = evaluate_policy(
            policy,  # type: ignore[arg-type]
            env,
            n_eval_episodes=episodes,
            return_episode_rewards=True,
        )
        env.close()
        assert isinstance(returns, list)
        baselines[name] = asdict(Baseline(float(np.mean(returns)), float(np.std(returns, ddof=1)), tuple(map(float, returns))))
    return baselines
