"""zoo_configs: everything builds for real once; the other tasks name only what exists, with values that can work."""

import inspect
from argparse import Namespace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from stable_baselines3 import SAC
from stable_baselines3.sac.policies import CnnPolicy

from sb3_crc import CRCSAC, PRESETS, CRCPolicy, PixelEncoder, make_dmc
from sb3_crc.augmentations import bind_augmentation, takes_size
from sb3_crc.configurations import configuration_file, read_settings, settings_for
from sb3_crc.envs.tasks import ACTION_REPEATS, PAPER_TASKS, environment_id
from sb3_crc.objectives import build_objectives
from sb3_crc.schedules import check_learning_rate, lr_schedule
from sb3_crc.settings import check_ranges
from sb3_crc.stock import STOCK, shared_settings
from sb3_crc.zoo import CONFIGS, CRCExperimentManager, register

CARTPOLE = "dmc_pixels/cartpole-swingup-v0"
HARDER_TASKS = PAPER_TASKS[6:]
ZOO_KEYS = {"n_timesteps", "env_kwargs", "n_envs"}

CASES = [
    pytest.param(path, env_id, {**settings, **own}, id=f"{path.stem}-{env_id}{preset and '-'}{preset}")
    for path in sorted(CONFIGS.glob("*.yml"))
    if path.stem not in STOCK
    for env_id, settings in yaml.safe_load(path.read_text()).items()
    for preset, own in {"": {}, **settings.pop("presets", {})}.items()
    if preset not in STOCK
]
#: Stock algorithms by files of their own, and by those that are for several algorithms
STOCK_CASES = [
    pytest.param(algorithm, settings_for(algorithm, settings), id=f"{path.stem}-{env_id}-{algorithm}")
    for path in sorted(CONFIGS.glob("*.yml"))
    for env_id, settings in yaml.safe_load(path.read_text()).items()
    for algorithm in STOCK
    if path.stem == algorithm or "presets" in settings
]


def arguments(*functions: Any) -> dict[str, inspect.Parameter]:
    return {name: value for function in functions for name, value in inspect.signature(function).parameters.items()}


@pytest.mark.parametrize(("path", "env_id", "settings"), CASES)
def test_every_setting_exists_and_can_work(path: Path, env_id: str, settings: dict[str, Any]) -> None:
    """Otherwise a mistake would show only when somebody trains with it."""
    known = arguments(SAC.__init__, CRCSAC.__init__)
    assert set(settings) <= known.keys() | ZOO_KEYS
    assert settings["policy"] == "CnnPolicy"
    environment = {**{name: value.default for name, value in arguments(make_dmc).items()}, **settings["env_kwargs"]}
    assert set(environment) == set(arguments(make_dmc))
    policy_kwargs = dict(settings["policy_kwargs"])
    assert set(policy_kwargs) <= set(arguments(CRCPolicy.__init__))
    encoder_kwargs = policy_kwargs["features_extractor_kwargs"]
    assert set(encoder_kwargs) <= set(arguments(PixelEncoder.__init__))

    model = SimpleNamespace(**{**{name: value.default for name, value in known.items()}, **settings})
    check_ranges(model)
    for name in ("learning_rate", "qf_learning_rate", "encoder_learning_rate", "ent_coef_learning_rate"):
        check_learning_rate(name, lr_schedule(getattr(model, name) or 0)(1))
    assert model.batch_size <= model.learning_starts < settings["n_timesteps"]
    assert model.learning_starts < model.buffer_size

    shape = (3 * environment["frame_stack"], environment["image_size"], environment["image_size"])
    side = round(0.84 * shape[1]) if takes_size(model.augmentation) else shape[1]
    size = {"size": side} if takes_size(model.augmentation) else {}
    bind_augmentation(model.augmentation, {**size, **(model.augmentation_kwargs or {})}, shape)
    if "objectives" in settings:
        space = make_space(shape)
        encoder = PixelEncoder(space, **{**encoder_kwargs, "image_size": side, "channels": [2] * 4})
        assert set(build_objectives(settings["objectives"], encoder, 2)) == set(settings["objectives"])


