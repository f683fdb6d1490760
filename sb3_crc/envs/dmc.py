"""dm_control suite tasks for Stable-Baselines3: byte pictures, channel first, one rendering per decision.

The chain, inside out: dm_control -> Shimmy -> SimulatorStep -> (RescaleAction) -> RepeatAction -> AddRenderObservation ->
:class:`PixelStack`. The picture is taken outside the repeat: rendering is by far the dearest part of a simulator step.

Dimensions: C channels, S picture side (pixels), k stacked frames, A action.
"""

from __future__ import annotations

import difflib
from collections import deque
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict, Space
from gymnasium.utils import RecordConstructorArgs

from sb3_crc.envs.distractions import DISTRACTIONS, MASKS, DistractionWrapper
from sb3_crc.envs.simulator import LARGE_PICTURE, Action, Observation, SimulatorStep, StepResult, load_simulator
from sb3_crc.envs.state import State, check_state
from sb3_crc.envs.tasks import default_action_repeat, default_camera, split_task

RENDER_QUALITIES = ("benchmark", "fast")
OBSERVATIONS = ("pixels", "state", "dict")
FRAME_CHANNELS = 3
IMAGE_KEY = "pixels"


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
    distraction: str | None = None,
    distraction_data: str | Path | None = None,
    distraction_mask: str = "chroma",
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
        after a reset; "state": float32 (n,), the task's own observations side by side in alphabetical order of their names;
        "dict": the stack under "pixels" and each of the task's own observations under its name, float32 (n,)
    :param render_mode: "rgb_array", or None if ``render()`` is not needed
    :param distraction: a test environment: "color_easy", "color_hard", "video_easy" or "video_hard" of DMControl-GB
        (arXiv 2011.13389), "dcs_easy", "dcs_medium" or "dcs_hard" of the Distracting Control Suite (arXiv 2101.02722), which
        move, or stand still with the suffix "_static".
        ``env.get_wrapper_attr("distraction_label")`` says what is shown; a warning, if nothing is (reacher's "video_easy")
    :param distraction_data: DMControl-GB's table of colours (.npz, .json, or a folder with ``<distraction>.npz``); for the
        others a folder of clips (.mp4, .npz, .npy), or one that has a folder ``<distraction>``. None: generated colours and
        clips, which are not the benchmark's
    :param distraction_mask: of the videos: "chroma" replaces what is green, as in the benchmark, "segmentation" what is
        background
    :return: the environment; it has the attributes ``action_repeat`` and, with pictures, ``frame_channels``; its whole state
        can be saved, see :meth:`DecisionEnv.get_state`
    :raises ValueError: for an unknown task or a value that is not allowed, with the nearest one that is; for data of a
        distraction that cannot be used, naming the file
    :raises FileNotFoundError: if these data are missing
    :raises ImportError: for an mp4 without the package ``av``, of the extra ``video``
    :raises RenderingUnavailable: if pixels are wanted and no OpenGL back end can draw
    """
    domain, subtask = split_task(task)
    task = f"{domain}-{subtask}"
    _check_choice("observation", observation, OBSERVATIONS)
    _check_choice("render_quality", render_quality, RENDER_QUALITIES)
    _check_choice("render_mode", render_mode, ("rgb_array", None))
    _check_distraction(distraction, distraction_data, distraction_mask, observation)
    action_repeat = default_action_repeat(task) if action_repeat is None else action_repeat
    camera_id = default_camera(task) if camera_id is None else camera_id
    for name, value in (("image_size", image_size), ("action_repeat", action_repeat), ("frame_stack", frame_stack)):
        _check_integer(name, value, lowest=1)

    has_pictures = observation != "state"
    simulator = load_simulator(domain, subtask, seed, needs_rendering=has_pictures or task == "quadruped-escape")
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
    data = None if distraction_data is None else str(distraction_data)
    distracted: DistractionWrapper | None = None
    if distraction is not None:
        env = distracted = DistractionWrapper(
            env,
            distraction,
            data,
            distraction_mask,
            task=task,
            image_size=int(image_size),
            camera_id=int(camera_id),
            action_repeat=int(action_repeat),
            seed=seed,
        )
    settings = {"task": task, "observation": observation, "action_repeat": int(action_repeat)}
    made: DecisionEnv
    if has_pictures:
        pictures = {"image_size": int(image_size), "frame_stack": int(frame_stack), "camera_id": int(camera_id)}
        settings |= {**pictures, "render_quality": render_quality}
        if distraction is not None:
            settings |= {"distraction": distraction, "distraction_data": data, "distraction_mask": distraction_mask}
        env = gym.wrappers.AddRenderObservation(env, render_only=observation == "pixels", render_key=IMAGE_KEY)
        stack = PixelStack if observation == "pixels" else DictStack
        made = stack(env, action_repeat, frame_stack, render_mode=render_mode, settings=settings)
    else:
        env.reset()  # as AddRenderObservation does: tasks measure their bodies at a reset, and set_state() needs none
        env = gym.wrappers.FlattenObservation(env)
        space = Box(-np.inf, np.inf, env.observation_space.shape, np.float32)
        env = gym.wrappers.TransformObservation(env, _single_precision, space)
        made = DecisionEnv(env, action_repeat, render_mode=render_mode, settings=settings)
    counter.await_reset(seed)
    if distracted is not None:
        distracted.await_reset(seed)
    if seed is not None:
        made.action_space.seed(seed)
    return made


class DecisionEnv(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """The outermost wrapper: one step is one decision; knows its own frame rate and draws large pictures.

    :param env: the environment, which already repeats actions
    :param action_repeat: simulator steps per decision
    :param render_mode: "rgb_array" or None
    :param settings: JSON scalars that a state must share to be accepted by :meth:`set_state`
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        action_repeat: int,
        *,
        render_mode: str | None = "rgb_array",
        settings: dict[str, Any] | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(self, action_repeat=action_repeat, render_mode=render_mode, settings=settings)
        super().__init__(env)
        self.action_repeat = action_repeat
        self._render_mode = render_mode
        self._settings = settings or {}
        self._is_distracted = self.env.has_wrapper_attr("distraction_label")
        # Shimmy writes a wrong rate into a dict shared by all its environments: the last one made would set everybody's.
        control_timestep = float(self.get_wrapper_attr("control_timestep")())  # seconds
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 1.0 / (control_timestep * action_repeat)}

    @property
    def render_mode(self) -> str | None:  # type: ignore[override]  # gymnasium's Env has it as an attribute
        """What ``render()`` returns: "rgb_array", or None for nothing."""
        return self._render_mode

    @property
    def settings(self) -> dict[str, Any]:
        """Arguments of :func:`make_dmc` that make another environment like this one, but for ``seed`` and ``render_mode``."""
        return dict(self._settings)

    def render(self) -> Any:
        """The current scene, uint8 (480, 480, 3) or larger, through the same camera and at the same quality.

        :return: the picture, height x width x RGB; None if ``render_mode`` is None
        """
        if self._render_mode is None:
            return None
        render_kwargs = dict(self.get_wrapper_attr("render_kwargs"))
        render_kwargs["height"] = max(render_kwargs["height"], LARGE_PICTURE)
        render_kwargs["width"] = max(render_kwargs["width"], LARGE_PICTURE)
        draw = self.get_wrapper_attr("draw_large") if self._is_distracted else self.get_wrapper_attr("physics").render
        # dm_control returns a view with a negative stride, which torch and video encoders refuse.
        return np.ascontiguousarray(draw(**render_kwargs))

    def get_state(self) -> State:
        """Everything on which the future of this environment depends, random numbers of later resets and actions included.

        Set into another environment of the same settings, whatever its seed and past, the state makes it continue exactly:
        observations, rewards, ends and infos are equal to the last bit, also after the next resets. Through a VecEnv:
        ``venv.env_method("get_state")``. Wrappers further out, such as SB3's Monitor, have a state of their own.

        :return: nested dictionaries of NumPy arrays, strings, booleans, numbers and None, for ``np.savez`` and JSON
        """
        state = {
            "settings": dict(self._settings),
            "simulator": self.get_wrapper_attr("get_simulator_state")(),
            "action_space": self.action_space.np_random.bit_generator.state,
        }
        if self._is_distracted:
            state["distraction"] = self.get_wrapper_attr("get_distraction_state")()
        return state

    def set_state(self, state: State) -> None:
        """Continue where :meth:`get_state` was called; no reset is needed.

        Under SB3's Monitor, which wants a ``reset()`` before the first ``step()``, call ``reset()`` first and this then.

        :param state: of an environment of the same settings; it is copied
        :raises ValueError: if the settings differ, naming both, or if the state is damaged; nothing is changed then
        """
        check_state(state, self.get_state())
        self._set_checked_state(state)

    def _set_checked_state(self, state: State) -> None:
        self.get_wrapper_attr("set_simulator_state")(state["simulator"])
        if self._is_distracted:
            self.get_wrapper_attr("set_distraction_state")(state["distraction"])
        self.action_space.np_random.bit_generator.state = state["action_space"]


