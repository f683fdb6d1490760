"""Tables for people and JSON for later: every figure with its spread, its target and the machine that it was measured on."""

import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from sb3_crc.experiments.provenance import provenance

RESULTS = Path(__file__).parents[1] / "results" / "benchmarks"


@dataclass(frozen=True)
class Target:
    """
    What a figure should be.

    :param figure: name of a column
    :param limit: it passes up to this value, or with ``at_least`` from it on
    :param at_least: larger is better
    """

    figure: str
    limit: float
    at_least: bool = False

    def met(self, row: Mapping[str, Any]) -> bool:
        """:return: whether ``row`` passes"""
        value = float(row[self.figure])
        return value >= self.limit if self.at_least else value <= self.limit

    @property
    def bound(self) -> str:
        """The limit, as ``<= 0.5``."""
        return f"{'>=' if self.at_least else '<='} {self.limit:g}"


def spread(seconds: Sequence[float]) -> dict[str, float]:
    """:return: median, and the quartiles around it, in milliseconds"""
    quartiles = statistics.quantiles(seconds, n=4) if len(seconds) > 1 else [seconds[0]] * 3
    return {name: 1e3 * value for name, value in zip(("ms q1", "ms", "ms q3"), quartiles, strict=True)}


def judged(row: dict[str, Any], targets: Sequence[Target]) -> dict[str, Any]:
    """:return: ``row``, and as "targets" what each of its figures should be, and PASS or MISS"""
    verdicts = {target.figure: f"{target.bound} {'PASS' if target.met(row) else 'MISS'}" for target in targets}
    return {**row, "targets": verdicts}


def publish(
    name: str, title: str, rows: Sequence[dict[str, Any]], command: str, *, by: Sequence[str] = (), folder: Path = RESULTS
) -> Path:
    """
    Print tables and write the same as JSON.

    :param name: of the benchmark, and of the file
    :param title: of the tables
    :param rows: column -> value; "targets" as :func:`judged` adds them
    :param command: that repeats it
    :param by: columns whose values are a table's title: one table for each combination
    :param folder: where the file goes
    :return: the file
    """
    for values in dict.fromkeys(tuple(row[column] for column in by) for row in rows):
        heading = ", ".join([title, *(f"{column} {value}" for column, value in zip(by, values, strict=True))])
        print_table(heading, [row for row in rows if tuple(row[column] for column in by) == values], hidden=by)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    path.write_text(json.dumps({"command": command, **provenance(), "rows": list(rows)}, indent=1) + "\n", encoding="utf-8")
    return path


def print_table(title: str, rows: Sequence[dict[str, Any]], hidden: Sequence[str] = ()) -> None:
    """
    :param title: above it
    :param rows: see :func:`publish`
    :param hidden: columns that are left out
    """
    columns = list(dict.fromkeys(column for row in rows for column in row if column not in {"targets", *hidden}))
    table = Table(title=title, title_justify="left")
    for column in columns:
        numbers = all(isinstance(row.get(column, 0), int | float) for row in rows)
        table.add_column(column, justify="right" if numbers else "left", no_wrap=True)
    for row in rows:
        verdicts = row.get("targets", {})
        table.add_row(*(_cell(row.get(column), verdicts.get(column, "")) for column in columns))
    Console(width=Console(width=1_000).measure(table).maximum).print(table)  # a terminal may wrap it, columns never shrink


def _cell(value: Any, verdict: str) -> str:
    if value is None:
        return ""
    text = str(value) if not isinstance(value, float) else f"{value:.2f}" if abs(value) < 10 else f"{value:.0f}"
    if not verdict:
        return text
    return f"[{'green' if verdict.endswith('PASS') else 'red'}]{verdict}[/]  {text}"
