"""What a comparison says in words and numbers: ``summary.md`` and ``summary.csv`` of ``sb3-crc curves``."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_crc.experiments.scores import PROTOCOL
from sb3_crc.experiments.statistics import NOT_RESOLVED, ONE_SEED, STATISTICS, Difference, Estimate, ScoreMatrices

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
    if not matrices.scores:
        return "No final scores to compare."
    tasks = ", ".join(matrices.tasks) if names else count(len(matrices.tasks), "task")
    return f"{tasks}; {'seeds' if len(matrices.seeds) > 1 else 'seed'} {', '.join(map(str, matrices.seeds))}"


def summary(
    matrices: ScoreMatrices,
    aggregates: Mapping[str, Mapping[str, Estimate]],
    compared: Sequence[Difference],
    baseline: str,
    final: "pd.DataFrame",
    notes: Mapping[str, Sequence[str]],
) -> str:
    """
    :param matrices: final scores
    :param aggregates: method -> statistic -> its estimate
    :param compared: each method with the baseline
    :param baseline: with which they are compared
    :param final: rows of final policies
    :param notes: title -> entries of a list
    :return: ``summary.md``
    """
    lines = ["# Comparison", "", about(matrices), ""]
    if matrices.scores:
        protocol = [f"{column} {', '.join(map(str, final[column].dropna().unique()))}" for column in PROTOCOL]
        lines += [f"Final policies: {'; '.join(protocol)}.", "", "## Final returns", ""]
        rows = [(method, *(found[name].text() for name in STATISTICS)) for method, found in aggregates.items()]
        lines += [*markdown(("method", *STATISTICS), rows), ""]
    if compared:
        lines += [f"## Against {baseline}", "", *difference_table(compared)]
        lines += ["", f"'{NOT_RESOLVED}': the interval of the difference includes 0, or there is none.", ""]
    if len(matrices.seeds) > 1:
        lines += ["In parentheses: 95 % intervals, stratified bootstrap over seeds; differences paired by seed.", ""]
    elif matrices.seeds:
        lines += [f"{ONE_SEED.capitalize()}.", ""]
    if 1 < len(matrices.seeds) < FEW_SEEDS:
        lines += [
            f"With {len(matrices.seeds)} seeds these intervals are too narrow: on one task, two equal methods come out as "
            "different in about 50 % of comparisons with 2 seeds, 26 % with 3, 10 % with 5 and 7 % with 10, instead of 5 %.",
            "",
        ]
    for title, entries in notes.items():
        lines += listed(title, entries)
    return "\n".join(lines)


def listed(title: str, entries: Sequence[str]) -> list[str]:
    """:return: lines of Markdown, none if there are no entries"""
    return [f"## {title}", "", *(f"- {entry}" for entry in entries), ""] if entries else []


def difference_table(compared: Sequence[Difference], places: Sequence[tuple[str, str]] = ()) -> list[str]:
    """
    :param compared: methods with one baseline, at least one
    :param places: tasks and seeds of each, where they are not the same for all
    :return: lines of a table
    """
    header = ["method", "difference of IQMs", "verdict", f"P(method > {compared[0].baseline})"]
    rows = [[one.method, one.iqm.text("+.0f"), one.verdict, one.probability.text(".2f")] for one in compared]
    if places:
        header[1:1] = ["tasks", "seeds"]
        rows = [[method, *place, *figures] for (method, *figures), place in zip(rows, places, strict=True)]
    return markdown(header, rows)


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]], marks: Sequence[str] | None = None) -> list[str]:
    """:param marks: how each column is aligned; None: as ever; :return: lines of a table, whatever is in its cells"""
    lines = (header, marks or ["---"] * len(header), *rows)
    return [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |" for cells in lines]


def write_rows(
    path: Path,
    matrices: ScoreMatrices,
    aggregates: Mapping[str, Mapping[str, Estimate]],
    compared: Sequence[Difference],
) -> None:
    """:param path: of ``summary.csv``, see :func:`summary` for the rest"""
    found = [(method, "", name, one, "") for method, own in aggregates.items() for name, one in own.items()]
    for one in compared:
        found.append((one.method, one.baseline, "difference of IQM", one.iqm, one.verdict))
        found.append((one.method, one.baseline, "probability of improvement", one.probability, ""))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(SUMMARY_COLUMNS)
        for method, baseline, name, estimate, verdict in found:
            low, high = ("", "") if estimate.interval is None else estimate.interval
            counts = len(matrices.seeds), len(matrices.tasks)
            writer.writerow([method, baseline, name, estimate.value, low, high, *counts, verdict])
