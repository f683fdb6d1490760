"""Files of settings: which of them an algorithm gets, and how they are changed."""

from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from sb3_crc.configurations import CONFIGS, configuration_file, read_settings, settings_for, shipped, with_overrides
from sb3_crc.envs.tasks import default_action_repeat, environment_id
from sb3_crc.experiments.published import SIX_TASKS
from sb3_crc.stock import shared_settings

ENV = "dmc_pixels/cartpole-swingup-v0"
SHARED: dict[str, Any] = {
    "n_timesteps": 10,
    "policy": "CnnPolicy",
    "env_kwargs": {"image_size": 64},
    "batch_size": 8,
    "augmentation": "random_shift",
    "policy_kwargs": {"net_arch": [8], "layer_norm": True},
    "presets": {"crc": {"batch_size": 16}, "sac": {"batch_size": 32}, "rad": None},
}
FILE = """
default: &default
  gamma: 0.9
  env_kwargs: &kwargs {image_size: 64}
  other: *kwargs
  presets: {crc: {gamma: 0.8}}
dmc_pixels/cartpole-swingup-v0:
  <<: *default
  tau: 0.1
broken: 7
typo: {presets: {carl: {}}}
"""


# -- One file for several algorithms -----------------------------------------------------------------------------------


def test_an_algorithm_gets_what_is_shared_and_its_own() -> None:
    before = deepcopy(SHARED)
    rest = {name: value for name, value in SHARED.items() if name != "presets"}
    assert settings_for("crc", SHARED) == {**rest, "batch_size": 16}
    assert settings_for("rad", SHARED) == settings_for("tqc", SHARED) == rest
    assert before == SHARED


@pytest.mark.parametrize("algorithm", ["sac", "sac_matched", "state_sac"])
def test_a_stock_algorithm_gets_what_it_shares_and_its_own(algorithm: str) -> None:
    own = SHARED["presets"].get(algorithm, {})
    assert settings_for(algorithm, SHARED) == {**shared_settings(algorithm, SHARED), **own}
    assert "augmentation" not in settings_for(algorithm, SHARED)


def test_a_file_for_one_algorithm_is_used_as_it_is() -> None:
    settings = {"batch_size": 8, "augmentation": "random_shift", "policy_kwargs": {"net_arch": [8]}}
    for algorithm in ("crc", "sac"):
        taken = settings_for(algorithm, settings)
        assert taken == settings and taken["policy_kwargs"] is not settings["policy_kwargs"]


