"""What runs need is measured, and decides how many run at once."""

import shutil
from collections import namedtuple
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.experiments.needs import Needs, check_disk, measure, most_at_once, seconds_for_all
from sb3_crc.experiments.specs import compared
from tests.test_zoo import ROOT

TINY = ROOT / "tests" / "tiny.yml"
GB = 10**9


def needs(memory: float = 1.0, gpu_memory: float = 0.0, disk: float = 1.0, seconds: float = 10.0) -> Needs:
    return Needs(round(memory * GB), round(gpu_memory * GB), round(disk * GB), seconds)


def test_cores_memory_and_gpu_each_limit_how_many_run_at_once() -> None:
    assert most_at_once([needs()], cores=8, free=100 * GB) == 8
    assert most_at_once([needs(4), needs(1)], cores=8, free=10 * GB) == 2  # 90 % of it, by the largest
    assert most_at_once([needs(1, 10)], cores=8, free=100 * GB, free_gpu=24 * GB) == 2
    assert most_at_once([needs(1, 1)], cores=16, free=100 * GB, free_gpu=139 * GB) == 4  # renderers
    assert most_at_once([needs(40)], cores=8, free=10 * GB) == 1  # let it try


def test_a_run_takes_the_place_of_one_that_ends() -> None:
    assert seconds_for_all([needs(seconds=10), needs(seconds=30), needs(seconds=10), needs(seconds=10)], 2) == 30
    assert seconds_for_all([needs(), needs()], 1) == 20


def test_too_little_disk_is_said_before_anything_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(9 * GB, 7 * GB, 2 * GB))
    check_disk([needs(disk=1.5)], tmp_path / "runs")
    with pytest.raises(ValueError, match=r"write about 3.0 GB, and 2.0 GB are free"):
        check_disk([needs(disk=1.5), needs(disk=1.5)], tmp_path / "runs")


@pytest.mark.parametrize(
    "preset", ["crc", pytest.param("sac", marks=pytest.mark.slow), pytest.param("state_sac", marks=pytest.mark.slow)]
)
def test_what_is_measured_grows_with_the_run(preset: str) -> None:
    short, long = (
        measure(compared([preset], ["cartpole-swingup"], [0], env_steps=steps, eval_every=400, conf_file=TINY)[0])
        for steps in (1_200, 4_000)
    )
    assert short.memory > 0.1 * GB and 0 < short.seconds < long.seconds
    assert short.gpu_memory == 0 and short.disk < long.disk


@pytest.mark.slow
def test_a_dry_run_says_hours_memory_and_disk(tmp_path: Path) -> None:
    own = ["--task", "cartpole-swingup", "--presets", "rad", "--seeds", "2", "--env-steps", "1200", "--eval-every", "400"]
    done = CliRunner().invoke(app, ["compare", *own, "--conf-file", str(TINY), "-o", str(tmp_path / "runs"), "--dry-run"])
    assert done.exit_code == 0, done.stderr
    assert done.stdout.count("150 agent steps, to run: 0:0") == 2
    assert "2 of 2 runs to do" in done.stdout and "GB memory" in done.stdout and "GB disk" in done.stdout
    assert not (tmp_path / "runs").exists()
