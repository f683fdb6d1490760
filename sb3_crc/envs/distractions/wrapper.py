"""The wrapper that distracts: it changes the scene at each episode and each picture that is taken.

S side of the picture in pixels.
"""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from sb3_crc.envs.distractions.modes import State, make_distraction
from sb3_crc.envs.distractions.textures import Scene


class DistractionWrapper(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """
    Distract an environment of :func:`~sb3_crc.make_dmc`: outside the repeat of actions, inside the stack of frames.

    :param env: whose ``render`` takes the picture of an observation
    :param mode: of :data:`~sb3_crc.envs.distractions.modes.DISTRACTIONS`
    :param data: table of colours or folder of clips; None: generated ones
    :param mask: of :data:`~sb3_crc.envs.distractions.modes.MASKS`
    :param task: "domain-task"
    :param image_size: S
    :param camera_id: of the picture
    :param action_repeat: simulator steps per decision
    :param seed: of what is drawn
    :raises FileNotFoundError: if ``data`` is missing
    :raises ImportError: for an mp4 without the package ``av``
    :raises ValueError: naming the file, if ``data`` is not what the mode needs, or if the task cannot be distracted
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        mode: str,
        data: str | None = None,
        mask: str = "chroma",
        *,
        task: str,
        image_size: int,
        camera_id: int,
        action_repeat: int,
        seed: int | None = None,
    ) -> None:
        settings: dict[str, Any] = {"task": task, "image_size": image_size, "camera_id": camera_id}
        settings["action_repeat"] = action_repeat
        RecordConstructorArgs.__init__(self, mode=mode, data=data, mask=mask, seed=seed, **settings)
        super().__init__(env)
        self._mode, self._task = mode, task
        self._scene = Scene(self.get_wrapper_attr("physics"), task)
        self._distraction = make_distraction(mode, data, mask, **settings)
        self._distraction.restart(seed)

    @property
    def distraction_label(self) -> str:
        """What is shown, for instance "video_easy (procedural)"; only the benchmark's own data are called so."""
        return self._distraction.label

    def await_reset(self, seed: int | None) -> None:
        """
        Take the resets and pictures so far as those of the construction.

        :param seed: of the next reset, unless it brings its own
        """
        if not self._distraction.visible:
            what = f"{self._mode} changes nothing of {self._task}"
            warnings.warn(f"{what}: nothing that it replaces is in the first picture", stacklevel=3)
        self._distraction.restart(seed)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; with a seed the distraction starts anew too."""
        if seed is not None:
            self._distraction.restart(seed)
        observation, info = self.env.reset(seed=seed, options=options)
        self._distraction.begin(self._current_scene())
        return observation, info

    def step(self, action: Any) -> Any:
        """Carry out a decision and move what moves."""
        result = self.env.step(action)
        self._distraction.advance()
        return result

    def render(self) -> Any:
        """:return: the picture of an observation, uint8 ``(S, S, 3)``"""
        return self._distraction.draw(self.get_wrapper_attr("take_picture"))

    def draw_large(self, **settings: Any) -> np.ndarray:
        """:param settings: of dm_control's ``Physics.render``; :return: the scene, distracted, uint8 ``(height, width, 3)``"""
        return self._distraction.draw(self._scene.physics.render, **settings)

    def get_distraction_state(self) -> State:
        """:return: everything on which later pictures depend beside the simulator"""
        return self._distraction.get_state()

    def set_distraction_state(self, state: State) -> None:
        """:param state: of :meth:`get_distraction_state`"""
        self._distraction.set_state(state, self._current_scene())

    def _current_scene(self) -> Scene:
        physics = self.get_wrapper_attr("physics")
        if physics.model is not self._scene.model:  # a task may compile a new model
            self._scene = Scene(physics, self._task)
        return self._scene