@pytest.mark.parametrize(("algorithm", "settings"), STOCK_CASES)
def test_every_setting_of_a_stock_algorithm_exists_and_can_work(algorithm: str, settings: dict[str, Any]) -> None:
    known = arguments(SAC.__init__)
    assert set(settings) <= known.keys() | ZOO_KEYS
    environment = settings["env_kwargs"]
    assert set(environment) <= set(arguments(make_dmc))
    if algorithm == "state_sac":
        assert settings["policy"] == "MlpPolicy"
        assert environment["observation"] == "state" and set(environment) <= {"observation", "action_repeat"}
    else:
        assert settings["policy"] == "CnnPolicy" and "observation" not in environment

    model = SimpleNamespace(**{**{name: value.default for name, value in known.items()}, **settings})
    assert 0 <= model.tau <= 1 and 0 <= model.gamma <= 1
    assert lr_schedule(model.learning_rate)(1) > 0  # rl_zoo3 turns "lin_x" into the same schedule
    assert min(model.batch_size, model.gradient_steps, model.target_update_interval) >= 1
    assert model.learning_starts < min(settings["n_timesteps"], model.buffer_size)
    assert ("policy_kwargs" in settings) == (algorithm == "sac_matched")
    if algorithm == "sac_matched":
        assert set(settings["policy_kwargs"]) == {"net_arch", "features_extractor_kwargs"}
        assert set(settings["policy_kwargs"]) <= set(arguments(CnnPolicy.__init__))
        encoder_kwargs = settings["policy_kwargs"]["features_extractor_kwargs"]
        assert set(encoder_kwargs) <= set(arguments(PixelEncoder.__init__))
        side = environment["image_size"]
        PixelEncoder(make_space((3 * environment["frame_stack"], side, side)), **encoder_kwargs)


def make_space(shape: tuple[int, int, int]) -> Any:
    import gymnasium as gym
    import numpy as np

    return gym.spaces.Box(0, 255, shape, np.uint8)


def batch_size(preset: str) -> int:
    return 128 if preset in ("rad", "crc_release", "sac_ae", "soda") else 512


def frame_size(preset: str) -> int:
    return 84 if preset in ("sac_ae", "drq") else 100


def is_part(value: Any, whole: Any) -> bool:
    """Whether a mapping has what another has, all the way down."""
    if isinstance(value, dict):
        return all(name in whole and is_part(own, whole[name]) for name, own in value.items())
    return bool(value == whole)


@pytest.mark.parametrize("preset", PRESETS)
def test_the_ten_tasks_of_the_paper_with_their_steps(preset: str) -> None:
    configuration = yaml.safe_load((CONFIGS / f"{preset}.yml").read_text())
    assert set(configuration) == {"default", *map(environment_id, PAPER_TASKS)}
    for task in PAPER_TASKS:
        settings = configuration[environment_id(task)]
        repeat = settings["env_kwargs"]["action_repeat"]
        assert settings["n_timesteps"] * repeat == (300_000 if task in HARDER_TASKS else 100_000), task
        original = 8 if preset == "crc_release" else ACTION_REPEATS.get(task.partition("-")[0], 2)
        assert repeat == original, task
        slower = task == "cheetah-run" and preset in ("crc", "curl", "rad", "pixel_sac")
        assert settings["learning_rate"] == (2e-4 if slower else 1e-3), task
        assert settings["batch_size"] == batch_size(preset), task
        assert settings["env_kwargs"]["image_size"] == frame_size(preset), task


