"""Whether the YAML of the pages would be understood: by the checks of ``zoo_configs``, on sweeps, configurations and parts."""

import importlib
import inspect
from pathlib import Path
from shutil import copy
from typing import Any

import gymnasium as gym
import yaml

from sb3_crc.configurations import CONFIGS, settings_for
from sb3_crc.envs.tasks import NAMESPACE
from sb3_crc.experiments.specs import read_sweep
from sb3_crc.objectives import OBJECTIVES
from tests import test_zoo_configs as zoo_configs


def check_yaml(text: str, folder: Path) -> None:
    """
    :param text: of a block: a sweep; a configuration, by environments; or some settings of one
    :param folder: for temporary files
    """
    content = yaml.safe_load(text)
    assert isinstance(content, dict), "YAML of a page is a mapping"
    if "variants" in content:
        check_sweep(text, folder)
    elif all("/" in name or name == "default" for name in content):
        for env_id, settings in content.items():
            assert env_id == "default" or env_id in gym.registry, f"there is no environment {env_id}"
            check_settings(env_id, settings_for("crc", settings), whole=True)
    else:
        check_settings("default", content, whole=False)


def check_sweep(text: str, folder: Path) -> None:
    """As ``sb3-crc sweep``; ``../laptop.yml`` is that of ``zoo_configs``."""
    (folder / "sweeps").mkdir(exist_ok=True)
    copy(CONFIGS / "laptop.yml", folder)
    file = folder / "sweeps" / "page.yml"
    file.write_text(text)
    for spec in read_sweep(file):
        check_objectives(spec.settings.get("objectives", {}))


def check_settings(env_id: str, settings: dict[str, Any], *, whole: bool) -> None:
    """
    :param env_id: of Gymnasium, or "default"
    :param settings: of one environment
    :param whole: False: the rest is that of laptop.yml
    """
    own = dict(settings)
    for callback in own.pop("callback", []):
        ((name, arguments),) = callback.items() if isinstance(callback, dict) else [(callback, {})]
        module, _, class_name = name.rpartition(".")
        inspect.signature(getattr(importlib.import_module(module), class_name)).bind(**arguments)
    base = yaml.safe_load((CONFIGS / "laptop.yml").read_text())["default"]
    base.pop("presets")
    settings = own if whole else base | own
    foreign = env_id != "default" and not env_id.startswith(f"{NAMESPACE}/")
    if foreign:  # whose pictures have their own size, and which take no arguments of make_dmc
        assert "env_kwargs" not in settings
        settings = {**settings, "env_kwargs": {"image_size": gym.make(env_id).observation_space.shape[-1], "frame_stack": 1}}
    check_objectives(settings.get("objectives", {}))
    zoo_configs.test_every_setting_exists_and_can_work(CONFIGS, env_id, settings)


def check_objectives(objectives: dict[str, Any]) -> None:
    """Those with a dotted path are there."""
    for name in objectives:
        if name not in OBJECTIVES:
            module, _, class_name = name.rpartition(".")
            assert hasattr(importlib.import_module(module), class_name), f"there is no objective {name}"
