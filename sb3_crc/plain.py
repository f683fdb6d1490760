"""Attributes of a saved model as plain JSON, so that reading it back executes nothing.

SB3 writes what JSON does not know as a pickle into its zip, and unpickles it when it loads. Here each such value that has a
plain form gets one, as ``{"type": name, ...}``; what has none stays a pickle: schedules and classes of the user's own.
"""

import base64
import io
import json
import math
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from torch import nn

from sb3_crc.buffers import DictFrameReplayBuffer, FrameReplayBuffer
from sb3_crc.encoder import PixelEncoder
from sb3_crc.policies import CRCPolicy

#: Activation functions that may be named
ACTIVATIONS: dict[str, type[nn.Module]] = {
    one.__name__: one for one in (nn.ReLU, nn.Tanh, nn.ELU, nn.GELU, nn.LeakyReLU, nn.SiLU, nn.Mish)
}
#: Classes that may be named
CLASSES: dict[str, type] = ACTIVATIONS | {
    one.__name__: one
    for one in (
        *(CRCPolicy, PixelEncoder, FrameReplayBuffer, DictFrameReplayBuffer),
        *(ReplayBuffer, DictReplayBuffer, NStepReplayBuffer),
        *(th.optim.Adam, th.optim.AdamW, th.optim.RMSprop, th.optim.SGD),
    )
}
#: Bytes of an array that is given as such
LARGEST_ARRAY = 1 << 28
#: Kinds of NumPy's types that are numbers
ARRAY_TYPES = "biuf"


class NotPlain(ValueError):
    """There is no plain form of this value, or this is none."""


def to_plain(value: Any) -> Any:
    """
    :param value: of an attribute
    :return: JSON from which :func:`from_plain` makes an equal value
    :raises NotPlain: if there is none
    """
    if value is None or isinstance(value, bool | str) or type(value) in (int, float):
        return value
    if isinstance(value, type):
        if CLASSES.get(value.__name__) is not value:
            raise NotPlain(f"{value.__name__} is a class of the user's own")
        return {"type": "class", "name": value.__name__}
    for name, (kind, write, _) in _FORMS.items():
        if type(value) is kind or (kind is dict and type(value) is OrderedDict):
            return {"type": name, **write(value)}
    if isinstance(value, np.generic) and value.dtype.kind in ARRAY_TYPES:
        return {"type": "scalar", **_write_array(np.asarray(value))}
    raise NotPlain(f"{type(value).__name__} has no plain form")


def from_plain(form: Any) -> Any:
    """
    :param form: of :func:`to_plain`, from anyone
    :return: the value
    :raises NotPlain: for anything else
    """
    if form is None or isinstance(form, bool | str | int | float):
        return form
    try:
        kind = form["type"]
        if kind == "class":
            return CLASSES[form["name"]]
        if kind == "scalar":
            return _read_array(form)[()]
        _, _, read = _FORMS[kind]
        return read(form)
    except Exception as error:  # numpy and Gymnasium raise nearly anything for what strangers write
        raise NotPlain(f"no plain form of a value: {str(form)[:80]!r}: {error}") from error


def plain_attributes(data: Mapping[str, Any]) -> str:
    """:param data: attributes of a model; :return: JSON of those that have a plain form"""
    found = {}
    for name, value in data.items():
        try:
            found[name] = to_plain(value)
        except NotPlain:
            continue
    return json.dumps(found)


def read_plain_attributes(text: str | bytes) -> dict[str, Any]:
    """
    :param text: of :func:`plain_attributes`, from anyone
    :return: the attributes, by name
    :raises NotPlain: if it is no such text
    """
    try:
        forms = json.loads(text, object_pairs_hook=unique_keys)
    except (ValueError, RecursionError) as error:
        raise NotPlain(f"no JSON: {error}") from error
    if not isinstance(forms, dict):
        raise NotPlain("no JSON mapping")
    return {name: from_plain(form) for name, form in forms.items()}


def unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """:param pairs: of a JSON mapping, as json.loads hands them over; :raises ValueError: if a key is there twice"""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key is there twice")
    return found


def _write_array(array: np.ndarray) -> dict[str, Any]:
    if array.dtype.kind not in ARRAY_TYPES:
        raise NotPlain(f"an array of {array.dtype}")
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return {"npy": base64.b64encode(buffer.getvalue()).decode("ascii")}


