"""Environments in processes that die, hang or raise."""

import multiprocessing
import os
import signal
import time
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.vec_env import SubprocVecEnv, VecFrameStack

from sb3_crc import CRCSAC, make_dmc, workers
from sb3_crc.checkpoints.callback import TrainingCheckpoint
from sb3_crc.envs.rendering import RenderingUnavailable
from sb3_crc.workers import WatchedSubprocVecEnv, WorkerError
from tests.checkpoints.runs import SETTINGS, STEPS, assert_equal, cartpole
from tests.conftest import POLICY_KWARGS, NoiseEnv


class Failing(NoiseEnv):
    """Its third step kills its process, hangs or raises, if there is no file that says it has done so."""

    def __init__(self, how: str, marker: Path | None = None):
        super().__init__(channels=3, length=5)
        self.how, self.marker = how, marker

    def step(self, action: np.ndarray) -> Any:
        if self.steps == 2 and self.how != "works" and not (self.marker and self.marker.exists()):
            if self.marker is not None:
                self.marker.touch()
            if self.how == "dies":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.how == "hangs":
                time.sleep(600)
            raise ZeroDivisionError("in the simulator")
        return super().step(action)


def environments(how: str, marker: Path | None = None, **own: Any) -> WatchedSubprocVecEnv:
    make = [partial(Failing, "works"), partial(Failing, how, marker)]
    return WatchedSubprocVecEnv(make, **{"timeout": 3.0, **own})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("dies", r"environment 1 \(process \d+\) was killed by signal 9, asked to 'step'"),
        ("hangs", r"environment 1 \(process \d+\) has not answered 'step' within 3 s: it hangs"),
        ("raises", r"environment 1 \(process \d+\) has ended with exit code 1, asked to 'step'"),
    ],
)
def test_an_environment_that_fails_is_named(how: str, message: str) -> None:
    env = environments(how)
    env.seed(0)
    env.reset()
    for _ in range(2):
        env.step(np.zeros((2, 2)))
    with pytest.raises(WorkerError, match=message) as error:
        env.step(np.zeros((2, 2)))
    assert error.value.index == 1
    if how == "dies":
        with pytest.raises(WorkerError, match="environment 1"):
            env.get_attr("steps")
    began = time.monotonic()
    env.close()
    assert time.monotonic() - began < 10 and not any(process.is_alive() for process in env.processes)


def make_failing(how: str) -> Failing:
    if how == "hangs":
        time.sleep(600)
    if how == "raises":
        raise ZeroDivisionError("in the constructor")
    return Failing("works")


HANGS = "hangs", r"environment {} \(process \d+\) has not been made within 5 s: it hangs"
RAISES = "raises", r"environment {} \(process \d+\) has ended with exit code 1, before it was made"


