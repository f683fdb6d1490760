"""What runs need: memory, disk and time, measured by a few seconds of each kind of run, in a process of its own.

``python -m sb3_crc.experiments.needs < spec.json`` measures one.
"""

import inspect
import io
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_crc.buffers import FrameReplayBuffer
from sb3_crc.crc_sac import CRCSAC
from sb3_crc.envs.dmc import make_dmc
from sb3_crc.experiments.engines.local import usable_cores
from sb3_crc.experiments.specs import ZOO_SETTINGS, RunSpec
from sb3_crc.memory import GIGABYTE, available_memory
from sb3_crc.presets import PRESETS
from sb3_crc.schedules import lr_schedule
from sb3_crc.stock import STOCK

#: Decisions before the first update, beside a batch; then seconds for which training is timed, and updates in them, at least
WARM_UP, SECONDS, UPDATES = 20, 3.0, 3
#: Environment steps in an episode of the suite
EPISODE = 1_000
#: Models that lie on the disk at the same time: two checkpoints and one that is being written, the best model and the last one
MODELS = 5
#: Logs of a run
LOGS = 5_000_000
#: Bytes that a run takes beside what is measured: rl_zoo3, logs, evaluations, checkpoints (0.36 and 0.43 GB in two runs of
#: laptop.yml)
AROUND = 450_000_000
#: Bytes of an environment's own process, with OpenGL in software
WORKER = 250_000_000

#: Share of the free memory that runs may take
USABLE = 0.9
#: Processes that draw on one GPU at the same time and are known to work
RENDERERS = 4


@dataclass(frozen=True)
class Needs:
    """
    Of one run.

    :param memory: bytes at the end, when the replay buffer is full
    :param gpu_memory: bytes on the GPU; 0 without one
    :param disk: bytes, checkpoints with their frames included
    :param seconds: until its score is there
    """

    memory: int
    gpu_memory: int
    disk: int
    seconds: float


def measure_needs(specs: Sequence[RunSpec], threads: int) -> tuple[dict[str, Needs], dict[str, str]]:
    """
    Train each kind of run for a few seconds. Runs are of one kind if they differ in their seed alone.

    :param specs: of runs
    :param threads: of torch
    :return: needs by the name of the run, those that cannot even begin are missing; and why, by their name
    """
    kinds: dict[str, Needs | str] = {}
    found, failed = {}, {}
    for spec in specs:
        kind = json.dumps({**asdict(spec), "seed": 0, "method": ""}, sort_keys=True)
        if kind not in kinds:
            kinds[kind] = _measure_apart(kind, threads)
        needs = kinds[kind]
        if isinstance(needs, Needs):
            found[spec.name] = needs
        else:
            failed[spec.name] = needs
    return found, failed


