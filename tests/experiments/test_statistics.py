"""Statistics of scores against hand computations, and what they refuse to say."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import trim_mean

from sb3_crc.experiments.scores import COLUMNS
from sb3_crc.experiments.statistics import (
    aggregate,
    curve,
    differences,
    probability_of_improvement,
    profile,
    score_matrices,
)

rliable = pytest.importorskip("rliable.metrics")
REPS = 200


def means_of(*rows: tuple[str, str, int, float]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=["method", "task", "seed", "return"])


def evaluated(
    method: str, seed: int, points: dict[int, float], *, task: str = "walker-walk", pace: float | None = 0.1, run: str = ""
) -> list[dict[str, Any]]:
    """Evaluations of a run, environment steps -> mean of two episodes; pace in seconds per step"""
    common = dict.fromkeys(COLUMNS) | {"method": method, "task": task, "seed": seed, "policy": "current"}
    common["run"] = run or f"{method}/{task}/{seed}"
    rows = []
    for steps, value in points.items():
        at = {"environment_steps": steps, "seconds": None if pace is None else steps * pace}
        rows += [common | at | {"episode": episode, "return": value + off} for episode, off in enumerate((-5, 5))]
    return rows


def table_of(*runs: list[dict[str, Any]]) -> pd.DataFrame:
    return pd.DataFrame([row for run in runs for row in run], columns=list(COLUMNS))


@pytest.fixture
def noisy() -> dict[str, np.ndarray]:
    draw = np.random.default_rng(0)
    return {
        "low": draw.normal(0.2, 0.02, (5, 3)),
        "also low": draw.normal(0.2, 0.02, (5, 3)),
        "high": draw.normal(0.8, 0.02, (5, 3)),
    }


def test_aggregates_are_those_of_the_sample(noisy: dict[str, np.ndarray]) -> None:
    found = aggregate(noisy, reps=REPS)["high"]
    assert found["IQM"].value == pytest.approx(1000 * trim_mean(noisy["high"].ravel(), 0.25))
    assert found["mean"].value == pytest.approx(1000 * noisy["high"].mean())
    assert found["optimality gap"].value == pytest.approx(1000 - found["mean"].value)
    low, high = found["IQM"].interval
    assert low < found["IQM"].value < high and high - low < 40


def test_only_a_gap_is_resolved(noisy: dict[str, np.ndarray]) -> None:
    also, high = differences(noisy, "low", reps=REPS)
    assert (also.method, high.method) == ("also low", "high")
    assert high.resolved and high.verdict == "better"
    assert high.probability.value == 1 and high.probability.interval == (1, 1)
    assert not also.resolved and also.verdict == "not resolved"
    worse = differences(noisy, "high", reps=REPS)[0]
    assert worse.resolved and worse.verdict == "worse" and worse.iqm.value == pytest.approx(-high.iqm.value)


def test_differences_are_paired_by_seed() -> None:
    scores = np.array([[0.1], [0.5], [0.9]])
    (better,) = differences({"base": scores, "plus": scores + 0.05}, "base", reps=REPS)
    assert better.iqm.interval == pytest.approx((50, 50))  # whatever seeds are drawn, they differ by as much


def test_probability_of_improvement_is_rliables() -> None:
    draw = np.random.default_rng(1)
    one, other = draw.integers(0, 5, (6, 4)) / 5, draw.integers(0, 5, (7, 4)) / 5  # with ties
    assert probability_of_improvement(one, other) == pytest.approx(rliable.probability_of_improvement(one, other))


def test_one_seed_has_no_interval() -> None:
    matrices = {"crc": np.array([[0.9, 0.8]]), "rad": np.array([[0.1, 0.2]])}
    (difference,) = differences(matrices, "rad", reps=REPS)
    assert difference.iqm.interval is None and difference.probability.interval is None and not difference.resolved
    assert difference.verdict == "not resolved (one seed: no interval)"
    assert aggregate(matrices, reps=REPS)["crc"]["IQM"].text() == "850"
    assert profile(matrices, np.array([0.0, 500.0]), reps=REPS)["crc"].interval is None


def test_two_seeds_have_an_interval_but_no_verdict() -> None:
    base = np.array([[0.1], [0.5], [0.9]])
    (two,) = differences({"base": base[:2], "plus": base[:2] + 0.05}, "base", reps=REPS)
    (three,) = differences({"base": base, "plus": base + 0.05}, "base", reps=REPS)
    assert two.iqm.interval == pytest.approx((50, 50)) and two.verdict == "not resolved (2 seeds)" and not two.resolved
    assert three.verdict == "better" and three.resolved


def test_unknown_baseline_and_other_seeds_are_refused(noisy: dict[str, np.ndarray]) -> None:
    with pytest.raises(ValueError, match=r"no method 'rad'.*low, also low, high"):
        differences(noisy, "rad", reps=REPS)
    with pytest.raises(ValueError, match="not the same seeds"):
        differences({"low": noisy["low"], "high": noisy["high"][:3]}, "low", reps=REPS)


def test_only_what_all_methods_have_counts_and_the_rest_is_named() -> None:
    rows = [(method, task, seed, 100.0 * seed) for method in ("crc", "rad") for task in ("a", "b") for seed in (1, 2, 3)]
    rows.remove(("rad", "b", 2, 200.0))
    matrices = score_matrices(means_of(*rows, ("crc", "c", 1, 5.0)))
    assert matrices.seeds == (1, 3) and matrices.tasks == ("a", "b")
    np.testing.assert_allclose(matrices.scores["rad"], [[0.1, 0.1], [0.3, 0.3]])
    assert any(text.startswith("seed 2: ") and "rad on b" in text for text in matrices.dropped)
    assert any(text.startswith("c: ") and "rad" in text for text in matrices.dropped)
    assert len(matrices.dropped) == 2
    nothing = score_matrices(means_of(("crc", "a", 1, 1.0), ("rad", "a", 2, 1.0)))
    assert nothing.scores == {} and len(nothing.dropped) == 2


def test_same_seed_same_intervals_and_numpys_generator_is_left_alone(noisy: dict[str, np.ndarray]) -> None:
    np.random.seed(3)
    before = np.random.get_state()[1].copy()
    first = aggregate(noisy, reps=REPS), differences(noisy, "low", reps=REPS)
    assert (np.random.get_state()[1] == before).all()
    np.random.seed(4)
    assert (aggregate(noisy, reps=REPS), differences(noisy, "low", reps=REPS)) == first
    assert aggregate(noisy, reps=REPS, seed=1) != first[0]
    alone = aggregate({"high": noisy["high"]}, reps=REPS)
    assert alone["high"] == first[0]["high"]  # whoever else is there


def test_steps_that_all_runs_share() -> None:
    table = table_of(
        evaluated("crc", 0, {10: 100, 20: 200, 30: 300}),
        evaluated("crc", 1, {10: 300, 20: 400}),
        evaluated("rad", 0, {10: 50, 30: 70}),
    )
    curves = curve(table, "environment_steps", reps=REPS)
    crc, rad = curves.methods["crc"], curves.methods["rad"]
    assert (list(crc.x), list(crc.y), crc.seeds) == ([10, 20], pytest.approx([200, 300]), 2)
    np.testing.assert_allclose(crc.interval, [[100, 200], [300, 400]])
    assert (list(rad.x), list(rad.y), rad.interval) == ([10, 30], pytest.approx([50, 70]), None)
    assert curves.left_out == ("crc: evaluations after 20 environment steps, which not all its runs have reached",)


def test_time_is_interpolated_up_to_the_first_end() -> None:
    line = {steps: 10.0 * steps for steps in range(10, 101, 10)}
    table = table_of(
        evaluated("crc", 0, line, pace=1.0), evaluated("crc", 1, line, pace=2.0), evaluated("rad", 0, line, pace=None)
    )
    curves = curve(table, "seconds", reps=REPS)
    crc = curves.methods["crc"]
    assert (crc.x[0], crc.x[-1]) == (20, 100)
    np.testing.assert_allclose(crc.y, (10 * crc.x + 5 * crc.x) / 2)
    assert "rad" not in curves.methods and curves.left_out == ("rad/walker-walk/0: seconds were not recorded",)


def test_tasks_and_seeds_of_curves_are_those_of_all() -> None:
    points = {10: 100.0}
    table = table_of(
        *(evaluated("crc", seed, points, task=task) for task in ("a", "b") for seed in (0, 1)),
        *(evaluated("rad", 0, points, task=task) for task in ("a", "b", "c")),
        evaluated("rad", 1, points, task="a"),
        evaluated("crc", 0, {10: 7.0, 20: 8.0}, task="a", run="again"),
    )
    curves = curve(table, "environment_steps", reps=REPS)
    assert {method: (one.seeds, one.tasks) for method, one in curves.methods.items()} == {"crc": (2, 2), "rad": (1, 2)}
    text = "\n".join(curves.left_out)
    assert "c: none of crc" in text and "rad, seed 1: no rad on b" in text and "crc/a/0: again is of the same" in text


def test_profile_counts_runs_above() -> None:
    matrices = {"crc": np.array([[0.1, 0.5], [0.3, 0.7]])}
    found = profile(matrices, np.array([0.0, 300.0, 600.0, 1000.0]), reps=REPS)["crc"]
    assert list(found.y) == [1, 0.5, 0.25, 0]
    assert (found.interval[0] <= found.y).all() and (found.y <= found.interval[1]).all()
