"""
A short training of real tasks, run as a program that may be killed at any moment: ``python -m tests.torture.training``.

Each agent step is told on the standard output; the last line is everything that the training has come to, but times.
"""

import argparse
import csv
import errno
import hashlib
import json
import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure

from sb3_crc import CRCSAC, TrainingCheckpoint, make_dmc
from sb3_crc.checkpoints import store, tree
from tests.conftest import POLICY_KWARGS

STEPS, EVERY, BUFFER_SIZE = 600, 20, 150
#: What the writer calls, each once or several times for each checkpoint
WRITER = {
    "frames": (np.lib.format, "write_array"),
    "arrays": (tree, "_write_arrays"),
    "index": (np, "savez"),
    "checksum": (store, "checksum"),
    "sync": (os, "fsync"),
    "rename": (os, "replace"),
    "prune": (store.CheckpointStore, "_prune"),
}


class Tell(BaseCallback):
    """Prints every agent step."""

    def _on_step(self) -> bool:
        print(self.num_timesteps, flush=True)
        return True


def fail(what: str, call: int, death: str) -> None:
    """
    Let the writer die in one of its calls.

    :param what: of :data:`WRITER`
    :param call: 1: the first one of this process
    :param death: "before" or "after": a SIGKILL around the call; "full": the disk is
    """
    owner, name = WRITER[what]
    original: Callable[..., Any] = getattr(owner, name)
    calls = 0

    def failing(*args: Any, **kwargs: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == call and death == "full":
            raise OSError(errno.ENOSPC, "No space left on device")
        if calls == call and death == "before":
            os.kill(os.getpid(), signal.SIGKILL)
        result = original(*args, **kwargs)
        if calls == call:
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    setattr(owner, name, failing)


def train(folder: Path, task: str, n_envs: int) -> dict[str, Any]:
    """:return: everything that the training has come to, but times"""
    make = partial(make_dmc, task, image_size=36, render_quality="fast", action_repeat=50)  # episodes of 20 steps
    env = make_vec_env(make, n_envs=n_envs, seed=0, monitor_dir=str(folder))
    evaluation_env = make_vec_env(make, seed=100)
    model = CRCSAC(
        "CnnPolicy",
        env,
        batch_size=8,
        buffer_size=BUFFER_SIZE,
        learning_starts=20,
        policy_kwargs=POLICY_KWARGS,
        seed=0,
        device="cpu",
    )
    model.set_logger(configure(str(folder), ["csv"]))
    evaluation = EvalCallback(evaluation_env, log_path=str(folder), n_eval_episodes=1, eval_freq=60 // n_envs, verbose=0)
    checkpoint = TrainingCheckpoint(folder / "checkpoints", every=EVERY)
    model.learn(STEPS, callback=[evaluation, Tell(), checkpoint], log_interval=1)
    model.logger.close()
    return {
        "weights": _digest(value.numpy() for value in model.policy.state_dict().values()),
        "buffer": _digest(model.replay_buffer.arrays().values()),
        "frames": _digest([model.replay_buffer.store.read(model.replay_buffer.store.first, model.replay_buffer.store.end)]),
        "updates": model._n_updates,
        "episodes": [_lines(folder / f"{rank}.monitor.csv") for rank in range(n_envs)],
        "progress": _progress(folder / "progress.csv"),
        "evaluations": [[float(r) for r in results] for results in evaluation.evaluations_results],
    }


def _digest(arrays: Any) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _lines(path: Path) -> list[str]:
    return [line.rsplit(",", 1)[0] for line in path.read_text(encoding="utf-8").splitlines()[1:]]


def _progress(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return [
            {key: value for key, value in row.items() if not key.startswith("time/") or "total" in key}
            for row in csv.DictReader(file)
        ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("task")
    parser.add_argument("n_envs", type=int)
    parser.add_argument("--fail", nargs=3, metavar=("WHAT", "CALL", "DEATH"))
    flags = parser.parse_args()
    th.set_num_threads(1)
    if flags.fail:
        what, call, death = flags.fail
        fail(what, int(call), death)
    print(json.dumps(train(flags.folder, flags.task, flags.n_envs)), flush=True)
