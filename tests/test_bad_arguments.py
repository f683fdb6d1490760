"""Arguments that cannot work fail at once, or at the latest where they matter, with their name, value and what is allowed."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_crc import CRCSAC
from sb3_crc.objectives import Contrastive
from tests.conftest import POLICY_KWARGS, NoiseEnv, construct, make_model

NAN, INFINITY = float("nan"), float("inf")

# -- Names -------------------------------------------------------------------------------------------------------------


def test_an_unknown_preset_is_named_with_the_nearest_and_the_known() -> None:
    from sb3_crc.zoo import preset_class

    with pytest.raises(ValueError, match="crcc.*did you mean 'crc'.*pixel_sac"):
        preset_class("crcc")


def test_an_unknown_algorithm_on_the_command_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from sb3_crc.zoo import train

    monkeypatch.setattr(sys, "argv", ["train.py", "--algo", "crcc", "--env", "dmc_pixels/cartpole-swingup-v0"])
    with pytest.raises(SystemExit) as stop:
        train()
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert "crcc" in message and all(name in message for name in ("crc", "rad", "pixel_sac"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"objectives": {"reconstructoin": 1.0}}, "reconstructoin.*did you mean 'reconstruction'.*contrastive"),
        ({"objectives": ["contrastive"]}, "objectives.*mapping.*contrastive"),
        ({"augmentation": "randomshift"}, "randomshift.*did you mean 'random_shift'.*center_crop"),
        ({"augmentation_kwargs": {"sise": 30}}, "augmentation_kwargs.*sise.*size"),
        ({"augmentation": "random_shift", "augmentation_kwargs": {"size": 30}}, "augmentation_kwargs.*size.*pad"),
        ({"policy_kwargs": {"features_extractor_kwargs": {"latent_activation": "tahn"}}}, "tahn.*did you mean 'tanh'.*none"),
        ({"policy_kwargs": {"actor_features": "latnet"}}, "latnet.*did you mean 'latent'.*conv"),
    ],
)
def test_unknown_names_are_met_with_the_nearest_and_the_known(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        construct(**settings)


@pytest.mark.parametrize("value", [None, "none"])
def test_how_to_augment_nothing_is_said(value: str | None) -> None:
    with pytest.raises(ValueError, match=f"unknown augmentation {value!r}: .*use 'center_crop'.* Known: random_crop"):
        construct(augmentation=value)
    with pytest.raises(ValueError, match="unknown objective_augmentation 'none'.*which is None.* Known: random_crop"):
        construct(objective_augmentation="none")


def test_a_name_like_none_of_the_known_is_not_taken_for_one() -> None:
    with pytest.raises(ValueError, match=r"unknown augmentation 'flip'\. Known: random_crop"):
        construct(augmentation="flip")
    with pytest.raises(ValueError, match="unknown balance 'GRAD_NORM'; did you mean 'grad_norm'"):
        construct(balance="GRAD_NORM")


# -- Types -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        *[({"image_size": value}, rf"image_size={value!r} must be.*\(height, width\)") for value in (20.0, "16", True)],
        ({"image_size": (16, 16, 3)}, r"image_size=\(16, 16, 3\) must be.*\(height, width\)"),
        ({"augmentation_kwargs": {"size": (16, 16, 3)}}, r"size=\(16, 16, 3\) must be.*\(height, width\)"),
        ({"objectives": {Contrastive: 1.0}}, r"dotted path as text, such as 'sb3_crc\.objectives\.contrastive\.Contrastive'"),
        ({"objectives": {1: 1.0}}, "objectives: 1 must be a name"),
        ({"policy_kwargs": {"activation_fn": "relu"}}, "activation_fn='relu' must be a class.*ReLU"),
        ({"policy_kwargs": {"activation_fn": th.nn.ReLU()}}, r"activation_fn=ReLU\(\) must be a class.*ReLU"),
        ({"policy_kwargs": {"features_extractor_class": "NatureCNN"}}, "features_extractor_class.*PixelEncoder.*'NatureCNN'"),
        *[({"policy_kwargs": {"n_critics": value}}, f"n_critics={value} must be.*at least 1") for value in (0, 1.5)],
        (
            {"policy_kwargs": {"features_extractor_kwargs": {"features_dim": 50.0}}},
            "features_dim=50.0: only integers of at least 1 are allowed",
        ),
        ({"policy_kwargs": {"features_extractor_kwargs": {"channels": 32}}}, "channels=32 must be a sequence"),
    ],
)
def test_values_of_other_types_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        construct(**settings)


# -- Crops -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"image_size": 41}, "41.*40x40"),
        ({"image_size": (30, 41)}, "41.*40x40"),
        ({"image_size": 0}, "image_size=0.*40x40"),
        ({"augmentation_kwargs": {"size": 60}}, "60x60.*40x40"),
        ({"augmentation": "center_crop", "augmentation_kwargs": {"size": (41, 30)}}, "41x30.*40x40"),
        ({"augmentation_kwargs": {"size": 20}}, "34x34.*20x20"),
        ({"augmentation": "random_shift", "augmentation_kwargs": {"pad": -1}}, "pad=-1.*at least 0"),
    ],
)
def test_impossible_crops_fail_at_construction(settings: dict[str, Any], message: str) -> None:
    """Not after the warm-up, when the first batch is cut."""
    with pytest.raises(ValueError, match=message):
        construct(**settings)


def test_the_check_of_the_augmentation_draws_no_random_numbers() -> None:
    """Nor does it depend on them: the same seed gives the same first batch with and without a random augmentation."""
    states = []
    for augmentation in ("center_crop", "random_crop", "random_shift"):
        construct(augmentation=augmentation, image_size=34, seed=3)
        states.append(th.get_rng_state())
    assert all(th.equal(state, states[0]) for state in states[1:])


# -- Numbers -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        *[("tau", value, r"\[0, 1\]") for value in (-0.1, 1.5, NAN)],
        *[("encoder_tau", value, r"\[0, 1\]") for value in (-0.1, 1.5, NAN)],
        *[("gamma", value, r"\[0, 1\]") for value in (-0.1, 1.5, NAN)],
        *[("policy_delay", value, ">= 1") for value in (0, -1, 1.5)],
        *[("target_update_interval", value, ">= 1") for value in (0, -1, 1.5)],
        *[("batch_size", value, ">= 1") for value in (0, -1)],
        *[("n_steps", value, ">= 1") for value in (0, -1)],
        ("gradient_steps", -2, ">= -1"),
        *[("initial_updates", value, ">= 0") for value in (-1, 0.5)],
        *[("reward_scale", value, "finite") for value in (NAN, INFINITY, -INFINITY)],
        *[("max_grad_norm", value, "> 0") for value in (0.0, -1.0, NAN)],
        *[(name, None, r"\[0, 1\]") for name in ("tau", "gamma")],
    ],
)
def test_numbers_out_of_range_are_refused(name: str, value: float, allowed: str) -> None:
    with pytest.raises(ValueError, match=rf"{name}={value}\b.*({allowed})"):
        construct(**{name: value})


@pytest.mark.parametrize("name", ["tau", "batch_size", "reward_scale", "max_grad_norm"])
def test_words_are_no_numbers(name: str) -> None:
    """As from a YAML file with quotes: comparing them was a TypeError that named nothing."""
    with pytest.raises(ValueError, match=f"{name}='0.5' must be"):
        construct(**{name: "0.5"})


@pytest.mark.parametrize(
    "settings",
    [
        {"tau": 0.0, "encoder_tau": 1.0, "gamma": 1.0},
        {"tau": 1, "encoder_tau": 0, "gamma": 0},
        {"policy_delay": np.int64(1), "target_update_interval": 1, "batch_size": 1, "initial_updates": 0},
        {"gradient_steps": -1, "reward_scale": 2, "max_grad_norm": 5},
    ],
)
def test_the_ends_of_the_ranges_are_allowed(settings: dict[str, Any]) -> None:
    model = make_model(**{"learning_starts": 12, "batch_size": 8, **settings})
    assert model._n_updates == 28


RATES = ("learning_rate", "qf_learning_rate", "encoder_learning_rate", "ent_coef_learning_rate")


@pytest.mark.parametrize("name", RATES)
@pytest.mark.parametrize("value", [-1e-3, NAN, INFINITY, "lin_-0.1", "lin_nan"])
def test_learning_rates_are_finite_and_not_negative(name: str, value: Any) -> None:
    number = str(value).removeprefix("lin_")
    with pytest.raises(ValueError, match=rf"{name}.*{number}"):
        construct(**{name: value})


@pytest.mark.parametrize("name", RATES)
def test_a_schedule_that_becomes_negative_is_stopped_there(name: str) -> None:
    model = make_model(**{name: lambda progress: progress - 0.5})
    model._current_progress_remaining = 0.75
    model.train(gradient_steps=1, batch_size=16)
    model._current_progress_remaining = 0.25
    with pytest.raises(ValueError, match=f"{name}.*-0.25"):
        model.train(gradient_steps=1, batch_size=16)


def test_loading_checks_the_numbers_too(tmp_path: Path) -> None:
    construct().save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="tau=1.5"):
        CRCSAC.load(tmp_path / "model.zip", tau=1.5)


def test_no_gradient_steps_are_no_updates() -> None:
    model = make_model()
    model.train(gradient_steps=0, batch_size=16)
    assert model._n_updates == 0


# -- Batches that are larger than what there is ------------------------------------------------------------------------


@pytest.mark.parametrize("n_envs", [1, 2])
def test_a_batch_larger_than_what_is_stored_is_refused(n_envs: int) -> None:
    """SB3 would fill it with copies, which are false negatives of the contrastive loss."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    model = construct(DummyVecEnv([NoiseEnv] * n_envs), batch_size=16, learning_starts=4)
    with pytest.raises(ValueError, match=rf"batch_size=16.*\b{6 if n_envs == 2 else 5}\b.*learning_starts"):
        model.learn(20)
    assert model._n_updates == 0
    model = construct(DummyVecEnv([NoiseEnv] * n_envs), batch_size=16, learning_starts=15)
    model.learn(16)
    assert model._n_updates == 1


