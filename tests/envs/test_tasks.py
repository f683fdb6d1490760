"""The static tables of the suite: complete, cheap to import, and with the literature's values."""

from __future__ import annotations

import gymnasium as gym
import pytest

from sb3_crc.envs.tasks import (
    SUITE_TASKS,
    default_action_repeat,
    default_camera,
    environment_id,
    register_environments,
    split_task,
    task_names,
)


def test_task_table_is_the_suite() -> None:
    from dm_control import suite

    table = {(domain, task) for domain, tasks in SUITE_TASKS.items() for task in tasks}
    assert table == set(suite.ALL_TASKS)
    assert {environment_id(task) for task in task_names()} <= set(gym.registry)


@pytest.mark.parametrize(
    ("task", "repeat"),
    [
        ("cartpole-swingup", 8),
        ("reacher-easy", 4),
        ("cheetah-run", 4),
        ("ball_in_cup-catch", 4),
        ("finger-spin", 2),
        ("walker-walk", 2),
        ("quadruped-walk", 2),
        ("hopper-hop", 2),
    ],
)
def test_action_repeats_are_the_literatures(task: str, repeat: int) -> None:
    assert default_action_repeat(task) == repeat


def test_cameras() -> None:
    assert default_camera("cartpole-swingup") == 0
    assert default_camera("quadruped-run") == 2
    assert (default_camera("dog-run"), default_camera("dog-fetch")) == (0, 2)


def test_task_names_and_ids_are_both_understood() -> None:
    assert split_task("dmc_pixels/humanoid_CMU-run-v0") == split_task("humanoid_CMU-run") == ("humanoid_CMU", "run")


def test_registering_twice_is_silent(recwarn: pytest.WarningsRecorder) -> None:
    register_environments()
    assert len(recwarn) == 0
