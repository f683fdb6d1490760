"""The page of results follows from the raw files, and says what they do not show."""

from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.experiments.evidence import BEST, OTHERS, goals, others, probability_of_reaching, results_page
from sb3_crc.experiments.published import SIX_TASKS
from sb3_crc.experiments.scores import COLUMNS

ROOT = Path(__file__).parents[2]


def scores(path: Path, method: str, returns: dict[int, float], task: str = "cartpole-swingup") -> Path:
    """Final scores, two episodes of each seed, a return above and below the mean."""
    rows = []
    for seed, mean in returns.items():
        for episode, value in enumerate((mean - 10, mean + 10)):
            row = dict.fromkeys(COLUMNS) | {"method": method, "preset": method, "task": task, "seed": seed, "policy": "final"}
            row |= {
                "budget": 100_000,
                "environment_steps": 100_000,
                "agent_steps": 12_500,
                "episode": episode,
                "return": value,
            }
            row |= {"first_seed": 10_000, "episodes": 2, "action_repeat": 8, "render_quality": "benchmark"}
            rows.append(row | {"run": f"{method}/{task}/{seed}", "machine": "a machine", "git_revision": "abc"})
    pd.DataFrame(rows).to_csv(path, index=False)
    return path


def test_the_committed_page_is_what_the_raw_files_give(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    results = Path("results")
    page = results_page(
        [results / "laptop" / "final"],
        baselines=["crc", "rad"],
        landmarks=results / "landmarks.json",
        trials=[results / "laptop" / "trials.csv", results / "laptop" / "final.csv"],
    )
    assert page == (ROOT / "docs" / "results.md").read_text(encoding="utf-8"), "run `make results`"


def test_every_seed_is_shown_and_what_was_not_done(tmp_path: Path) -> None:
    files = [scores(tmp_path / "a.csv", "crc", {0: 800, 1: 860, 2: 900}), scores(tmp_path / "b.csv", "rad", {0: 700, 1: 860})]
    page = results_page(files, baselines=["rad"])
    assert "| crc | 0: 800, 1: 860, 2: 900 | 853 (" in page and "| rad | 0: 700, 1: 860 | 780 (" in page
    assert (
        "rad on cartpole-swingup, seed 2: absent" in page and "- no run on walker-walk" in page and "- no run of drq" in page
    )
    assert "| crc | cartpole-swingup | 0, 1 | +50 (" in page
    rad = next(line for line in page.splitlines() if line.startswith("| rad"))
    assert rad.endswith("|  |  |")  # two seeds: no chances
    assert "| 813 |" not in page and "P(mean >= 813)" in page and "P(mean >= 851)" in page


def test_each_method_is_compared_on_the_seeds_that_it_shares_with_the_baseline(tmp_path: Path) -> None:
    returns = {"crc": {0: 800, 1: 860, 2: 900}, "rad": {0: 700, 1: 860, 2: 950}, "sac": {1: 100}}
    page = results_page([scores(tmp_path / f"{name}.csv", name, own) for name, own in returns.items()], baselines=["crc"])
    assert "| rad | cartpole-swingup | 0, 1, 2 | -17 (" in page  # one seed of stock SAC costs rad none
    assert "| sac | cartpole-swingup | 1 | -760 | not resolved (one seed" in page
    assert "- sac on cartpole-swingup: no sac with seed 0, 2" in page
    assert "- sac on cartpole-swingup, seeds 0, 2: absent" in page  # a line for the runs that lack the same


def test_methods_are_compared_with_each_baseline_that_is_named(tmp_path: Path) -> None:
    returns = {"crc": {0: 800, 1: 860, 2: 900}, "rad": {0: 700, 1: 860, 2: 950}, "sac": {1: 100}}
    sources = [str(scores(tmp_path / f"{name}.csv", name, own)) for name, own in returns.items()]
    page = tmp_path / "page.md"
    named = ["--baseline", "crc", "--baseline", "rad", "--baseline", "crc"]
    assert CliRunner().invoke(app, ["results", *sources, *named, "-o", str(page)]).exit_code == 0
    crc, rad = page.read_text(encoding="utf-8").split("## Against ")[1:]
    assert crc.startswith("crc\n") and "| rad | cartpole-swingup | 0, 1, 2 | -17 (" in crc
    assert rad.startswith("rad\n") and "| crc | cartpole-swingup | 0, 1, 2 | +17 (" in rad
    assert "| sac | cartpole-swingup | 1 | -760 |" in crc and "| sac | cartpole-swingup | 1 | -760 |" in rad
    assert rad.count("- sac on cartpole-swingup: no sac with seed 0, 2") == 1 and "In no row" not in crc


def test_one_seed_on_another_task_costs_no_seeds(tmp_path: Path) -> None:
    files = [
        scores(tmp_path / f"{name}-{task}.csv", name, own, task)
        for name, task, own in (
            ("crc", "cartpole-swingup", {0: 800, 1: 860, 2: 900}),
            ("rad", "cartpole-swingup", {0: 700, 1: 860, 2: 950}),
            ("crc", "finger-spin", {0: 300}),
            ("rad", "finger-spin", {0: 200, 1: 210}),
        )
    ]
    page = results_page(files, baselines=["crc"])
    assert "| rad | cartpole-swingup | 0, 1, 2 | -17 (" in page
    assert "| rad | finger-spin | 0 | -100 | not resolved (one seed" in page
    assert "- rad on finger-spin: no crc with seed 1" in page


def test_all_trials_before_are_counted_with_their_seeds(tmp_path: Path) -> None:
    for name, rows in (("trials", "rad,0\nrad,1\ncrc,0\n"), ("earlier", "crc,11\n")):
        (tmp_path / f"{name}.csv").write_text(f"algo,seed\n{rows}")
    files = [str(tmp_path / f"{name}.csv") for name in ("trials", "earlier")]
    source, page = scores(tmp_path / "a.csv", "crc", {0: 800}), tmp_path / "page.md"
    arguments = ["results", str(source), "--baseline", "crc", "-o", str(page), "--trials", files[0], "--trials", files[1]]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    text = " ".join(page.read_text(encoding="utf-8").split())
    assert "2 of rad, 1 of crc, with seeds 0, 1 (trials.csv); 1 of crc, with seed 11 (earlier.csv)" in text
    assert "were used by no training; trials before used them too" in text and "no other evaluation" not in text


def test_pages_of_nothing_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no score of a final policy"):
        results_page([tmp_path], baselines=["rad"])
    path = scores(tmp_path / "a.csv", "crc", {0: 800})
    done = CliRunner().invoke(app, ["results", str(path), "--baseline", "red", "-o", str(tmp_path / "page.md")])
    assert done.exit_code == 2 and "unknown baseline 'red'" in done.stderr and not (tmp_path / "page.md").exists()


def test_chances_to_reach_a_goal() -> None:
    assert probability_of_reaching([800, 900, 850], 700) == 1
    assert probability_of_reaching([800, 900, 850], 901) == 0
    assert probability_of_reaching([800, 900], 700) is None
    # of three draws of 0 or 1 with equal chances of 1/3 and 2/3, the mean is 1 in 8 of 27
    assert probability_of_reaching([0, 1, 1], 1) == pytest.approx(8 / 27, abs=0.02)


def test_goals_are_published_figures() -> None:
    found = {task: list(goals(task).values()) for task in SIX_TASKS}
    assert [round(values[0]) for values in found.values()] == [813, 636, 355, 832, 793, 490]
    assert [round(values[1]) for values in found.values()] == [851, 917, 518, 971, 981, 869]
    assert set(BEST) == set(SIX_TASKS) and goals("humanoid-run") == {}


def test_what_is_published_beside_the_goals_is_sorted() -> None:
    assert others("cartpole-swingup") == {
        **{"state SAC": 835, "MLR": 806, "DrQ": 759, "CURL": 582},
        **{"pixel SAC": 419, "SAC+AE": 311},
    }
    for task in SIX_TASKS:
        means = list(others(task).values())
        assert set(others(task)) == set(OTHERS) and means == sorted(means, reverse=True)
