"""What ``-optimize`` draws, and what becomes of it: arguments of CRCSAC, with everything that is not drawn kept.

rl_zoo3 replaces whole arguments by what a sampler returns. Therefore nothing of ``policy_kwargs`` is returned, and the drawn
weights are put into the configuration's own ``objectives``, whose other settings stay.
"""

import math
from collections.abc import Mapping
from typing import Any

import optuna

#: Where a trial keeps its arguments, ready to be used
ARGUMENTS = "arguments"

Configuration = Mapping[str, Any]
Parameters = dict[str, Any]


def sample(
    configuration: Configuration, trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    A sampler for ``rl_zoo3.hyperparams_opt.HYPERPARAMS_SAMPLER``, once its first argument is bound.

    :param configuration: CRCSAC's arguments, with at least ``objectives`` and ``augmentation``; ranges depend on them
    :param trial: to draw from; its user attribute :data:`ARGUMENTS` will hold what is returned
    :param n_actions: the zoo's, not used
    :param n_envs: environments that are stepped at once
    :param additional_args: the zoo's, not used
    :return: CRCSAC's arguments that take the place of the configuration's
    """
    arguments = constructor_arguments(configuration, draw(configuration, trial), n_envs)
    trial.set_user_attr(ARGUMENTS, arguments)
    return arguments


def draw(configuration: Configuration, trial: optuna.Trial) -> Parameters:
    """
    :param configuration: see :func:`sample`
    :param trial: to draw from
    :return: the trial's parameters: numbers by name
    """
    objectives = configuration["objectives"]
    # Batches larger than what is stored at the first update are refused.
    largest_batch = min(9, int(math.log2(configuration.get("learning_starts", 1_000))))
    parameters: Parameters = {
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 2e-3, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", min(6, largest_batch), largest_batch),
        "tau": trial.suggest_float("tau", 0.005, 0.05, log=True),
        "encoder_tau": trial.suggest_float("encoder_tau", 0.01, 0.1, log=True),
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.003, 0.05, log=True),
    }
    if _decisions_between_updates(configuration) is not None:
        parameters["replay_ratio"] = trial.suggest_int("replay_ratio", 1, 4)
    if objectives and not configuration.get("joint_update", False):  # a joint update has no optimizer of its own for them
        parameters["encoder_learning_rate"] = trial.suggest_float("encoder_learning_rate", 1e-5, 2e-3, log=True)
    if len(objectives) > 1:  # Adam is blind to the scale of a single one
        for name in objectives:
            parameters[f"share_{name}"] = trial.suggest_float(f"share_{name}", 0.05, 1, log=True)
    if configuration["augmentation"] == "random_shift":
        parameters["pad"] = trial.suggest_int("pad", 2, 8)
    return parameters


def constructor_arguments(
    configuration: Configuration, parameters: Mapping[str, Any], n_envs: int | None = None
) -> dict[str, Any]:
    """
    A converter for ``rl_zoo3.hyperparams_opt.HYPERPARAMS_CONVERTER``, once its first argument is bound.

    :param configuration: see :func:`sample`
    :param parameters: what :func:`draw` returned
    :param n_envs: environments that are stepped at once; None: the configuration's
    :return: CRCSAC's arguments that take the place of the configuration's; plain values
    """
    arguments = dict(parameters)
    arguments["batch_size"] = 2 ** arguments.pop("batch_size_pow")
    arguments["gamma"] = 1 - arguments.pop("one_minus_gamma")
    if "replay_ratio" in arguments:
        decisions = _decisions_between_updates(configuration) or 1
        n_envs = configuration.get("n_envs", 1) if n_envs is None else n_envs
        arguments["gradient_steps"] = arguments.pop("replay_ratio") * decisions * n_envs
    shares = {name: arguments.pop(f"share_{name}") for name in configuration["objectives"] if f"share_{name}" in arguments}
    if shares:
        arguments["objectives"] = {
            name: _with_weight(setting, shares[name] / sum(shares.values()))
            for name, setting in configuration["objectives"].items()
        }
    if "pad" in arguments:
        arguments["augmentation_kwargs"] = {
            **(configuration.get("augmentation_kwargs") or {}),
            "pad": arguments.pop("pad"),
        }
    return arguments


def _with_weight(setting: float | Mapping[str, Any], weight: float) -> float | dict[str, Any]:
    return {**setting, "weight": weight} if isinstance(setting, Mapping) else weight


def _decisions_between_updates(configuration: Configuration) -> int | None:
    """Decisions of each environment between two calls of ``train()``; None: whole episodes, whose length nobody knows."""
    train_freq = configuration.get("train_freq", 1)
    if isinstance(train_freq, int):
        return train_freq
    count, unit = train_freq
    return int(count) if unit == "step" else None
