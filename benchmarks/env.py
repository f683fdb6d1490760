"""make_dmc beside dm_control itself, and beside the usual chain of wrappers, which draws every simulator step."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.report import Target, judged, spread
from sb3_crc.envs.dmc import make_dmc
from sb3_crc.envs.simulator import LARGE_PICTURE, load_simulator
from sb3_crc.envs.tasks import default_action_repeat, default_camera, split_task

OURS, RAW, NAIVE = "ours", "raw", "naive"
FRAME_STACK = 3
#: Turns that are not timed
WARM_UP = 5
#: Turns from one decision of the naive chain to its next: it is slow
NAIVE_EVERY = 5
TARGETS = [Target("% of raw", 95, at_least=True)]


@dataclass(frozen=True)
class Program:
    """
    One way to make a decision and the picture that follows it.

    :param reset: start an episode
    :param decide: takes the action, float32 ``(A,)`` in [-1, 1]; returns whether the episode is over
    :param close: free the simulator
    """

    reset: Callable[[], object]
    decide: Callable[[np.ndarray], bool]
    close: Callable[[], object]


def measure(
    tasks: Sequence[str],
    qualities: Sequence[str],
    *,
    repeats: int,
    image_size: int = 100,
    on_row: Callable[[int], object] = lambda done: None,
) -> list[dict[str, Any]]:
    """
    Raw is the limit: the simulator's steps and one picture by a camera that dm_control keeps. (Its ``physics.render`` makes a
    camera for every picture, which takes longer than drawing a fast one.)

    :param tasks: "domain-task"
    :param qualities: of :data:`~sb3_crc.envs.dmc.RENDER_QUALITIES`
    :param repeats: decisions of ours and of raw that are timed, in turn; the naive chain makes one in :data:`NAIVE_EVERY`
    :param image_size: side of the pictures in pixels
    :param on_row: told how many rows are done
    :return: a row per task and quality, with milliseconds per decision
    """
    rows: list[dict[str, Any]] = []
    for quality in qualities:
        for task in tasks:
            env = make_dmc(task, image_size=image_size, frame_stack=FRAME_STACK, render_quality=quality)
            programs = {
                OURS: of_gymnasium(env),
                RAW: raw(task, quality, image_size),
                NAIVE: of_gymnasium(naive(task, quality, image_size)),
            }
            seconds = in_turn(programs, make_actions(task, repeats + WARM_UP), repeats)
            for program in programs.values():
                program.close()
            rows.append(judged({"quality": quality, "task": task, **compare(seconds)}, TARGETS))
            on_row(len(rows))
    return rows


def compare(seconds: dict[str, dict[int, float]]) -> dict[str, float]:
    """:param seconds: name -> turn -> duration; :return: the figures of a row"""
    mine = seconds[OURS]
    ratios = {name: statistics.median(theirs / mine[turn] for turn, theirs in seconds[name].items()) for name in (RAW, NAIVE)}
    durations = spread(list(mine.values()))
    return {
        **durations,
        "decisions/s": 1e3 / durations["ms"],
        "raw ms": 1e3 * statistics.median(seconds[RAW].values()),
        "% of raw": 100 * ratios[RAW],
        "naive ms": 1e3 * statistics.median(seconds[NAIVE].values()),
        "x naive": ratios[NAIVE],
    }


def in_turn(programs: dict[str, Program], actions: np.ndarray, repeats: int) -> dict[str, dict[int, float]]:
    """
    Let each program decide, then each again; who comes first alternates, since the second finds warm caches.

    :param actions: of each turn, those before the first one at the end, ``(WARM_UP + repeats, A)``; the same for all programs
    :return: name -> turn -> seconds
    """
    seconds: dict[str, dict[int, float]] = {name: {} for name in programs}
    for program in programs.values():
        program.reset()
    for turn in range(-WARM_UP, repeats):
        names = [name for name in programs if name != NAIVE or turn % NAIVE_EVERY == 0]
        for name in names if turn % 2 else reversed(names):
            start = time.perf_counter()
            is_over = programs[name].decide(actions[turn])
            duration = time.perf_counter() - start
            if turn >= 0:
                seconds[name][turn] = duration
            if is_over:
                programs[name].reset()
    return seconds


def make_actions(task: str, number: int) -> np.ndarray:
    """:return: random ones in [-1, 1], float32 ``(number, A)``: a body that lies still is cheaper than one that moves"""
    specification = load_simulator(*split_task(task), 0, needs_rendering=True).action_spec()
    return np.random.default_rng(0).uniform(-1, 1, (number, *specification.shape)).astype(np.float32)


def of_gymnasium(env: gym.Env[Any, Any]) -> Program:
    """:return: its steps; every episode starts as the first one does"""

    def decide(action: np.ndarray) -> bool:
        _, _, terminated, truncated, _ = env.step(action)
        return terminated or truncated

    return Program(lambda: env.reset(seed=0), decide, env.close)


def raw(task: str, quality: str, image_size: int) -> Program:
    """:return: dm_control's own steps and picture"""
    from dm_control.mujoco.engine import Camera  # not before make_dmc has chosen a back end

    simulator, render_kwargs = _simulator(task, quality, image_size)
    flags = render_kwargs.pop("render_flag_overrides", None)
    camera = Camera(simulator.physics, **render_kwargs)
    action_repeat, bounds = default_action_repeat(task), simulator.action_spec()
    middle, half = (bounds.maximum + bounds.minimum) / 2, (bounds.maximum - bounds.minimum) / 2

    def decide(action: np.ndarray) -> bool:
        own_action = middle + half * action
        for _ in range(action_repeat):
            time_step = simulator.step(own_action)
        camera.render(render_flag_overrides=flags)
        return bool(time_step.last())

    return Program(simulator.reset, decide, simulator.physics.free)


