"""Each argument by its signature: with another value something else comes out, or the test that sees it is named.

An argument that is ignored fails here, and so does a new one that is not in these tables.
"""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.noise import NormalActionNoise
from torch import nn

from sb3_crc import (
    CRCSAC,
    AuxiliaryLossCallback,
    CRCPolicy,
    FrameReplayBuffer,
    PixelDecoder,
    PixelEncoder,
    TrainingCheckpoint,
    make_dmc,
)
from sb3_crc.objectives import OBJECTIVES
from tests.fixtures.make import SMALL, new_model
from tests.named_tests import is_test
from tests.probes import (
    ACTIONS,
    ENCODER,
    IMAGES,
    checkpointed,
    decoded,
    replayed,
    seen,
    trained,
    with_auxiliary_loss,
    with_encoder,
    with_objective,
    with_policy,
)


class Table(NamedTuple):
    """
    :param probe: arguments -> what they lead to
    :param changes: argument -> another value than its default, or that with what it needs to matter: (value, the others)
    :param elsewhere: argument -> the test that fails when it is ignored, since what is probed here does not show it
    :param refused: argument -> a value that is refused, where it is supported in no other way
    :param meaningless: arguments of SB3 that have no meaning here
    """

    probe: Callable[..., Any]
    changes: dict[str, Any]
    elsewhere: dict[str, str]
    refused: dict[str, Any]
    meaningless: tuple[str, ...] = ()


