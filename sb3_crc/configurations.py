"""Configurations as rl_zoo3 reads them: YAML files of settings by environment, ``default`` for all others.

A file may be for several algorithms: ``presets: {crc: {...}, sac: {...}}`` holds what one of them has beside the rest. Of the
rest, a stock algorithm takes only what it has in common with ours (:func:`~sb3_crc.stock.shared_settings`).
"""

from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import yaml

from sb3_crc.presets import PRESETS
from sb3_crc.settings import check_name
from sb3_crc.stock import STOCK, shared_settings

_PACKAGE = Path(__file__).resolve().parent
#: The project's own: in an installed package they are part of it, in a checkout they stand beside it
CONFIGS = (_PACKAGE if (_PACKAGE / "zoo_configs").is_dir() else _PACKAGE.parent) / "zoo_configs"


def shipped(file: Path) -> Path:
    """:param file: as a user names it; :return: the same, or for ``zoo_configs/...`` that is not there the project's own"""
    first, *rest = file.parts or ("",)
    own = CONFIGS.joinpath(*rest)
    return own if first == CONFIGS.name and not file.exists() and own.is_file() else file


def configuration_file(algorithm: str) -> Path:
    """:param algorithm: preset or stock algorithm; :return: the file of its own settings, whether it exists or not"""
    return CONFIGS / f"{algorithm}.yml"


def read_settings(file: Path, algorithm: str, env_id: str) -> dict[str, Any]:
    """
    :param file: YAML, loaded safely; see :func:`shipped`
    :param algorithm: whose settings are wanted
    :param env_id: of Gymnasium; an environment that the file does not name has the settings of ``default``
    :return: settings of rl_zoo3, which share nothing with each other
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if it has no settings for this environment, or is no such file at all, saying what is there instead
    """
    file = shipped(file)
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{file} is no YAML file: {error}") from error
    if not isinstance(content, Mapping):
        raise ValueError(f"{file} is no configuration: it must be a mapping from environments, or 'default', to settings")
    key = env_id if env_id in content else "default"
    if key not in content:
        raise ValueError(f"{file} has settings neither for {env_id!r} nor for 'default', only for {_listed(content)}")
    if not isinstance(content[key], Mapping):
        raise ValueError(f"{file}: {key!r} must be a mapping of settings; it is {content[key]!r}")
    try:
        return settings_for(algorithm, content[key])
    except ValueError as error:
        raise ValueError(f"{file}, {key!r}: {error}") from error


def settings_for(algorithm: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param algorithm: any of rl_zoo3's, with ours
    :param settings: one environment's; if it has ``presets``, it is for several algorithms
    :return: those of this algorithm, which share nothing with ``settings``
    :raises ValueError: for an unknown name in ``presets``, or if that or what is in it is no mapping
    """
    own_settings: dict[str, Any] = _unshared(settings)
    if "presets" not in own_settings:
        return own_settings
    presets = own_settings.pop("presets")
    if not isinstance(presets, Mapping):
        raise ValueError(f"presets must be a mapping from algorithms to settings; it is {presets!r}")
    for name, own in presets.items():
        check_name("preset", name, [*PRESETS, *STOCK])
        if own is not None and not isinstance(own, Mapping):
            raise ValueError(f"presets.{name} must be a mapping of settings; it is {own!r}")
    if algorithm in STOCK:
        own_settings = shared_settings(algorithm, own_settings)
    return {**own_settings, **(presets.get(algorithm) or {})}


def with_overrides(settings: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """
    Change settings, one after the other.

    :param settings: of one environment
    :param overrides: values by name. A dotted name reaches into mappings (``env_kwargs.render_quality``) and makes those that
        are missing; below a weight of ``objectives`` (``objectives.contrastive.key``) the weight becomes the objective's
        ``weight``. None takes out what is there
    :return: the changed settings, which share nothing with the arguments
    :raises ValueError: naming the path, if it leads through something that is no mapping, or takes out what is not there: the
        name of a run would then say more than is true
    """
    changed: dict[str, Any] = _unshared(settings)
    for path, value in overrides.items():
        *parents, name = path.split(".") if isinstance(path, str) else [""]
        if not all([*parents, name]):
            raise ValueError(f"{path!r} is no path: there is nothing before or behind one of its dots")
        inner = changed
        for depth in range(len(parents)):
            inner = _entered(inner, parents[: depth + 1], path)
        if value is not None:
            inner[name] = _unshared(value)
        elif name in inner:
            del inner[name]
        else:
            raise ValueError(f"{path}: null takes out what is there, but there is only {_listed(inner)}")
    return changed


def _entered(mapping: dict[str, Any], way: list[str], path: str) -> dict[str, Any]:
    """:return: the mapping that the last step of the way leads to, made if there is none"""
    name = way[-1]
    inner = mapping.get(name)
    is_number = isinstance(inner, int | float) and not isinstance(inner, bool)
    if is_number and len(way) == 2 and way[0] == "objectives":
        inner = {"weight": inner}
    if inner is not None and not isinstance(inner, dict):
        raise ValueError(f"{path}: {'.'.join(way)} is {inner!r}, no mapping that could be reached into")
    mapping[name] = {} if inner is None else inner
    return mapping[name]  # type: ignore[no-any-return]


def _unshared(value: Any) -> Any:
    """:return: a copy no two parts of which are one object, as those that a YAML file names with ``&`` and ``*`` are"""
    if isinstance(value, Mapping):
        return {key: _unshared(own) for key, own in value.items()}
    return [_unshared(own) for own in value] if isinstance(value, list) else deepcopy(value)


def _listed(mapping: Mapping[Any, Any]) -> str:
    return ", ".join(map(repr, mapping)) or "nothing"
