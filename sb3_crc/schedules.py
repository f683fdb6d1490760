"""Learning rates that change with the progress of training."""

import torch as th
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule

LearningRate = float | str | Schedule


def lr_schedule(learning_rate: LearningRate) -> FloatSchedule:
    """
    :param learning_rate: a number, a schedule of the remaining progress (1 to 0), ``"lin_x"``: from x down to 0 at the end, or
        ``"lin_x_f"``: from x down to 0 when a share f of the training is done, and 0 from there on
    :return: learning rate as a function of the remaining progress
    :raises ValueError: for any other string
    """
    if not isinstance(learning_rate, str):
        return FloatSchedule(learning_rate)
    kind, *numbers = learning_rate.split("_")
    try:
        start, share = (float(number) for number in [*numbers, "1"][:2])
        known = kind == "lin" and len(numbers) <= 2 and 0 < share <= 1
    except ValueError:
        known = False
    if not known:
        raise ValueError(
            f"unknown learning rate {learning_rate!r}; expected a number, a schedule, 'lin_x' or 'lin_x_f', x a number and f "
            "the share of the training, above 0 and at most 1, after which 0 is reached"
        )
    return FloatSchedule(LinearSchedule(start, 0.0, share))


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
