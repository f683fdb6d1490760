"""An exported policy in its own task and in others: it sees and decides as where it was trained."""

import importlib.util
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from typer.testing import CliRunner

from sb3_crc import load_policy, make_dmc
from sb3_crc.cli import app
from sb3_crc.envs import dmc
from sb3_crc.export import export_policy
from tests.analysis.conftest import ENV_KWARGS, make_model


def asked_for(monkeypatch: pytest.MonkeyPatch, *words: str) -> dict[str, Any]:
    """:return: what make_dmc is called with"""
    asked: dict[str, Any] = {}

    def make(task: str, **kwargs: Any) -> None:
        asked.update(kwargs, task=task)
        raise ValueError("asked for")

    monkeypatch.setattr(dmc, "make_dmc", make)
    done = CliRunner().invoke(app, ["enjoy", *words])
    assert done.exit_code == 2 and done.stderr == "asked for\n"
    return asked


def test_in_another_task_a_policy_sees_the_same_pictures(places: dict[str, Path]) -> None:
    done = CliRunner().invoke(app, ["enjoy", str(places["policy"]), "--task", "cartpole-swingup", "--episodes", "1"])
    assert done.exit_code == 0, done.stderr
    env = make_vec_env(lambda: make_dmc("cartpole-swingup", seed=0, **ENV_KWARGS), seed=0)
    (expected,), _ = evaluate_policy(load_policy(places["policy"]), env, n_eval_episodes=1, return_episode_rewards=True)  # type: ignore[misc]
    assert done.stdout == f"cartpole-swingup, episode 0: {expected:.1f}\n"


@pytest.mark.parametrize(("said", "expected"), [({}, 8), ({"action_repeat": 5}, 5)])
def test_in_another_task_it_decides_as_often(
    said: dict[str, int], expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """cartpole's actions are repeated 8 times where nothing is said, pendulum's twice."""
    about: dict[str, Any] = {"task": "cartpole-balance", "env_kwargs": {"image_size": 36, "frame_stack": 2, **said}}
    path = str(export_policy(make_model("rad", 0), tmp_path / "policy.sb3crc", **about))  # type: ignore[arg-type]
    own = {"image_size": 36, "frame_stack": 2, "seed": 0}
    assert asked_for(monkeypatch, path, "--task", "pendulum-swingup") == {
        **own,
        "task": "pendulum-swingup",
        "action_repeat": expected,
    }
    assert asked_for(monkeypatch, path) == {**own, **said, "task": "cartpole-balance"}


def test_a_policy_that_does_not_say_where_it_acts_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = str(export_policy(make_model("rad", 0), tmp_path / "policy.sb3crc"))  # type: ignore[arg-type]
    done = CliRunner().invoke(app, ["enjoy", path])
    assert done.exit_code == 2 and "does not say in which environment it acts" in done.stderr
    assert asked_for(monkeypatch, path, "--task", "cartpole-balance") == {"seed": 0, "task": "cartpole-balance"}


def test_where_it_cannot_act_it_does_not(places: dict[str, Path]) -> None:
    """dm_control would take its one action for all of the walker's six."""
    done = CliRunner().invoke(app, ["enjoy", str(places["policy"]), "--task", "walker-walk", "--episodes", "1"])
    assert done.exit_code == 2 and "Action spaces do not match" in done.stderr and not done.stdout


def test_a_film_that_cannot_be_made_is_said_before_anything_acts(
    places: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda one, *rest: None if one == "av" else find(one, *rest))
    done = CliRunner().invoke(app, ["enjoy", str(places["policy"]), "--film", str(tmp_path / "film.mp4")])
    assert done.exit_code == 2 and "pip install 'sb3-crc[video]'" in done.stderr and not done.stdout
