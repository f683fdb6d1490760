"""Which names and numbers the arguments may be."""

import difflib
import math
import reprlib
from collections.abc import Callable, Iterable, Sequence
from numbers import Integral
from typing import Any

#: Names that are less like one than this are not taken for its misspelling
LIKENESS = 0.4
#: Argument -> what to give where nothing shall be done, which None and "none" are not
INSTEAD_OF_NONE = {
    "augmentation": "to leave pixels as they are use 'center_crop', which cuts out the middle, or nothing at the frame's size",
    "objective_augmentation": "without a view of their own, which is None and not a text, objectives see what the critic sees",
}


def check_name(argument: str, value: object, known: Iterable[str]) -> None:
    """:raises ValueError: if ``value`` is not among the ``known``, with the nearest of them, if one is near"""
    names = list(known)
    if value in names:
        return
    if str(value).lower() == "none" and argument in INSTEAD_OF_NONE:
        hint = f": {INSTEAD_OF_NONE[argument]}."
    else:
        lower = {name.lower(): name for name in names}
        nearest = difflib.get_close_matches(str(value).lower(), lower, n=1, cutoff=LIKENESS)
        hint = f"; did you mean {lower[nearest[0]]!r}?" if nearest else "."
    raise ValueError(f"unknown {argument} {value!r}{hint} Known: {', '.join(names)}")


def check_sizes(**sizes: int | Sequence[int]) -> None:
    """:raises ValueError: for the first of them that is, or has, no integer or one below 1, or that has none"""
    for name, size in sizes.items():
        numbers = [size] if isinstance(size, str) or not isinstance(size, Sequence) else size
        if not all(is_count(number, -math.inf) for number in numbers):
            raise ValueError(f"{name}={size!r}: only integers of at least 1 are allowed")
        if min(numbers, default=0) < 1:
            raise ValueError(f"{name}={size} must be at least 1")


def height_and_width(argument: str, size: Any) -> tuple[int, int]:
    """
    :param argument: its name
    :param size: one integer for both sides, or a sequence of two
    :return: height and width
    :raises ValueError: for anything else
    """
    if is_count(size, -math.inf):
        return int(size), int(size)
    if isinstance(size, Sequence) and len(size) == 2 and all(is_count(side, -math.inf) for side in size):
        return int(size[0]), int(size[1])
    raise ValueError(f"{argument}={size!r} must be an integer, or two of them: (height, width)")


def described(value: Any) -> str:
    """:return: an array's or tensor's kind, type and shape, of anything else how it is written, shortened"""
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        return f"a {type(value).__name__} of shape {tuple(value.shape)} and type {str(value.dtype).removeprefix('torch.')}"
    return reprlib.repr(value)


def is_count(value: Any, least: float = 1) -> bool:
    """Whether it is an integer, which a bool is not, of at least ``least``."""
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= least


def _is_share(value: Any) -> bool:
    return not isinstance(value, bool) and bool(0 <= value <= 1)


_SHARE: tuple[Callable[[Any], bool], str] = _is_share, "in [0, 1]"
_COUNT: tuple[Callable[[Any], bool], str] = is_count, "an integer >= 1"

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
    "gradient_steps": (lambda value: is_count(value, -1), "an integer >= -1 (-1: as many as steps were taken)"),
    "initial_updates": (lambda value: is_count(value, 0), "an integer >= 0"),
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
