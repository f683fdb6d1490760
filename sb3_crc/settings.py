"""Which names and numbers the arguments may be."""

import difflib
import math
from collections.abc import Callable, Iterable, Sequence
from numbers import Integral
from typing import Any


def check_name(argument: str, value: object, known: Iterable[str]) -> None:
    """:raises ValueError: if ``value`` is not among the ``known``, with the nearest of them"""
    names = list(known)
    if value not in names:
        nearest = difflib.get_close_matches(str(value), names, n=1, cutoff=0)[0]
        raise ValueError(f"unknown {argument} {value!r}; did you mean {nearest!r}? Known: {', '.join(names)}")


def check_sizes(**sizes: int | Sequence[int]) -> None:
    """:raises ValueError: for the first of them that is, or has, a number below 1, or that has none"""
    for name, size in sizes.items():
        if min(size if isinstance(size, Sequence) else [size], default=0) < 1:
            raise ValueError(f"{name}={size} must be at least 1")


def _is_share(value: Any) -> bool:
    return not isinstance(value, bool) and bool(0 <= value <= 1)


def _is_count(value: Any, least: int = 1) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= least


_SHARE: tuple[Callable[[Any], bool], str] = _is_share, "in [0, 1]"
_COUNT: tuple[Callable[[Any], bool], str] = _is_count, "an integer >= 1"

#: Argument -> what it must fulfil, and that in words
RANGES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "tau": _SHARE,
    "encoder_tau": _SHARE,
    "gamma": _SHARE,
    "batch_size": _COUNT,
    "policy_delay": _COUNT,
    "auxiliary_interval": _COUNT,
    "q_augmentations": _COUNT,
    "target_augmentations": _COUNT,
    "target_update_interval": _COUNT,
    "n_steps": _COUNT,
    "gradient_steps": (lambda value: _is_count(value, -1), "an integer >= -1 (-1: as many as steps were taken)"),
    "initial_updates": (lambda value: _is_count(value, 0), "an integer >= 0"),
    "reward_scale": (math.isfinite, "finite"),
    "max_grad_norm": (lambda value: value is None or value > 0, "None or > 0"),
}


def check_ranges(model: object) -> None:
    """:raises ValueError: for the first attribute of ``model`` that is out of its range, or no number"""
    for name, (allows, words) in RANGES.items():
        value = getattr(model, name)
        try:
            allowed = allows(value)
        except TypeError:  # a string, None
            allowed = False
        if not allowed:
            raise ValueError(f"{name}={value!r} must be {words}")
