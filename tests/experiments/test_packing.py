"""Many runs on one GPU: how many, who draws where, and what happens if a driver hangs at its first frame."""

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch as th
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.envs.rendering import FIRST_FRAME, NO_FRAME
from sb3_crc.experiments.campaign import Campaign
from sb3_crc.experiments.engines import execution, local
from sb3_crc.experiments.engines.execution import RunProcess, plan
from sb3_crc.experiments.needs import RENDERERS, Needs, most_at_once
from sb3_crc.experiments.specs import RunSpec
from tests.experiments.test_engines import collector, specs
from tests.test_zoo import ROOT

WATCHED = """
import time
from sb3_crc.envs.rendering import first_frame_watched
with first_frame_watched():
    time.sleep({})
"""


@pytest.mark.parametrize(("limit", "takes", "code"), [("0.3", 30, 1), ("30", 0, 0), ("", 0.5, 0)])
def test_a_process_whose_first_frame_does_not_come_ends(limit: str, takes: float, code: int) -> None:
    began = time.monotonic()
    script = WATCHED.format(takes) + "time.sleep(0.5)\n"  # afterwards nothing is watched any more
    done = subprocess.run(
        [sys.executable, "-c", script], env={"PATH": "", FIRST_FRAME: limit}, cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == code and (NO_FRAME in done.stderr) == bool(code), done.stderr
    assert time.monotonic() - began < 20


class Limits:
    """What is written into the environment of one process after the other."""

    def __init__(self, *limits: str):
        self.limits = list(limits)

    def __str__(self) -> str:
        return self.limits.pop(0)


@pytest.mark.slow
def test_another_back_end_draws_for_one_that_hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(execution, "FIRST_FRAME_WITHIN", Limits("0.0001", "60", "60"))
    (spec,) = plan(specs(), tmp_path)
    events, report = collector()
    own: dict[str, Any] = {"checkpoint_every": 1_000, "threads": 1, "report": report, "backends": ["egl", "egl"]}
    run = RunProcess(spec, tmp_path, **own)
    run.start()
    while run.poll():
        time.sleep(0.1)
    assert [event for event, _ in events] == ["begun", "restarted", "begun", "finished"]
    assert events[1][1] == "rad no frame came from egl; now egl draws"


class Recorded(RunProcess):
    """Runs for as many polls as its seed says, and does nothing."""

    started: list[tuple[int, list[str]]]

    def start(self) -> None:
        self.left = self.spec.seed
        self.started.append((self.spec.seed, list(self.backends)))

    def poll(self) -> bool:
        self.left -= 1
        return self.left > 0

    def wait_until_stopped(self, deadline: float) -> None: ...


def test_only_so_many_draw_on_the_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "RunProcess", Recorded)
    Recorded.started = []
    (one,) = specs()
    runs = [RunSpec(**{**vars(one), "seed": seed}) for seed in (9, 1, 9, 9)]
    local.run_locally(runs, tmp_path, jobs=3, renderers=2)
    assert Recorded.started == [(9, ["egl", "osmesa"]), (1, ["egl", "osmesa"]), (9, ["osmesa"]), (9, ["egl", "osmesa"])]
    Recorded.started = []
    local.run_locally(runs[:1], tmp_path, jobs=1)
    assert Recorded.started == [(9, [])]


def test_memory_and_cores_limit_what_is_packed() -> None:
    needs = [Needs(10**9, 2 * 10**9, 0, 60.0)] * 20
    room: dict[str, Any] = {"cores": 16, "free": 10**11, "free_gpu": 10**11}
    assert most_at_once(needs, **room) == RENDERERS
    assert most_at_once(needs, **room, renderers=None) == 16
    assert most_at_once(needs, **{**room, "free_gpu": 2 * 10**10}, renderers=None) == 9


def test_packing_needs_a_gpu_and_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(th.cuda, "is_available", lambda: False)
    sweep = str(ROOT / "zoo_configs" / "sweeps" / "ablation_1.yml")
    done = CliRunner().invoke(app, ["sweep", sweep, "--pack", "-o", str(tmp_path / "runs")])
    assert done.exit_code == 2 and "--pack fills a GPU, and there is none that torch can use" in " ".join(done.stderr.split())
    monkeypatch.setattr(th.cuda, "is_available", lambda: True)
    with pytest.raises(ValueError, match="--pack is an option of --engine local"):
        Campaign(engine="ray", pack=True)
    assert Campaign(pack=True).pack