HERE = "tests/test_every_argument.py::"
TABLES: dict[Callable[..., Any], Table] = {
    CRCSAC: Table(
        trained,
        {
            "learning_rate": 1e-2,
            "buffer_size": 14,
            "learning_starts": 15,
            "batch_size": 7,
            "tau": 0.5,
            "gamma": 0.5,
            "train_freq": 2,
            "gradient_steps": 2,
            "action_noise": NormalActionNoise(np.ones(2), np.zeros(2)),
            "replay_buffer_class": type("Other", (FrameReplayBuffer,), {}),
            "replay_buffer_kwargs": ({"handle_timeout_termination": False}, {}),
            "n_steps": 2,
            "ent_coef": 0.3,
            "target_update_interval": 3,
            "target_entropy": -7.0,
            "stats_window_size": 7,
            "seed": 1,
            "policy_kwargs": {**SMALL["policy_kwargs"], "layer_norm": True},
            "encoder_tau": 0.5,
            "policy_delay": 3,
            "qf_learning_rate": 1e-2,
            "encoder_learning_rate": 1e-2,
            "ent_coef_learning_rate": 1e-1,
            "objectives": {"contrastive": 1.0},
            "augmentation": "random_shift",
            "augmentation_kwargs": ({"pad": 2}, {"augmentation": "random_shift"}),
            "objective_augmentation": "random_shift",
            "objective_augmentation_kwargs": (
                {"pad": 1},
                {"augmentation": "random_shift", "objective_augmentation": "random_shift"},
            ),
            "image_size": 18,
            "q_augmentations": 2,
            "target_augmentations": 2,
            "anchor": "center_crop",
            "balance": "grad_norm",
            "auxiliary_interval": 2,
            "joint_update": True,
            "reencode": True,
            "initial_updates": 3,
            "reward_scale": 2.0,
            "max_grad_norm": 1e-3,
            "precision": "bfloat16",
        },
        {
            "policy": "tests/test_bad_spaces.py::test_the_policy_must_suit_the_observations",
            "env": "tests/test_sb3_environments.py::test_set_env",
            "tensorboard_log": "tests/test_sb3_logs.py::test_the_tensorboard_folder_is_named_for_the_algorithm",
            "verbose": HERE + "test_verbose_tells_more",
            "compile": "tests/test_recording.py::test_on_a_cpu_nothing_is_recorded_and_the_argument_is_kept",
            "replay_device": "tests/test_precision.py::test_frames_that_do_not_fit_beside_the_networks_stay_with_the_host",
            "overlap": "tests/test_overlap.py::test_environments_in_processes_step_meanwhile",
            "on_nonfinite": "tests/test_finite.py::test_skipped_updates_are_counted_and_training_goes_on",
            "_init_setup_model": HERE + "test_networks_can_be_left_for_later",
        },
        {"use_sde": True, "optimize_memory_usage": True, "device": "nowhere"},
        ("sde_sample_freq", "use_sde_at_warmup"),
    ),
    CRCPolicy: Table(
        with_policy,
        {
            "net_arch": [9],
            "activation_fn": nn.ELU,
            "features_extractor_kwargs": {**ENCODER, "features_dim": 5},
            "optimizer_class": th.optim.AdamW,
            "optimizer_kwargs": {"eps": 1e-2},
            "n_critics": 3,
            "actor_features": "latent",
            "log_std_bounds": (-5, 0),
            "layer_norm": True,
            "encoder_steps": 3,
        },
        {
            "features_extractor_class": HERE + "test_the_encoder_may_be_ones_own",
            "observation_space": "tests/test_bad_spaces.py::test_observations_that_are_not_byte_images_are_refused",
            "action_space": "tests/test_predict.py::test_actions_are_scaled_to_the_action_space",
            "use_sde": HERE + "test_a_policy_refuses_gsde",
            # What CRCSAC passes on
            "objectives": HERE + "test_another_value_leads_to_something_else",
            "joint_update": HERE + "test_another_value_leads_to_something_else",
            "lr_schedule": "tests/test_crc_sac.py::test_learning_rates_are_separate_and_follow_their_schedules",
            "qf_lr_schedule": "tests/test_crc_sac.py::test_learning_rates_are_separate_and_follow_their_schedules",
            "encoder_lr_schedule": "tests/test_crc_sac.py::test_learning_rates_are_separate_and_follow_their_schedules",
        },
        {"normalize_images": False},
    ),
    PixelEncoder: Table(
        with_encoder,
        {
            "features_dim": 5,
            "image_size": 18,
            "channels": [2, 3],
            "strides": [2, 1],
            "kernel_size": 5,
            "latent_activation": "tanh",
            "center_input": True,
            "frame_differences": (1.0, {"frame_channels": 1}),
            "initialization": "orthogonal",
        },
        {
            "observation_space": "tests/test_encoder.py::test_bytes_and_sb3s_scaled_floats_give_the_same_latent",
            "frame_channels": "tests/test_encoder.py::test_differences_need_two_whole_frames",
        },
        {},
    ),
    PixelDecoder: Table(
        decoded,
        {"latent_dim": 7, "observation_shape": (3, 26, 24), "channels": (3, 4), "strides": (1, 1), "kernel_size": 5},
        {},
        {},
    ),
    OBJECTIVES["contrastive"]: Table(
        with_objective("contrastive"), {"key": "next", "initialization": "uniform", "symmetric": False}, {}, {}
    ),
    OBJECTIVES["reconstruction"]: Table(
        with_objective("reconstruction"),
        {
            "channels": [3, 4],
            "strides": [1, 2],
            "kernel_size": 5,
            "reduction": "sum",
            "target": "clean",
            "half_size": True,
            "standardize": True,
            "bits": 3,
            "latent_penalty": 1.0,
            "decoder_penalty": 1.0,
        },
        {"mixing": "tests/test_encoder.py::test_the_encoder_is_fed_amplified_differences_and_the_newest_frame"},
        {},
    ),
    OBJECTIVES["consistency"]: Table(
        with_objective("consistency"),
        {
            "predictor_side": "online",
            "target": ("positive", {"predictor_side": "online"}),
            "predictor": "batch_norm",
            "hidden_dim": 5,
            "normalize": True,
            "reduction": "mean",
        },
        {},
        {},
    ),
    FrameReplayBuffer: Table(
        replayed,
        {
            "buffer_size": 6,
            "n_envs": 2,
            "handle_timeout_termination": False,
            "frame_channels": 1,
            "n_steps": 2,
            "gamma": (0.5, {"n_steps": 2}),
        },
        {
            "observation_space": "tests/buffers/test_replay.py::test_observations_that_are_not_stacks_are_stored_whole",
            "action_space": "tests/buffers/test_replay.py::test_actions_of_any_space",
            "frame_device": "tests/test_precision.py::test_frames_elsewhere_are_brought_to_where_they_are_needed",
        },
        {"optimize_memory_usage": True, "device": "nowhere"},
    ),
    make_dmc: Table(
        seen,
        {
            "task": "cartpole-balance",
            "seed": 1,
            "image_size": 40,
            "action_repeat": 2,
            "frame_stack": 2,
            "camera_id": 1,
            "render_quality": "benchmark",
            "observation": "state",
            "render_mode": None,
            "distraction": "color_easy",
        },
        {
            "distraction_data": "tests/envs/test_distractions_data.py::test_other_data_have_another_label",
            "distraction_mask": "tests/envs/test_distractions_benchmark.py::test_the_segmentation_keeps_it",
        },
        {},
    ),
    AuxiliaryLossCallback: Table(
        with_auxiliary_loss,
        {
            "objectives": {"contrastive": 1.0},
            "gradient_steps": 2,
            "learning_rate": 1e-2,
            "augmentation": "random_conv",
            "augmentation_kwargs": {"pad": 1},
            "batch_size": 7,
            "encoder_tau": 0.9,
        },
        {"verbose": HERE + "test_verbose_tells_more"},
        {},
    ),
}
#: Of SB3's SAC, what CRCSAC passes on
OWN_AND_PASSED_ON = {*inspect.signature(CRCSAC).parameters, *inspect.signature(SAC).parameters} - {"kwargs"}
CHECKPOINT_CHANGES = {"folder": "elsewhere", "every": 6, "keep": 1}
CHECKPOINT_ELSEWHERE = {
    "monitor_dir": "tests/checkpoints/test_logs.py::test_environments_in_other_processes_go_on_with_their_files",
    "verbose": HERE + "test_verbose_tells_more",
}
CASES = [(thing, argument) for thing, table in TABLES.items() for argument in table.changes]


