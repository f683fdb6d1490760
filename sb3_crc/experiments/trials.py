"""A table of trials: what was set, what came of it, failed ones too."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.atomic import atomic_write
from sb3_crc.experiments.final import final_returns
from sb3_crc.experiments.runs import Run

#: Of the environment: settings are not chosen on the episodes of final scores (sb3_crc.experiments.final)
FIRST_SEED = 40_000
FIELDS = (
    "trial",
    "algo",
    "env",
    "seed",
    "environment_steps",
    "curve",
    "final_mean",
    "final_std",
    "final_returns",
    "minutes",
    "note",
    "settings",
)


def read_trial(run: Run) -> dict[str, Any]:
    """
    Read what a run has written, finished or not.

    :param run: whose folder is read
    :return: a row of the table: curve is "environment steps:mean return" of each evaluation, minutes are those of
        training and evaluations, settings are the hyper-parameters as JSON
    :raises FileNotFoundError: if it has no log of episodes
    :raises ValueError: if one of its files cannot be read, naming it
    """
    row = {"trial": str(run.folder), "algo": run.preset, "env": run.arguments["env"], "seed": run.seed}
    row["settings"] = json.dumps(run.settings, default=str)
    if (evaluations := run.evaluations) is not None:
        steps, returns = evaluations["timesteps"] * run.action_repeat, evaluations["results"].mean(axis=1)
        row["environment_steps"] = int(steps[-1])
        row["curve"] = " ".join(f"{step}:{value:.0f}" for step, value in zip(steps, returns, strict=True))
    episodes = (run.folder / "0.monitor.csv").read_text(encoding="utf-8").splitlines()[2:]
    if episodes:
        row["minutes"] = round(float(episodes[-1].split(",")[2]) / 60, 1)
    return row


def record_trials(runs: Sequence[Path], table: Path, *, episodes: int = 10, note: str = "") -> list[dict[str, Any]]:
    """
    Write runs into a table, each in the place of what it said before.

    :param runs: folders, ``<logs>/<algo>/<env>_<number>`` of rl_zoo3
    :param table: CSV file, made if it is missing
    :param episodes: fresh ones, from :data:`FIRST_SEED`, for the final policy of a run that has ended; 0: none
    :param note: written beside them
    :return: the new rows
    :raises FileNotFoundError: if a folder is no run
    :raises ValueError: if the file is another table, which stays as it is
    """
    old = _read_table(table)
    rows = []
    for run in map(Run, runs):
        row = read_trial(run) | {"note": note}
        if episodes > 0 and run.has_ended:
            returns = final_returns(run, episodes=episodes, seed=FIRST_SEED)
            row["final_mean"] = round(float(np.mean(returns)), 1)
            row["final_std"] = round(float(np.std(returns, ddof=1)), 1) if len(returns) > 1 else ""
            row["final_returns"] = " ".join(f"{value:.0f}" for value in returns)
        rows.append(row)
    names = {row["trial"] for row in rows}
    table.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(table) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, FIELDS)
        writer.writeheader()
        writer.writerows([*(row for row in old if row["trial"] not in names), *rows])
    return rows


def _read_table(table: Path) -> list[dict[str, Any]]:
    if not table.exists():
        return []
    with table.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        columns = tuple(reader.fieldnames or ())
        if set(columns) != set(FIELDS):
            raise ValueError(f"{table} is no table of trials: its columns are {', '.join(columns) or 'none'}")
        return list(reader)
