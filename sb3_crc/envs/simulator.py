"""The simulator's side of a dm_control environment: loading, one control step, one picture, the whole state."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs

from sb3_crc.envs.rendering import (
    RenderingUnavailable,
    first_frame_watched,
    loss_of_context_named,
    mending_line,
    select_backend,
)
from sb3_crc.envs.state import State, read_task, write_task

LARGE_PICTURE = 480  # side of render()'s picture in pixels: all that fits the suite's 640 x 480 off-screen buffer
UNLIMITED = 1e9  # dm_control writes +-1e10 for an actuator without limits

Observation = Any
Action = Any
StepResult = tuple[Observation, float, bool, bool, dict[str, Any]]


def load_simulator(domain: str, subtask: str, seed: int | None, *, needs_rendering: bool) -> Any:
    """Load the task, with a back end chosen before dm_control's first import binds one.

    :param domain: of the suite
    :param subtask: of the domain
    :param seed: of the task's random numbers, or None
    :param needs_rendering: fail now if nothing can be drawn
    :return: ``dm_control.rl.control.Environment``
    :raises RenderingUnavailable: if pictures are needed and no OpenGL back end can draw
    """
    if needs_rendering:  # quadruped-escape uploads its terrain to OpenGL at every reset, pixels or not
        select_backend()
    else:  # states need no pictures, but pixels may follow in this process
        with suppress(RenderingUnavailable):
            select_backend()
    try:
        from dm_control import suite
    except (ImportError, AttributeError, RuntimeError) as error:
        raise RenderingUnavailable(
            f"MUJOCO_GL={os.environ.get('MUJOCO_GL')} asks for a back end that cannot be loaded: {error}\n"
            f"Unset MUJOCO_GL to try other back ends, or mend this one:\n{mending_line()}"
        ) from error

    return suite.load(domain, subtask, task_kwargs={"random": seed})


class SimulatorStep(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Count simulator steps, keep the renderer's settings, and take float32 actions.

    :param env: Shimmy's environment around a dm_control task
    :param fast: draw without multisampling and shadows
    :param buffer_size: side in pixels of the largest picture that will be drawn
    """

    def __init__(self, env: gym.Env[Any, Any], *, fast: bool = False, buffer_size: int = LARGE_PICTURE) -> None:
        RecordConstructorArgs.__init__(self, fast=fast, buffer_size=buffer_size)
        super().__init__(env)
        self.pending_seed: int | None = None
        self.env_steps = 0
        self.episode_env_steps = 0
        self._episode_over = True
        self._fast = fast
        self._buffer_size = buffer_size
        self._prepared_model: Any = None
        self._camera: Any = None
        self._prepare_renderer()
        space = env.action_space
        assert isinstance(space, Box)
        if np.any(np.abs(space.low) > UNLIMITED) or np.any(np.abs(space.high) > UNLIMITED):
            self.action_space = Box(-1.0, 1.0, space.shape, np.float32)
        else:
            self.action_space = Box(space.low.astype(np.float32), space.high.astype(np.float32), dtype=np.float32)

    def _prepare_renderer(self) -> None:
        """Write the quality into the model, where the OpenGL context reads it once, at the first picture."""
        model = self.get_wrapper_attr("physics").model
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, self._buffer_size)
        model.vis.global_.offheight = max(model.vis.global_.offheight, self._buffer_size)
        if self._fast:
            model.vis.quality.offsamples = 0
            model.vis.quality.shadowsize = 0
        self._prepared_model = model
        self._camera = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; without a seed of its own the first one uses ``pending_seed``.

        A seeded reset makes the environment as good as new, its counter included: Gymnasium's ``check_env`` requires that
        everything after it repeats exactly, ``info`` too.
        """
        if seed is not None:
            self.env_steps = 0
        seed = self.pending_seed if seed is None else seed
        self.pending_seed = None
        observation, info = self.env.reset(seed=seed, options=options)
        if self.get_wrapper_attr("physics").model is not self._prepared_model:  # a task may compile a new model
            self._prepare_renderer()
        self.episode_env_steps = 0
        self._episode_over = False
        return observation, self._with_counts(info)

    def await_reset(self, seed: int | None) -> None:
        """Take the resets so far as not done: the next one is the user's first.

        :param seed: of that reset, unless it brings its own
        """
        self.pending_seed = seed
        self._episode_over = True

    def step(self, action: Action) -> StepResult:
        """Advance the simulator by one control step.

        :raises ResetNeeded: if none was started or it is over; dm_control would silently start one and ignore the action
        """
        if self._episode_over:
            raise ResetNeeded("No episode is under way: call reset() before step().")
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.env_steps += 1
        self.episode_env_steps += 1
        self._episode_over = terminated or truncated
        return observation, float(reward), terminated, truncated, self._with_counts(info)

    def _with_counts(self, info: dict[str, Any]) -> dict[str, Any]:
        info["env_steps"] = self.env_steps
        info["episode_env_steps"] = self.episode_env_steps
        return info

    def render(self) -> Any:
        """The picture of an observation: uint8 (S, S, 3), upside down in memory, overwritten by the next one.

        ``Physics.render`` draws the same, but builds and frees a scene each time, which takes longer than drawing a fast one.
        """
        return self.take_picture()

    def take_picture(self, *, segmentation: bool = False) -> Any:
        """
        :param segmentation: not the picture but what is seen in it
        :return: as :meth:`render`; or int32 (S, S, 2), upside down in memory: id and type of the object, -1 for none
        :raises RenderingUnavailable: if the OpenGL context is lost
        """
        size_and_camera = dict(self.get_wrapper_attr("render_kwargs"))
        flags = size_and_camera.pop("render_flag_overrides", None)
        if self._camera is None:
            from dm_control.mujoco.engine import Camera

            self._camera = Camera(self.get_wrapper_attr("physics"), **size_and_camera)
            with first_frame_watched():  # a driver that hangs does so here
                self._camera.render(render_flag_overrides=flags)
        with loss_of_context_named():
            if segmentation:
                return self._camera.render(segmentation=True)
            return self._camera.render(render_flag_overrides=flags)

    def close(self) -> None:
        """Free the simulator and its OpenGL context."""
        self._camera = None
        super().close()

    def __getstate__(self) -> dict[str, Any]:
        """The camera's scene is native memory and cannot be pickled; the next picture makes a new one."""
        return {**vars(self), "_camera": None}

    def get_simulator_state(self) -> State:
        """Counters, seeds and everything that :func:`~sb3_crc.envs.state.read_task` returns."""
        return {
            "env_steps": self.env_steps,
            "episode_env_steps": self.episode_env_steps,
            "episode_over": bool(self._episode_over),
            "pending_seed": None if self.pending_seed is None else int(self.pending_seed),
            "np_random_seed": self.unwrapped._np_random_seed,
            "task": read_task(self.get_wrapper_attr("_env")),
        }

    def set_simulator_state(self, state: State) -> None:
        """Continue where :meth:`get_simulator_state` was called.

        :param state: checked with :func:`~sb3_crc.envs.state.check_state`
        """
        write_task(self.get_wrapper_attr("_env"), state["task"])
        self.env_steps = state["env_steps"]
        self.episode_env_steps = state["episode_env_steps"]
        self._episode_over = state["episode_over"]
        self.pending_seed = state["pending_seed"]
        self.unwrapped._np_random_seed = state["np_random_seed"]
