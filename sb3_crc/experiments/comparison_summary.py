"""What a comparison says in words and numbers: ``summary.md`` and ``summary.csv`` of ``sb3-crc curves``."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_crc.experiments.pairs import Pair
from sb3_crc.experiments.scores import PROTOCOL
from sb3_crc.experiments.statistics import ENOUGH_SEEDS, NOT_RESOLVED, ONE_SEED, STATISTICS, Estimate, ScoreMatrices

if TYPE_CHECKING:
    import pandas as pd

SUMMARY_COLUMNS = ("method", "baseline", "statistic", "value", "low", "high", "seeds", "tasks", "verdict")
#: Below this many seeds the summary says what an interval of a bootstrap is worth
FEW_SEEDS = 8


def count(number: int, name: str) -> str:
    """:return: ``1 seed``, ``2 seeds``"""
    return f"{number} {name}{'s' * (number != 1)}"


def machines(current: "pd.DataFrame") -> list[str]:
    """:param current: rows of evaluations during training; :return: a sentence for each machine, if there are several"""
    known = current.dropna(subset=["seconds"])
    methods_on = known.groupby("machine", dropna=False)["method"].unique()
    if len(methods_on) < 2:
        return []
    return [f"runs on different machines: {name}: {', '.join(methods)}" for name, methods in methods_on.items()]


def about(matrices: ScoreMatrices, names: bool = True) -> str:
    """:param names: of the tasks, or only how many; :return: what is compared"""
    tasks = ", ".join(matrices.tasks) if names else count(len(matrices.tasks), "task")
    return f"{tasks}; {'seeds' if len(matrices.seeds) > 1 else 'seed'} {', '.join(map(str, matrices.seeds))}"


def summary(
    matrices: Mapping[str, ScoreMatrices],
    aggregates: Mapping[str, Mapping[str, Estimate]],
    compared: Sequence[Pair],
    by_task: Sequence[Pair],
    baseline: str,
    final: "pd.DataFrame",
    notes: Mapping[str, Sequence[str]],
) -> str:
    """
    :param matrices: final scores of each method, on the tasks that all have
    :param aggregates: method -> statistic -> its estimate
    :param compared: each method with the baseline
    :param by_task: the same on each task by itself
    :param baseline: with which they are compared
    :param final: rows of final policies
    :param notes: title -> entries of a list
    :return: ``summary.md``
    """
    lines = ["# Comparison", ""]
    if final.empty:
        lines += ["No final scores to compare.", ""]
    else:
        protocol = [f"{column} {', '.join(map(str, final[column].dropna().unique()))}" for column in PROTOCOL]
        lines += [f"Final policies: {'; '.join(protocol)}.", ""]
    if matrices:
        tasks = ", ".join(next(iter(matrices.values())).tasks)
        lines += ["## Final returns", "", f"{tasks}: each method with all its own seeds.", ""]
        rows = [
            (method, _seeds(matrices[method].seeds), *(found[name].text() for name in STATISTICS))
            for method, found in aggregates.items()
        ]
        lines += [*markdown(("method", "seeds", *STATISTICS), rows), ""]
    if compared:
        lines += [f"## Against {baseline}", "", *difference_table(compared), ""]
    if len({one.tasks for one in by_task}) > 1:
        lines += ["On each task:", "", *difference_table(by_task), ""]
    if compared or by_task:
        lines += [
            f"Each method on the tasks and seeds that it and {baseline} both have. '{NOT_RESOLVED}': the interval of the "
            f"difference includes 0, or there are fewer than {ENOUGH_SEEDS} seeds.",
            "",
        ]
    seeds = [len(own.seeds) for own in matrices.values()] + [len(pair.seeds) for pair in (*compared, *by_task)]
    if max(seeds, default=0) > 1:
        lines += ["In parentheses: 95 % intervals, stratified bootstrap over seeds; differences paired by seed.", ""]
    elif seeds:
        lines += [f"{ONE_SEED.capitalize()}.", ""]
    if any(1 < number < FEW_SEEDS for number in seeds):
        lines += [
            f"With fewer than {FEW_SEEDS} seeds these intervals are too narrow: on one task, two equal methods come out as "
            "different in about 50 % of comparisons with 2 seeds, 26 % with 3, 10 % with 5 and 7 % with 10, instead of 5 %.",
            "",
        ]
    for title, entries in notes.items():
        lines += listed(title, entries)
    return "\n".join(lines)


def listed(title: str, entries: Sequence[str]) -> list[str]:
    """:return: lines of Markdown, none if there are no entries"""
    return [f"## {title}", "", *(f"- {entry}" for entry in entries), ""] if entries else []


def difference_table(compared: Sequence[Pair]) -> list[str]:
    """
    :param compared: methods with one baseline, at least one
    :return: lines of a table
    """
    tasks = "task" if all(len(one.tasks) == 1 for one in compared) else "tasks"
    baseline = compared[0].difference.baseline
    header = ["method", tasks, "seeds", "difference of IQMs", "verdict", f"P(method > {baseline})"]
    rows = []
    for one in compared:
        found = one.difference
        figures = [found.iqm.text("+.0f"), found.verdict, found.probability.text(".2f")]
        rows.append([found.method, ", ".join(one.tasks), _seeds(one.seeds), *figures])
    return markdown(header, rows)


def _seeds(seeds: Iterable[int]) -> str:
    return ", ".join(map(str, seeds))


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]], marks: Sequence[str] | None = None) -> list[str]:
    """:param marks: how each column is aligned; None: as ever; :return: lines of a table, whatever is in its cells"""
    lines = (header, marks or ["---"] * len(header), *rows)
    return [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |" for cells in lines]


def write_rows(
    path: Path,
    matrices: Mapping[str, ScoreMatrices],
    aggregates: Mapping[str, Mapping[str, Estimate]],
    compared: Sequence[Pair],
) -> None:
    """:param path: of ``summary.csv``, see :func:`summary` for the rest"""
    rows = [
        (method, "", name, one, len(matrices[method].seeds), len(matrices[method].tasks), "")
        for method, own in aggregates.items()
        for name, one in own.items()
    ]
    for pair in compared:
        one, counts = pair.difference, (len(pair.seeds), len(pair.tasks))
        rows.append((one.method, one.baseline, "difference of IQM", one.iqm, *counts, one.verdict))
        rows.append((one.method, one.baseline, "probability of improvement", one.probability, *counts, ""))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(SUMMARY_COLUMNS)
        for method, baseline, name, estimate, *rest in rows:
            low, high = ("", "") if estimate.interval is None else estimate.interval
            writer.writerow([method, baseline, name, estimate.value, low, high, *rest])
