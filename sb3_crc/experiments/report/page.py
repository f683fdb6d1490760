"""The page itself: everything that it shows is in it, so that it can be sent, kept and opened without a network."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timezone
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_crc.atomic import atomic_write
from sb3_crc.experiments.published import STEPS
from sb3_crc.experiments.report.contents import (
    Medium,
    RunContents,
    all_contents,
    differing_settings,
    folder_media,
    run_media,
)
from sb3_crc.experiments.scores import MixedProtocols, Scores, final_means, read_scores, recorded
from sb3_crc.experiments.statistics import Axis, curve, training_runs
from sb3_crc.experiments.table_formats import Grid, grids
from sb3_crc.experiments.tables import fits, paper_table

if TYPE_CHECKING:
    import pandas as pd

#: Bytes that a page may have; pictures and films beyond are left out, and the page says which
LARGEST = 15_000_000
#: Okabe and Ito's colours, which those see apart who see some colours alike, then tab10's
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#8c564b", "#9467bd", "#bcbd22")
AXES: tuple[Axis, ...] = ("environment_steps", "seconds")
#: Bootstrap samples of a curve's interval
REPS = 500


def write_report(sources: Sequence[Path], output: Path, *, title: str | None = None, largest: int = LARGEST) -> list[str]:
    """
    Write one page about runs: scores beside published ones, curves, instruments, settings, pictures and films, machines and
    commands. Runs that are unfinished or failed are shown as such.

    :param sources: runs, folders that contain runs (and figures, which are shown too), or CSV files of scores
    :param output: file to write, whole or not at all
    :param title: of the page; None: the sources' names
    :param largest: bytes; pictures and films that would exceed it are left out
    :return: what was left out
    :raises FileNotFoundError: if a source, or the folder of ``output``, does not exist
    :raises ValueError: if there is nothing to show, or a file cannot be read, naming it
    """
    if not output.absolute().parent.is_dir():
        raise FileNotFoundError(f"{output.parent} is no folder: {output} cannot be written")
    scores = read_scores(sources)
    folders = [source for source in sources if source.is_dir()]
    contents = all_contents(folders)
    if scores.table.empty and not contents:
        raise ValueError(f"no run and no score in {', '.join(map(str, sources))}")
    methods = dict.fromkeys([*map(str, scores.table["method"]), *(one.run.method for one in contents)])
    colours = {method: COLOURS[number % len(COLOURS)] for number, method in enumerate(methods)}
    title = title or ", ".join(source.name or str(source) for source in sources)

    tasks = _curves(scores.table)
    data = {"colours": colours, "tasks": tasks, "instruments": _instruments(contents)}
    sections = {
        "Scores": _scores(scores),
        "Curves": _curves_section(len(tasks)),
        "Instruments": _instruments_section(contents),
        "Settings": _settings_section(contents),
        "Runs and machines": _runs_section(contents),
    }
    shell = _page(title, sections, data, {})
    media, left_out = _fitting(_media(contents, folders), largest - len(shell.encode()))
    page = _page(title, sections, data, {"Pictures and films": _media_section(media, left_out)})
    with atomic_write(output) as unfinished:
        unfinished.write_text(page, encoding="utf-8")
    return left_out


# Scores


def _scores(scores: Scores) -> str:
    final, parts = scores.final, []
    shown = np.zeros(len(final), bool)
    for name in STEPS:
        fitting = [fits(name, task, budget) for task, budget in zip(final["task"], final["budget"], strict=True)]
        chosen = np.array(fitting, bool) & ~shown
        if chosen.any():
            try:
                table = paper_table(Scores(final[chosen], ()), name)
            except MixedProtocols as mixed:
                parts.append(f'<p class="warning">{html.escape(str(mixed))}</p>')
                continue
            shown |= chosen
            for grid in grids(table):
                parts.append(f"<h3>{html.escape(grid.title)}</h3>{_table(grid)}")
            parts.append(_details("Where these come from", "".join(f"<li>{html.escape(note)}</li>" for note in table.notes)))
    if (~shown).any():
        parts.append("<h3>Others</h3>" + _table(_own_grid(final[~shown])))
    if final.empty:
        parts.append('<p class="warning">There is no score of a final policy: <code>sb3-crc evaluate</code> makes them.</p>')
    missing = "".join(f"<li>{html.escape(str(one))}</li>" for one in scores.missing)
    return "".join(parts) + (f'<h3>Not in the tables</h3><ul class="warning">{missing}</ul>' if missing else "")


def _own_grid(final: pd.DataFrame) -> Grid:
    rows = []
    for (budget, quality), of_budget in final.groupby(["budget", "render_quality"], dropna=False):
        for (method, task), of in final_means(of_budget).groupby(["method", "task"], sort=False):
            values = of["return"].to_numpy()
            spread = f"{values.std(ddof=1):.0f}" if len(values) > 1 else ""
            numbers = [str(len(values)), f"{values.mean():.0f}", spread, f"{values.min():.0f}", f"{values.max():.0f}"]
            rows.append([str(method), str(task), f"{budget:,}", str(quality), *numbers])
    header = ["method", "task", "environment steps", "pictures", "seeds", "mean", "std", "lowest", "highest"]
    return Grid("Final policies", header, rows, 2)


def _table(grid: Grid, kind: str = "numbers") -> str:
    ours = [' class="ours"' if name.startswith("ours") else "" for name in grid.header]
    head = "".join(f"<th{own}>{html.escape(name)}</th>" for own, name in zip(ours, grid.header, strict=True))
    body = "".join(
        "<tr>" + "".join(f"<td{own}>{html.escape(cell)}</td>" for own, cell in zip(ours, row, strict=True)) + "</tr>"
        for row in grid.rows
    )
    return f'<div class="wide {kind}"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


# Curves and instruments


def _curves(table: pd.DataFrame) -> list[dict[str, Any]]:
    """By task: each run, and for each axis the methods' IQM with its interval."""
    tasks = []
    current = table[table["policy"] == "current"]
    for task, rows in table[table["task"].isin(current["task"])].groupby("task", sort=False):
        runs: dict[tuple[str, int], dict[str, Any]] = {}
        curves: dict[str, dict[str, Any]] = {}
        for axis in AXES:
            for (method, _, seed), (x, y) in training_runs(rows, axis)[0].items():
                entry = runs.setdefault((method, seed), {"method": method, "seed": seed, "returns": _numbers(y)})
                entry[axis] = _numbers(x)
            curves[axis] = {}
            for method, found in curve(rows, axis, reps=REPS).methods.items():
                own: dict[str, Any] = {"x": _numbers(found.x), "y": _numbers(found.y), "seeds": found.seeds}
                if found.interval is not None:
                    own |= {"low": _numbers(found.interval[0]), "high": _numbers(found.interval[1])}
                curves[axis][method] = own
        tasks.append({"name": str(task), "runs": list(runs.values()), "curves": curves})
    return tasks


