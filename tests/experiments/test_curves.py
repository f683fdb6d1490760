"""Pictures of learning curves show the numbers of the files."""

import json
from pathlib import Path

import matplotlib.figure
import numpy as np
import pytest
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.experiments.runs import SPEC, write_json
from tests.experiments.test_report import make_run


def write_run(folder: Path, returns: dict[int, list[float]]) -> Path:
    folder.mkdir(parents=True)
    np.savez(folder / "evaluations.npz", timesteps=list(returns), results=list(returns.values()))
    return folder


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[matplotlib.figure.Figure]:
    figures: list[matplotlib.figure.Figure] = []
    save = matplotlib.figure.Figure.savefig
    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", lambda self, *a, **k: (figures.append(self), save(self, *a, **k)))
    return figures


def test_methods_side_by_side(tmp_path: Path, drawn: list[matplotlib.figure.Figure]) -> None:
    runs = [
        write_run(tmp_path / "crc" / "seed_1", {10: [100, 200], 20: [300, 300]}),
        write_run(tmp_path / "crc" / "seed_2", {10: [50, 50]}),
        write_run(tmp_path / "rad" / "seed_1", {10: [10, 30]}),
    ]
    baselines = tmp_path / "baselines.json"
    baselines.write_text(json.dumps({"random": {"mean": 140.0}}))
    picture = tmp_path / "curves.png"
    arguments = ["curve", *map(str, runs), "--output", str(picture), "--action-repeat", "8", "--baselines", str(baselines)]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    assert picture.stat().st_size > 5_000
    (axes,) = drawn[0].axes
    labels = {line.get_label(): [list(map(float, values)) for values in line.get_data()] for line in axes.lines}
    assert labels["crc, 2 seeds"] == [[80], [100]]  # the mean only where both seeds were evaluated
    assert labels["rad, 1 seed"] == [[80], [20]]
    assert labels["random policy (140)"][1] == [140, 140]
    thin = [
        list(line.get_ydata()) for line in axes.lines if line.get_linewidth() < 1 and not line.get_label().startswith("random")
    ]
    assert thin == [[150, 300], [50], [20]]


def test_a_run_knows_its_action_repeat(tmp_path: Path, drawn: list[matplotlib.figure.Figure]) -> None:
    runs = [make_run(tmp_path / "a", "crc"), make_run(tmp_path / "b", "rad", env_kwargs={"action_repeat": 4})]
    command = ["curve", "--output", str(tmp_path / "curve.png")]
    assert CliRunner().invoke(app, [*command, str(runs[0])]).exit_code == 0
    (axes,) = drawn[0].axes
    assert axes.get_xlabel() == "environment steps (8 per agent step)" and axes.lines[0].get_xdata()[-1] == 100_000
    done = CliRunner().invoke(app, [*command, *map(str, runs)])
    assert done.exit_code == 2 and "an agent step is 4 or 8 environment steps" in done.stderr
    (runs[0] / "evaluations.npz").write_bytes(b"PK\3\4 half")
    done = CliRunner().invoke(app, [*command, str(runs[0])])
    assert done.exit_code == 2 and "evaluations.npz cannot be read" in done.stderr


def test_runs_of_a_comparison_are_grouped_by_method(tmp_path: Path, drawn: list[matplotlib.figure.Figure]) -> None:
    runs = [make_run(tmp_path / name, "crc", seed) for name, seed in (("a", 0), ("b", 0), ("a", 1))]
    for run, method in zip(runs, ("C+R", "C", "C+R"), strict=True):
        write_json({"method": method}, run.parent.parent / SPEC)
    arguments = ["curve", *map(str, runs), "--output", str(tmp_path / "curve.png")]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    labels = {line.get_label() for line in drawn[0].axes[0].lines}
    assert {"C+R, 2 seeds", "C, 1 seed"} <= labels and not any(label.startswith("crc") for label in labels)


def test_several_tasks_are_no_seeds_of_one(tmp_path: Path) -> None:
    runs = [make_run(tmp_path / "a", "crc", 0), make_run(tmp_path / "b", "crc", 1)]
    (arguments,) = runs[1].glob("*/args.yml")
    arguments.write_text(arguments.read_text().replace("cartpole-swingup", "cartpole-balance"))
    done = CliRunner().invoke(app, ["curve", *map(str, runs), "--output", str(tmp_path / "curve.png")])
    assert done.exit_code == 2 and "several tasks, cartpole-balance, cartpole-swingup" in " ".join(done.stderr.split())
    assert not (tmp_path / "curve.png").exists()


def test_one_run_shows_its_episodes_range(tmp_path: Path, drawn: list[matplotlib.figure.Figure]) -> None:
    run = write_run(tmp_path / "crc" / "seed_1", {10: [100, 200], 20: [300, 300]})
    assert CliRunner().invoke(app, ["curve", str(run), "--output", str(tmp_path / "curve.svg")]).exit_code == 0
    (line,) = drawn[0].axes[0].lines
    assert list(line.get_ydata()) == [150, 300]
    assert drawn[0].axes[0].get_ylim()[1] > 300  # no marker is cut off
