"""Figures of comparisons show something, and summaries say what is missing."""

import csv
import re
from pathlib import Path

import matplotlib.figure
import numpy as np
import pandas as pd
import pytest
from matplotlib.image import imread

from sb3_crc.experiments.comparison_figures import FIGURES, draw_comparison
from sb3_crc.experiments.scores import COLUMNS, Missing, MixedProtocols, Scores

pytest.importorskip("rliable")
REPS = 50
TASKS = ("cartpole-swingup", "walker-walk")


def scores_of(levels: dict[str, float], *, seeds: int = 3, tasks: tuple[str, ...] = TASKS, seconds: bool = True) -> Scores:
    rows = []
    for number, (method, level) in enumerate(levels.items()):
        for task in tasks:
            for seed in range(seeds):
                common = dict.fromkeys(COLUMNS) | {"method": method, "preset": method, "task": task, "seed": seed}
                common |= {"budget": 80, "action_repeat": 8, "render_quality": "benchmark", "run": f"{method}/{task}/{seed}"}
                for step in (20, 40, 80):
                    at = {"policy": "current", "environment_steps": step, "first_seed": 20_000 + step, "episodes": 2}
                    at |= {"seconds": 100.0 * step * (1 + number) if seconds else None, "episode": 0}
                    rows.append(common | at | {"return": level * step / 80 + seed})
                at = {"policy": "final", "environment_steps": 80, "first_seed": 9, "episodes": 2, "seconds": 1.0}
                rows += [common | at | {"episode": episode, "return": level + seed + episode} for episode in (0, 1)]
    return Scores(pd.DataFrame(rows, columns=list(COLUMNS)), ())


def is_drawn(picture: Path) -> bool:
    colours = (imread(picture)[..., :3] * 255).astype(int) @ (1 << 16, 1 << 8, 1)
    return len(np.unique(colours)) > 20


def draw(scores: Scores, folder: Path, **options: object) -> tuple[set[str], str]:
    written = draw_comparison(scores, folder, **{"baseline": None, "reps": REPS, **options})  # type: ignore[arg-type]
    assert all(path.parent == folder and path.exists() for path in written)
    assert all(is_drawn(path) for path in written if path.suffix == ".png")
    return {path.name for path in written}, (folder / "summary.md").read_text()


