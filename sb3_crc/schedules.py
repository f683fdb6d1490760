"""Learning rates that change with the progress of training."""

import torch as th
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule

LearningRate = float | str | Schedule


def lr_schedule(learning_rate: LearningRate) -> FloatSchedule:
    """
    :param learning_rate: a number, a schedule of the remaining progress (1 to 0), or ``"lin_x"``: from x down to 0
    :return: learning rate as a function of the remaining progress
    :raises ValueError: for any other string
    """
    if isinstance(learning_rate, str):
        kind, _, start = learning_rate.partition("_")
        try:
            value = float(start)
        except ValueError:
            kind = "unknown"
        if kind != "lin":
            raise ValueError(f"unknown learning rate {learning_rate!r}; expected a number, a schedule or 'lin_x', x a number")
        return FloatSchedule(LinearSchedule(value, 0.0, 1.0))
    return FloatSchedule(learning_rate)


def check_learning_rate(name: str, value: float) -> None:
    """:raises ValueError: unless ``value`` is a finite number >= 0"""
    if not 0 <= value < float("inf"):
        raise ValueError(f"{name} must be a finite number >= 0, got {value}")


def set_learning_rate(optimizer: th.optim.Optimizer, learning_rate: float) -> None:
    """Set the rate of every parameter group, times the group's ``lr_factor`` if it has one."""
    for group in optimizer.param_groups:
        value = learning_rate * group.get("lr_factor", 1)
        if isinstance(group["lr"], th.Tensor):  # read by recorded updates, where it lies
            group["lr"].fill_(value)
        else:
            group["lr"] = value