@pytest.mark.parametrize(
    ("presets", "message"),
    [
        ({"carl": {}}, "unknown preset 'carl'; did you mean 'curl'"),
        ({"sac_match": {}}, "did you mean 'sac_matched'"),
        (["crc"], "presets must be a mapping"),
        ({"crc": 3}, "presets.crc must be a mapping of settings; it is 3"),
    ],
)
def test_mistakes_in_presets_are_named(presets: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        settings_for("rad", {"presets": presets})


# -- Files -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "own.yml").write_text(FILE)
    return tmp_path / "own.yml"


def test_an_environment_has_its_own_settings_or_the_default(file: Path) -> None:
    kwargs = {"image_size": 64}
    assert read_settings(file, "crc", ENV) == {"gamma": 0.8, "tau": 0.1, "env_kwargs": kwargs, "other": kwargs}
    assert read_settings(file, "rad", "Pendulum-v1") == {"gamma": 0.9, "env_kwargs": kwargs, "other": kwargs}


def test_what_yaml_shares_can_be_changed_alone(file: Path) -> None:
    changed = with_overrides(read_settings(file, "rad", ENV), {"env_kwargs.image_size": 84})
    assert (changed["env_kwargs"], changed["other"]) == ({"image_size": 84}, {"image_size": 64})


def test_every_algorithm_has_a_file() -> None:
    for algorithm in ("crc", "rad", "sac", "sac_matched", "state_sac"):
        assert configuration_file(algorithm) == CONFIGS / f"{algorithm}.yml"
        assert read_settings(configuration_file(algorithm), algorithm, ENV)["n_timesteps"] == 12_500


@pytest.mark.parametrize(
    ("env_id", "content", "message"),
    [
        (ENV, "just text", "own.yml is no configuration: it must be a mapping"),
        (ENV, "a: [", "own.yml is no YAML file"),
        (ENV, "!!python/object/apply:os.getcwd []", "own.yml is no YAML file"),
        (ENV, "a: caf\udce9", "own.yml is no YAML file"),
        (ENV, "Pendulum-v1: {}", f"own.yml has settings neither for '{ENV}' nor for 'default', only for 'Pendulum-v1'"),
        ("broken", FILE, "own.yml: 'broken' must be a mapping of settings; it is 7"),
        ("typo", FILE, "own.yml, 'typo': unknown preset 'carl'"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(file: Path, env_id: str, content: str, message: str) -> None:
    file.write_text(content, encoding="utf-8", errors="surrogateescape")
    with pytest.raises(ValueError, match=message):
        read_settings(file, "crc", env_id)


def test_a_missing_file_is_missing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere.yml"):
        read_settings(tmp_path / "nowhere.yml", "crc", ENV)


# -- Overrides ---------------------------------------------------------------------------------------------------------

SETTINGS: dict[str, Any] = {
    "gamma": 0.99,
    "augmentation_kwargs": None,
    "env_kwargs": {"image_size": 64},
    "objectives": {"contrastive": 0.33, "reconstruction": 1, "consistency": {"weight": 0.34, "reduction": "mean"}},
}


@pytest.mark.parametrize(
    ("overrides", "name", "expected"),
    [
        ({"gamma": 0.9}, "gamma", 0.9),
        ({"gamma": None}, "gamma", None),
        ({"env_kwargs.render_quality": "fast"}, "env_kwargs", {"image_size": 64, "render_quality": "fast"}),
        ({"env_kwargs.image_size": None}, "env_kwargs", {}),
        ({"a.b.c": 1, "a.b.d": 2}, "a", {"b": {"c": 1, "d": 2}}),
        ({"augmentation_kwargs.pad": 4}, "augmentation_kwargs", {"pad": 4}),
        ({"objectives": {}, "objectives.contrastive": 1.0}, "objectives", {"contrastive": 1.0}),
        (
            {
                "objectives.contrastive.key": "bootstrap",
                "objectives.reconstruction.weight": 0.5,
                "objectives.consistency": None,
            },
            "objectives",
            {"contrastive": {"weight": 0.33, "key": "bootstrap"}, "reconstruction": {"weight": 0.5}},
        ),
        (
            {"objectives.consistency.weight": 0.1},
            "objectives",
            {**SETTINGS["objectives"], "consistency": {"weight": 0.1, "reduction": "mean"}},
        ),
    ],
)
def test_overrides_reach_into_settings(overrides: dict[str, Any], name: str, expected: Any) -> None:
    before = deepcopy(SETTINGS)
    changed = with_overrides(SETTINGS, overrides)
    assert changed.get(name) == expected
    rest = {key: value for key, value in changed.items() if key != name}
    assert rest == {key: value for key, value in before.items() if key != name}
    assert before == SETTINGS


def test_what_is_set_is_a_copy() -> None:
    own = {"net_arch": [8]}
    changed = with_overrides({}, {"policy_kwargs": own, "policy_kwargs.layer_norm": True})
    assert changed == {"policy_kwargs": {"net_arch": [8], "layer_norm": True}}
    assert own == {"net_arch": [8]}


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"gamma.weight": 1}, "gamma.weight: gamma is 0.99, no mapping"),
        ({"objectives.contrastive.weight.more": 1}, "objectives.contrastive.weight is 0.33, no mapping"),
        ({"env_kwargs.image_size.weight": 1}, "env_kwargs.image_size is 64, no mapping"),
        ({"policy": "CnnPolicy", "policy.name": 1}, "policy.name: policy is 'CnnPolicy', no mapping"),
        ({"train_freq": [1, "episode"], "train_freq.unit": 1}, r"train_freq is \[1, 'episode'\], no mapping"),
        ({"on": True, "on.off": 1}, "on.off: on is True, no mapping"),
        ({"objectives.consistancy": None}, "objectives.consistancy: null takes out what is there, but there is only 'contr"),
        ({"objectives.": 1}, "'objectives.' is no path"),
        ({"": 1}, "'' is no path"),
    ],
)
def test_paths_that_lead_nowhere_are_named(overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        with_overrides(SETTINGS, overrides)


def test_the_projects_own_are_found_from_anywhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    laptop = Path("zoo_configs/laptop.yml")
    assert read_settings(laptop, "rad", "dmc_pixels/cartpole-swingup-v0")["batch_size"] == 128
    assert shipped(Path("zoo_configs/sweeps/ablation_1.yml")) == CONFIGS / "sweeps" / "ablation_1.yml"
    with pytest.raises(FileNotFoundError):
        read_settings(Path("zoo_configs/desktop.yml"), "rad", "dmc_pixels/cartpole-swingup-v0")
    with pytest.raises(FileNotFoundError):
        read_settings(Path("laptop.yml"), "rad", "dmc_pixels/cartpole-swingup-v0")
    laptop.parent.mkdir()
    laptop.write_text("default: {batch_size: 7}\n", encoding="utf-8")
    assert read_settings(laptop, "rad", "dmc_pixels/cartpole-swingup-v0") == {"batch_size": 7}  # one's own comes first


@pytest.mark.parametrize("task", SIX_TASKS)
def test_the_laptop_class_has_one_budget_for_each_task(task: str) -> None:
    settings = read_settings(Path("zoo_configs/laptop.yml"), "crc", environment_id(task))
    decisions = settings["n_timesteps"]
    assert decisions * default_action_repeat(task) == 100_000 and settings["buffer_size"] >= decisions
    assert decisions * settings["gradient_steps"] / settings["train_freq"] == 25_000
