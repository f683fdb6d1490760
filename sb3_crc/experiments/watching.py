"""How runs are doing while they train: what ``sb3-crc watch`` shows. It only reads files, so it may watch from anywhere."""

from __future__ import annotations

import csv
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_crc.experiments.runs import Run

if TYPE_CHECKING:
    from rich.table import Table

STEPS, ELAPSED = "time/total_timesteps", "time/time_elapsed"
#: Column of the view -> logged value
INSTRUMENTS = {
    "Q bias": "eval/q_bias",
    "critic loss": "train/critic_loss",
    "temperature": "train/ent_coef",
    "contrastive accuracy": "representation/contrastive_accuracy",
    "rank": "representation/effective_rank",
}
#: Rows of the log from which the present speed is taken
RECENT = 6
BARS = "▁▂▃▄▅▆▇█"


@dataclass(frozen=True)
class Progress:
    """
    :param name: method, task and seed
    :param status: of the run; "silent" if an unfinished one has written nothing for a long time; "waiting" if it is to come
    :param agent_steps: done, as far as the log says
    :param budget: agent steps that it was asked for
    :param seconds_left: at the present speed; None if that is not known
    :param returns: mean of each evaluation so far
    :param final: mean return of the final policy; None if that has no score yet
    :param instruments: newest of each of :data:`INSTRUMENTS` that is logged
    """

    name: str
    status: str
    agent_steps: int
    budget: int
    seconds_left: float | None
    returns: tuple[float, ...]
    final: float | None
    instruments: dict[str, float]


def read_progress(run: Run, *, now: float | None = None) -> Progress:
    """
    :param run: in any state; files that are just being written are taken as far as they are whole
    :param now: seconds since the epoch; None: now
    """
    log, rows = run.folder / "progress.csv", _rows(run.folder / "progress.csv")
    logged = [(int(float(row[STEPS])), float(row[ELAPSED])) for row in rows if row.get(STEPS) and row.get(ELAPSED)]
    returns = _returns(run)
    budget = run.budget // run.action_repeat
    steps = max([int(float(row[STEPS])) for row in rows if row.get(STEPS)] or [0])
    status, final = run.status, None
    if (scored := run.final) is not None:
        steps, final = budget, float(np.mean(scored["returns"]))
    elif status == "unevaluated":
        steps = budget
    left = None if status != "unfinished" else _seconds_left(logged, budget)
    if status == "unfinished" and log.exists():
        between = max((later[1] - one[1] for one, later in pairwise(logged)), default=300.0)
        if (time.time() if now is None else now) - log.stat().st_mtime > 3 * max(between, 60.0):
            status, left = "silent", None
    newest = {}
    for name, key in INSTRUMENTS.items():
        values = [row[key] for row in rows if row.get(key)]
        if values:
            newest[name] = float(values[-1])
    return Progress(f"{run.method}, {run.task}, seed {run.seed}", status, steps, budget, left, returns, final, newest)


def progress_table(progresses: Sequence[Progress]) -> Table:
    """
    :param progresses: of runs
    :return: a line for each, and one for all
    """
    from rich.table import Table
    from rich.text import Text

    shown = [name for name in INSTRUMENTS if any(name in one.instruments for one in progresses)]
    table = Table(title=_in_total(progresses), title_justify="left", expand=False)
    for name, justify in (("run", "left"), ("", "left"), ("done", "right"), ("left", "right"), ("returns", "left")):
        table.add_column(name, justify=justify, no_wrap=name != "run")  # type: ignore[arg-type]
    for name in shown:
        table.add_column(name, justify="right")
    for one in progresses:
        last = "" if not one.returns else f"{one.returns[-1]:.0f} {sparkline(one.returns)}"
        table.add_row(
            Text(one.name),
            one.status,
            f"{min(1.0, one.agent_steps / max(1, one.budget)):.0%}",
            "" if one.seconds_left is None else duration(one.seconds_left),
            last if one.final is None else f"{last} final {one.final:.0f}",
            *("" if name not in one.instruments else f"{one.instruments[name]:.3g}" for name in shown),
        )
    return table


def sparkline(values: Sequence[float], width: int = 20) -> str:
    """
    :param values: at least one
    :param width: characters at most; the last values count
    :return: a small drawing of them, from 0 or the lowest, if that is below, to the highest
    """
    kept = np.asarray(values[-width:], float)
    lowest = min(0.0, float(kept.min()))
    spread = max(float(kept.max()) - lowest, 1e-9)
    return "".join(BARS[int((len(BARS) - 1) * (value - lowest) / spread)] for value in kept)


def _rows(path: Path) -> list[dict[str, Any]]:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return []
    whole = text[: text.rfind("\n") + 1]  # the last line may be half written
    return list(csv.DictReader(whole.splitlines()))


def _returns(run: Run) -> tuple[float, ...]:
    try:
        evaluations = run.evaluations
    except (FileNotFoundError, ValueError):  # half written
        evaluations = None
    return () if evaluations is None else tuple(float(np.mean(returns)) for returns in evaluations["results"])


def _seconds_left(logged: Sequence[tuple[int, float]], budget: int) -> float | None:
    recent = list(logged[-RECENT:])
    while len(recent) > 1 and recent[0][1] > recent[-1][1]:  # before a resume, which counts from 0 again
        recent.pop(0)
    if len(recent) < 2 or recent[-1][0] <= recent[0][0]:
        return None
    speed = (recent[-1][1] - recent[0][1]) / (recent[-1][0] - recent[0][0])
    return speed * max(0, budget - recent[-1][0])


def _in_total(progresses: Sequence[Progress]) -> str:
    done = sum(min(one.agent_steps, one.budget) for one in progresses)
    budget = sum(one.budget for one in progresses)
    ended = sum(one.status in ("finished", "unevaluated") for one in progresses)
    text = f"{ended} of {len(progresses)} runs ended, {done / max(1, budget):.0%} of all decisions made"
    speed = sum((one.budget - one.agent_steps) / one.seconds_left for one in progresses if one.seconds_left)
    failed = any(one.status == "failed" for one in progresses)
    return text if speed == 0 or failed else f"{text}, about {duration((budget - done) / speed)} left"


def duration(seconds: float) -> str:
    """:return: hours, minutes and seconds, as ``1:30:00``"""
    return str(timedelta(seconds=round(seconds)))