class PixelStack(DecisionEnv):
    """Turn (S, S, 3) pictures into contiguous (3 k, S, S) stacks, newest frame last, repeating the first after a reset.

    :param env: an environment whose observations are uint8 (S, S, 3)
    :param action_repeat: simulator steps per decision
    :param frame_stack: number k of frames
    :param render_mode: "rgb_array" or None
    :param settings: JSON scalars that a state must share to be accepted by :meth:`set_state`
    """

    frame_channels = FRAME_CHANNELS

    def __init__(
        self,
        env: gym.Env[Any, Any],
        action_repeat: int,
        frame_stack: int = 3,
        *,
        render_mode: str | None = "rgb_array",
        settings: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(env, action_repeat, render_mode=render_mode, settings=settings)
        RecordConstructorArgs.__init__(
            self, action_repeat=action_repeat, frame_stack=frame_stack, render_mode=render_mode, settings=settings
        )
        picture_space = self._picture(env.observation_space)
        height, width, channels = picture_space.shape
        self._stack_space = Box(0, 255, (channels * frame_stack, height, width), np.uint8)
        self.observation_space = self._space()
        self._frame_stack = frame_stack
        self._frames: deque[np.ndarray] = deque(maxlen=frame_stack)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; all k frames of the stack are the first picture (as CURL and DrQ do; SB3's own stack is black)."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._frames.extend([_channel_first(self._picture(observation))] * self._frame_stack)
        return self._stacked(observation), info

    def step(self, action: Action) -> StepResult:
        """One decision: the rewards of its simulator steps summed, the picture after the last of them.

        :raises ResetNeeded: if the episode is over or none was started
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._frames.append(_channel_first(self._picture(observation)))
        return self._stacked(observation), float(reward), terminated, truncated, info

    def _picture(self, observation: Any) -> Any:
        return observation

    def _space(self) -> Space[Any]:
        return self._stack_space

    def _stacked(self, observation: Observation) -> Observation:
        # A new array every time: an observation that was handed out never changes.
        return np.concatenate(self._frames)  # (3 k, S, S)

    def get_state(self) -> State:
        """As :meth:`DecisionEnv.get_state`, with the stacked frames."""
        frames = np.concatenate(self._frames) if self._frames else np.zeros(self._stack_space.shape, np.uint8)
        return {**super().get_state(), "frames": frames, "has_frames": bool(self._frames)}

    def _set_checked_state(self, state: State) -> None:
        super()._set_checked_state(state)
        self._frames.clear()
        if state["has_frames"]:
            self._frames.extend(np.split(state["frames"].copy(), self._frame_stack))


class DictStack(PixelStack):
    """The stack of a :class:`PixelStack` under "pixels", beside the task's own observations as float32 (n,).

    :param env: an environment whose observations are a dictionary with uint8 (S, S, 3) under "pixels"; the other parameters
        are those of :class:`PixelStack`
    """

    image_key = IMAGE_KEY

    def _picture(self, observation: Any) -> Any:
        return observation[IMAGE_KEY]  # of an observation or of the space

    def _space(self) -> Space[Any]:
        assert isinstance(self.env.observation_space, Dict)
        own = {
            name: Box(-np.inf, np.inf, space.shape or (1,), np.float32)
            for name, space in self.env.observation_space.items()
            if name != IMAGE_KEY
        }
        return Dict({**own, IMAGE_KEY: self._stack_space})

    def _stacked(self, observation: Observation) -> Observation:
        own = {name: np.array(value, np.float32, ndmin=1) for name, value in observation.items() if name != IMAGE_KEY}
        return {**own, IMAGE_KEY: np.concatenate(self._frames)}


def _channel_first(picture: np.ndarray) -> np.ndarray:
    """Copy (S, S, 3), a view that the next picture overwrites, to contiguous (3, S, S)."""
    return np.array(picture.transpose(2, 0, 1), order="C")


def _single_precision(state: np.ndarray) -> np.ndarray:
    return state.astype(np.float32)


def _check_choice(name: str, value: object, allowed: tuple[object, ...]) -> None:
    if value in allowed:
        return
    message = f"{name}={value!r} is not known; it must be one of {', '.join(map(repr, allowed))}."
    if isinstance(value, str):
        nearest = difflib.get_close_matches(value, [known for known in allowed if isinstance(known, str)], n=1, cutoff=0.0)
        message += f" Did you mean {nearest[0]!r}?"
    raise ValueError(message)


def _check_distraction(distraction: str | None, data: str | Path | None, mask: str, observation: str) -> None:
    _check_choice("distraction", distraction, (None, *DISTRACTIONS))
    _check_choice("distraction_mask", mask, MASKS)
    if distraction is not None and observation == "state":
        raise ValueError(f"distraction={distraction!r} changes pictures, but observation='state' has none.")
    if distraction is None and data is not None:
        raise ValueError(f"distraction_data={str(data)!r} is for a distraction, but none is given.")


def _check_integer(name: str, value: object, *, lowest: int, highest: int | None = None, what: str = "") -> None:
    is_integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if is_integer and lowest <= value and (highest is None or value <= highest):  # type: ignore[operator]
        return
    bounds = f"an integer >= {lowest}" if highest is None else f"an integer from {lowest} to {highest}"
    raise ValueError(f"{name}={value!r} is not possible; it must be {bounds}{what}.")