def test_everything_is_written_and_what_is_missing_is_listed(tmp_path: Path) -> None:
    scores = scores_of({"crc": 800, "rad": 600, "sac": 601}, seeds=4)
    table = scores.table[scores.table["run"] != "rad/walker-walk/2"]
    scores = Scores(table, (Missing("rad", "walker-walk", 2, "failed"),))
    written, summary = draw(scores, tmp_path / "new", baseline="rad")
    assert written == {*FIGURES, "summary.md", "summary.csv"}
    assert "- rad on walker-walk, seed 2: failed" in summary
    assert (
        "- crc against rad on all tasks: seed 2: no rad on walker-walk" in summary
        and "- rad, seed 2: not on walker-walk" in summary
    )
    assert "these intervals are too narrow" in summary
    both = "cartpole-swingup, walker-walk | 0, 1, 3 | +"
    crc, sac = (
        next(line for line in summary.splitlines() if line.startswith(f"| {name} | {both}")) for name in ("crc", "sac")
    )
    assert "| better | 1.00" in crc and "not resolved" not in crc
    assert "| crc | 0, 1, 2, 3 | 802 (801 to 803) | 802" in summary and "| rad | 0, 1, 3 | 602 (" in summary
    assert "| crc | cartpole-swingup | 0, 1, 2, 3 | +200 (" in summary and "| crc | walker-walk | 0, 1, 3 | +200 (" in summary
    with (tmp_path / "new" / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    (row,) = (row for row in rows if row["method"] == "sac" and row["statistic"] == "difference of IQM")
    assert (row["baseline"], float(row["value"]), row["seeds"], row["tasks"]) == ("rad", pytest.approx(1), "3", "2")
    assert sac.endswith("|")


def test_equal_methods_are_not_resolved(tmp_path: Path) -> None:
    _, summary = draw(scores_of({"crc": 500, "rad": 500}), tmp_path)
    assert "| rad | cartpole-swingup, walker-walk | 0, 1, 2 | +0 (+0 to +0) | not resolved | 0.50" in summary  # the first


def test_two_seeds_give_no_verdict(tmp_path: Path) -> None:
    written, summary = draw(scores_of({"crc": 800, "rad": 600}, seeds=2), tmp_path)
    rad = next(
        line for line in summary.splitlines() if line.startswith("| rad | cartpole-swingup, walker-walk | 0, 1 | -200 (")
    )
    assert "| not resolved (2 seeds) | 0.00 (" in rad and not {"better", "worse"} & {*rad.split()}
    assert "improvement.png" in written


def test_one_seed_gives_lines_without_bands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    figures: dict[str, matplotlib.figure.Figure] = {}
    save = matplotlib.figure.Figure.savefig
    monkeypatch.setattr(
        matplotlib.figure.Figure, "savefig", lambda self, path, **k: (figures.update({path.name: self}), save(self, path, **k))
    )
    written, summary = draw(scores_of({"crc": 800, "rad": 600}, seeds=1, tasks=TASKS[:1]), tmp_path)
    assert written >= set(FIGURES)
    assert "not resolved (one seed: no interval)" in summary
    (axes,) = figures["sample_efficiency.png"].axes
    assert not axes.collections
    crc, rad = axes.lines
    assert (crc.get_label(), rad.get_label()) == ("crc, 1 seed", "rad, 1 seed")
    assert list(crc.get_xdata()) == [20, 40, 80] and list(crc.get_ydata()) == pytest.approx([200, 400, 800])
    crc, rad = figures["wall_time.png"].axes[0].lines
    assert crc.get_xdata()[-1] == pytest.approx(8000 / 3600) and rad.get_xdata()[-1] == pytest.approx(16000 / 3600)


def test_what_cannot_be_drawn_is_said_and_not_left_from_before(tmp_path: Path) -> None:
    (tmp_path / "wall_time.png").write_bytes(b"old")
    written, summary = draw(scores_of({"crc": 800}, seconds=False), tmp_path)
    assert written == {"sample_efficiency.png", "profile.png", "tasks.png", "summary.md", "summary.csv"}
    assert not (tmp_path / "wall_time.png").exists()
    assert "wall_time.png: no run has seconds" in summary and "improvement.png: there is only one method" in summary
    assert "- crc/walker-walk/1: seconds were not recorded" in summary


def test_runs_that_have_not_ended_give_curves(tmp_path: Path) -> None:
    table = scores_of({"crc": 800, "rad": 600}).table
    written, summary = draw(Scores(table[table["policy"] == "current"], ()), tmp_path)
    assert written == {"sample_efficiency.png", "wall_time.png", "tasks.png", "summary.md", "summary.csv"}
    assert "No final scores to compare." in summary


def test_a_method_may_be_called_anything(tmp_path: Path) -> None:
    _, summary = draw(scores_of({"crc": 500, "a|b": 500}), tmp_path)
    tables = [line for line in summary.splitlines() if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in tables} == {7}  # of six columns
    assert sum(line.startswith("| a\\|b |") for line in tables) == 4  # final returns, compared, and on each of two tasks


def test_an_evaluation_with_a_gap_is_refused(tmp_path: Path) -> None:
    table = scores_of({"crc": 500, "rad": 500}).table
    first = table[(table["policy"] == "final") & (table["run"] == "rad/walker-walk/1")].index[0]
    with pytest.raises(ValueError, match="the final evaluation of rad/walker-walk/1 is not whole: 1 of 2 episodes"):
        draw(Scores(table.drop(first), ()), tmp_path)


def test_refusals(tmp_path: Path) -> None:
    scores = scores_of({"crc": 800, "rad": 600})
    with pytest.raises(ValueError, match="no method 'sac' to compare with, only crc, rad"):
        draw(scores, tmp_path, baseline="sac")
    with pytest.raises(ValueError, match="no scores"):
        draw(Scores(scores.table[:0], ()), tmp_path)
    mixed = scores.table.copy()
    mixed.loc[mixed["method"] == "rad", "action_repeat"] = 4
    with pytest.raises(MixedProtocols, match="action_repeat"):
        draw(Scores(mixed, ()), tmp_path)
    with pytest.raises(MixedProtocols, match="action_repeat"):
        draw(Scores(mixed[mixed["policy"] == "current"], ()), tmp_path)
    assert not list(tmp_path.iterdir())
    assert draw(Scores(mixed, ()), tmp_path, allow_mixed=True)[0] >= set(FIGURES)
