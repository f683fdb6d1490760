"""The table of trials."""

import csv
import json
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import yaml

from sb3_crc import CRCSAC, make_dmc
from sb3_crc.experiments import final, trials
from sb3_crc.experiments.runs import Run
from sb3_crc.experiments.trials import FIELDS, record_trials
from sb3_crc.experiments.watching import read_progress
from tests.conftest import POLICY_KWARGS

ENV = "dmc_pixels/cartpole-swingup-v0"
ENV_KWARGS = {"image_size": 36, "frame_stack": 2, "render_quality": "fast", "action_repeat": 40}


def make_run(folder: Path, *, finished: bool, seen: int = 50) -> Path:
    """A folder as rl_zoo3 leaves it, with a policy that has learned nothing; its budget is 50 decisions."""
    name = "dmc_pixels-cartpole-swingup-v0"
    run = folder / "crc" / f"{name}_1"
    (run / name).mkdir(parents=True)
    (run / name / "args.yml").write_text(yaml.dump(OrderedDict(algo="crc", env=ENV, seed=7, n_timesteps=50)))
    (run / name / "config.yml").write_text(yaml.dump(OrderedDict(gamma=0.9, env_kwargs=ENV_KWARGS)))
    (run / "0.monitor.csv").write_text("#{}\nr,l,t\n1.0,25,30.0\n2.0,25,90.0\n")
    np.savez(run / "evaluations.npz", timesteps=[25, 50], results=[[1.0, 2.0], [3.0, 5.0]])
    if finished:
        env = make_dmc("cartpole-swingup", seed=0, **ENV_KWARGS)
        model = CRCSAC("CnnPolicy", env, buffer_size=10, policy_kwargs=POLICY_KWARGS)
        model.num_timesteps = seen
        model.save(run / name)
    return run


def test_trials_are_read_evaluated_and_replaced(tmp_path: Path) -> None:
    table = tmp_path / "results" / "trials.csv"
    unfinished = make_run(tmp_path / "one", finished=False)
    record_trials([unfinished], table)
    run = make_run(tmp_path / "two", finished=True)
    rows = record_trials([run], table, episodes=2)
    assert 0 <= rows[0]["final_mean"] < 500
    record_trials([unfinished], table, note="stopped")  # again: no second row
    written = list(csv.DictReader(table.open()))
    assert {row["trial"] for row in written} == {str(unfinished), str(run)} and len(written) == 2
    for row in written:
        assert (row["algo"], row["seed"], row["environment_steps"]) == ("crc", "7", "2000")
        assert (row["curve"], row["minutes"]) == ("1000:2 2000:4", "1.5")
        assert row["note"] == ("stopped" if row["trial"] == str(unfinished) else "")
        assert json.loads(row["settings"])["gamma"] == 0.9
        assert bool(row["final_returns"]) == (row["trial"] == str(run))
    assert list(FIELDS) == list(written[0])


def test_another_table_stays_as_it_is(tmp_path: Path) -> None:
    run, table = make_run(tmp_path / "one", finished=False), tmp_path / "scores.csv"
    for content, message in (("method,return\ncrc,1\n", "its columns are method, return"), ("", "its columns are none")):
        table.write_text(content)
        with pytest.raises(ValueError, match=rf"scores\.csv is no table of trials: {message}"):
            record_trials([run], table)
        assert table.read_text() == content


def test_one_episode_has_no_spread(tmp_path: Path) -> None:
    (row,) = record_trials([make_run(tmp_path / "one", finished=True)], tmp_path / "trials.csv", episodes=1)
    assert row["final_std"] == "" and float(row["final_returns"]) == pytest.approx(row["final_mean"], abs=0.5)


def test_an_interrupted_run_has_a_model_but_no_final_score(tmp_path: Path) -> None:
    run = make_run(tmp_path / "one", finished=True, seen=49)
    (row,) = record_trials([run], tmp_path / "trials.csv", episodes=1)
    assert "final_mean" not in row and row["curve"] == "1000:2 2000:4"
    assert (Run(run).status, Run(run).has_ended, Run(run).agent_steps) == ("unfinished", False, 49)
    assert read_progress(Run(run)).status == "unfinished"
    whole = Run(make_run(tmp_path / "two", finished=True))
    assert (whole.status, whole.has_ended) == ("unevaluated", True) and read_progress(whole).agent_steps == 50


def test_trials_have_episodes_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds = []
    monkeypatch.setattr(trials, "final_returns", lambda run, *, episodes, seed: seeds.append(seed) or [1.0] * episodes)
    record_trials([make_run(tmp_path / "one", finished=True)], tmp_path / "trials.csv", episodes=2)
    assert seeds == [40_000] and trials.FIRST_SEED != final.FIRST_SEED


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no run of train.py"):
        record_trials([tmp_path], tmp_path / "trials.csv")
    assert not (tmp_path / "trials.csv").exists()
