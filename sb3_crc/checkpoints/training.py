"""Everything on which the future of a training depends, but for the frames of the replay buffer."""

from collections.abc import Iterator
from inspect import signature

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EventCallback
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import recursive_getattr

from sb3_crc.checkpoints.environments import set_vec_env_state, vec_env_state
from sb3_crc.checkpoints.logs import log_state, set_log_state
from sb3_crc.checkpoints.tree import Tree, copied, in_type_of, is_plain, random_states, set_random_states

#: Counters, the last observation, and the episodes that the log's means are over. ``_total_timesteps`` is not among them: it
#: is what ``learn`` was called with
COUNTERS = (
    "num_timesteps",
    "_episode_num",
    "_n_updates",
    "_n_calls",
    "_current_progress_remaining",
    "exploration_rate",
    "_last_obs",
    "_last_episode_starts",
    "_last_original_obs",
    "ep_info_buffer",
    "ep_success_buffer",
    "_env_steps",
    "_skipped_updates",
    "_skipped_transitions",
)
#: Arguments of an algorithm that change nothing of what a training comes to, or that are told of elsewhere
INCIDENTAL = (
    *("verbose", "tensorboard_log", "device", "stats_window_size"),
    *("overlap", "compile", "replay_device", "buffer_size"),
)
#: Of a callback: what every callback has of the training, and what only describes the present moment
NOT_STATE = ("locals", "globals", "verbose")


def training_state(model: OffPolicyAlgorithm, callback: BaseCallback) -> Tree:
    """
    :param model: at the start of a rollout, where environments, counters, buffer and networks agree
    :param callback: the root of the callbacks that ``learn`` was given
    :return: a tree of plain data, which shares no memory with the model
    """
    state_dicts, variables = model._get_torch_save_params()
    assert model.env is not None
    return {
        "random": random_states(),
        "arguments": copied(plain_arguments(model)),
        "networks": copied({name: recursive_getattr(model, name).state_dict() for name in state_dicts}),
        "variables": copied({name: recursive_getattr(model, name) for name in variables}),
        "counters": {name: copied(getattr(model, name)) for name in COUNTERS if hasattr(model, name)},
        "collapse_alarm": getattr(getattr(model, "_collapse_alarm", None), "_updates", None),
        "action_noise": _noise_state(model.action_noise),
        "action_space": model.action_space.np_random.bit_generator.state,
        "environment": vec_env_state(model.env),
        "log": log_state(model.logger, model.env),
        "callbacks": [callback_state(one) for one in callback_tree(callback)],
    }


def plain_arguments(model: OffPolicyAlgorithm) -> dict[str, Tree]:
    """:return: what the model was made with, as far as it is plain data"""
    names = {name for cls in type(model).__mro__ if issubclass(cls, OffPolicyAlgorithm) for name in signature(cls).parameters}
    found = {name: getattr(model, name, None) for name in sorted(names - {*INCIDENTAL})}
    return {name: value for name, value in found.items() if is_plain(value)}


def other_arguments(model: OffPolicyAlgorithm, state: Tree) -> list[str]:
    """:return: for each argument that differs from the saved training's, in words what both are"""
    saved, own = state.get("arguments", {}), copied(plain_arguments(model))
    differing = [name for name in saved if name in own and repr(saved[name]) != repr(own[name])]
    return [f"{name}={saved[name]!r}, not {own[name]!r}" for name in differing]


def set_training_state(model: OffPolicyAlgorithm, callback: BaseCallback, state: Tree) -> None:
    """
    Go on where :func:`training_state` was called.

    :param model: made with the same arguments, in environments made the same, after ``_setup_learn``
    :param callback: the same callbacks
    :param state: is not changed
    :raises ValueError: if anything does not fit, naming it; the model is then not to be used
    """
    assert model.env is not None
    _set_networks(model, state)
    for name, value in state["counters"].items():
        setattr(model, name, copied(value))
    if state["collapse_alarm"] is not None:
        model._collapse_alarm._updates = state["collapse_alarm"]  # type: ignore[attr-defined]
    _set_noise_state(model.action_noise, state["action_noise"])
    model.action_space.np_random.bit_generator.state = state["action_space"]
    if not set_vec_env_state(model.env, state["environment"]):
        model._last_obs = model.env.reset()  # type: ignore[assignment]  # also of wrappers, which had been in an episode
        if model._vec_normalize_env is not None:
            model._last_original_obs = model._vec_normalize_env.get_original_obs()
        model._last_episode_starts = np.ones(model.env.num_envs, dtype=bool)
    set_log_state(model.logger, model.env, state["log"])
    callbacks = list(callback_tree(callback))
    names = [type(one).__name__ for one in callbacks]
    saved_names = [one["name"] for one in state["callbacks"]]
    if names != saved_names:
        raise ValueError(f"the callbacks are {', '.join(names)}; those of the saved run were {', '.join(saved_names)}")
    for one, own in zip(callbacks, state["callbacks"], strict=True):
        set_callback_state(one, own)
    set_random_states(state["random"])


