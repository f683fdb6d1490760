"""The state of a vectorised environment: what its wrappers keep, and each environment's own ``get_state``."""

import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers.utils import RunningMeanStd as Moments
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

from sb3_crc.checkpoints.tree import Tree, copied, is_plain

#: What SB3's Monitor keeps of the present episode and of those before
MONITOR = ("rewards", "needs_reset", "episode_returns", "episode_lengths", "episode_times", "total_steps")
#: Where a VecEnv keeps what its next reset is called with: evaluation environments may not have had one yet
NEXT_RESET = ("_seeds", "_options")
#: Of TimeLimit: the one state of a wrapper of Gymnasium that is reached where environments live in other processes
ELAPSED = "_elapsed_steps"
#: What a wrapper of Gymnasium holds that no step changes
UNCHANGING = (gym.Env, gym.Space, EnvSpec, type)


def vec_env_state(env: VecEnv) -> Tree:
    """
    :param env: environments, whatever they are wrapped in
    :return: what their future depends on. Of environments without ``get_state`` only the wrappers' state is held: they go on
        at their next reset, which is not exact, and :func:`set_vec_env_state` says so. Gymnasium's wrappers around what has
        ``get_state`` are held by their plain attributes; in other processes of these only TimeLimit's
    """
    wrappers = []
    while isinstance(env, VecEnvWrapper):
        wrappers.append(_plain_attributes(env))
        env = env.venv
    exact = all(env.has_attr(name) for name in ("get_state", "set_state"))
    return {
        "wrappers": wrappers,
        "environments": env.env_method("get_state") if exact else None,
        "gym_wrappers": [[_plain_attributes(one) for one in _outer(inner)] for inner in getattr(env, "envs", [])],
        "elapsed_steps": copied(env.get_attr(ELAPSED)) if env.has_attr(ELAPSED) else None,
        "monitors": [copied(env.get_attr(name)) for name in MONITOR] if all(env.env_is_wrapped(Monitor)) else None,
        "action_space": env.action_space.np_random.bit_generator.state,
        "next_reset": {name: copied(getattr(env, name)) for name in NEXT_RESET if is_plain(getattr(env, name))},
    }


def set_vec_env_state(env: VecEnv, state: Tree) -> bool:
    """
    :param env: made as the one that was saved, and reset
    :param state: of :func:`vec_env_state`
    :return: whether it goes on exactly where it was; False: it must be reset before its next step
    :raises ValueError: if the environments are others
    """
    for attributes in state["wrappers"]:
        if not isinstance(env, VecEnvWrapper):
            raise ValueError(f"{len(state['wrappers'])} wrappers were saved, this environment has fewer")
        _set_attributes(env, attributes)
        env = env.venv
    if isinstance(env, VecEnvWrapper):
        raise ValueError(f"{len(state['wrappers'])} wrappers were saved, this environment has more")
    env.action_space.np_random.bit_generator.state = state["action_space"]
    for name, value in state["next_reset"].items():
        setattr(env, name, copied(value))
    if state["environments"] is None:
        warnings.warn(
            "the environments have no get_state() and set_state(): the run goes on at the start of an episode, "
            "so it will not be bit for bit the one that was stopped",
            stacklevel=2,
        )
        return False
    if len(state["environments"]) != env.num_envs:
        raise ValueError(f"{len(state['environments'])} environments were saved, there are {env.num_envs} now")
    _set_environments(env, state)
    return True


def _set_environments(env: VecEnv, state: Tree) -> None:
    for index, own in enumerate(state["environments"]):
        env.env_method("set_state", own, indices=index)
    for index, value in enumerate(state.get("elapsed_steps") or []):
        env.env_method("set_wrapper_attr", ELAPSED, value, indices=index)
    for inner, saved in zip(getattr(env, "envs", []), state.get("gym_wrappers", []), strict=False):
        _set_outer(list(_outer(inner)), saved)
    for name, values in zip(MONITOR, state["monitors"] or [], strict=False):
        for index, value in enumerate(values):
            env.env_method("set_wrapper_attr", name, copied(value), indices=index)


def _outer(env: Any) -> Iterator[gym.Wrapper[Any, Any, Any, Any]]:
    """:return: the wrappers around what has ``get_state``, but for Monitor, the outermost first"""
    while isinstance(env, gym.Wrapper) and not hasattr(env, "get_state"):
        if not isinstance(env, Monitor):
            yield env
        env = env.env


def _set_outer(wrappers: list[gym.Wrapper[Any, Any, Any, Any]], saved: list[Tree]) -> None:
    if len(wrappers) != len(saved):
        raise ValueError(f"{len(saved)} wrappers around an environment were saved, there are {len(wrappers)} now")
    for wrapper, attributes in zip(wrappers, saved, strict=True):
        _set_attributes(wrapper, attributes)
        for name, value in vars(wrapper).items():
            known = name in attributes["plain"] or name in attributes["inner"] or callable(value)
            if not known and not name.startswith("_saved_kwargs") and not isinstance(value, UNCHANGING):
                warnings.warn(
                    f"{type(wrapper).__name__} keeps {name}, of type {type(value).__name__}, which checkpoints do not hold: "
                    "the run may not be bit for bit the one that was stopped",
                    stacklevel=4,
                )


def _plain_attributes(wrapper: Any) -> Tree:
    """VecFrameStack's stack, VecNormalize's moments, VecMonitor's sums: whatever is plain data or made of it."""
    plain, inner = {}, {}
    for name, value in vars(wrapper).items():
        if (state := _inner(value)) is not None:
            inner[name] = state
        elif is_plain(value):
            plain[name] = copied(value)
    return {"plain": plain, "inner": inner}


def _inner(value: Any) -> Tree | None:
    """:return: of the objects in which SB3's wrappers keep their state, their attributes"""
    if isinstance(value, dict) and value and all(isinstance(part, RunningMeanStd) for part in value.values()):
        return {"parts": {name: _inner(part) for name, part in value.items()}}
    if not isinstance(value, RunningMeanStd | Moments | StackedObservations):
        return None
    return {"attributes": {name: copied(part) for name, part in vars(value).items() if is_plain(part)}}


def _set_inner(value: Any, state: Tree) -> None:
    for name, part in state.get("parts", {}).items():
        _set_inner(value[name], part)
    for name, part in state.get("attributes", {}).items():
        setattr(value, name, copied(part))


def _set_attributes(wrapper: Any, attributes: Tree) -> None:
    for name, value in attributes["plain"].items():
        setattr(wrapper, name, copied(value))
    for name, state in attributes["inner"].items():
        _set_inner(getattr(wrapper, name), state)