def _instruments(contents: Iterable[RunContents]) -> list[dict[str, Any]]:
    return [
        {
            "name": one.name,
            "method": one.run.method,
            "action_repeat": one.run.action_repeat,
            "values": one.instruments,
        }
        for one in contents
        if one.instruments
    ]


def _curves_section(tasks: int) -> str:
    if not tasks:
        return "<p>No run has been evaluated during training.</p>"
    charts = "".join(f'<div class="chart" id="curves-{index}"></div>' for index in range(tasks))
    return (
        '<div class="controls"><button data-axis="environment_steps" aria-pressed="true">environment steps</button>'
        '<button data-axis="seconds" aria-pressed="false">hours</button>'
        f'<button id="each" aria-pressed="true">each run</button></div><div class="charts">{charts}</div>'
        '<p class="faint">Mean action, evaluation episodes during training. Thick: interquartile mean over seeds, with a 95 % '
        "interval of the stratified bootstrap, each point for itself; with few seeds such intervals are too narrow.</p>"
    )


def _instruments_section(contents: Sequence[RunContents]) -> str:
    names = sorted({name for one in contents for name in one.instruments})
    if not names:
        return "<p>No run has a log (progress.csv).</p>"
    first = "train/critic_loss" if "train/critic_loss" in names else names[0]
    entries = "".join(f"<option{' selected' if name == first else ''}>{html.escape(name)}</option>" for name in names)
    return (
        f'<div class="controls"><label>what was logged <select id="metric">{entries}</select></label></div>'
        '<div class="chart" id="logged"></div>'
    )


