"""Policies as files that nothing is executed to read: weights and a configuration, no pickle.

A ``.sb3crc`` file is a safetensors file whose header also holds a configuration as JSON::

    header    {"__metadata__": {"format": "sb3_crc policy 1", "configuration": "{...}"}, "actor.mu.weight": {...}, ...}
    weights   float32

It is enough to act and to go on learning from: encoder, actor, Q networks and their targets. Objectives stay behind.
"""

import inspect
import json
import math
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch as th
from gymnasium import spaces
from safetensors import SafetensorError, safe_open
from stable_baselines3.common.utils import ConstantSchedule, get_device
from torch import nn

from sb3_crc.atomic import atomic_write
from sb3_crc.crc_sac import CRCSAC
from sb3_crc.encoder import PixelEncoder
from sb3_crc.image_spaces import image_shape, image_space
from sb3_crc.plain import ACTIVATIONS, unique_keys
from sb3_crc.policies import CRCPolicy

FORMAT = "sb3_crc policy 1"
#: Arguments of the policy that are written as they are, and of its encoder
POLICY_ARGUMENTS = ("net_arch", "n_critics", "actor_features", "log_std_bounds", "layer_norm")
ENCODER_ARGUMENTS = (
    *("features_dim", "image_size", "channels", "strides", "kernel_size", "latent_activation", "center_input"),
    *("frame_differences", "frame_channels", "initialization"),
)
#: Of make_dmc
ENVIRONMENT_ARGUMENTS = ("image_size", "action_repeat", "frame_stack", "camera_id", "render_quality", "observation")
#: A number in a configuration is at most this
LARGEST = 1 << 20
#: Numbers that come out of a convolution, of one image
MOST_ACTIVATIONS = 1 << 26
#: Characters of a configuration
LONGEST = 1 << 20


class PolicyFileError(ValueError):
    """A file is no policy, is damaged, or asks for what it does not hold."""


def export_policy(
    model: CRCSAC | CRCPolicy, path: str | Path, *, task: str | None = None, env_kwargs: Mapping[str, Any] | None = None
) -> Path:
    """
    :param model: a CRCSAC, or its policy
    :param path: file to write, which appears whole; ``.sb3crc`` is added where there is no suffix
    :param task: domain-task on which it acts, for ``sb3-crc enjoy``
    :param env_kwargs: of :func:`~sb3_crc.make_dmc` there, plain data: some of :data:`ENVIRONMENT_ARGUMENTS`
    :return: the file
    :raises TypeError: for any other algorithm or policy
    :raises ValueError: if it has parts that such a file cannot describe: classes of the user's own, spaces of other kinds,
        other arguments of the environment
    """
    if unknown := sorted(set(env_kwargs or {}) - set(ENVIRONMENT_ARGUMENTS)):
        raise ValueError(f"env_kwargs: {', '.join(unknown)} is none of {', '.join(ENVIRONMENT_ARGUMENTS)}")
    policy = model.policy if isinstance(model, CRCSAC) else model
    if not isinstance(policy, CRCPolicy):
        raise TypeError(f"a CRCSAC or its policy can be exported, {type(model).__name__} cannot")
    target = Path(path) if Path(path).suffix else Path(path).with_suffix(".sb3crc")
    about = {"format": FORMAT, "configuration": json.dumps(_describe(policy))}
    _read(about["configuration"], target)  # here and now, and not when the policy is needed
    if task is not None:
        about["environment"] = json.dumps({"task": task, "env_kwargs": dict(env_kwargs or {})})
    weights = {name: tensor.detach().cpu().contiguous() for name, tensor in _weights(policy).items()}
    with atomic_write(target) as unfinished:
        unfinished.write_bytes(safetensors.torch.save(weights, about))  # save_file() would let nobody else read it
    return target


def load_policy(path: str | Path, device: th.device | str = "auto") -> CRCPolicy:
    """
    Read a policy, from anyone: nothing in the file is executed, and no memory is claimed that the file does not fill.

    :param path: of :func:`export_policy`
    :param device: on which it shall be
    :return: ``predict`` takes the observations that it was trained on; see :func:`load_weights` for going on
    :raises FileNotFoundError: if there is no such file
    :raises PolicyFileError: for anything that is not whole, finite, and exactly what its configuration describes
    """
    source = Path(path)
    if not source.is_file():
        raise FileNotFoundError(f"there is no file {source}")
    try:
        with safe_open(source, framework="pt") as file:
            about = file.metadata() or {}
            if about.get("format") != FORMAT:
                raise PolicyFileError(f"{source} is no policy of sb3_crc: {about.get('format')!r} is not {FORMAT!r}")
            arguments = _read(about.get("configuration", ""), source)
            shapes = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
            _check_size(arguments, sum(4 * math.prod(shape) for shape in shapes.values()), source)
            try:
                policy = CRCPolicy(lr_schedule=ConstantSchedule(0.0), **arguments)
            except (ValueError, TypeError, KeyError, AssertionError, RuntimeError) as error:
                raise PolicyFileError(f"{source}: no policy can be made of its configuration: {error}") from error
            expected = {name: tuple(tensor.shape) for name, tensor in _weights(policy).items()}
            for name in sorted(expected.keys() | shapes.keys()):
                if expected.get(name) != shapes.get(name):
                    here, wanted = shapes.get(name, "missing"), expected.get(name, "not there")
                    raise PolicyFileError(f"{source}: {name} is {here}, and should be {wanted}")
            weights = {name: file.get_tensor(name) for name in shapes}
    except SafetensorError as error:
        raise PolicyFileError(f"{source} is no safetensors file, or is damaged: {error}") from error
    for name, tensor in weights.items():
        if tensor.dtype != th.float32 or not bool(th.isfinite(tensor).all()):
            raise PolicyFileError(f"{source}: {name} holds {tensor.dtype}, or numbers that are not finite")
    policy.load_state_dict(weights, strict=False)
    policy.set_training_mode(False)
    return policy.to(get_device(device))


