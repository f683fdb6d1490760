"""Returns in distracted environments as figures, numbers and text, beside what papers report."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.analysis.figures import new_figure, save
from sb3_crc.analysis.generalization import NONE, ModeReturns, read_records
from sb3_crc.analysis.policies import SavedPolicy
from sb3_crc.analysis.tables import write_lines, write_rows
from sb3_crc.experiments.comparison_summary import markdown
from sb3_crc.experiments.runs import Run

#: What must be known to read DMControl-GB's figures beside ours
UNITS = (
    "Published figures: DMControl-GB trains for '500k frames', which in its code are agent steps: 2 000 000 environment steps "
    "at its action repeat of 4; ours have seen as many as the table says. Frames of 100 x 100 cropped to 84 x 84; ± is over "
    "five seeds.",
    "video_hard and SGQN: the SGQN authors' own runs.",
)
PUBLISHED = "Published:"
COLUMNS = ("policy", "method", "task", "seed", "environment_steps", "mode", "shown", "episode", "return")


@dataclass(frozen=True)
class Generalization:
    """
    :param policy: which was evaluated
    :param environment_steps: of its training
    :param results: one per mode
    """

    policy: SavedPolicy
    environment_steps: int
    results: Sequence[ModeReturns]


def write_generalization(evaluated: Sequence[Generalization], folder: Path) -> list[Path]:
    """
    :param evaluated: at least one policy, all in the same modes
    :param folder: is made
    :return: what was written: generalization.csv and .json (every episode), .md, .png, and over_training.png of the runs that
        a :class:`~sb3_crc.analysis.generalization.GeneralizationCallback` has watched
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = write_rows(list(_rows(evaluated)), folder, "generalization")
    by_task: dict[str, list[Generalization]] = {}
    for one in evaluated:
        by_task.setdefault(one.policy.run.task, []).append(one)
    what = "Mean return of the policy's mean action; ± over the trainings, where there are several."
    lines = ["# Where it was not trained", "", what]
    for task, own in by_task.items():
        lines += _task_lines(task, own)
    shown = dict.fromkeys(result.label for one in evaluated for result in one.results if result.mode != NONE)
    if shown:
        lines += ["", f"Shown: {', '.join(shown)}."]
    if PUBLISHED in lines:
        lines += ["", *(f"{note}\n" for note in UNITS)]
    written.append(write_lines(lines, folder / "generalization.md"))
    written.append(_draw_bars(by_task, folder / "generalization.png"))
    curves = _draw_curves([one.policy.run for one in evaluated], folder / "over_training.png")
    return written if curves is None else [*written, curves]


def read_published() -> list[dict[str, str]]:
    """:return: rows method, task, mode, mean, std, seeds, source: test returns of DMControl-GB"""
    text = (files("sb3_crc.analysis") / "published_generalization.csv").read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))


def _rows(evaluated: Iterable[Generalization]) -> Iterable[dict[str, Any]]:
    for one in evaluated:
        run = one.policy.run
        for result in one.results:
            for episode, value in enumerate(result.returns):
                cells = (
                    one.policy.name,
                    run.method,
                    run.task,
                    run.seed,
                    one.environment_steps,
                    result.mode,
                    result.label,
                    episode,
                    value,
                )
                yield dict(zip(COLUMNS, cells, strict=True))


def _by_policy(own: Sequence[Generalization]) -> dict[tuple[str, int], dict[str, np.ndarray]]:
    """:return: (method, environment steps) -> mode -> mean returns, one per training"""
    found: dict[tuple[str, int], dict[str, list[float]]] = {}
    for one in own:
        modes = found.setdefault((one.policy.run.method, one.environment_steps), {})
        for result in one.results:
            modes.setdefault(result.mode, []).append(float(np.mean(result.returns)))
    return {key: {mode: np.array(values) for mode, values in modes.items()} for key, modes in found.items()}