def _read_array(form: Mapping[str, Any]) -> np.ndarray:
    content = base64.b64decode(form["npy"], validate=True)
    if len(content) > LARGEST_ARRAY:
        raise ValueError(f"an array of {len(content)} bytes")
    buffer = io.BytesIO(content)
    major, _ = np.lib.format.read_magic(buffer)
    header = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
    shape, _, dtype = header(buffer)
    if math.prod(shape) * dtype.itemsize != len(content) - buffer.tell():  # before memory is claimed
        raise ValueError(f"an array of shape {shape} in {len(content)} bytes")
    buffer.seek(0)
    return np.lib.format.read_array(buffer, allow_pickle=False)


def _write_box(space: spaces.Box) -> dict[str, Any]:
    if space.dtype.kind not in ARRAY_TYPES:
        raise NotPlain(f"a Box of {space.dtype}")
    bounds = {}
    for name, bound in (("low", space.low), ("high", space.high)):
        values = np.unique(bound)
        bounds[name] = _write_array(values if len(values) == 1 else bound)
    return {"shape": list(space.shape), "dtype": str(space.dtype), **bounds}


def _read_box(form: Mapping[str, Any]) -> spaces.Box:
    shape, dtype = tuple(map(int, form["shape"])), np.dtype(str(form["dtype"]))
    if dtype.kind not in ARRAY_TYPES or min(shape, default=1) < 0 or math.prod(shape) * dtype.itemsize > LARGEST_ARRAY:
        raise ValueError(f"a Box of shape {shape} and type {dtype}")
    low, high = (_read_array(form[name]) for name in ("low", "high"))
    low, high = (np.broadcast_to(bound, shape).astype(dtype) for bound in (low, high))
    return spaces.Box(low, high, shape, dtype.type)


def _read_schedule(form: Mapping[str, Any]) -> FloatSchedule:
    inner = from_plain(form["of"])
    if not isinstance(inner, ConstantSchedule | LinearSchedule):
        raise ValueError(f"a schedule of {inner!r}")
    return FloatSchedule(inner)


def _write_mapping(mapping: dict[Any, Any]) -> dict[str, Any]:
    return {"items": [[to_plain(key), to_plain(value)] for key, value in mapping.items()]}


def _write_deque(values: deque[Any]) -> dict[str, Any]:
    return {"length": values.maxlen, "items": [to_plain(value) for value in values]}


_Form = tuple[type, Callable[[Any], dict[str, Any]], Callable[[Any], Any]]
#: Name -> type, what writes it and what reads it
_FORMS: dict[str, _Form] = {
    "array": (np.ndarray, _write_array, _read_array),
    "box": (spaces.Box, _write_box, _read_box),
    "dict space": (
        spaces.Dict,
        lambda space: {"items": [[name, to_plain(one)] for name, one in space.spaces.items()]},
        lambda form: spaces.Dict({str(name): from_plain(one) for name, one in form["items"]}),
    ),
    "discrete": (
        spaces.Discrete,
        lambda space: {"n": int(space.n), "start": int(space.start)},
        lambda form: spaces.Discrete(int(form["n"]), start=int(form["start"])),
    ),
    "deque": (deque, _write_deque, lambda form: deque(map(from_plain, form["items"]), form["length"])),
    "train_freq": (
        TrainFreq,
        lambda value: {"frequency": value.frequency, "unit": value.unit.value},
        lambda form: TrainFreq(int(form["frequency"]), TrainFrequencyUnit(form["unit"])),
    ),
    "schedule": (FloatSchedule, lambda schedule: {"of": to_plain(schedule.value_schedule)}, _read_schedule),
    "constant": (
        ConstantSchedule,
        lambda schedule: {"value": float(schedule.val)},
        lambda form: ConstantSchedule(float(form["value"])),
    ),
    "linear": (
        LinearSchedule,
        lambda schedule: {"ends": [float(schedule.start), float(schedule.end), float(schedule.end_fraction)]},
        lambda form: LinearSchedule(*map(float, form["ends"])),
    ),
    "list": (
        list,
        lambda value: {"items": [to_plain(one) for one in value]},
        lambda form: [from_plain(one) for one in form["items"]],
    ),
    "tuple": (
        tuple,
        lambda value: {"items": [to_plain(one) for one in value]},
        lambda form: tuple(from_plain(one) for one in form["items"]),
    ),
    "mapping": (dict, _write_mapping, lambda form: {from_plain(key): from_plain(value) for key, value in form["items"]}),
}