def _weights(policy: CRCPolicy) -> dict[str, th.Tensor]:
    """Each tensor once: actor and critic share the encoder, target heads and key encoder are one module."""
    kept: dict[str, th.Tensor] = {}
    seen: dict[tuple[int, tuple[int, ...]], str] = {}
    for name, tensor in policy.state_dict().items():
        if name.split(".")[0] in ("objectives", "gradient_norms"):
            continue
        place = tensor.data_ptr(), tuple(tensor.shape)
        if tensor.numel() and place in seen:
            continue
        seen[place] = name
        kept[name] = tensor
    return kept


def load_weights(model: CRCSAC, path: str | Path) -> None:
    """
    Go on from an exported policy: encoder, actor, Q networks and targets become its own; objectives and optimizers stay.

    :param model: with networks of the same form
    :param path: of :func:`export_policy`
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if it is no policy, or has networks of another form, naming the first difference
    """
    weights, own = _weights(load_policy(path, model.device)), _weights(model.policy)
    for name in sorted(weights.keys() | own.keys()):
        here, there = (tuple(one[name].shape) if name in one else "missing" for one in (own, weights))
        if here != there:
            raise ValueError(f"{path}: {name} is {there} there and {here} in the model")
    with th.no_grad():
        for name, tensor in own.items():
            tensor.copy_(weights[name])


