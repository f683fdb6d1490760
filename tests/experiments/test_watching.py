"""What is said of runs while they train."""

import io
import os
import time
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.experiments import campaign
from sb3_crc.experiments.runs import find_runs
from sb3_crc.experiments.specs import compared
from sb3_crc.experiments.watching import Progress, progress_table, read_progress, sparkline
from tests.experiments.test_report import STEPS, make_run

HEADER = "time/total_timesteps,time/time_elapsed,train/critic_loss,eval/q_bias"


def running(tmp_path: Path, *rows: str) -> Path:
    folder = make_run(tmp_path, "crc", ended=False)
    (folder / "progress.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    return folder


def progress_of(tmp_path: Path, **options: float) -> Progress:
    (run,) = find_runs([tmp_path])
    return read_progress(run, **options)


def test_a_run_tells_how_far_it_is_and_how_long_it_will_take(tmp_path: Path) -> None:
    running(tmp_path, "500,100,0.5,", "1000,200,0.25,-3", "1500,300,,")
    progress = progress_of(tmp_path)
    assert (progress.status, progress.agent_steps, progress.budget) == ("unfinished", 1_500, STEPS)
    assert progress.seconds_left == pytest.approx((STEPS - 1_500) * 100 / 500)
    assert progress.instruments == {"Q bias": -3.0, "critic loss": 0.25}
    assert len(progress.returns) == 10 and progress.returns[-1] == pytest.approx(801)
    assert progress.final is None


def test_a_resume_counts_its_seconds_from_0_again(tmp_path: Path) -> None:
    running(tmp_path, "500,1000,,", "1000,2000,,", "1500,10,,", "2000,20,,")
    assert progress_of(tmp_path).seconds_left == pytest.approx((STEPS - 2_000) * 10 / 500)


def test_half_written_files_are_taken_as_far_as_they_are_whole(tmp_path: Path) -> None:
    folder = running(tmp_path, "500,100,0.5,", "1000,200,0.25,")
    with (folder / "progress.csv").open("a") as log:
        log.write("15")
    whole = (folder / "evaluations.npz").read_bytes()
    for half in (b"", b"PK half", whole[: len(whole) // 2]):
        (folder / "evaluations.npz").write_bytes(half)
        progress = progress_of(tmp_path)
        assert progress.agent_steps == 1_000 and progress.returns == ()
    (folder / "progress.csv").unlink()
    assert progress_of(tmp_path).agent_steps == 0


def test_a_run_that_writes_nothing_any_more_is_silent(tmp_path: Path) -> None:
    folder = running(tmp_path, "500,100,,", "1000,200,,")
    later = time.time() + 299
    assert progress_of(tmp_path, now=later).status == "unfinished"
    assert progress_of(tmp_path, now=later + 10).status == "silent"
    os.utime(folder / "progress.csv", (later, later))
    assert progress_of(tmp_path, now=later + 10).status == "unfinished"


def test_a_finished_run_has_a_score(tmp_path: Path) -> None:
    make_run(tmp_path, "crc", level=700)
    progress = progress_of(tmp_path)
    assert (progress.status, progress.agent_steps, progress.final) == ("finished", STEPS, 701)


def test_a_sparkline_rises_with_its_values() -> None:
    assert sparkline([0, 50, 100]) == "▁▄█"
    assert sparkline([5.0]) == "█" and sparkline([0.0]) == "▁"
    assert sparkline(list(np.linspace(-1, 1, 50)), width=3)[-1] == "█" and len(sparkline([1] * 50)) == 20


def test_the_table_has_a_line_for_each_run(tmp_path: Path) -> None:
    make_run(tmp_path, "crc", 0)
    make_run(tmp_path, "rad", 1, ended=False)
    console = Console(width=200, file=io.StringIO())
    console.print(progress_table([read_progress(run) for run in find_runs([tmp_path])]))
    assert isinstance(console.file, io.StringIO)
    shown = console.file.getvalue()
    assert "crc, cartpole-swingup, seed 0" in shown and "rad, cartpole-swingup, seed 1" in shown and "final 801" in shown


def test_the_command_says_how_far_all_are(tmp_path: Path) -> None:
    make_run(tmp_path, "crc", 0)
    make_run(tmp_path, "rad", 1, ended=False)
    result = CliRunner().invoke(app, ["watch", str(tmp_path), "--once"])
    assert result.exit_code == 0 and "1 of 2 runs ended" in result.output
    missing = CliRunner().invoke(app, ["watch", str(tmp_path / "nowhere")])
    assert missing.exit_code == 2 and "nowhere is no folder" in missing.output.replace("\n", "")


def test_a_comparison_shows_what_is_still_to_come(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    specs = compared(["crc", "rad"], ["cartpole-swingup"], [0], env_steps=8 * STEPS, eval_every=400)
    make_run(tmp_path / specs[0].name, "crc", ended=False)
    screen = Console(file=io.StringIO(), force_terminal=True, width=120)
    monkeypatch.setattr(screen.file, "isatty", lambda: True)
    monkeypatch.setattr(campaign, "errors", screen)
    with campaign._shown(tmp_path, specs):
        time.sleep(0.1)  # it is drawn on entering and on leaving
    assert isinstance(screen.file, io.StringIO)
    shown = screen.file.getvalue()
    assert "0 of 2 runs ended" in shown and "waiting" in shown and "rad, cartpole-swingup" in shown


def test_all_that_is_left_takes_as_long_as_those_that_run_need() -> None:
    def progress(name: str, steps: int, left: float | None) -> Progress:
        return Progress(name, "unfinished" if left else "waiting", steps, 1_000, left, (), None, {})

    # two runs of 10 and 20 steps a second, and 500 + 500 + 1 000 steps to go
    table = progress_table([progress("a", 500, 50.0), progress("b", 500, 25.0), progress("c", 0, None)])
    assert table.title == "0 of 3 runs ended, 33% of all decisions made, about 0:01:07 left"
