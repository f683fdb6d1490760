"""train.py --checkpoint-every and --resume: a killed run goes on in its own folder to the end that it would have had."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import torch as th

from sb3_crc import CRCSAC
from sb3_crc.zoo.resume import CHECKPOINTS, FLAGS, Plan, read_plan, write_plan
from tests.test_zoo import ROOT, command, environment

RUN = "crc/dmc_pixels-cartpole-swingup-v0_1"
MODEL = "dmc_pixels-cartpole-swingup-v0.zip"


def test_own_flags_are_taken_out() -> None:
    assert read_plan(["--algo", "crc", "-n", "10"]) == Plan(["--algo", "crc", "-n", "10"], None, None)
    assert read_plan(["--algo", "crc", "--checkpoint-every", "50", "-n", "10"]) == Plan(
        ["--algo", "crc", "-n", "10"], 50, None
    )


def test_a_run_goes_on_with_its_flags_and_later_ones_count(tmp_path: Path) -> None:
    write_plan(Plan(["--algo", "crc", "-params", "gamma:0.9"], 50, None), tmp_path)
    assert read_plan(["--resume", str(tmp_path)]) == Plan(["--algo", "crc", "-params", "gamma:0.9"], 50, tmp_path)
    plan = read_plan(["--resume", str(tmp_path), "-n", "99", "--checkpoint-every", "7"])
    assert (plan.flags[-2:], plan.checkpoint_every) == (["-n", "99"], 7)


def test_what_cannot_go_on_is_said_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for flags, message in (
        (["--resume", str(tmp_path)], "no checkpoints of a run made with --checkpoint-every"),
        (["--checkpoint-every", "0"], "must be at least 1"),
        (["--resume", str(tmp_path), "-i", "model.zip"], "exclude each other"),
    ):
        with pytest.raises(SystemExit) as stop:
            read_plan(flags)
        assert stop.value.code == 2
        assert message in capsys.readouterr().err
    write_plan(Plan([], 50, None), tmp_path)
    (tmp_path / CHECKPOINTS / "DONE").write_text("100\n")
    (tmp_path / "best_model.zip").touch()
    assert read_plan(["--resume", str(tmp_path)]).run == tmp_path, "killed before its final model was saved"
    (tmp_path / "dmc_pixels-cartpole-swingup-v0.zip").touch()
    with pytest.raises(SystemExit, match="has ended; to prolong it, add -n"):
        read_plan(["--resume", str(tmp_path)])
    assert read_plan(["--resume", str(tmp_path), "-n", "200"]).run == tmp_path


def results(folder: Path) -> tuple[Any, ...]:
    """Everything that a run leaves, but times."""
    with (folder / "progress.csv").open() as file:
        progress = [{k: v for k, v in row.items() if not k.startswith("time/")} for row in csv.DictReader(file)]
    monitor = [line.rsplit(",", 1)[0] for line in (folder / "0.monitor.csv").read_text().splitlines()[1:]]
    with np.load(folder / "evaluations.npz") as data:
        evaluations = {name: data[name].tolist() for name in data.files if "seconds" not in name}
    return progress, monitor, evaluations


@pytest.mark.slow
def test_a_killed_run_ends_as_it_would_have(tmp_path: Path) -> None:
    flags = ["-n", "400", "--eval-freq", "100", "--eval-episodes", "1", "--verbose", "0", "--checkpoint-every", "40"]
    whole = subprocess.run(command(tmp_path / "whole", *flags), cwd=ROOT, env=environment(), capture_output=True, text=True)
    assert whole.returncode == 0, whole.stderr[-2000:]
    first = subprocess.Popen(command(tmp_path / "killed", *flags), cwd=ROOT, env=environment(), stdout=subprocess.DEVNULL)
    folder = tmp_path / "killed" / RUN
    deadline = time.time() + 200
    while not (folder / CHECKPOINTS / "000000000120").exists():
        assert first.poll() is None and time.time() < deadline
        time.sleep(0.05)
    first.send_signal(signal.SIGKILL)
    first.wait()
    resume = [sys.executable, "train.py", "--resume", str(folder)]
    second = subprocess.run(resume, cwd=ROOT, env=environment(), capture_output=True, text=True)
    assert second.returncode == 0, second.stderr[-2000:]
    assert "Going on from" in second.stdout
    assert not (tmp_path / "killed" / "crc" / "dmc_pixels-cartpole-swingup-v0_2").exists()
    assert results(folder) == results(tmp_path / "whole" / RUN)
    one, other = (CRCSAC.load(path / MODEL).policy.state_dict() for path in (folder, tmp_path / "whole" / RUN))
    assert all(th.equal(value, other[name]) for name, value in one.items())
    assert json.loads((folder / CHECKPOINTS / FLAGS).read_text())["checkpoint_every"] == 40

    again = subprocess.run(resume, cwd=ROOT, env=environment(), capture_output=True, text=True)
    assert again.returncode == 1 and "has ended" in again.stderr


@pytest.mark.slow
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_and_says_how_to_go_on(signum: int, tmp_path: Path) -> None:
    """As a terminal or a scheduler sends it: to each process, those of the environments included."""
    flags = ["-n", "100000", "--eval-freq", "-1", "--verbose", "0", "--checkpoint-every", "40", "--vec-env", "subproc"]
    run = subprocess.Popen(
        command(tmp_path, *flags), cwd=ROOT, env=environment(), stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    checkpoints = tmp_path / RUN / CHECKPOINTS
    deadline = time.time() + 200
    while not (checkpoints / "000000000080").exists():
        assert run.poll() is None and time.time() < deadline
        time.sleep(0.05)
    processes = psutil.Process(run.pid).children(recursive=True)
    assert len(processes) >= 2
    os.killpg(run.pid, signum)
    output, _ = run.communicate(timeout=100)
    assert run.returncode == 128 + signum
    assert not psutil.wait_procs(processes, timeout=10)[1]
    last_line = output.strip().splitlines()[-1]
    assert "To go on from the last checkpoint: " in last_line and last_line.endswith(f"--resume {tmp_path / RUN}")
    stopped_at = int(last_line.partition("stopped at ")[2].split()[0])
    assert (checkpoints / f"{stopped_at:012d}").exists()
    go_on = last_line.partition("checkpoint: ")[2].split()
    resumed = subprocess.run([*go_on, "-n", str(stopped_at + 5)], cwd=ROOT, env=environment(), capture_output=True, text=True)
    assert resumed.returncode == 0, resumed.stderr[-2000:]
    assert (checkpoints / f"{stopped_at + 5:012d}").exists()


@pytest.mark.slow
def test_an_environment_that_dies_is_named_with_the_way_to_go_on(tmp_path: Path) -> None:
    """Environments are processes of their own; one is killed, and its run is resumed to its end."""
    flags = ["-n", "400", "--eval-freq", "200", "--eval-episodes", "1", "--verbose", "0", "--checkpoint-every", "40"]
    flags += ["--vec-env", "subproc", "-params", "overlap:True"]
    running = subprocess.Popen(
        command(tmp_path, *flags), cwd=ROOT, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    folder = tmp_path / RUN
    while not list((folder / CHECKPOINTS).glob("0*/manifest.json")):
        time.sleep(0.1)
        assert running.poll() is None
    for worker in psutil.Process(running.pid).children(recursive=True):
        if any("forkserver" in part for part in worker.cmdline()) and worker.ppid() != running.pid:
            worker.kill()
    said, _ = running.communicate(timeout=60)
    last = said.strip().splitlines()[-2:]
    assert running.returncode == 1 and "Traceback" not in said, said
    assert "environment 0 (process " in last[0] and "was killed by signal 9" in last[0]
    assert "To go on from the last checkpoint: " in last[1] and f"--resume {folder}" in last[1]
    resumed = [sys.executable, "train.py", "--resume", str(folder)]
    done = subprocess.run(resumed, cwd=ROOT, env=environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0 and (folder / CHECKPOINTS / "DONE").exists(), done.stderr
    assert CRCSAC.load(folder / MODEL).num_timesteps == 400