def environment_of(path: str | Path) -> tuple[str, dict[str, Any]]:
    """
    :param path: of :func:`export_policy`
    :return: task, and arguments of :func:`~sb3_crc.make_dmc`: some of :data:`ENVIRONMENT_ARGUMENTS`; none names a file
    :raises FileNotFoundError: if there is no such file
    :raises PolicyFileError: if it does not say
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no file {path}")
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {}).get("environment", "null"), object_pairs_hook=unique_keys)
    except (SafetensorError, ValueError, RecursionError) as error:
        raise PolicyFileError(f"{path} is no policy, or is damaged: {error}") from error
    if not isinstance(about, dict) or not isinstance(about.get("task"), str) or not isinstance(about.get("env_kwargs"), dict):
        raise PolicyFileError(f"{path} does not say in which environment it acts")
    if unknown := sorted(about["env_kwargs"].keys() - set(ENVIRONMENT_ARGUMENTS)):
        raise PolicyFileError(f"{path}: {', '.join(unknown)} is none of {', '.join(ENVIRONMENT_ARGUMENTS)}")
    return about["task"], about["env_kwargs"]


# Configurations


def _describe(policy: CRCPolicy) -> dict[str, Any]:
    arguments = policy._get_constructor_parameters()
    if policy.features_extractor_class is not PixelEncoder:
        raise ValueError(f"{policy.features_extractor_class.__name__} cannot be described: only PixelEncoder itself can")
    activation: type[nn.Module] = arguments["activation_fn"]
    if ACTIVATIONS.get(activation.__name__) is not activation:
        raise ValueError(f"activation_fn={activation.__name__} cannot be described: {', '.join(ACTIVATIONS)} can")
    encoder = arguments["features_extractor_kwargs"]
    if unknown := sorted(encoder.keys() - set(ENCODER_ARGUMENTS)):
        raise ValueError(f"features_extractor_kwargs {', '.join(unknown)} cannot be described")
    return {
        **{name: arguments[name] for name in POLICY_ARGUMENTS},
        "activation_fn": activation.__name__,
        "features_extractor_kwargs": encoder,
        "observation_space": _describe_space(policy.observation_space),
        "action_space": _describe_space(policy.action_space),
    }


def _describe_space(space: spaces.Space[Any]) -> dict[str, Any]:
    if isinstance(space, spaces.Dict):
        return {"dict": {name: _describe_space(one) for name, one in space.spaces.items()}}
    if not isinstance(space, spaces.Box):
        raise ValueError(f"{type(space).__name__} cannot be described: a Box, or a Dict of Boxes, can")
    low, high = (np.unique(bound) for bound in (space.low, space.high))
    if len(low) > 1 or len(high) > 1:
        raise ValueError(f"{space} cannot be described: its bounds differ from component to component")
    return {"shape": list(space.shape), "dtype": str(space.dtype), "low": _number(low[0]), "high": _number(high[0])}


def _number(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None  # JSON knows no infinity


def _read(text: str, source: Path) -> dict[str, Any]:
    """:return: arguments of the policy, all of which are plain numbers, strings and lists"""
    try:
        if len(text) > LONGEST:
            raise ValueError(f"{len(text)} characters")
        given = json.loads(text, object_pairs_hook=unique_keys, parse_constant=_refuse)
        if not isinstance(given, dict):
            raise ValueError("no mapping")
        known = {*POLICY_ARGUMENTS, "activation_fn", "features_extractor_kwargs", "observation_space", "action_space"}
        if given.keys() != known:
            raise ValueError(f"{', '.join(sorted(given.keys() ^ known))}: missing, or not known")
        encoder = given["features_extractor_kwargs"]
        if not isinstance(encoder, dict) or not encoder.keys() <= set(ENCODER_ARGUMENTS):
            raise ValueError(f"features_extractor_kwargs must hold some of {', '.join(ENCODER_ARGUMENTS)}")
        low, high = given["log_std_bounds"]
        if not float(low) < float(high):
            raise ValueError(f"log_std_bounds={given['log_std_bounds']}: the first must be less than the second")
        for number in _numbers({name: value for name, value in given.items() if not name.endswith("_space")}):
            if not abs(number) <= LARGEST:
                raise ValueError(f"{number} is more than {LARGEST}")
        if given["activation_fn"] not in ACTIVATIONS:
            raise ValueError(f"activation_fn={given['activation_fn']!r} is none of {', '.join(ACTIVATIONS)}")
        return {
            **given,
            "activation_fn": ACTIVATIONS[given["activation_fn"]],
            "observation_space": _space(given["observation_space"]),
            "action_space": _space(given["action_space"]),
        }
    except Exception as error:  # numpy and Gymnasium raise nearly anything for what strangers write
        raise PolicyFileError(f"{source}: its configuration cannot be used: {error}") from error


def _space(about: Mapping[str, Any]) -> spaces.Space[Any]:
    if about.keys() == {"dict"}:
        return spaces.Dict({str(name): _space(one) for name, one in about["dict"].items()})
    shape, dtype = tuple(map(int, about["shape"])), np.dtype(about["dtype"])
    if dtype.kind not in "iuf" or min(shape, default=1) < 1 or math.prod(shape) > 100 * LARGEST:
        raise ValueError(f"no space of shape {shape} and type {dtype}")
    low, high = (limit if about[name] is None else about[name] for name, limit in (("low", -np.inf), ("high", np.inf)))
    return spaces.Box(low, high, shape, dtype.type)


def _check_size(arguments: Mapping[str, Any], there: int, source: Path) -> None:
    """What the convolutions, the projection behind them and the Q networks alone would take must be in the file."""
    encoder = inspect.signature(PixelEncoder).bind(None, **arguments["features_extractor_kwargs"])
    encoder.apply_defaults()
    own, widths = encoder.arguments, arguments["net_arch"]
    try:
        frames, *size = image_shape(image_space(arguments["observation_space"]))
        given = own["image_size"] or [min(size), max(size)]
        sides = list(given) if isinstance(given, list) else [given, given]
        asked, activations = 0, 0
        for before, channels, stride in zip((frames, *own["channels"]), own["channels"], own["strides"], strict=False):
            sides = [(side - own["kernel_size"]) // stride + 1 for side in sides]
            asked += before * channels * own["kernel_size"] ** 2
            activations = max(activations, channels * max(sides) ** 2)
        asked += own["channels"][-1] * min(sides) ** 2 * own["features_dim"]
        heads = widths["qf"] if isinstance(widths, dict) else widths
        asked += int(arguments["n_critics"]) * sum(before * after for before, after in pairwise([own["features_dim"], *heads]))
    except (ValueError, TypeError, KeyError, IndexError, ZeroDivisionError) as error:
        raise PolicyFileError(f"{source}: no policy can be made of its configuration: {error}") from error
    if 4 * asked > there or activations > MOST_ACTIVATIONS:
        raise PolicyFileError(
            f"{source} holds {there} bytes of weights, and its configuration asks for at least {4 * asked}, and {activations} "
            f"activations in a layer, of which {MOST_ACTIVATIONS} are allowed"
        )


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, dict):
        for one in value.values():
            yield from _numbers(one)
    elif isinstance(value, list):
        for one in value:
            yield from _numbers(one)
    elif isinstance(value, int | float):
        yield value


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is no number")