# Settings, runs, media


def _settings_section(contents: Sequence[RunContents]) -> str:
    if not contents:
        return "<p>Scores alone say nothing about settings.</p>"
    parts = []
    if differing := differing_settings(contents):
        header = ["setting", *(one.name for one in contents)]
        parts.append(_table(Grid("", header, [[name, *values] for name, values in differing.items()], 1), "text"))
    else:
        parts.append("<p>All runs have the same settings.</p>")
    for one in contents:
        rows = [[name, str(value)] for name, value in sorted(one.settings.items())]
        parts.append(_details(one.name, _table(Grid("", ["setting", "value"], rows, 1), "text")))
    return "<p>What is not the same in all runs, then each run's own:</p>" + "".join(parts)


def _runs_section(contents: Sequence[RunContents]) -> str:
    rows = []
    for one in contents:
        about = [recorded(one.run, name) or "" for name in ("machine", "versions", "git_revision")]
        rows.append([one.name, one.run.status, *about])
    commands = "".join(
        f"<h3>{html.escape(one.name)}</h3><pre>{html.escape(one.command or 'not recorded')}</pre>" for one in contents
    )
    grid = Grid("", ["run", "state", "machine", "versions", "revision"], rows, 1)
    return _table(grid, "text") + _details("The commands that began them", commands)


def _media(contents: Sequence[RunContents], folders: Sequence[Path]) -> Iterable[Medium]:
    for one in contents:
        yield from run_media(one)
    for folder in folders:
        yield from folder_media(folder, [one.run for one in contents])


def _fitting(media: Iterable[Medium], room: int) -> tuple[list[Medium], list[str]]:
    shown: list[Medium] = []
    left_out = []
    for medium in media:
        needed = len(medium.uri) + len(medium.caption) + 500
        if needed <= room:
            shown.append(medium)
            room -= needed
        else:
            left_out.append(f"{medium.caption} ({len(medium.uri) / 1e6:.1f} MB)")
    return shown, left_out


def _media_section(media: Sequence[Medium], left_out: Sequence[str]) -> str:
    if not media and not left_out:
        return "<p>There are none.</p>"
    figures = []
    for medium in media:
        caption = html.escape(medium.caption)
        shown = (
            f'<video src="{medium.uri}" controls loop muted playsinline preload="metadata"></video>'
            if medium.is_film
            else f'<a href="{medium.uri}" download="{caption}.png"><img src="{medium.uri}" alt="{caption}" loading="lazy"></a>'
        )
        figures.append(f"<figure>{shown}<figcaption>{caption}</figcaption></figure>")
    missing = "".join(f"<li>{html.escape(one)}</li>" for one in left_out)
    note = f'<p class="warning">Left out, since the page would have become too large:</p><ul>{missing}</ul>' if missing else ""
    return f'<div class="media">{"".join(figures)}</div>{note}'


def _details(summary: str, content: str) -> str:
    return f"<details><summary>{html.escape(summary)}</summary>{content}</details>"


def _page(title: str, sections: Mapping[str, str], data: Mapping[str, Any], more: Mapping[str, str]) -> str:
    from plotly.offline import get_plotlyjs  # type: ignore[import-untyped]

    parts = {**sections, **more}
    anchors = {name: name.lower().replace(" ", "-") for name in parts}
    links = "".join(f'<a href="#{anchor}">{name}</a>' for name, anchor in anchors.items())
    body = "".join(f'<section id="{anchors[name]}"><h2>{name}</h2>{content}</section>' for name, content in parts.items())
    made = f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC, sb3_crc {version('sb3-crc')}"
    embedded = json.dumps(data, separators=(",", ":")).replace("</", "<\\/")
    own = files("sb3_crc.experiments.report")
    css, script = ((own / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">'
        f"<title>{html.escape(title)}</title><style>{css}</style></head><body>"
        f'<header><h1>{html.escape(title)}</h1><button id="theme" aria-pressed="false">dark</button></header>'
        f'<p class="faint">{made}</p><nav>{links}</nav>{body}'
        f'<script type="application/json" id="data">{embedded}</script>'
        f"<script>{get_plotlyjs()}</script><script>{script}</script></body></html>\n"
    )


def _numbers(values: np.ndarray) -> list[float]:
    return [round(float(value), 2) for value in values]