def test_a_buffer_smaller_than_the_batch_is_refused_when_it_trains(tmp_path: Path) -> None:
    """And not before: whoever only wants to predict may load with the smallest buffer."""
    model = construct(batch_size=16, buffer_size=10, learning_starts=20)
    with pytest.raises(ValueError, match=r"batch_size=16.*\b10\b.*buffer_size"):
        model.learn(21)
    model.save(tmp_path / "model.zip")
    CRCSAC.load(tmp_path / "model.zip", buffer_size=1).predict(np.zeros((9, 40, 40), np.uint8))


@pytest.mark.parametrize(
    ("name", "instead"),
    [
        ("objectives", "objectives"),
        ("joint_update", "joint_update"),
        ("qf_lr_schedule", "qf_learning_rate"),
        ("encoder_lr_schedule", "encoder_learning_rate"),
    ],
)
def test_what_the_algorithm_gives_the_policy_is_refused_among_its_own(name: str, instead: str) -> None:
    with pytest.raises(ValueError, match=rf"policy_kwargs: {name} is not the policy's own, give CRCSAC {instead}=\.\.\."):
        CRCSAC("CnnPolicy", NoiseEnv(), policy_kwargs={name: {}})


def test_an_argument_that_there_is_not_is_named_with_the_nearest() -> None:
    with pytest.raises(TypeError, match=r"unknown argument of CRCSAC 'learning_rates'; did you mean 'learning_rate'\?"):
        CRCSAC("CnnPolicy", NoiseEnv(), learning_rates=1e-3)


def test_a_buffer_that_never_holds_a_batch_is_refused_before_it_is_filled() -> None:
    model = CRCSAC("CnnPolicy", NoiseEnv(), batch_size=64, buffer_size=50, learning_starts=100, policy_kwargs=POLICY_KWARGS)
    with pytest.raises(
        ValueError, match="batch_size=64 is more than the replay buffer holds, 50 transitions: raise buffer_size"
    ):
        model.learn(120)
    assert model.replay_buffer.size() == 0
    assert model.learn(20).replay_buffer.size() == 20  # random actions alone
