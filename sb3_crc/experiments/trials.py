"""A table of trials: what was set, what came of it, failed ones too."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.experiments.final import final_returns
from sb3_crc.experiments.runs import Run

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
)


def read_trial(run: Path) -> dict[str, Any]:
    """
    Read a run's folder, finished or not.

    :param run: ``<logs>/<algo>/<env>_<number>`` of rl_zoo3
    :return: a row of the table: curve is "environment steps:mean return" of each evaluation, minutes are those of
        training and evaluations, settings are the hyper-parameters as JSON
    :raises FileNotFoundError: if the folder is no run
    """
    described = Run(run)
    row = {"trial": str(run), "algo": described.preset, "env": described.arguments["env"], "seed": described.seed}
    row["settings"] = json.dumps(described.settings, default=str)
    if (run / "evaluations.npz").exists():
        with np.load(run / "evaluations.npz") as evaluations:
            steps, returns = evaluations["timesteps"] * described.action_repeat, evaluations["results"].mean(axis=1)
        row["environment_steps"] = int(steps[-1])
        row["curve"] = " ".join(f"{step}:{value:.0f}" for step, value in zip(steps, returns, strict=True))
    episodes = (run / "0.monitor.csv").read_text().splitlines()[2:]
    if episodes:
        row["minutes"] = round(float(episodes[-1].split(",")[2]) / 60, 1)
    return row


def record_trials(runs: Sequence[Path], table: Path, *, episodes: int = 10, note: str = "") -> list[dict[str, Any]]:
    """
    Write runs into a table, each in the place of what it said before.

    :param runs: folders as for :func:`read_trial`
    :param table: CSV file, made if it is missing
    :param episodes: fresh ones on which the final policy of a finished run is evaluated; 0: none
    :param note: written beside them
    :return: the new rows
    """
    rows = []
    for run in runs:
        row = read_trial(run) | {"note": note}
        if episodes > 0 and Run(run).model.exists():
            returns = final_returns(Run(run), episodes=episodes)
            row |= {"final_mean": round(float(np.mean(returns)), 1), "final_std": round(float(np.std(returns, ddof=1)), 1)}
            row["final_returns"] = " ".join(f"{value:.0f}" for value in returns)
        rows.append(row)
    old = list(csv.DictReader(table.open())) if table.exists() else []
    names = {row["trial"] for row in rows}
    table.parent.mkdir(parents=True, exist_ok=True)
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*FIELDS, "settings"])
        writer.writeheader()
        writer.writerows([*(row for row in old if row["trial"] not in names), *rows])
    return rows
