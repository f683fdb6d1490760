"""``compare`` and ``sweep``: real trainings in processes of their own, stopped, taken up again, and failing."""

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.experiments.runs import FAILURE, find_runs, read_json
from tests.test_zoo import ROOT

TINY = ROOT / "tests" / "tiny.yml"


def command(output: Path, *flags: str, presets: str = "crc,sac") -> list[str]:
    own = ["--task", "cartpole-swingup", "--presets", presets, "--seeds", "1", "--env-steps", "1200", "--eval-every", "400"]
    own += ["--eval-episodes", "1", "--conf-file", str(TINY), "-o", str(output), "--checkpoint-every", "25"]
    return ["compare", *own, *flags]


def start(output: Path, *flags: str) -> subprocess.Popen[str]:
    whole = [sys.executable, "-m", "sb3_crc", *command(output, *flags)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(whole, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def results(output: Path) -> dict[str, Any]:
    """What each run came to, but times."""
    found = {}
    for run in find_runs([output]):
        with np.load(run.folder / "evaluations.npz") as data:
            evaluations = {name: data[name].tolist() for name in data.files if "seconds" not in name}
        found[run.method] = evaluations, read_json(run.folder / "final.json")["returns"]
    return found


@pytest.mark.slow
def test_a_dry_run_starts_nothing(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, command(tmp_path / "runs", "--dry-run", presets="rad"))
    assert done.exit_code == 0 and done.stdout.count("150 agent steps, to run") == 1
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--presets", "crc,sacc"], "preset of 'sacc'"),
        (["--env-steps", "1001"], "env_steps=1001 must be a positive multiple of the action repeat, 8"),
        (["--task", "cartpole-swingdown"], "Unknown task 'cartpole-swingdown'"),
        (["--task", "cartpole-swingdown", "--dry-run"], "Did you mean 'cartpole-swingup'"),
        (["--conf-file", "nowhere.yml"], "nowhere.yml"),
    ],
)
def test_mistakes_are_one_line(tmp_path: Path, flags: list[str], message: str) -> None:
    done = CliRunner().invoke(app, [*command(tmp_path / "runs"), *flags])
    assert done.exit_code == 2 and message in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_a_comparison_that_was_stopped_twice_ends_as_it_would_have(tmp_path: Path) -> None:
    whole = start(tmp_path / "whole", "--jobs", "2")
    output, errors = whole.communicate(timeout=300)
    assert whole.returncode == 0, errors
    assert errors.count("begun") == 2 and errors.count("finished") == 2 and output.count("\n") == 1
    with (tmp_path / "whole" / "scores.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {(row["method"], row["policy"], row["environment_steps"]) for row in rows} == {
        (method, policy, steps)
        for method in ("crc", "sac")
        for policy, steps in (("current", "400"), ("current", "800"), ("current", "1200"), ("final", "1200"))
    }
    assert all(float(row["seconds"]) > 0 and row["git_revision"] and row["machine"] for row in rows)

    stopped = tmp_path / "stopped"
    for signum, jobs in ((signal.SIGTERM, "2"), (signal.SIGINT, "1")):
        first = start(stopped, "--jobs", jobs)
        deadline = time.time() + 200
        seen = set(stopped.rglob("checkpoints/0*/manifest.json"))  # of each run two are kept: a new one, not one more
        while not set(stopped.rglob("checkpoints/0*/manifest.json")) - seen or not list(
            stopped.rglob("checkpoints/flags.json")
        ):
            assert first.poll() is None, first.communicate()
            assert time.time() < deadline
            time.sleep(0.05)
        first.send_signal(signum)
        _, errors = first.communicate(timeout=120)
        assert first.returncode == 128 + signum, errors
        assert "The same command goes on" in errors
    last = start(stopped, "--jobs", "2")
    output, errors = last.communicate(timeout=300)
    assert last.returncode == 0, errors
    assert "resumed" in errors
    assert results(stopped) == results(tmp_path / "whole")

    again = start(stopped)
    output, errors = again.communicate(timeout=120)
    assert again.returncode == 0 and "begun" not in errors and "resumed" not in errors


@pytest.mark.slow
def test_a_failure_does_not_stop_the_others_and_can_be_mended(tmp_path: Path) -> None:
    sweep = tmp_path / "sweep.yml"
    sweep.write_text(
        f"env_steps: 1200\neval_every: 600\neval_episodes: 1\ntasks: [cartpole-swingup]\nseeds: 1\nconf_file: {TINY}\n"
        "variants:\n  broken: {preset: crc, augmentation: mirror}\n  rad: {}\n"
    )
    whole = [sys.executable, "-m", "sb3_crc", "sweep", str(sweep), "-o", str(tmp_path / "runs")]
    done = subprocess.run(whole, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1
    assert "broken" in done.stderr and "augmentation" in done.stderr and "[1/2]" in done.stderr
    assert "missing: broken on cartpole-swingup, seed 0: failed" in done.stderr
    (failure,) = (tmp_path / "runs").rglob(FAILURE)
    assert read_json(failure)["exit_code"] != 0 and "mirror" in str(read_json(failure)["last_lines"])
    assert set(results(tmp_path / "runs")) == {"rad"}
