"""dm_control suite tasks for Stable-Baselines3: byte pictures, channel first, one rendering per decision.

The chain, inside out: dm_control -> Shimmy -> :class:`SimulatorStep` -> (RescaleAction) -> RepeatAction ->
AddRenderObservation -> :class:`PixelStack`. The picture is taken outside the repeat: rendering is by far the dearest part of
a simulator step.

Dimensions: C channels, S picture side (pixels), k stacked frames, A action.
"""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs

from sb3_crc.envs.rendering import RenderingUnavailable, select_backend
from sb3_crc.envs.tasks import default_action_repeat, default_camera, split_task

RENDER_QUALITIES = ("benchmark", "fast")
OBSERVATIONS = ("pixels", "state")
FRAME_CHANNELS = 3
LARGE_PICTURE = 480  # side of render()'s picture in pixels: all that fits the suite's 640 x 480 off-screen buffer
UNLIMITED = 1e9  # dm_control writes +-1e10 for an actuator without limits

Observation = Any
Action = Any
StepResult = tuple[Observation, float, bool, bool, dict[str, Any]]


def make_dmc(
    task: str,
    *,
    seed: int | None = None,
    image_size: int = 100,
    action_repeat: int | None = None,
    frame_stack: int = 3,
    camera_id: int | None = None,
    render_quality: str = "benchmark",
    observation: str = "pixels",
    render_mode: str | None = "rgb_array",
) -> DecisionEnv:
    """Make a task of the dm_control suite as a Gymnasium environment whose step is one decision of the agent.

    A decision repeats its action for ``action_repeat`` simulator steps and sums their rewards. The suite's time limit (1000
    simulator steps for most tasks) truncates, a discount of 0 terminates. ``info["env_steps"]`` counts simulator steps since
    the environment was made (or made anew by ``reset(seed=...)``), ``info["episode_env_steps"]`` since the last reset, also
    where an episode ends inside a repeat.
    Actions are float32 in [-1, 1]^A, rescaled to the task's own bounds; the two LQR tasks have none and take the
    action as it is. LQR also draws its springs when it is made: only ``seed`` fixes those, not ``reset(seed=...)``.

    :param task: "domain-task" with the suite's spelling, for instance "cartpole-swingup", or a "dmc_pixels/...-v0" id
    :param seed: of the task's random initial states and of ``action_space``; the first ``reset()`` without a seed uses it, so
        that ``make_dmc(t, seed=s).reset()`` equals ``make_dmc(t).reset(seed=s)``
    :param image_size: side S of the square picture in pixels
    :param action_repeat: simulator steps per decision; None takes the literature's value (``tasks.ACTION_REPEATS``)
    :param frame_stack: number k of frames in an observation
    :param camera_id: index of the camera, -1 for MuJoCo's free camera; None takes the one of ``tasks.CAMERAS``
    :param render_quality: "benchmark" is dm_control's own picture, the one of all published results; "fast" draws without
        multisampling, shadows and reflections, 5 to 10 times cheaper in software OpenGL: for tests and search, not for
        results that are to be compared
    :param observation: "pixels": uint8 (3 k, S, S), channel first and contiguous, newest frame last, the first frame repeated
        after a reset; "state": float32 (n,), the task's own observations side by side in alphabetical order of their names
    :param render_mode: "rgb_array", or None if ``render()`` is not needed
    :return: the environment; it has the attributes ``action_repeat`` and, for pixels, ``frame_channels``
    :raises ValueError: for an unknown task or a value that is not allowed
    :raises RenderingUnavailable: if pixels are wanted and no OpenGL back end can draw
    """
    domain, subtask = split_task(task)
    task = f"{domain}-{subtask}"
    _check_choice("observation", observation, OBSERVATIONS)
    _check_choice("render_quality", render_quality, RENDER_QUALITIES)
    _check_choice("render_mode", render_mode, ("rgb_array", None))
    action_repeat = default_action_repeat(task) if action_repeat is None else action_repeat
    camera_id = default_camera(task) if camera_id is None else camera_id
    for name, value in (("image_size", image_size), ("action_repeat", action_repeat), ("frame_stack", frame_stack)):
        _check_integer(name, value, lowest=1)

    simulator = _load_simulator(domain, subtask, seed, needs_rendering=observation == "pixels" or task == "quadruped-escape")
    cameras = simulator.physics.model.ncam
    _check_integer("camera_id", camera_id, lowest=-1, highest=cameras - 1, what=f"; {task} has {cameras} cameras")

    # Only after the back end is chosen: Shimmy imports dm_control, which binds one OpenGL back end for good.
    from shimmy.dm_control_compatibility import DmControlCompatibilityV0

    render_kwargs: dict[str, Any] = {"height": image_size, "width": image_size, "camera_id": camera_id}
    if render_quality == "fast":
        render_kwargs["render_flag_overrides"] = {"shadow": False, "reflection": False}
    env: gym.Env[Any, Any] = DmControlCompatibilityV0(simulator, render_mode="rgb_array", render_kwargs=render_kwargs)
    counter = SimulatorStep(env, fast=render_quality == "fast", buffer_size=max(image_size, LARGE_PICTURE))
    env = counter
    if np.any(env.action_space.low != -1.0) or np.any(env.action_space.high != 1.0):  # type: ignore[attr-defined]
        env = gym.wrappers.RescaleAction(env, np.float32(-1.0), np.float32(1.0))
    env = gym.wrappers.RepeatAction(env, action_repeat)
    made: DecisionEnv
    if observation == "pixels":
        env = gym.wrappers.AddRenderObservation(env, render_only=True)
        made = PixelStack(env, action_repeat, frame_stack, render_mode=render_mode)
    else:
        env = gym.wrappers.FlattenObservation(env)
        space = Box(-np.inf, np.inf, env.observation_space.shape, np.float32)
        env = gym.wrappers.TransformObservation(env, _single_precision, space)
        made = DecisionEnv(env, action_repeat, render_mode=render_mode)
    # AddRenderObservation has already reset once to learn the picture's shape: the seed is for the user's first reset.
    counter.pending_seed = seed
    if seed is not None:
        made.action_space.seed(seed)
    return made


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

    def step(self, action: Action) -> StepResult:
        """Advance the simulation by one control step.

        :raises ResetNeeded: if the episode is over; dm_control would silently start another one and ignore the action
        """
        if self._episode_over:
            raise ResetNeeded("The episode is over: call reset() before the next step().")
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.env_steps += 1
        self.episode_env_steps += 1
        self._episode_over = terminated or truncated
        return observation, float(reward), terminated, truncated, self._with_counts(info)

    def _with_counts(self, info: dict[str, Any]) -> dict[str, Any]:
        info["env_steps"] = self.env_steps
        info["episode_env_steps"] = self.episode_env_steps
        return info


