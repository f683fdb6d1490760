"""How a policy does where it was not trained: its returns in distracted variants of its environment."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_crc.analysis.policies import SavedPolicy
from sb3_crc.analysis.rollouts import FOLDER, make_environment
from sb3_crc.atomic import atomic_write
from sb3_crc.checkpoints.store import checksum
from sb3_crc.disk import outlived
from sb3_crc.envs.distractions import DISTRACTIONS
from sb3_crc.envs.dmc import make_dmc
from sb3_crc.evaluation import FIRST_SEED as FIRST_TRAINING_SEED
from sb3_crc.evaluation import SEED_STEP
from sb3_crc.experiments.final import EPISODES, FIRST_SEED
from sb3_crc.experiments.provenance import provenance
from sb3_crc.experiments.runs import read_json, write_json
from sb3_crc.settings import check_name

#: What the environment of the training is called beside its distracted variants
NONE = "none"
#: DMControl-GB's
MODES = ("color_easy", "color_hard", "video_easy", "video_hard")
RECORDS = "generalization.npz"


@dataclass(frozen=True)
class ModeReturns:
    """
    :param mode: a distraction, or "none"
    :param label: what was really shown, for instance "video_easy (procedural)"
    :param returns: undiscounted, one per episode
    """

    mode: str
    label: str
    returns: tuple[float, ...]


def generalize(
    policy: SavedPolicy,
    modes: Sequence[str] = (NONE, *MODES),
    *,
    data: Path | None = None,
    episodes: int = EPISODES,
    report: Callable[[str], None] = lambda line: None,
) -> list[ModeReturns]:
    """
    Evaluate a saved policy by its mean action, in each mode on the episodes of a run's final score
    (:func:`~sb3_crc.experiments.final.final_returns`).

    What was measured is kept in ``analysis/`` of the run's folder and not measured again as long as the model (by its sha256),
    the environment, the episodes and the label of what is shown stay the same.

    :param policy: which
    :param modes: distractions of :func:`~sb3_crc.make_dmc`; "none" is the environment that it was trained in
    :param data: tables of colours and clips, see ``distraction_data`` of :func:`~sb3_crc.make_dmc`
    :param episodes: of each mode
    :param report: is told each result
    :return: one result per mode
    :raises ValueError: for an unknown mode, or an environment that cannot be distracted
    """
    run = policy.run
    _check_modes(modes)
    if not run.is_of_suite:
        raise ValueError(f"{policy.file} was trained in {run.arguments['env']}; only dm_control tasks can be distracted")
    path = run.folder / FOLDER / f"{policy.file.stem}-generalization.json"
    about = {
        "model": checksum(policy.file),
        "env_kwargs": dict(run.env_kwargs),
        "episodes": episodes,
        "first_seed": FIRST_SEED,
    }
    known = read_json(path) if path.exists() else {}
    measured: dict[str, Any] = known.get("modes", {}) if {name: known.get(name) for name in about} == about else {}
    model, results = None, []
    for mode in modes:
        env = Monitor(make_environment(run, FIRST_SEED, **_distraction(mode, data)))
        try:
            label = _label(env, mode)
            if label not in measured:
                model = policy.load() if model is None else model
                returns, _ = evaluate_policy(model, env, n_eval_episodes=episodes, return_episode_rewards=True)
                measured[label] = {"mode": mode, "returns": np.asarray(returns, float).tolist()}
                _keep({**about, "modes": measured, "evaluated": provenance()}, path)
        finally:
            env.close()
        result = ModeReturns(mode, label, tuple(measured[label]["returns"]))
        report(f"{policy.name}, {label}: {np.mean(result.returns):.1f}")
        results.append(result)
    return results


class GeneralizationCallback(BaseCallback):
    """
    Evaluate the current policy in distracted variants of the training environment while it trains.

    Logs the mean return as ``generalization/<mode>`` and keeps all episodes in ``generalization.npz``: ``timesteps`` ``(K,)``
    in agent steps, and for each mode returns ``(K, episodes)``. The k-th evaluation has the seed that
    :class:`~sb3_crc.evaluation.QBiasEvalCallback` has then, in every mode. Videos start with their first clip each time.
    In a configuration of rl_zoo3::

        callback:
          - sb3_crc.analysis.generalization.GeneralizationCallback: {eval_every: 10000, modes: [video_easy, color_hard]}

    :param eval_every: environment steps (action repeats count) between two evaluations, rounded up to whole agent steps
    :param modes: distractions of :func:`~sb3_crc.make_dmc`; "none" is the training environment
    :param episodes: of each mode and evaluation
    :param data: see ``distraction_data`` of :func:`~sb3_crc.make_dmc`
    :param folder: of ``generalization.npz``; None: where the logger writes
    :param verbose: as in SB3
    :raises ValueError: for an unknown mode, and when training starts, for an environment that make_dmc did not make
    """

    def __init__(
        self,
        eval_every: int,
        modes: Sequence[str] = ("video_easy", "color_hard"),
        episodes: int = EPISODES,
        data: str | Path | None = None,
        folder: str | Path | None = None,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        if eval_every < 1 or episodes < 1:
            raise ValueError(f"eval_every={eval_every} and episodes={episodes} must be at least 1")
        _check_modes(modes)
        self.eval_every, self.modes, self.episodes = eval_every, tuple(modes), episodes
        self.data = None if data is None else Path(data)
        self.folder = None if folder is None else Path(folder)
        self.timesteps: list[int] = []
        self.returns: dict[str, list[list[float]]] = {mode: [] for mode in self.modes}
        self._envs: dict[str, VecEnv] = {}
        self._calls = eval_every

    def _on_training_start(self) -> None:
        settings = _settings(self.training_env)
        self._calls = math.ceil(self.eval_every / (int(settings["action_repeat"]) * self.training_env.num_envs))
        for mode in self.modes:  # made now, so that missing clips are not found out after hours
            self._envs[mode] = DummyVecEnv([partial(_monitored, {**settings, **_distraction(mode, self.data)})])

    def _on_step(self) -> bool:
        if self.n_calls % self._calls != 0:
            return True
        seed = FIRST_TRAINING_SEED + SEED_STEP * (self.n_calls // self._calls)
        self.timesteps.append(self.num_timesteps)
        for mode, env in self._envs.items():
            env.seed(seed)
            returns, _ = evaluate_policy(self.model, env, n_eval_episodes=self.episodes, return_episode_rewards=True)
            self.returns[mode].append(np.asarray(returns, float).tolist())
            self.logger.record(f"generalization/{mode}", float(np.mean(returns)))
        self._write()
        return True

    def _on_training_end(self) -> None:
        for env in self._envs.values():
            env.close()
        self._envs = {}

    def _write(self) -> None:
        folder = self.folder or (Path(self.logger.dir) if self.logger.dir else None)
        if folder is None:
            return
        with outlived(folder / RECORDS), atomic_write(folder / RECORDS) as unfinished, unfinished.open("wb") as file:
            arrays = {mode: np.array(returns) for mode, returns in self.returns.items()}
            np.savez(file, timesteps=np.array(self.timesteps), **arrays)  # type: ignore[arg-type]


def read_records(folder: Path) -> dict[str, np.ndarray]:
    """
    :param folder: of a run
    :return: what :class:`GeneralizationCallback` kept there, nothing if it was not used
    :raises ValueError: if the file cannot be read
    """
    path = folder / RECORDS
    if not path.exists():
        return {}
    try:
        with np.load(path) as file:
            return dict(file)
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error


def _monitored(settings: Mapping[str, Any]) -> gym.Env[Any, Any]:
    return Monitor(make_dmc(**settings))


def _check_modes(modes: Sequence[str]) -> None:
    for mode in modes:
        check_name("mode", mode, [NONE, *DISTRACTIONS])
    if not modes:
        raise ValueError("no mode is given: there is nothing to evaluate")


def _distraction(mode: str, data: Path | None) -> dict[str, Any]:
    return {} if mode == NONE else {"distraction": mode, "distraction_data": data}


def _label(env: gym.Env[Any, Any], mode: str) -> str:
    return NONE if mode == NONE else str(env.get_wrapper_attr("distraction_label"))


def _settings(env: Any) -> Mapping[str, Any]:
    try:
        return dict(env.get_attr("settings")[0])
    except AttributeError:
        raise ValueError(
            "GeneralizationCallback needs an environment made by make_dmc: only those can be distracted"
        ) from None


def _keep(content: dict[str, Any], path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    with atomic_write(path) as unfinished:
        write_json(content, unfinished)
