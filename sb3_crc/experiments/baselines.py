"""What policies that have learned nothing get, random actions and none: the floor under every learning curve.

``sb3-crc baselines`` measures one task, for its curve; ``sb3-crc landmarks`` several, on the episodes of final scores. Nothing
is drawn, since neither policy looks.
"""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_crc.envs.dmc import make_dmc
from sb3_crc.envs.tasks import split_task
from sb3_crc.experiments.final import EPISODES, FIRST_SEED
from sb3_crc.experiments.provenance import provenance

Policy = Callable[[gym.Env[Any, Any]], np.ndarray]

POLICIES: dict[str, Policy] = {
    "random": lambda env: np.asarray(env.action_space.sample()),
    "zero": lambda env: np.zeros(env.action_space.shape or (), np.float32),
}


def measure_baselines(
    task: str, *, episodes: int = 20, action_repeat: int | None = None, seed: int = 0
) -> dict[str, dict[str, Any]]:
    """
    :param task: as for :func:`~sb3_crc.make_dmc`
    :param episodes: of each policy, at least two
    :param action_repeat: environment steps per action; None: the task's own
    :param seed: of initial states and random actions
    :return: ``{"random": {mean, std, returns}, "zero": {...}}``, std over the episodes, with n - 1
    :raises ValueError: for an unknown task
    """
    return {
        name: {"mean": float(np.mean(returns)), "std": float(np.std(returns, ddof=1)), "returns": returns}
        for name, returns in _returns(task, episodes, seed, action_repeat).items()
    }


def measure_landmarks(tasks: Sequence[str], *, episodes: int = EPISODES, seed: int = FIRST_SEED) -> dict[str, Any]:
    """
    :param tasks: domain-task
    :param episodes: of each policy on each task
    :param seed: of the environment and of the random actions
    :return: ``returns``: task -> policy -> the return of each episode, and on what they were measured
    :raises ValueError: for an unknown task, before anything is measured
    """
    for task in tasks:
        split_task(task)
    returns = {
        task: {name: [round(value, 3) for value in own] for name, own in _returns(task, episodes, seed).items()}
        for task in tasks
    }
    return {"episodes": episodes, "first_seed": seed, "returns": returns, "measured": provenance()}


def _returns(task: str, episodes: int, seed: int, action_repeat: int | None = None) -> dict[str, list[float]]:
    """:return: policy -> return of each episode"""
    found = {}
    for name, policy in POLICIES.items():
        env = make_dmc(task, seed=seed, action_repeat=action_repeat, observation="state", render_mode=None)
        found[name] = [_episode(env, policy) for _ in range(episodes)]
        env.close()
    return found


def _episode(env: gym.Env[Any, Any], policy: Policy) -> float:
    env.reset()
    total, ended = 0.0, False
    while not ended:
        _, reward, terminated, truncated, _ = env.step(policy(env))
        total, ended = total + float(reward), terminated or truncated
    return total