class DecisionEnv(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """The outermost wrapper: one step is one decision; knows its own frame rate and draws large pictures.

    :param env: the environment, which already repeats actions
    :param action_repeat: simulator steps per decision
    :param render_mode: "rgb_array" or None
    """

    def __init__(self, env: gym.Env[Any, Any], action_repeat: int, *, render_mode: str | None = "rgb_array") -> None:
        RecordConstructorArgs.__init__(self, action_repeat=action_repeat, render_mode=render_mode)
        super().__init__(env)
        self.action_repeat = action_repeat
        self._render_mode = render_mode
        # Shimmy writes a wrong rate into a dict shared by all its environments: the last one made would set everybody's.
        control_timestep = float(self.get_wrapper_attr("control_timestep")())  # seconds
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 1.0 / (control_timestep * action_repeat)}

    @property
    def render_mode(self) -> str | None:  # type: ignore[override]  # gymnasium's Env has it as an attribute
        """What ``render()`` returns: "rgb_array", or None for nothing."""
        return self._render_mode

    def render(self) -> Any:
        """The current scene, uint8 (480, 480, 3) or larger, through the same camera and at the same quality.

        :return: the picture, height x width x RGB; None if ``render_mode`` is None
        """
        if self._render_mode is None:
            return None
        render_kwargs = dict(self.get_wrapper_attr("render_kwargs"))
        render_kwargs["height"] = max(render_kwargs["height"], LARGE_PICTURE)
        render_kwargs["width"] = max(render_kwargs["width"], LARGE_PICTURE)
        # dm_control returns a view with a negative stride, which torch and video encoders refuse.
        return np.ascontiguousarray(self.get_wrapper_attr("physics").render(**render_kwargs))