def callback_tree(callback: BaseCallback) -> Iterator[BaseCallback]:
    """:param callback: the root; :return: it and all callbacks below it, in an order that depends on nothing else"""
    yield callback
    children: list[BaseCallback | None] = list(callback.callbacks) if isinstance(callback, CallbackList) else []
    if isinstance(callback, EventCallback):
        children.append(callback.callback)
    if isinstance(callback, EvalCallback):
        children.append(callback.callback_on_new_best)
    for child in children:
        if child is not None:
            yield from callback_tree(child)


def callback_state(callback: BaseCallback) -> Tree:
    """
    :param callback: any; one that keeps more than plain data may have methods ``training_state()`` and
        ``set_training_state(state)``
    :return: its attributes that are plain data, without its constructor's arguments, and its evaluation environment's state
    """
    classes = [cls for cls in type(callback).__mro__ if issubclass(cls, BaseCallback)]
    arguments = {name for cls in classes for name in signature(cls).parameters}
    attributes = {
        name: copied(value)
        for name, value in vars(callback).items()
        if name not in arguments and name not in NOT_STATE and is_plain(value)
    }
    state = {"name": type(callback).__name__, "attributes": attributes}
    if isinstance(callback, EvalCallback):
        state["environment"] = vec_env_state(callback.eval_env)
    if hasattr(callback, "training_state"):
        state["own"] = copied(callback.training_state())
    return state


def set_callback_state(callback: BaseCallback, state: Tree) -> None:
    """:param callback: of the same class; :param state: of :func:`callback_state`"""
    for name, value in copied(state["attributes"]).items():
        setattr(callback, name, in_type_of(getattr(callback, name, None), value))
    if isinstance(callback, EvalCallback):
        callback.eval_env.reset()
        set_vec_env_state(callback.eval_env, state["environment"])
    if "own" in state:
        callback.set_training_state(copied(state["own"]))  # type: ignore[attr-defined]


def _set_networks(model: OffPolicyAlgorithm, state: Tree) -> None:
    for kind, own in zip(("networks", "variables"), model._get_torch_save_params(), strict=True):
        if differing := sorted(set(own) ^ state[kind].keys()):
            raise ValueError(f"{', '.join(differing)}: there is none in the saved training, or none in this one")
    for name, value in state["networks"].items():
        try:
            recursive_getattr(model, name).load_state_dict(copied(value))
        except (RuntimeError, ValueError, KeyError) as error:
            raise ValueError(f"{name} is not the one that was saved: {error}") from error
    if hasattr(model, "forget_recordings"):
        model.forget_recordings()
    for name, value in state["variables"].items():
        recursive_getattr(model, name).data.copy_(value)


def _noise_state(noise: ActionNoise | None) -> Tree:
    if isinstance(noise, VectorizedActionNoise):
        return [_noise_state(one) for one in noise.noises]
    return None if noise is None else {name: copied(value) for name, value in vars(noise).items() if is_plain(value)}


def _set_noise_state(noise: ActionNoise | None, state: Tree) -> None:
    if (noise is None, isinstance(noise, VectorizedActionNoise)) != (state is None, isinstance(state, list)):
        raise ValueError(f"the action noise {noise} is not of the kind that was saved")
    if isinstance(noise, VectorizedActionNoise):
        for one, own in zip(noise.noises, state, strict=True):
            _set_noise_state(one, own)
    elif noise is not None:
        vars(noise).update(copied(state))
