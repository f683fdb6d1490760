"""Each method is compared on what it and the baseline have, whatever others lack, and nothing is left out without a word."""

from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.experiments.pairs import compare_by_task, compare_pairs, own_matrices, ranges

pytest.importorskip("rliable")
FINAL = Path(__file__).parents[2] / "results" / "laptop" / "final"
REPS = 50


def means_of(*runs: tuple[str, str, dict[int, float]]) -> pd.DataFrame:
    rows = [(method, task, seed, value) for method, task, own in runs for seed, value in own.items()]
    return pd.DataFrame(rows, columns=["method", "task", "seed", "return"])


CRC, RAD = {21: 829.0, 22: 753.0, 23: 744.0}, {21: 806.0, 22: 692.0, 23: 849.0}


def test_a_third_method_with_a_missing_run_changes_nothing_for_the_others() -> None:
    two = means_of(("crc", "a", CRC), ("rad", "a", RAD))
    three = means_of(("crc", "a", CRC), ("rad", "a", RAD), ("sac", "a", {21: 138.0, 22: 205.0}))
    (alone,), _ = compare_pairs(two, "crc", reps=REPS)
    (rad, sac), left_out = compare_pairs(three, "crc", reps=REPS)
    assert rad == alone and rad.seeds == (21, 22, 23) and rad.difference.verdict == "not resolved"
    assert sac.seeds == (21, 22) and sac.difference.verdict == "not resolved (2 seeds)"
    assert left_out == ["sac on a: no sac with seed 23"]


def test_one_more_task_with_a_single_seed_costs_the_other_task_none() -> None:
    means = means_of(("crc", "a", CRC), ("crc", "b", {21: 1.0}), ("rad", "a", RAD), ("rad", "b", {21: 2.0, 22: 3.0}))
    found, left_out = compare_by_task(means, "crc", reps=REPS)
    assert [(one.tasks, one.seeds) for one in found] == [(("a",), (21, 22, 23)), (("b",), (21,))]
    assert left_out == ["rad on b: no crc with seed 22"]
    (overall,), left_out = compare_pairs(means, "crc", reps=REPS)
    assert overall.tasks == ("a", "b") and overall.seeds == (21,)
    assert [one.partition(":")[0] for one in left_out] == ["rad against crc on all tasks"] * 2


def test_methods_without_a_common_run_are_named() -> None:
    means = means_of(("crc", "a", CRC), ("sac", "b", {21: 1.0}))
    for compare in (compare_pairs, compare_by_task):
        assert compare(means, "crc", reps=REPS) == ([], ["sac: no sac on a", "sac: no crc on b"])
        apart = means_of(("crc", "a", {1: 1.0}), ("sac", "a", {2: 1.0}))
        assert compare(apart, "crc", reps=REPS) == ([], ["sac on a: no sac with seed 1", "sac on a: no crc with seed 2"])


def test_tasks_that_only_one_of_the_two_has_decide_nothing() -> None:
    means = means_of(("crc", "a", CRC), *(("crc", task, {21: 1.0}) for task in "bcd"), ("rad", "a", RAD))
    (pair,), left_out = compare_pairs(means, "crc", reps=REPS)
    assert (pair.tasks, pair.seeds) == (("a",), (21, 22, 23)) and left_out == ["rad: no rad on b, c, d"]


def test_every_method_keeps_its_own_seeds_on_the_tasks_of_all() -> None:
    means = means_of(
        ("crc", "a", CRC), ("crc", "b", {21: 1.0, 22: 2.0}), ("crc", "c", CRC), ("rad", "a", {1: 5.0}), ("rad", "b", {1: 6.0})
    )
    found, left_out = own_matrices(means)
    assert (found["crc"].tasks, found["crc"].seeds, found["rad"].seeds) == (("a", "b"), (21, 22), (1,))
    assert found["crc"].scores["crc"].tolist() == [[0.829, 0.001], [0.753, 0.002]]
    assert left_out == ["c: no rad", "crc, seed 23: not on b"]
    assert own_matrices(means_of(("crc", "a", CRC), ("sac", "b", CRC))) == ({}, ["a: no sac", "b: no crc"])


def test_ranges_of_numbers() -> None:
    assert [ranges(numbers) for numbers in ([3], [1, 2], [1, 2, 3], [0, 2, 3, 4, 5, 9])] == ["3", "1, 2", "1-3", "0, 2-5, 9"]


@pytest.mark.slow
def test_the_committed_runs_are_compared(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["curves", str(FINAL), "--baseline", "crc", "-o", str(tmp_path)])
    assert done.exit_code == 0, done.output
    summary = (tmp_path / "summary.md").read_text(encoding="utf-8")
    runs = FINAL / "cartpole-swingup"
    crc, rad = ({int(run.name.removeprefix("seed_")) for run in (runs / name).iterdir()} for name in ("crc", "rad"))
    seeds = sorted(crc & rad)
    assert {21, 22, 23} <= {*seeds}
    begin = f"| rad | cartpole-swingup | {', '.join(map(str, seeds))} |"
    *_, each_task = summary.split("On each task:")  # the only table, as long as rad and crc share one task
    (compared,) = (line for line in each_task.splitlines() if line.startswith(begin))
    assert "| not resolved |" in compared and "| sac | cartpole-swingup |" in summary
    assert "No final scores" not in summary and (tmp_path / "profile.png").exists() and (tmp_path / "improvement.png").exists()
