"""Environments in processes of their own, which are watched: one that has died or hangs is named, and may be replaced."""

import atexit
import json
import math
import multiprocessing
import signal
import time
import weakref
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common import monitor
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import SubprocVecEnv
from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper, VecEnv, VecEnvStepReturn
from stable_baselines3.common.vec_env.subproc_vec_env import _stack_obs, _worker

#: Seconds in which an environment must answer
TIMEOUT = 300.0

#: Seconds that a new process has at least for its first answer, since it must import what it needs and make its environment
START = 120.0

#: Seconds after which somebody who waits looks again
PAUSE = 0.5

#: Seconds in which environments that are closed may end of themselves
FAREWELL = 5.0

#: Reach each process of a terminal or of a job. They are for the training, which answers them with the environments' states
SIGNALS = (signal.SIGINT, signal.SIGTERM)

Make = Callable[[], gym.Env[Any, Any]]


class WorkerError(RuntimeError):
    """
    The process of an environment has died, or does not answer.

    :param index: of the environment
    :param message: what has happened
    """

    def __init__(self, index: int, message: str):
        super().__init__(message)
        self.index = index


class WatchedSubprocVecEnv(SubprocVecEnv):
    """
    SB3's SubprocVecEnv, which would wait for ever for a process that hangs, names none that has died, and whose processes end
    with Ctrl-C before the training can save their states.

    :param env_fns: make the environments
    :param start_method: as in SB3
    :param timeout: seconds in which each must answer, or :data:`START` if that is more while it is made; those in which this
        process itself is stopped do not count
    :param restart: replace one that has died or hangs in a step by a new one: its episode ends there, truncated, with the last
        picture once more, and the next one begins by another seed; Monitor's file and ``info["env_steps"]`` go on. Otherwise,
        and outside of steps, a :class:`WorkerError` names it
    :raises ValueError: if ``timeout`` is not a positive number of seconds
    :raises WorkerError: for the first environment that cannot be made, or not in time; the processes of all are ended
    """

    def __init__(
        self,
        env_fns: list[Make],
        start_method: str | None = None,
        *,
        timeout: float = TIMEOUT,
        restart: bool = False,
    ):
        if not 0 < timeout < math.inf:
            raise ValueError(f"timeout={timeout} must be a positive number of seconds")
        self.timeout = timeout
        self.restart = restart
        #: How often one was replaced
        self.restarts = 0
        self.waiting = self.closed = False
        self._env_fns: list[Make] = [partial(_undisturbed, make) for make in env_fns]
        self._last: list[Any] = [None] * len(env_fns)
        #: ``info["env_steps"]`` of each, where there is such a thing
        self._env_steps: list[int | None] = [None] * len(env_fns)
        methods = multiprocessing.get_all_start_methods()
        self._start_method = start_method or ("forkserver" if "forkserver" in methods else "spawn")
        self.remotes: tuple[_WatchedPipe, ...] = ()
        self.processes: list[Any] = []
        # Before multiprocessing waits for processes that nobody has told to end
        self._at_exit = partial(_close, weakref.ref(self))
        atexit.register(self._at_exit)
        try:
            for index in range(len(env_fns)):
                remote, process = self._started(index, self._env_fns[index])
                self.remotes += (remote,)
                self.processes.append(process)
            self.remotes[0].send(("get_spaces", None))
            # Not SubprocVecEnv's constructor, which waits for ever for an environment whose own does not end
            VecEnv.__init__(self, len(env_fns), *self.remotes[0].recv())
        except BaseException:
            self.close()
            raise

    def step_async(self, actions: np.ndarray) -> None:
        """:param actions: ``(N, A)``"""
        for remote, action in zip(self.remotes, actions, strict=True):
            remote.send_if_alive(("step", action))
        self.waiting = True

    def step_wait(self) -> VecEnvStepReturn:
        """:raises WorkerError: for the first environment that does not answer, unless it is replaced"""
        results = []
        for index, remote in enumerate(self.remotes):
            try:
                results.append(remote.recv())
            except WorkerError:
                if not self.restart:
                    self.waiting = False
                    raise
                results.append(self._replaced(index))
        self.waiting = False
        observations, rewards, dones, infos, reset_infos = zip(*results, strict=True)
        self.reset_infos = list(reset_infos)
        self._last = list(observations)
        self._env_steps = [info.get("env_steps", before) for info, before in zip(infos, self._env_steps, strict=True)]
        stacked: Any = _stack_obs(observations, self.observation_space)
        return stacked, np.stack(rewards), np.stack(dones), list(infos)

    def reset(self) -> Any:
        """:return: the first observations of new episodes"""
        observations = super().reset()
        rows = range(self.num_envs)
        if isinstance(observations, dict):
            self._last = [{key: values[row] for key, values in observations.items()} for row in rows]
        else:
            self._last = [observations[row] for row in rows]
        return observations

    def close(self) -> None:
        """End all processes, also those that do not listen any more."""
        if self.closed:
            return
        if not self.waiting:
            for remote in self.remotes:
                remote.send_if_alive(("close", None))
        until = time.monotonic() + (0.0 if self.waiting else FAREWELL)
        for remote, process in zip(self.remotes, self.processes, strict=True):
            process.join(max(0.0, until - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()
            remote.close()
        self.closed = True
        atexit.unregister(self._at_exit)

    def _started(self, index: int, make: Make) -> "tuple[_WatchedPipe, Any]":
        """:return: the pipe to a new process that makes this environment, and the process"""
        context: Any = multiprocessing.get_context(self._start_method)
        remote, work_remote = context.Pipe()
        arguments = (work_remote, remote, CloudpickleWrapper(make))
        process = context.Process(target=_worker, args=arguments, daemon=True)
        process.start()
        work_remote.close()
        return _WatchedPipe(remote, process, index, self.timeout), process

    def _replaced(self, index: int) -> tuple[Any, float, bool, dict[str, Any], dict[str, Any]]:
        """:return: the end of the lost episode, as a worker tells of one"""
        self.restarts += 1
        self.processes[index].kill()
        self.processes[index].join()
        self.remotes[index].close()
        remote, self.processes[index] = self._started(index, partial(_continued, self._env_fns[index]))
        self.remotes = (*self.remotes[:index], remote, *self.remotes[index + 1 :])
        observation, reset_info = remote.ask("reset", (1_000_003 * self.restarts + index, None))
        if self._env_steps[index] is not None:
            remote.ask("env_method", ("set_wrapper_attr", ("env_steps", self._env_steps[index]), {}))
        channels = remote.ask("get_attr", "frame_channels") if remote.ask("has_attr", "frame_channels") else None
        last = _one_frame_on(self._last[index], self.observation_space, channels)
        info = {"TimeLimit.truncated": True, "terminal_observation": last, "restarted": True}
        return observation, 0.0, True, info, reset_info


def _undisturbed(make: Make) -> gym.Env[Any, Any]:
    """:return: the environment, in a process that signals do not end; it ends with the pipe to the training"""
    for signum in SIGNALS:
        signal.signal(signum, signal.SIG_IGN)
    return make()


def _continued(make: Make) -> gym.Env[Any, Any]:
    """:return: the environment in the place of a lost one, in a new process: Monitor goes on with its file"""

    class Appended(monitor.ResultsWriter):
        def __init__(self, *args: Any, **kwargs: Any):
            super().__init__(*args, **{**kwargs, "override_existing": False})

    monitor.ResultsWriter = Appended  # type: ignore[misc]
    env = make()
    if env.has_wrapper_attr("results_writer") and (writer := env.get_wrapper_attr("results_writer")) is not None:
        with Path(writer.file_handler.name).open(encoding="utf-8") as file, suppress(ValueError, KeyError):
            env.set_wrapper_attr("t_start", json.loads(file.readline()[1:])["t_start"])
    return env


def _one_frame_on(observation: Any, space: spaces.Space[Any], channels: int | None) -> Any:
    """:return: what the observation is if the newest of its frames, of so many channels, comes once more"""
    if isinstance(space, spaces.Dict):
        return {key: _one_frame_on(observation[key], one, channels) for key, one in space.items()}
    if channels is None or not is_image_space(space):
        return observation
    return np.concatenate([observation[channels:], observation[-channels:]])


def _close(reference: "weakref.ref[WatchedSubprocVecEnv]") -> None:
    env = reference()
    if env is not None:
        env.close()


class _WatchedPipe:
    """A pipe to a worker that knows whether somebody is at its other end."""

    def __init__(self, pipe: Any, process: Any, index: int, timeout: float):
        self._pipe = pipe
        self._process = process
        self._index = index
        self._timeout = timeout
        self._asked: Any = None
        #: Whether it has answered: before that it makes its environment, whatever it was asked
        self._is_made = False

    def send(self, message: Any) -> None:
        self._asked = message[0]
        try:
            self._pipe.send(message)
        except OSError:
            raise self._dead() from None

    def ask(self, command: str, data: Any) -> Any:
        self.send((command, data))
        return self.recv()

    def send_if_alive(self, message: Any) -> None:
        self._asked = message[0]
        with suppress(OSError):  # told of when its answer is awaited
            self._pipe.send(message)

    def recv(self) -> Any:
        timeout = self._timeout if self._is_made else max(self._timeout, START)
        try:
            for _ in range(math.ceil(timeout / PAUSE)):
                if self._pipe.poll(PAUSE):
                    answer = self._pipe.recv()
                    self._is_made = True
                    return answer
        except (EOFError, ConnectionError):
            raise self._dead() from None
        what = f"has not answered {self._asked!r}" if self._is_made else "has not been made"
        raise WorkerError(
            self._index,
            f"environment {self._index} (process {self._process.pid}) {what} within {timeout:g} s: it hangs",
        )

    def close(self) -> None:
        self._pipe.close()

    def _dead(self) -> WorkerError:
        self._process.join(1.0)
        code = self._process.exitcode
        how = f"was killed by signal {-code}" if code is not None and code < 0 else f"has ended with exit code {code}"
        when = f"asked to {self._asked!r}" if self._is_made else "before it was made"
        return WorkerError(
            self._index,
            f"environment {self._index} (process {self._process.pid}) {how}, {when}: what it said last stands above, in the "
            "error output",
        )
