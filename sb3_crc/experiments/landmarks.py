"""What policies that have learned nothing get: random actions, and none. What ``sb3-crc landmarks`` measures."""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_crc.envs.dmc import make_dmc
from sb3_crc.experiments.final import EPISODES, FIRST_SEED
from sb3_crc.experiments.provenance import provenance

Policy = Callable[[gym.Env[Any, Any]], np.ndarray]

POLICIES: dict[str, Policy] = {
    "random": lambda env: np.asarray(env.action_space.sample()),
    "zero": lambda env: np.zeros(env.action_space.shape or (), np.float32),
}


def measure_landmarks(tasks: Sequence[str], *, episodes: int = EPISODES, seed: int = FIRST_SEED) -> dict[str, Any]:
    """
    The episodes are those on which final policies are scored; nothing is drawn, since neither policy looks.

    :param tasks: domain-task
    :param episodes: of each policy on each task
    :param seed: of the environment and of the random actions
    :return: ``returns``: task -> policy -> the return of each episode, and on what they were measured
    :raises ValueError: for an unknown task
    """
    returns: dict[str, dict[str, list[float]]] = {}
    for task in tasks:
        returns[task] = {}
        for name, policy in POLICIES.items():
            env = make_dmc(task, seed=seed, observation="state", render_mode=None)
            returns[task][name] = [_episode(env, policy) for _ in range(episodes)]
            env.close()
    return {"episodes": episodes, "first_seed": seed, "returns": returns, "measured": provenance()}


def _episode(env: gym.Env[Any, Any], policy: Policy) -> float:
    env.reset()
    total, ended = 0.0, False
    while not ended:
        _, reward, terminated, truncated, _ = env.step(policy(env))
        total, ended = total + float(reward), terminated or truncated
    return round(total, 3)
