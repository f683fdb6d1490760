"""What our wrappers cost beside the simulator itself, in the same process, step by step in turn."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sb3_crc.envs.dmc import make_dmc
from sb3_crc.envs.tasks import default_camera, split_task

SIZE = 100


def raw_simulator(task: str, render_quality: str) -> tuple[Any, dict[str, Any]]:
    """The suite's own environment with our quality, and the arguments of its ``physics.render``."""
    from dm_control import suite

    domain, subtask = split_task(task)
    simulator = suite.load(domain, subtask, task_kwargs={"random": 0})
    simulator.reset()
    arguments: dict[str, Any] = {"height": SIZE, "width": SIZE, "camera_id": default_camera(task)}
    buffer = simulator.physics.model.vis.global_
    buffer.offwidth, buffer.offheight = max(buffer.offwidth, 480), max(buffer.offheight, 480)
    if render_quality == "fast":
        simulator.physics.model.vis.quality.offsamples = 0
        simulator.physics.model.vis.quality.shadowsize = 0
        arguments["render_flag_overrides"] = {"shadow": False, "reflection": False}
    return simulator, arguments


def seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def in_turn(ours: Callable[[], object], raw: Callable[[], object], rounds: int) -> tuple[np.ndarray, np.ndarray]:
    """Seconds of each call of both; who comes first alternates, since the second finds warm caches."""
    for _ in range(5):
        ours(), raw()
    durations = np.empty((rounds, 2))
    for i in range(rounds):
        for which in (0, 1) if i % 2 else (1, 0):
            durations[i, which] = seconds((ours, raw)[which])
    return durations[:, 0], durations[:, 1]


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.parametrize("observation", ["state", "pixels", "dict"])
@pytest.mark.parametrize("task", ["cartpole-swingup", "cheetah-run", "quadruped-walk"])
def test_overhead_per_decision(task: str, observation: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A decision less its time in dm_control's own step and camera: what remains is Shimmy's, Gymnasium's and ours."""
    env = make_dmc(task, seed=0, image_size=SIZE, observation=observation, render_quality="fast")
    env.reset()

    from dm_control.mujoco.engine import Camera  # after a back end was chosen
    from dm_control.rl.control import Environment

    spent = 0.0

    def timed(call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            nonlocal spent
            start = time.perf_counter()
            result = call(*args, **kwargs)
            spent += time.perf_counter() - start
            return result

        return wrapper

    monkeypatch.setattr(Environment, "step", timed(Environment.step))
    monkeypatch.setattr(Camera, "render", timed(Camera.render))
    action = np.zeros(env.action_space.shape, np.float32)  # type: ignore[arg-type]
    overheads, simulations = [], []
    for _ in range(110):
        spent = 0.0
        total = seconds(lambda: env.step(action))
        overheads.append(1e3 * (total - spent))
        simulations.append(1e3 * spent)
    print(f"{task} {observation}: {np.median(overheads):.3f} ms overhead on {np.median(simulations):.3f} ms")
    assert np.median(simulations) > (0.5 if observation != "state" else 0.03)  # drawn, and on our watch
    assert 0 < np.median(overheads) <= 0.3
    env.close()


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.parametrize("render_quality", ["benchmark", "fast"])
@pytest.mark.parametrize("task", ["cartpole-swingup", "cheetah-run", "quadruped-walk"])
def test_pixels_run_at_the_speed_of_the_simulator(task: str, render_quality: str) -> None:
    env = make_dmc(task, seed=0, image_size=SIZE, render_quality=render_quality)
    env.reset()
    simulator, arguments = raw_simulator(task, render_quality)
    action = np.zeros(env.action_space.shape)  # type: ignore[arg-type]
    float32_action = action.astype(np.float32)

    def raw() -> None:
        for _ in range(env.action_repeat):
            simulator.step(action)
        simulator.physics.render(**arguments)

    ours, theirs = in_turn(lambda: env.step(float32_action), raw, rounds=110)
    speed = np.median(theirs) / np.median(ours)
    print(
        f"{task} {render_quality}: {100 * speed:.0f} % of raw physics plus render, {1e3 * np.median(ours):.2f} ms a decision"
    )
    assert speed >= 0.95
    env.close()