def naive(task: str, quality: str, image_size: int) -> gym.Env[Any, Any]:
    """:return: the same environment by the usual wrappers in their usual order: pixels come first, hence inside the repeat"""
    from shimmy.dm_control_compatibility import DmControlCompatibilityV0

    simulator, render_kwargs = _simulator(task, quality, image_size)
    env: gym.Env[Any, Any] = DmControlCompatibilityV0(simulator, render_mode="rgb_array", render_kwargs=render_kwargs)
    env = gym.wrappers.RescaleAction(env, np.float64(-1), np.float64(1))
    env = gym.wrappers.AddRenderObservation(env, render_only=True)  # at its final size: there is nothing to resize
    env = gym.wrappers.RepeatAction(env, default_action_repeat(task))
    env = gym.wrappers.FrameStackObservation(env, FRAME_STACK)  # (k, S, S, 3)
    space = gym.spaces.Box(0, 255, (3 * FRAME_STACK, image_size, image_size), np.uint8)
    return gym.wrappers.TransformObservation(env, _channel_first, space)


def _simulator(task: str, quality: str, image_size: int) -> tuple[Any, dict[str, Any]]:
    """:return: the suite's own environment, and the arguments of its ``physics.render``, as make_dmc sets both"""
    simulator = load_simulator(*split_task(task), 0, needs_rendering=True)
    render_kwargs: dict[str, Any] = {"height": image_size, "width": image_size, "camera_id": default_camera(task)}
    visual = simulator.physics.model.vis
    visual.global_.offwidth = max(visual.global_.offwidth, LARGE_PICTURE)
    visual.global_.offheight = max(visual.global_.offheight, LARGE_PICTURE)
    if quality == "fast":
        visual.quality.offsamples = visual.quality.shadowsize = 0
        render_kwargs["render_flag_overrides"] = {"shadow": False, "reflection": False}
    return simulator, render_kwargs


def _channel_first(pictures: np.ndarray) -> np.ndarray:
    stack = pictures.transpose(0, 3, 1, 2)  # (k, 3, S, S)
    return stack.reshape(-1, *stack.shape[2:])
