"""A table of trials: what was set, what came of it, failed ones too."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import yaml
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_crc.crc_sac import CRCSAC

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

    :param run: ``<logs>/<algo>/<env>_<number>`` of rl_zoo3. Its YAML files are loaded as rl_zoo3 does, which makes such a
        folder as good as code: read only your own.
    :return: a row of the table: curve is "environment steps:mean return" of each evaluation, minutes are those of
        training and evaluations, settings are the hyper-parameters as JSON
    :raises FileNotFoundError: if the folder is no run
    """
    arguments, settings = _configuration(run)
    repeat = _make(arguments, settings).get_wrapper_attr("action_repeat")
    row = {"trial": str(run), "algo": arguments["algo"], "env": arguments["env"], "seed": arguments["seed"]}
    row["settings"] = json.dumps(settings, default=str)
    if (run / "evaluations.npz").exists():
        with np.load(run / "evaluations.npz") as evaluations:
            steps, returns = evaluations["timesteps"] * repeat, evaluations["results"].mean(axis=1)
        row["environment_steps"] = int(steps[-1])
        row["curve"] = " ".join(f"{step}:{value:.0f}" for step, value in zip(steps, returns, strict=True))
    episodes = (run / "0.monitor.csv").read_text().splitlines()[2:]
    if episodes:
        row["minutes"] = round(float(episodes[-1].split(",")[2]) / 60, 1)
    return row


def evaluate_run(run: Path, *, episodes: int = 10, seed: int = 10_000) -> list[float]:
    """
    Evaluate a run's final policy, its mean action, in the environment that it was trained in.

    :param run: as for :func:`read_trial`
    :param episodes: how many
    :param seed: of the first of them
    :return: their returns
    """
    env = Monitor(_make(*_configuration(run), seed=seed))
    model = CRCSAC.load(_final_model(run), device="cpu")
    returns, _ = evaluate_policy(model, env, n_eval_episodes=episodes, return_episode_rewards=True)
    assert isinstance(returns, list)
    return [float(value) for value in returns]


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
        if _final_model(run).exists() and episodes > 0:
            returns = evaluate_run(run, episodes=episodes)
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


def _configuration(run: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """:return: flags and hyper-parameters"""
    folder = _configuration_folder(run)
    arguments, settings = (yaml.load((folder / name).read_text(), yaml.UnsafeLoader) for name in ("args.yml", "config.yml"))
    return dict(arguments), dict(settings)


def _final_model(run: Path) -> Path:
    return run / f"{_configuration_folder(run).name}.zip"


def _configuration_folder(run: Path) -> Path:
    folder = next((path.parent for path in sorted(run.glob("*/args.yml"))), None)
    if folder is None:
        raise FileNotFoundError(f"{run} is no run of rl_zoo3: there is no */args.yml in it")
    return folder


def _make(arguments: dict[str, Any], settings: dict[str, Any], **kwargs: Any) -> gym.Env[Any, Any]:
    return gym.make(arguments["env"], **{**settings.get("env_kwargs", {}), **kwargs})