def most_at_once(
    needs: Sequence[Needs],
    *,
    cores: int | None = None,
    free: int | None = None,
    free_gpu: int | None = None,
    renderers: int | None = RENDERERS,
) -> int:
    """
    :param needs: of the runs that are to be done
    :param cores: None: those of this process
    :param free: bytes of memory; None: what is free now
    :param free_gpu: bytes on the GPU; None: what is free now
    :param renderers: how many processes may draw on the GPU; None: who has no place there draws elsewhere
    :return: how many of them may run at the same time, at least one: each has a core, its memory and, on a GPU, a renderer
    """
    limits = [usable_cores() if cores is None else cores]
    if largest := max((one.memory for one in needs), default=0):
        limits.append(int(USABLE * (available_memory() if free is None else free)) // largest)
    if on_gpu := max((one.gpu_memory for one in needs), default=0):
        there = int(th.cuda.mem_get_info()[0]) if free_gpu is None else free_gpu
        limits += [int(USABLE * there) // on_gpu, *([] if renderers is None else [renderers])]
    return max(1, min(limits))


def seconds_for_all(needs: Sequence[Needs], jobs: int) -> float:
    """
    :param needs: of runs, in their order
    :param jobs: how many at once; the next one begins when one ends
    """
    free_at = [0.0] * jobs
    for one in needs:
        free_at[free_at.index(min(free_at))] += one.seconds
    return max(free_at)


def check_disk(needs: Sequence[Needs], root: Path) -> None:
    """
    :param needs: of the runs that are to be done
    :param root: folder of the comparison, which need not exist yet
    :raises ValueError: if what they write will not fit
    """
    existing = nearest_existing(root)
    needed, free = sum(one.disk for one in needs), shutil.disk_usage(existing).free
    if needed > free:
        raise ValueError(
            f"the runs will write about {needed / GIGABYTE:.1f} GB, and {free / GIGABYTE:.1f} GB are free in {existing}: "
            "make room, or choose another --output"
        )


def nearest_existing(path: Path) -> Path:
    """:return: the path itself, or the nearest above it that exists"""
    return next(one for one in (path.absolute(), *path.absolute().parents) if one.exists())


def measure(spec: RunSpec) -> Needs:
    """:param spec: of a run, which is trained for a few seconds in this process; :return: what all of it will need"""
    model, env = _small(spec)
    timer = _Timer()
    model.learn(10**9, callback=timer)
    deciding = _seconds_of_a_decision(model, env)
    updating = max(0.0, timer.seconds_of_a_step - deciding) / timer.updates_of_a_step
    own = inspect.signature(type(model).__init__).parameters["learning_starts"].default
    random = int(spec.settings.get("learning_starts", own))
    decisions = random + (spec.env_steps // spec.eval_every + 1) * spec.eval_episodes * (EPISODE // spec.action_repeat)
    archive = io.BytesIO()
    model.save(archive)
    frames = _bytes_of_experience(spec, model)
    on_gpu = model.device.type == "cuda"
    around = AROUND + WORKER * (env.num_envs + 1)  # one more evaluates
    return Needs(
        memory=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
        + (around if on_gpu else around + frames),
        gpu_memory=int(th.cuda.max_memory_reserved()) + frames if on_gpu else 0,
        disk=frames + MODELS * archive.tell() + LOGS,
        seconds=decisions * deciding
        + int(spec.settings.get("initial_updates") or 0) * updating
        + (spec.agent_steps - random) * timer.seconds_of_a_step,
    )


class _Timer(BaseCallback):
    """Ends the training when enough of it has been timed; rollouts start where updates have ended."""

    def __init__(self) -> None:
        super().__init__()
        #: At starts of rollouts: when, after how many steps, after how many updates
        self.starts: list[tuple[float, int, int]] = []

    def _on_rollout_start(self) -> None:
        updates = int(self.model._n_updates)
        if updates > 0:
            self.starts.append((time.perf_counter(), self.model.num_timesteps, updates))

    def _on_step(self) -> bool:
        if len(self.starts) < 2:
            return True
        (first, _, before), (last, _, after) = self.starts[0], self.starts[-1]
        return last - first < SECONDS or after - before < UPDATES

    @property
    def seconds_of_a_step(self) -> float:
        (first, begun, _), (last, ended, _) = self.starts[0], self.starts[-1]
        return (last - first) / (ended - begun)

    @property
    def updates_of_a_step(self) -> float:
        (_, begun, before), (_, ended, after) = self.starts[0], self.starts[-1]
        return (after - before) / (ended - begun)


def _small(spec: RunSpec) -> tuple[SAC, VecEnv]:
    """:return: the model of a run with a buffer of a few transitions, and its environment"""
    settings = {name: value for name, value in spec.settings.items() if name not in ZOO_SETTINGS}
    enough = WARM_UP + int(settings.get("batch_size", PRESETS["crc"]["batch_size"]))
    settings |= {"learning_starts": enough, "buffer_size": 2 * enough, "seed": 0}
    if isinstance(settings.get("train_freq"), list):
        settings["train_freq"] = tuple(settings["train_freq"])
    env_kwargs = spec.settings.get("env_kwargs") or {}
    env = make_vec_env(lambda: make_dmc(spec.task, **env_kwargs), int(spec.settings.get("n_envs", 1)), seed=0)
    if spec.preset in PRESETS:
        return CRCSAC(settings.pop("policy"), env, **settings | {"initial_updates": 0}), env
    if isinstance(settings.get("learning_rate"), str):
        settings["learning_rate"] = lr_schedule(settings["learning_rate"])
    return STOCK[spec.preset](settings.pop("policy"), env, **settings), env


def _seconds_of_a_decision(model: SAC, env: VecEnv) -> float:
    observation: Any = env.reset()
    begun = time.perf_counter()
    for _ in range(WARM_UP):
        observation, *_ = env.step(model.predict(observation, deterministic=True)[0])
    return (time.perf_counter() - begun) / (WARM_UP * env.num_envs)


def _bytes_of_experience(spec: RunSpec, model: SAC) -> int:
    """:return: size of the replay buffer at the end of the run"""
    buffer = model.replay_buffer
    assert buffer is not None
    if isinstance(buffer, FrameReplayBuffer):
        size = buffer.full_bytes
    else:
        size = sum(value.nbytes for value in vars(buffer).values() if isinstance(value, np.ndarray))
    kept = min(spec.agent_steps, int(spec.settings.get("buffer_size", 1_000_000)))
    return round(size / (buffer.buffer_size * buffer.n_envs) * kept)


def _measure_apart(kind: str, threads: int) -> Needs | str:
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "MKL_NUM_THREADS": str(threads)}
    command = [sys.executable, "-m", "sb3_crc.experiments.needs"]
    done = subprocess.run(command, input=kind, capture_output=True, text=True, env=environment, check=False)
    if done.returncode == 0:
        return Needs(**json.loads(done.stdout.splitlines()[-1]))
    return (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]


if __name__ == "__main__":
    print(json.dumps(asdict(measure(RunSpec(**json.load(sys.stdin))))))
