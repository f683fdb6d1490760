"""The wrapper that distracts: it changes the scene at each episode and each picture that is taken.

S side of the picture in pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from sb3_crc.envs.distractions.chroma import GREEN, green_mask
from sb3_crc.envs.distractions.clips import (
    PROCEDURAL_CLIPS,
    Clip,
    ProceduralClip,
    StoredClip,
    bilinear,
    find_clips,
    what_they_are,
)
from sb3_crc.envs.distractions.colours import Paint, Table, generated_table, read_table
from sb3_crc.envs.distractions.textures import GRID, SKYBOX, Scene

Render = Callable[..., np.ndarray]
State = dict[str, Any]


class Distraction(Protocol):
    """What differs from the environment of the training."""

    label: str

    def begin(self, scene: Scene) -> None:
        """An episode begins; its task has been initialised."""

    def advance(self) -> None:
        """A decision has been carried out."""

    def draw(self, render: Render, **settings: Any) -> np.ndarray:
        """:param render: of dm_control's Physics; :param settings: of it; :return: uint8 ``(height, width, 3)``"""

    def restart(self, seed: int | None) -> None:
        """Be as good as new, with this seed."""

    def get_state(self) -> State:
        """Arrays, strings and numbers on which what follows depends."""

    def set_state(self, state: State, scene: Scene) -> None:
        """:param state: of :meth:`get_state`; :param scene: to be changed accordingly"""


class Colours:
    """
    DMControl-GB's color_easy and color_hard: at each reset ``RandomState(seed).randint`` draws one of a table's entries.

    :param mode: which
    :param data: a table, see :func:`~sb3_crc.envs.distractions.colours.read_table`; None: the generated one
    """

    def __init__(self, mode: str, data: Path | None) -> None:
        self._table: Table
        self._table, what = (generated_table(mode), "generated") if data is None else read_table(data, mode)
        self.label = f"{mode} ({what})"
        self._paint: tuple[Scene, Paint] | None = None
        self._entry = -1
        self.restart(None)

    def restart(self, seed: int | None) -> None:
        """:param seed: of the draws"""
        self._rng = np.random.RandomState(seed)

    def begin(self, scene: Scene) -> None:
        """Draw colours; they stay for the episode."""
        self._entry = int(self._rng.randint(len(self._table["self_rgb"])))
        self._apply(scene)

    def advance(self) -> None:
        """Nothing moves."""

    def draw(self, render: Render, **settings: Any) -> np.ndarray:
        """:return: the picture as it is: the scene has the colours"""
        return render(**settings)

    def get_state(self) -> State:
        """:return: the entry, and where the draws stand"""
        return {"entry": self._entry, "random": self._rng.get_state(legacy=False)}

    def set_state(self, state: State, scene: Scene) -> None:
        """:param state: of :meth:`get_state`; :param scene: is painted"""
        self._rng.set_state(state["random"])
        self._entry = state["entry"]
        if self._entry >= 0:
            self._apply(scene)

    def _apply(self, scene: Scene) -> None:
        if self._paint is None or self._paint[0] is not scene:
            self._paint = scene, Paint(scene)
        self._paint[1].apply({name: values[self._entry] for name, values in self._table.items()})


class Video:
    """
    DMControl-GB's video_easy (behind the scene) and video_hard (in place of the floor too).

    The k-th episode shows clip k, counted from 1 and modulo their number, from its first frame, one frame per decision.

    :param mode: which
    :param data: folder of clips, or one that has a folder of the mode's name; None: procedural clips
    :param side: S
    :param mask: "chroma": sky (and floor) are painted green and what looks green is replaced, as in the benchmark;
        "segmentation": what MuJoCo says is background (or floor) is replaced, at the cost of a second, cheap rendering
    """

    def __init__(self, mode: str, data: Path | None, side: int, mask: str) -> None:
        self._replaced = (SKYBOX, GRID) if mode == "video_hard" else (SKYBOX,)
        self._side = side
        self._chroma = mask == "chroma"
        self._paths: list[Path] | None = None
        what = "procedural"
        self._count = PROCEDURAL_CLIPS[mode]
        if data is not None:
            self._paths = find_clips(data / mode if (data / mode).is_dir() else data)
            self._count = len(self._paths)
            what = what_they_are(self._paths) if mode == "video_easy" else f"{self._count} clips"
            for path in self._paths:  # now, so that a broken clip is not found out after hours
                StoredClip(path, side)
        self.label = f"{mode} ({what}{'' if self._chroma else ', segmentation'})"
        self._scene: Scene | None = None
        self._clip: Clip | None = None
        self.restart(None)

    def restart(self, seed: int | None) -> None:
        """Nothing is drawn by lot: ``seed`` changes nothing."""
        self._episode, self._frame = 0, 0

    def begin(self, scene: Scene) -> None:
        """The next clip, from its beginning."""
        self._episode += 1
        self._frame = 0
        self._show(scene)

    def advance(self) -> None:
        """The next frame, or the first one after the last."""
        self._frame += 1

    def draw(self, render: Render, **settings: Any) -> np.ndarray:
        """:return: the picture with the clip's frame behind it"""
        picture = np.array(render(**settings))
        if self._clip is None:
            return picture
        mask = green_mask(picture) if self._chroma else self._segmented(render, settings)
        background = bilinear(self._clip.frame(self._frame % len(self._clip)), picture.shape[0])
        np.copyto(picture, background, where=mask[..., None])
        return picture

    def get_state(self) -> State:
        """:return: where clips and frames stand"""
        return {"episode": self._episode, "frame": self._frame}

    def set_state(self, state: State, scene: Scene) -> None:
        """:param state: of :meth:`get_state`; :param scene: is painted"""
        self._episode, self._frame = state["episode"], state["frame"]
        if self._episode > 0:
            self._show(scene)

    def _show(self, scene: Scene) -> None:
        number = self._episode % self._count
        self._clip = ProceduralClip(number, self._side) if self._paths is None else StoredClip(self._paths[number], self._side)
        if self._scene is not scene:
            self._scene = scene
            for name in self._replaced if self._chroma else ():
                scene.texture(name)[...] = GREEN
                scene.upload(name)

    def _segmented(self, render: Render, settings: dict[str, Any]) -> np.ndarray:
        assert self._scene is not None
        flagless = {name: value for name, value in settings.items() if name != "render_flag_overrides"}
        geoms = render(**flagless, segmentation=True)[..., 0]
        mask = geoms == -1
        if GRID in self._replaced:
            floors = np.flatnonzero(self._scene.physics.model.geom_matid == self._scene.material(GRID))
            mask |= np.isin(geoms, floors)
        return np.asarray(mask)


class DistractionWrapper(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """
    Distract an environment of :func:`~sb3_crc.make_dmc`: outside the repeat of actions, inside the stack of frames.

    :param env: whose ``render`` takes the picture of an observation
    :param distraction: what differs
    :param task: for messages
    """

    def __init__(self, env: gym.Env[Any, Any], distraction: Distraction, task: str) -> None:
        RecordConstructorArgs.__init__(self, distraction=distraction, task=task)
        super().__init__(env)
        self._distraction = distraction
        self._task = task
        self._scene = Scene(self.get_wrapper_attr("physics"), task)

    @property
    def distraction_label(self) -> str:
        """What is shown, for instance "video_easy (procedural)"; only the benchmark's own data are called so."""
        return self._distraction.label

    def await_reset(self, seed: int | None) -> None:
        """Take the resets so far as not done. :param seed: of the next one, unless it brings its own"""
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