class PixelStack(DecisionEnv):
    """Turn (S, S, 3) pictures into contiguous (3 k, S, S) stacks, newest frame last, repeating the first after a reset.

    :param env: an environment whose observations are uint8 (S, S, 3)
    :param action_repeat: simulator steps per decision
    :param frame_stack: number k of frames
    :param render_mode: "rgb_array" or None
    """

    frame_channels = FRAME_CHANNELS

    def __init__(
        self, env: gym.Env[Any, Any], action_repeat: int, frame_stack: int = 3, *, render_mode: str | None = "rgb_array"
    ) -> None:
        RecordConstructorArgs.__init__(self, action_repeat=action_repeat, frame_stack=frame_stack, render_mode=render_mode)
        super().__init__(env, action_repeat, render_mode=render_mode)
        assert env.observation_space.shape is not None
        height, width, channels = env.observation_space.shape
        self.observation_space = Box(0, 255, (channels * frame_stack, height, width), np.uint8)
        self._frame_stack = frame_stack
        self._frames: deque[np.ndarray] = deque(maxlen=frame_stack)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; all k frames of the stack are the first picture (as CURL and DrQ do; SB3's own stack is black)."""
        picture, info = self.env.reset(seed=seed, options=options)
        self._frames.extend([_channel_first(picture)] * self._frame_stack)
        return np.concatenate(self._frames), info

    def step(self, action: Action) -> StepResult:
        """One decision: the rewards of its simulator steps summed, the picture after the last of them.

        :raises ResetNeeded: if the episode is over or none was started
        """
        if not self._frames:
            raise ResetNeeded("Call reset() before the first step().")
        picture, reward, terminated, truncated, info = self.env.step(action)
        self._frames.append(_channel_first(picture))
        # A new array every time: an observation that was handed out never changes.
        return np.concatenate(self._frames), float(reward), terminated, truncated, info  # (3 k, S, S)


def _channel_first(picture: np.ndarray) -> np.ndarray:
    """Copy (S, S, 3), which dm_control returns upside down in memory, to contiguous (3, S, S)."""
    return np.ascontiguousarray(picture.transpose(2, 0, 1))


def _single_precision(state: np.ndarray) -> np.ndarray:
    return state.astype(np.float32)


def _load_simulator(domain: str, subtask: str, seed: int | None, *, needs_rendering: bool) -> Any:
    """Load the task, with a back end chosen before dm_control's first import binds one."""
    if needs_rendering:  # quadruped-escape uploads its terrain to OpenGL at every reset, pixels or not
        select_backend()
    else:  # states need no pictures, but pixels may follow in this process
        with suppress(RenderingUnavailable):
            select_backend()
    from dm_control import suite

    return suite.load(domain, subtask, task_kwargs={"random": seed})


def _check_choice(name: str, value: object, allowed: tuple[object, ...]) -> None:
    if value not in allowed:
        raise ValueError(f"{name}={value!r} is not known; it must be one of {', '.join(map(repr, allowed))}.")


def _check_integer(name: str, value: object, *, lowest: int, highest: int | None = None, what: str = "") -> None:
    is_integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if is_integer and lowest <= value and (highest is None or value <= highest):  # type: ignore[operator]
        return
    bounds = f"an integer >= {lowest}" if highest is None else f"an integer from {lowest} to {highest}"
    raise ValueError(f"{name}={value!r} is not possible; it must be {bounds}{what}.")
