"""Numbers of an analysis as CSV, JSON and Markdown."""

import csv
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sb3_crc.experiments.statistics import Estimate

Row = Mapping[str, Any]


def estimate_columns(estimate: Estimate) -> dict[str, float | None]:
    """:return: value and ends of the interval, None where there is none"""
    low, high = (None, None) if estimate.interval is None else estimate.interval
    return {"value": estimate.value, "low": low, "high": high}


def estimate_of(row: Row) -> Estimate:
    """:return: what :func:`estimate_columns` wrote into the row"""
    return Estimate(row["value"], None if row["low"] is None else (row["low"], row["high"]))


def write_rows(rows: Sequence[Row], folder: Path, name: str) -> list[Path]:
    """
    :param rows: of equal columns; at least one
    :param folder: to write to
    :param name: of the files, without suffix
    :return: the CSV and the JSON file
    """
    table, data = folder / f"{name}.csv", folder / f"{name}.json"
    with table.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    plain = [{key: _plain(value) for key, value in row.items()} for row in rows]
    data.write_text(json.dumps(plain, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return [table, data]


def write_lines(lines: Sequence[str], path: Path) -> Path:
    """:return: the path that was written"""
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def number(value: float, form: str = ".2f") -> str:
    """:return: the value, or a dash for NaN"""
    return "-" if math.isnan(value) else f"{value:{form}}"


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