@pytest.mark.parametrize("preset", PRESETS)
def test_a_configuration_is_its_preset(preset: str) -> None:
    """What differs is RAD's batch and SAC+AE's frame, which the files give sources for, and what is written out."""
    settings = yaml.safe_load((CONFIGS / f"{preset}.yml").read_text())[CARTPOLE]
    for name, value in PRESETS[preset].items():
        assert is_part(value, settings[name]) if name == "policy_kwargs" else settings[name] == value, name
    defaults = arguments(SAC.__init__, CRCSAC.__init__)
    departures = {
        name
        for name, value in settings.items()
        if name not in ZOO_KEYS | {"policy", "policy_kwargs"} | PRESETS[preset].keys() and value != defaults[name].default
    }
    assert departures == {"rad": {"batch_size"}, "sac_ae": {"image_size"}}.get(preset, set())


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_builds_for_real(preset: str, tmp_path: Path) -> None:
    register()
    manager = CRCExperimentManager(Namespace(), preset, CARTPOLE, str(tmp_path), eval_freq=-1, verbose=0, device="cpu")
    model, _ = manager.setup_experiment()
    try:
        assert manager.config == str(CONFIGS / f"{preset}.yml")
        assert model.env.get_attr("action_repeat") == [8]
        assert model.observation_space.shape == (9, frame_size(preset), frame_size(preset))
        assert model.policy.key_encoder.input_shape == (9, 84, 84)
        assert set(model.policy.objectives) == set(PRESETS[preset]["objectives"])
        assert (model.batch_size, model.buffer_size) == (batch_size(preset), 100_000)
        assert manager.n_timesteps == 12_500
    finally:
        model.env.close()


# -- Stock algorithms --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", STOCK)
def test_a_stock_algorithm_has_the_tasks_and_what_it_shares_with_crc(algorithm: str) -> None:
    """Tasks, steps, environments and buffers are those of crc.yml; beside these, sac has nothing of its own."""
    configuration = yaml.safe_load((CONFIGS / f"{algorithm}.yml").read_text())
    assert set(configuration) == {"default", *map(environment_id, PAPER_TASKS)}
    for env_id, settings in configuration.items():
        crc = read_settings(configuration_file("crc"), "crc", env_id)
        assert settings == shared_settings(algorithm, crc), env_id
        for name in ("n_timesteps", "buffer_size"):
            assert settings[name] == crc[name]
        own = {"observation": "state"} if algorithm == "state_sac" else {"image_size": 100, "frame_stack": 3}
        assert settings["env_kwargs"] == {**own, "action_repeat": crc["env_kwargs"]["action_repeat"]}
    departures = {name for name, value in configuration[CARTPOLE].items() if value != value_of_sb3(name)}
    shared = {"n_timesteps", "policy", "env_kwargs", "buffer_size"}
    matched = {"learning_rate", "batch_size", "learning_starts", "tau", "ent_coef", "policy_kwargs"}
    assert departures == shared | {"sac": set(), "sac_matched": matched, "state_sac": {"learning_starts"}}[algorithm]


def value_of_sb3(name: str) -> Any:
    parameter = arguments(SAC.__init__).get(name)
    return None if parameter is None else parameter.default


@pytest.mark.parametrize("algorithm", STOCK)
def test_every_stock_algorithm_builds_for_real(algorithm: str, tmp_path: Path) -> None:
    register()
    manager = CRCExperimentManager(Namespace(), algorithm, CARTPOLE, str(tmp_path), eval_freq=-1, verbose=0, device="cpu")
    model, _ = manager.setup_experiment()
    try:
        assert manager.config == str(CONFIGS / f"{algorithm}.yml")
        assert type(model) is STOCK[algorithm]
        assert model.env.get_attr("action_repeat") == [8]
        assert model.observation_space.shape == ((5,) if algorithm == "state_sac" else (9, 100, 100))
        assert model.replay_buffer.frame_channels == (None if algorithm == "state_sac" else 3)
        assert (model.buffer_size, manager.n_timesteps) == (100_000, 12_500)
        if algorithm == "sac_matched":
            assert model.critic.features_extractor.input_shape == (9, 84, 84)
    finally:
        model.env.close()