@pytest.mark.parametrize(
    ("how", "message", "index"), [(*RAISES, 0), (*RAISES, 1), pytest.param(*HANGS, 0, marks=pytest.mark.slow), (*HANGS, 1)]
)
def test_an_environment_that_cannot_be_made_is_named(
    how: str, message: str, index: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And no process is left, which would keep this one from ending."""
    monkeypatch.setattr(workers, "START", 5.0)
    monkeypatch.setattr(workers, "FAREWELL", 1.0)
    makers: list[Any] = [partial(make_failing, "works")] * 2
    makers[index] = partial(make_failing, how)
    with pytest.raises(WorkerError, match=message.format(index)) as error:
        WatchedSubprocVecEnv(makers, "fork", timeout=3.0)  # nothing is imported anew
    assert error.value.index == index
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("timeout", [0.0, -1.0, float("inf"), float("nan")])
def test_the_timeout_is_a_number_of_seconds(timeout: float) -> None:
    with pytest.raises(ValueError, match=f"timeout={timeout} must be a positive number of seconds"):
        environments("works", timeout=timeout)


def test_without_a_failure_it_is_sb3s() -> None:
    results = []
    for cls in (SubprocVecEnv, WatchedSubprocVecEnv):
        env = cls([partial(Failing, "works")] * 2)
        env.seed(7)
        observations = [env.reset()]
        for _ in range(7):
            observation, rewards, dones, infos = env.step(np.full((2, 2), 0.5))
            observations.append(observation)
        results.append((np.stack(observations), rewards, dones, [sorted(info) for info in infos], env.get_attr("steps")))
        env.close()
    for one, other in zip(*results, strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize("how", ["dies", "hangs", "raises"])
def test_a_failing_environment_is_replaced_and_its_episode_truncated(how: str, tmp_path: Path) -> None:
    env = environments(how, tmp_path / "failed", restart=True)
    env.seed(0)
    env.reset()
    seen = [env.step(np.zeros((2, 2))) for _ in range(4)]
    observations, rewards, dones, infos = seen[2]
    assert dones.tolist() == [False, True] and rewards[1] == 0 and env.restarts == 1
    assert infos[1]["TimeLimit.truncated"] and infos[1]["restarted"]
    assert np.array_equal(infos[1]["terminal_observation"], seen[1][0][1])
    assert not np.array_equal(observations[1], seen[1][0][1])
    assert env.get_attr("steps") == [4, 1]
    env.close()


def test_a_training_goes_on_with_a_replaced_environment(tmp_path: Path) -> None:
    env = VecFrameStack(environments("dies", tmp_path / "failed", restart=True), 3, channels_order="first")
    model = CRCSAC(
        "CnnPolicy", env, batch_size=8, buffer_size=100, learning_starts=20, policy_kwargs=POLICY_KWARGS, seed=0, n_steps=2
    )
    model.learn(60)
    env.close()
    assert model.num_timesteps == 60 and model._n_updates == 20


class FailsOnce(Monitor):  # type: ignore[type-arg]
    """A task at one of whose steps its process is killed, or its OpenGL context destroyed, once."""

    def __init__(self, how: str, marker: Path | None, seed: int):
        super().__init__(cartpole(seed))
        self.how, self.marker, self.count = how, marker, 0

    def step(self, action: Any) -> Any:
        self.count += 1
        if self.marker is not None and self.count == 33 and not self.marker.exists():
            self.marker.touch()
            if self.how == "dies":
                os.kill(os.getpid(), signal.SIGKILL)
            destroy_context(self)
        return super().step(action)


def destroy_context(env: Any) -> None:
    """What a reset of the driver does to it. It goes when another one is used."""
    from dm_control._render.pyopengl import egl_renderer
    from OpenGL import EGL

    context = env.get_wrapper_attr("physics").contexts.gl
    with context.make_current() as executor:
        executor.call(EGL.eglDestroyContext, egl_renderer.EGL_DISPLAY, context._context)
    cartpole(0).reset(seed=0)


@pytest.mark.skipif(os.environ.get("MUJOCO_GL", "egl") != "egl", reason="destroys a context of EGL")
def test_a_lost_context_is_named() -> None:
    env = cartpole(0)
    env.reset(seed=0)
    env.step(np.zeros(1, np.float32))
    destroy_context(env)
    with pytest.raises(RenderingUnavailable, match=r"OpenGL draws no more \(EGLError .*its context is lost"):
        env.step(np.zeros(1, np.float32))


def train(folder: Path, marker: Path | None, how: str = "dies") -> CRCSAC:
    env = WatchedSubprocVecEnv([partial(FailsOnce, how, marker, 0)], timeout=60)
    model = CRCSAC("CnnPolicy", env, seed=0, **SETTINGS)
    checkpoint = TrainingCheckpoint(folder, every=10)
    try:
        model.learn(STEPS, callback=checkpoint)
    finally:
        checkpoint.close()
        env.close()
    return model


@pytest.mark.slow
def test_a_training_whose_environment_failed_goes_on_to_the_same_end(tmp_path: Path) -> None:
    whole = train(tmp_path / "whole", None)
    for how in ("dies", "loses its context"):
        run, marker = tmp_path / how, tmp_path / f"{how} was here"
        with pytest.raises(WorkerError, match="environment 0"):
            train(run, marker, how)
        assert marker.exists() and sorted(path.name for path in run.glob("0*"))[-1] == "000000000030"
        assert_equal(train(run, marker), whole)


class Dying(gym.Wrapper[Any, Any, Any, Any]):
    """Kills its process at the 30th step, once."""

    def __init__(self, env: gym.Env[Any, Any], marker: Path):
        super().__init__(env)
        self.marker, self.count = marker, 0

    def step(self, action: Any) -> Any:
        self.count += 1
        if self.count == 30 and not self.marker.exists():
            self.marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().step(action)


def mortal(folder: Path, rank: int) -> gym.Env[Any, Any]:
    marker = folder / ("dead" if rank else "alive")
    if rank == 0:
        marker.touch()
    task = make_dmc("cartpole-swingup", seed=rank, image_size=36, render_quality="fast", action_repeat=50)
    return Monitor(Dying(task, marker), str(folder / str(rank)))


class Infos(BaseCallback):
    def __init__(self) -> None:
        super().__init__()
        self.env_steps: list[int] = []

    def _on_step(self) -> bool:
        self.env_steps += [info["env_steps"] for info in self.locals["infos"][1:] if "env_steps" in info]
        return True


def test_a_task_of_the_suite_is_replaced_and_its_records_go_on(tmp_path: Path) -> None:
    env = WatchedSubprocVecEnv([partial(mortal, tmp_path, rank) for rank in range(2)], restart=True)
    model = CRCSAC("CnnPolicy", env, seed=0, **{**SETTINGS, "buffer_size": 200})
    infos = Infos()
    model.learn(120, callback=infos)
    assert env.restarts == 1
    assert infos.env_steps == sorted(infos.env_steps) and len(infos.env_steps) == 59 and infos.env_steps[-1] == 59 * 50
    place = int(np.flatnonzero(model.replay_buffer.dones[:60, 1] > 0)[1])
    stored = model.replay_buffer.observations[place, 1], model.replay_buffer.next_observations[place, 1]
    assert place == 29 and np.array_equal(stored[0][3:], stored[1][:-3]) and np.array_equal(stored[1][-3:], stored[1][-6:-3])
    episodes = load_results(str(tmp_path))
    files = [(tmp_path / f"{rank}.monitor.csv").read_text().splitlines() for rank in range(2)]
    lengths = [[int(line.split(",")[1]) for line in lines[2:]] for lines in files]
    assert lengths == [[20, 20, 20], [20, 20]]  # the lost one has no line
    assert len(episodes) == 5 and (episodes["t"].diff().dropna() >= 0).all()
    env.close()
