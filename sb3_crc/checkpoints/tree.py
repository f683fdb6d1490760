"""Trees of plain data, and how they become one file of arrays and one of JSON, without pickle."""

import copy
import json
import random
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from safetensors import safe_open
from safetensors.torch import save

#: What a tree is made of: None, numbers, strings, arrays and tensors, in dictionaries, lists, tuples and deques
Tree = Any

SCALARS = (type(None), bool, int, float, str)
ARRAYS, STRUCTURE = "arrays.safetensors", "structure.json"


def is_plain(value: Any) -> bool:
    """:return: whether ``value`` is a tree, all the way down"""
    if isinstance(value, Mapping):
        return all(isinstance(key, int | str) and is_plain(item) for key, item in value.items())
    if isinstance(value, list | tuple | deque):
        return all(map(is_plain, value))
    return type(value) in SCALARS or isinstance(value, th.Tensor) or _is_numeric(value)


def _is_numeric(value: Any) -> bool:
    return isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biuf"


def write_tree(tree: Tree, folder: Path) -> None:
    """
    :param tree: what to write
    :param folder: an existing one, for the two files
    :raises TypeError: for anything that is not plain data, naming where it is
    """
    arrays: dict[str, th.Tensor] = {}
    structure = _encode(tree, arrays, "")
    _write_arrays(arrays, folder / ARRAYS)
    (folder / STRUCTURE).write_text(json.dumps(structure), encoding="utf-8")


def _write_arrays(arrays: dict[str, th.Tensor], path: Path) -> None:
    """As ``save_file()``, which would let nobody but the owner read it."""
    path.write_bytes(save(arrays))


def read_tree(folder: Path) -> Tree:
    """:param folder: of :func:`write_tree`; :return: an equal tree, all arrays and tensors on the CPU"""
    with safe_open(folder / ARRAYS, framework="pt") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # it is no mapping
    return _decode(json.loads((folder / STRUCTURE).read_text(encoding="utf-8")), arrays)


def copied(tree: Tree) -> Tree:
    """:return: an equal tree that shares no memory with ``tree``; tensors come to the CPU"""
    if isinstance(tree, Mapping):
        return {key: copied(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [copied(item) for item in tree]
    if isinstance(tree, tuple):
        return tuple(map(copied, tree))
    if isinstance(tree, deque):
        return deque(map(copied, tree), tree.maxlen)
    if isinstance(tree, th.Tensor):
        return tree.detach().to("cpu", copy=True)
    return tree.copy() if isinstance(tree, np.ndarray) else tree


def in_type_of(example: Any, tree: Tree) -> Any:
    """
    Trees know no more types than JSON and a few: what took the place of a subclass becomes one again.

    :param example: what ``tree`` is to replace, a defaultdict for instance, or a named tuple
    :param tree: of the same kind
    :return: ``tree`` itself, or its items in the type of ``example``
    """
    if isinstance(tree, dict) and isinstance(example, dict) and type(example) is not dict:
        same = copy.copy(example)
        same.clear()
        same.update(tree)
        return same
    return example._make(tree) if isinstance(tree, tuple) and hasattr(example, "_make") else tree


def _encode(value: Any, arrays: dict[str, th.Tensor], place: str) -> Any:
    """Everything that JSON has no word for becomes ``{"kind": ..., ...}``."""
    if type(value) in SCALARS:
        return value
    if isinstance(value, list):
        return [_encode(item, arrays, f"{place}/{index}") for index, item in enumerate(value)]
    if isinstance(value, Mapping):
        items = [[key, _encode(item, arrays, f"{place}/{key}")] for key, item in value.items()]
        return {"kind": "dict", "items": items}
    if isinstance(value, tuple | deque):
        items = _encode(list(value), arrays, place)
        maxlen = {"maxlen": value.maxlen} if isinstance(value, deque) else {}
        return {"kind": "deque" if isinstance(value, deque) else "tuple", "items": items, **maxlen}
    if isinstance(value, th.Tensor):
        kind, tensor = "tensor", value.detach().cpu()
    elif _is_numeric(value):
        kind, tensor = "scalar" if isinstance(value, np.generic) else "array", th.from_numpy(np.array(value, order="C"))
    else:
        raise TypeError(f"{place} is {type(value).__name__}, which is no plain data")
    name = place if place not in arrays else f"{place} {len(arrays)}"  # a key may hold a slash, or be 3 beside "3"
    arrays[name] = tensor.clone().contiguous()
    # Little matters where memory is laid out otherwise, but sums over it would round otherwise
    layout = {"layout": "channels_last"} if _is_channels_last(tensor) else {}
    return {"kind": kind, "name": name, **layout}


def _is_channels_last(tensor: th.Tensor) -> bool:
    return tensor.dim() == 4 and not tensor.is_contiguous() and tensor.is_contiguous(memory_format=th.channels_last)


def _decode(value: Any, arrays: Mapping[str, th.Tensor]) -> Tree:
    if isinstance(value, list):
        return [_decode(item, arrays) for item in value]
    if not isinstance(value, dict):
        return value
    kind = value["kind"]
    if kind == "dict":
        return {key: _decode(item, arrays) for key, item in value["items"]}
    if kind in ("tuple", "deque"):
        items = _decode(value["items"], arrays)
        return tuple(items) if kind == "tuple" else deque(items, value["maxlen"])
    tensor = arrays[value["name"]]
    if kind == "tensor":
        return tensor.contiguous(memory_format=th.channels_last) if "layout" in value else tensor
    return tensor.numpy() if kind == "array" else tensor.numpy()[()]


def random_states() -> Tree:
    """:return: where the global generators of Python, NumPy and torch stand"""
    cuda = th.cuda.get_rng_state_all() if th.cuda.is_available() else []
    return {"python": random.getstate(), "numpy": np.random.get_state(legacy=False), "torch": th.get_rng_state(), "cuda": cuda}


def set_random_states(states: Tree) -> None:
    """:param states: of :func:`random_states`; those of GPUs that this machine lacks are left out"""
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])
    th.set_rng_state(states["torch"])
    if th.cuda.is_available() and len(states["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all(states["cuda"])