def _task_lines(task: str, own: Sequence[Generalization]) -> list[str]:
    modes = list(dict.fromkeys(result.mode for one in own for result in one.results))
    rows = []
    for (method, steps), means in _by_policy(own).items():
        trainings = max(len(values) for values in means.values())
        cells = [_cell(means.get(mode), means.get(NONE) if mode != NONE else None) for mode in modes]
        rows.append([method, f"{steps}", f"{trainings}", *cells])
    lines = ["", f"## {task}", "", *markdown(["method", "environment steps", "trainings", *modes], rows)]
    if NONE in modes:
        lines += ["", f"In parentheses: share of the return in the environment of the training ({NONE})."]
    published = [row for row in read_published() if row["task"] == task and row["mode"] in modes]
    if published:
        kinds = [mode for mode in modes if any(row["mode"] == mode for row in published)]
        at = {(row["method"], row["mode"]): f"{row['mean']} ± {row['std']}" for row in published}
        methods = list(dict.fromkeys(row["method"] for row in published))
        table = [[method, *(at.get((method, mode), "-") for mode in kinds)] for method in methods]
        sources = dict.fromkeys(row["source"] for row in published)
        lines += ["", PUBLISHED, "", *markdown(["method", *kinds], table), "", f"Sources: {'; '.join(sources)}."]
    return lines


def _cell(values: np.ndarray | None, undistracted: np.ndarray | None) -> str:
    if values is None:
        return "-"
    text = f"{values.mean():.0f}" + (f" ± {values.std(ddof=1):.0f}" if len(values) > 1 else "")
    if undistracted is None or undistracted.mean() <= 0:
        return text
    return f"{text} ({values.mean() / undistracted.mean():.0%})"


def _draw_bars(by_task: Mapping[str, Sequence[Generalization]], path: Path) -> Path:
    """A bar per method and mode, a dot per training."""
    figure = new_figure(8.0, 3.2 * len(by_task))
    for axes, (task, own) in zip(figure.subplots(len(by_task), squeeze=False).flat, by_task.items(), strict=True):
        modes = list(dict.fromkeys(result.mode for one in own for result in one.results))
        grouped = _by_policy(own)
        several = len({steps for _, steps in grouped}) > 1
        width = 0.8 / len(grouped)
        for number, ((method, steps), means) in enumerate(grouped.items()):
            at = np.arange(len(modes)) + (number - (len(grouped) - 1) / 2) * width
            label = f"{method}, {steps} steps" if several else method
            axes.bar(at, [means[mode].mean() for mode in modes], 0.9 * width, label=label, alpha=0.6, color=f"C{number}")
            for where, mode in zip(at, modes, strict=True):
                axes.plot([where] * len(means[mode]), means[mode], "o", color=f"C{number}", markersize=4)
        axes.set_xticks(np.arange(len(modes)), modes)
        axes.set_ylabel("mean return")
        axes.set_title(task)
        axes.legend(fontsize="small")
    return save(figure, path)


def _draw_curves(runs: Sequence[Run], path: Path) -> Path | None:
    """The paper's plot: a row per task, a column per mode, a line per method: mean and range where all its trainings are."""
    found: dict[str, dict[str, dict[str, list[tuple[np.ndarray, np.ndarray]]]]] = {}
    for run in {run.folder: run for run in runs}.values():
        records = read_records(run.folder)
        for mode in records.keys() - {"timesteps"}:
            steps = records["timesteps"] * run.action_repeat
            curve = steps, records[mode].mean(axis=1)
            found.setdefault(run.task, {}).setdefault(mode, {}).setdefault(run.method, []).append(curve)
    if not found:
        return None
    modes = sorted({mode for own in found.values() for mode in own})
    figure = new_figure(4.5 * len(modes), 3.2 * len(found))
    grid = figure.subplots(len(found), len(modes), squeeze=False)
    for row, (task, own) in zip(grid, found.items(), strict=True):
        for axes, mode in zip(row, modes, strict=True):
            for number, (method, curves) in enumerate(own.get(mode, {}).items()):
                steps = reduce(np.intersect1d, (own_steps for own_steps, _ in curves))
                returns = np.stack([values[np.isin(own_steps, steps)] for own_steps, values in curves])
                axes.plot(steps, returns.mean(axis=0), color=f"C{number}", label=f"{method} ({len(curves)})", marker=".")
                axes.fill_between(steps, returns.min(axis=0), returns.max(axis=0), color=f"C{number}", alpha=0.15)
            axes.set_title(f"{task}, {mode}")
            axes.set_xlabel("environment steps")
            axes.set_ylabel("mean return")
            if own.get(mode):
                axes.legend(fontsize="small")
    return save(figure, path)