def same(first: dict[str, Any], second: dict[str, Any]) -> bool:
    return first.keys() == second.keys() and all(np.array_equal(first[name], second[name]) for name in first)


def change(table: Table, argument: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """:return: what it is compared with, and the same with another value"""
    value = table.changes[argument]
    value, others = value if isinstance(value, tuple) and isinstance(value[-1], dict) else (value, {})
    return others, {**others, argument: value}


@pytest.fixture(scope="module")
def known() -> dict[str, dict[str, Any]]:
    """What was probed already."""
    return {}


@pytest.mark.parametrize(("thing", "argument"), CASES, ids=[f"{thing.__name__}-{argument}" for thing, argument in CASES])
def test_another_value_leads_to_something_else(
    thing: Callable[..., Any], argument: str, known: dict[str, dict[str, Any]]
) -> None:
    table = TABLES[thing]
    others, changed = change(table, argument)
    name = f"{thing.__name__} {others}"
    if name not in known:
        known[name] = table.probe(**others)
        assert same(known[name], table.probe(**others)), "what is probed is not repeatable: it would differ from anything"
    assert not same(known[name], table.probe(**changed)), f"{argument} of {thing.__name__} is ignored"


REFUSED = [(thing, argument) for thing, table in TABLES.items() for argument in table.refused]


@pytest.mark.parametrize(("thing", "argument"), REFUSED, ids=[f"{thing.__name__}-{argument}" for thing, argument in REFUSED])
def test_what_is_not_supported_is_refused(thing: Callable[..., Any], argument: str) -> None:
    table = TABLES[thing]
    with pytest.raises((ValueError, RuntimeError), match=rf"{argument}|{table.refused[argument]}"):
        table.probe(**{argument: table.refused[argument]})


@pytest.mark.parametrize("argument", CHECKPOINT_CHANGES)
def test_another_value_leads_to_other_checkpoints(argument: str, tmp_path: Path) -> None:
    probe = checkpointed(tmp_path)
    assert not same(probe(), probe(**{argument: CHECKPOINT_CHANGES[argument]}))


@pytest.mark.parametrize("thing", TABLES, ids=lambda thing: thing.__name__)
def test_no_argument_is_left_out(thing: Callable[..., Any]) -> None:
    table = TABLES[thing]
    told = [*table.changes, *table.elsewhere, *table.refused, *table.meaningless]
    base = {"latent_dim", "observation_shape", "action_dim"} if thing in OBJECTIVES.values() else set()  # given to all of them
    arguments = OWN_AND_PASSED_ON if thing is CRCSAC else set(inspect.signature(thing).parameters) - base
    assert sorted(told) == sorted(arguments)
    assert [reference for reference in table.elsewhere.values() if not is_test(reference)] == []


def test_no_argument_of_a_checkpoint_is_left_out() -> None:
    assert {*CHECKPOINT_CHANGES, *CHECKPOINT_ELSEWHERE} == set(inspect.signature(TrainingCheckpoint).parameters)
    assert all(is_test(reference) for reference in CHECKPOINT_ELSEWHERE.values())
    assert not is_test(HERE + "test_that_is_not_there")


# -- What a training's end does not show -------------------------------------------------------------------------------


def test_verbose_tells_more(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    new_model(verbose=0)
    assert capsys.readouterr().out == ""
    new_model(verbose=1)
    assert "Using cpu device" in capsys.readouterr().out
    for verbose in (0, 1):
        with_auxiliary_loss(verbose=verbose)
        assert ("AuxiliaryLossCallback trains PixelEncoder" in capsys.readouterr().out) == (verbose == 1)
    new_model().learn(8, callback=TrainingCheckpoint(tmp_path))
    for verbose in (0, 1):
        new_model().learn(12 + 4 * verbose, callback=TrainingCheckpoint(tmp_path, verbose=verbose))
        assert ("Going on from" in capsys.readouterr().out) == (verbose == 1)


def test_networks_can_be_left_for_later() -> None:
    assert not hasattr(new_model(_init_setup_model=False), "policy")
    assert hasattr(new_model(), "policy")


def test_a_policy_refuses_gsde() -> None:
    with pytest.raises(ValueError, match="use_sde=True"):
        CRCPolicy(IMAGES, ACTIONS, lambda _: 0.0, use_sde=True)


def test_the_encoder_may_be_ones_own() -> None:
    own = type("Own", (PixelEncoder,), {})
    assert type(new_model(policy_kwargs={**SMALL["policy_kwargs"], "features_extractor_class": own}).policy.key_encoder) is own
