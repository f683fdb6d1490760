"""Files of the log and of Monitor go on where the checkpoint was."""

import csv
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_crc import CRCSAC, make_dmc
from sb3_crc.checkpoints.callback import TrainingCheckpoint
from tests.checkpoints.runs import SETTINGS, Stop, StoppedError, cartpole


def test_files_of_the_log_go_on_where_the_checkpoint_was(tmp_path: Path) -> None:
    """What a stopped run wrote after its last checkpoint is cut off; all but times equals the uninterrupted run's."""

    def run(folder: Path, seed: int, stop: int | None) -> None:
        folder.mkdir(exist_ok=True)
        env = Monitor(cartpole(seed).env, str(folder / "monitor.csv"))
        model = CRCSAC("CnnPolicy", env, seed=seed, **SETTINGS)
        model.set_logger(configure(str(folder), ["csv", "json"]))
        evaluation = EvalCallback(cartpole(seed + 1), log_path=str(folder), n_eval_episodes=1, eval_freq=20, verbose=0)
        checkpoint = TrainingCheckpoint(folder / "checkpoints", every=10)
        try:
            model.learn(80, callback=[evaluation, Stop(stop), checkpoint], log_interval=1)
        except StoppedError:
            checkpoint.close()
        model.logger.close()

    def timeless(folder: Path) -> tuple[Any, ...]:
        with (folder / "progress.csv").open() as file:
            progress = [
                {key: value for key, value in row.items() if not key.startswith("time/") or "total" in key}
                for row in csv.DictReader(file)
            ]
        lines = [json.loads(line) for line in (folder / "progress.json").read_text().splitlines()]
        monitor = [line.rsplit(",", 1) for line in (folder / "monitor.csv").read_text().splitlines()[1:]]
        times = [float(time) for _, time in monitor[1:]]
        assert times == sorted(times)
        with np.load(folder / "evaluations.npz") as data:
            evaluations = {name: data[name].tolist() for name in data.files if "seconds" not in name}
        return (
            progress,
            [line["rollout/ep_rew_mean"] for line in lines if "rollout/ep_rew_mean" in line],
            [r for r, _ in monitor],
            evaluations,
        )

    run(tmp_path / "whole", 0, None)
    for seed, stop in ((0, 38), (4, 55), (5, None)):
        run(tmp_path / "stopped", seed, stop)
    whole, stopped = timeless(tmp_path / "whole"), timeless(tmp_path / "stopped")
    assert len(whole[0]) == 8 and len(whole[2]) == 5 and len(whole[3]["timesteps"]) == 4
    assert stopped == whole


@pytest.mark.slow  # each process imports everything
def test_environments_in_other_processes_go_on_with_their_files(tmp_path: Path) -> None:
    def run(folder: Path, seed: int, stop: int | None) -> None:
        env = make_vec_env(
            partial(make_dmc, "cartpole-swingup", image_size=36, render_quality="fast", action_repeat=50),
            n_envs=2,
            seed=seed,
            monitor_dir=str(folder),
            vec_env_cls=SubprocVecEnv,
        )
        model = CRCSAC("CnnPolicy", env, seed=seed, **SETTINGS)
        checkpoint = TrainingCheckpoint(folder / "checkpoints", every=10, monitor_dir=folder)
        try:
            model.learn(100, callback=[Stop(stop), checkpoint])
        except StoppedError:
            checkpoint.close()
        env.close()

    def episodes(folder: Path) -> list[list[str]]:
        files = [(folder / f"{rank}.monitor.csv").read_text().splitlines() for rank in (0, 1)]
        times = [[float(line.rsplit(",", 1)[1]) for line in lines[2:]] for lines in files]
        assert all(own == sorted(own) for own in times)
        return [[line.rsplit(",", 1)[0] for line in lines[1:]] for lines in files]

    run(tmp_path / "whole", 0, None)
    for seed, stop in ((0, 54), (4, 86), (5, None)):  # 54: each has ended one episode, which a new file would not show
        run(tmp_path / "stopped", seed, stop)
    assert [len(lines) for lines in episodes(tmp_path / "whole")] == [3, 3]
    assert episodes(tmp_path / "stopped") == episodes(tmp_path / "whole")
