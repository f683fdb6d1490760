"""Figures and summaries of a comparison: what ``sb3-crc curves`` writes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sb3_crc.experiments.comparison_summary import count, machines, summary, write_rows
from sb3_crc.experiments.pairs import Pair, compare_by_task, compare_pairs, own_matrices, ranges
from sb3_crc.experiments.scores import Scores, final_means, one_protocol
from sb3_crc.experiments.statistics import (
    HIGHEST_RETURN,
    NOT_RESOLVED,
    REPS,
    Curve,
    Estimate,
    ScoreMatrices,
    aggregate,
    curve,
    profile,
    training_runs,
)

if TYPE_CHECKING:
    import pandas as pd

FIGURES = ("sample_efficiency.png", "wall_time.png", "improvement.png", "profile.png", "tasks.png")
DOTS_PER_INCH = 150
STEPS, HOURS, RETURN = "environment steps", "hours of training, without evaluations", "return"


def draw_comparison(
    scores: Scores,
    folder: Path,
    *,
    baseline: str | None,
    allow_mixed: bool = False,
    reps: int = REPS,
) -> list[Path]:
    """
    Write :data:`FIGURES`, ``summary.md`` and ``summary.csv``. A figure that cannot be drawn is left out, the summary says why,
    and one of that name from an earlier call is removed.

    :param scores: of the runs
    :param folder: to write to
    :param baseline: method that the others are compared with; None: the first
    :param allow_mixed: let runs of different protocols stand beside each other
    :param reps: bootstrap samples
    :return: what was written
    :raises ValueError: if there are no scores, no method of the baseline's name, or a seed was run twice
    :raises MixedProtocols: if final policies, or evaluations during training, were measured in different ways
    """
    methods = list(dict.fromkeys(map(str, scores.table["method"])))
    if not methods:
        raise ValueError("there are no scores to draw")
    baseline = methods[0] if baseline is None else baseline
    if baseline not in methods:
        raise ValueError(f"there is no method {baseline!r} to compare with, only {', '.join(methods)}")
    final = one_protocol(scores.final, allow_mixed=allow_mixed)
    current = scores.table[scores.table["policy"] == "current"]
    one_protocol(current.assign(first_seed=0), allow_mixed=allow_mixed)  # each of a run's evaluations has its own first seed
    means = final_means(final)
    matrices, not_aggregated = own_matrices(means)
    own = {method: of.scores[method] for method, of in matrices.items()}
    compared, not_compared = compare_pairs(means, baseline, reps=reps)
    by_task, not_by_task = compare_by_task(means, baseline, reps=reps)
    styles = {method: _style(number) for number, method in enumerate(methods)}
    notes = {
        "Runs without a score": list(map(str, scores.missing)),
        "Not in final returns and profile": not_aggregated,
        f"Not compared with {baseline}": list(dict.fromkeys([*not_by_task, *not_compared])),
    }

    folder.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Any] = {}
    steps, seconds = curve(scores.table, "environment_steps", reps=reps), curve(scores.table, "seconds", reps=reps)
    notes["Not in the curves"] = list(steps.left_out)
    notes["About wall time"] = [*(one for one in seconds.left_out if one not in steps.left_out), *machines(current)]
    if steps.methods:
        figures["sample_efficiency.png"] = _curves_figure(steps.methods, styles, STEPS)
        figures["tasks.png"] = _tasks_figure(scores.table, styles)
    if seconds.methods:
        figures["wall_time.png"] = _curves_figure(seconds.methods, styles, HOURS)
    if compared:
        figures["improvement.png"] = _improvement_figure(compared, styles)
    if own:
        shares = profile(own, np.linspace(0, HIGHEST_RETURN, 101), reps=reps)
        figures["profile.png"] = _profile_figure(shares, styles, matrices)
    scored = means["method"].nunique()
    notes["Figures left out"] = [f"{name}: {_why_not(name, scored)}" for name in FIGURES if name not in figures]
    for name in FIGURES:
        (folder / name).unlink(missing_ok=True)
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=DOTS_PER_INCH)

    aggregates = aggregate(own, reps=reps)
    text = summary(matrices, aggregates, compared, by_task, baseline, final, notes)
    (folder / "summary.md").write_text(text, encoding="utf-8")
    write_rows(folder / "summary.csv", matrices, aggregates, compared)
    return [folder / name for name in (*figures, "summary.md", "summary.csv")]


def _style(number: int) -> dict[str, Any]:
    """A colour, and for those who cannot tell colours apart a marker; beyond ten methods another kind of line."""
    lines: tuple[Literal["-", "--", ":", "-."], ...] = ("-", "--", ":", "-.")
    return {"color": f"C{number % 10}", "marker": "osD^vPX*<>"[number % 10], "linestyle": lines[number // 10 % len(lines)]}


def _new_figure(height: float, labels: Sequence[str] = ()) -> Any:
    """With room for a legend of these labels."""
    from matplotlib.figure import Figure  # without pyplot no display is asked for

    rows = -(-len(labels) // _columns(labels)) if labels else 0
    return Figure(figsize=(7, height + 0.21 * rows), layout="constrained")


def _columns(labels: Sequence[str]) -> int:
    return min(len(labels), 2 if max(map(len, labels)) > 22 else 3)


def _legend(figure: Any, handles: Mapping[str, Any]) -> None:
    columns = _columns(list(handles))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns, frameon=False)


def _draw_all(
    curves: Mapping[str, Curve], styles: Mapping[str, Mapping[str, Any]], labels: Mapping[str, str], scale: float = 1.0
) -> tuple[Any, Any]:
    figure = _new_figure(4.0, list(labels.values()))
    axes = figure.subplots()
    handles = {}
    for method, shown in curves.items():
        style, every = styles[method], max(1, len(shown.x) // 8)
        (line,) = axes.plot(
            shown.x * scale, shown.y, **style, markevery=every, markersize=5, linewidth=1.8, label=labels[method]
        )
        handles[labels[method]] = line
        if shown.interval is not None:
            alpha = 0.18 if len(curves) < 8 else 0.06  # many bands would hide the lines
            axes.fill_between(shown.x * scale, *shown.interval, color=style["color"], alpha=alpha, linewidth=0)
    axes.grid(alpha=0.3)
    _legend(figure, handles)
    return figure, axes


def _curves_figure(curves: Mapping[str, Curve], styles: Mapping[str, Mapping[str, Any]], abscissa: str) -> Any:
    labels = {method: f"{method}, {count(shown.seeds, 'seed')}" for method, shown in curves.items()}
    figure, axes = _draw_all(curves, styles, labels, scale=1 / 3600 if abscissa == HOURS else 1.0)
    tasks = count(next(iter(curves.values())).tasks, "task")
    banded = any(shown.interval is not None for shown in curves.values())
    axes.set_title(f"IQM over seeds, {tasks}{', with 95 % intervals' * banded}", fontsize=11)
    axes.set_xlabel(f"{abscissa} (each until its first run ends)" if abscissa == HOURS else abscissa)
    axes.set_ylabel("return in evaluations")
    _finish(axes, abscissa)
    return figure


def _finish(axes: Any, abscissa: str) -> None:
    from matplotlib.ticker import EngFormatter, MaxNLocator

    if abscissa == STEPS:
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))  # 100k
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=axes.get_ylim()[0] if axes.dataLim.y0 < 0 else 0.0)


def _tasks_figure(table: "pd.DataFrame", styles: Mapping[str, Mapping[str, Any]]) -> Any:
    runs, _ = training_runs(table, "environment_steps")
    methods, tasks = list(dict.fromkeys(key[0] for key in runs)), list(dict.fromkeys(key[1] for key in runs))
    own = {(m, t): [run for key, run in runs.items() if key[:2] == (m, t)] for m in methods for t in tasks}
    counts = {method: sorted({len(own[method, task]) for task in tasks}) for method in methods}
    few_to_many = {
        method: " to ".join(map(str, dict.fromkeys((numbers[0], numbers[-1])))) for method, numbers in counts.items()
    }
    labels = {method: f"{method}, {few_to_many[method]} seed{'s' * (counts[method] != [1])}" for method in methods}
    columns = min(2, len(tasks))
    rows = -(-len(tasks) // columns)
    figure = _new_figure(0.9 + (2.5 if columns == 2 else 3.2) * rows, list(labels.values()))
    grid = figure.subplots(rows, columns, squeeze=False)
    handles = {}
    for axes in grid.flat[len(tasks) :]:
        axes.remove()
    for axes, task in zip(grid.flat, tasks, strict=False):
        for method in methods:
            if not own[method, task]:
                continue
            style = styles[method]
            for run in own[method, task]:
                axes.plot(*run, color=style["color"], linestyle=style["linestyle"], linewidth=0.8, alpha=0.45)
            shared = np.array(sorted(set.intersection(*(set(x) for x, _ in own[method, task]))))
            mean = np.mean([np.interp(shared, *run) for run in own[method, task]], axis=0) if len(shared) else shared
            every = max(1, len(shared) // 6)
            (handles[labels[method]],) = axes.plot(shared, mean, **style, markevery=every, markersize=4, linewidth=1.8)
        axes.set_title(task, fontsize=11)
        axes.grid(alpha=0.3)
        _finish(axes, STEPS)
    for axes in grid.flat[max(0, len(tasks) - columns) : len(tasks)]:  # the lowest of each column
        axes.set_xlabel(STEPS)
    for axes in grid[:, 0]:
        axes.set_ylabel("return in evaluations")
    figure.suptitle("Each seed (thin) and the mean of the seeds (thick)", fontsize=11)
    _legend(figure, handles)
    return figure


def _improvement_figure(compared: Sequence[Pair], styles: Mapping[str, Mapping[str, Any]]) -> Any:
    from matplotlib.ticker import MaxNLocator

    figure = _new_figure(1.4 + 0.5 * len(compared))
    left, right = figure.subplots(1, 2, sharey=True)
    baseline = compared[0].difference.baseline
    for row, pair in enumerate(compared):
        one = pair.difference
        _point(left, one.probability, row, styles[one.method], one.resolved)
        _point(right, one.iqm, row, styles[one.method], one.resolved)
        text = f"{one.iqm.value:+.0f}" if one.resolved else NOT_RESOLVED
        right.text(1.02, row, text, transform=right.get_yaxis_transform(), va="center", fontsize=9)
    left.axvline(0.5, color="black", linewidth=1, linestyle=":")
    right.axvline(0, color="black", linewidth=1, linestyle=":")
    left.set_xlim(-0.04, 1.04)
    right.margins(x=0.12)
    right.xaxis.set_major_locator(MaxNLocator(5))
    left.set_ylim(len(compared) - 0.5, -0.6)
    left.set_yticks(range(len(compared)), [_on(one.difference.method, one.seeds, len(one.tasks), "\n") for one in compared])
    left.set_xlabel(f"P(method > {baseline})")
    right.set_xlabel(f"IQM of {RETURN} minus that of {baseline}")
    for axes in (left, right):
        axes.grid(alpha=0.3, axis="x")
    banded = any(len(one.seeds) > 1 for one in compared)
    intervals = "95 % intervals; hollow: not resolved" if banded else "no interval"
    figure.suptitle(f"Final policies against {baseline}, {intervals}", fontsize=11)
    return figure


def _on(method: str, seeds: Sequence[int], tasks: int, between: str = ", ") -> str:
    """The method, and on what it is judged."""
    return f"{method}{between}{count(tasks, 'task')}, seed{'s' * (len(seeds) != 1)} {ranges(seeds)}"


def _point(axes: Any, estimate: Estimate, row: int, style: Mapping[str, Any], filled: bool) -> None:
    error = None
    if estimate.interval is not None:
        low, high = estimate.interval
        error = [[max(0.0, estimate.value - low)], [max(0.0, high - estimate.value)]]
    axes.errorbar(
        estimate.value,
        row,
        xerr=error,
        color=style["color"],
        marker=style["marker"],
        markersize=7,
        capsize=4,
        linewidth=1.8,
        markerfacecolor=style["color"] if filled else "white",
    )


def _profile_figure(
    profiles: Mapping[str, Curve], styles: Mapping[str, Mapping[str, Any]], matrices: Mapping[str, ScoreMatrices]
) -> Any:
    labels = {method: _on(method, matrices[method].seeds, shown.tasks) for method, shown in profiles.items()}
    figure, axes = _draw_all(profiles, styles, labels)
    banded = ", with 95 % intervals" if any(one.interval is not None for one in profiles.values()) else ""
    axes.set_title(f"Performance profile{banded}", fontsize=11)
    axes.set_xlabel("final return x")
    axes.set_ylabel("share of runs with a return above x")
    axes.set_xlim(0, HIGHEST_RETURN)
    axes.set_ylim(-0.02, 1.04)
    return figure


def _why_not(name: str, scored: int) -> str:
    if name == "wall_time.png":
        return "no run has seconds of training at its evaluations"
    if name == "improvement.png":
        return "there is only one method" if scored == 1 else "no method has a task and seed in common with the baseline"
    if name == "profile.png":
        return "no task has a final score of every method"
    return "no run has evaluations during training that can be shown"
