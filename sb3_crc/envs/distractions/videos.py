"""DMControl-GB's videos: a clip in place of the sky, or of sky and floor.

Hansen & Wang 2021 (arXiv 2011.13389). S side of the picture in pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.envs.distractions.clips import Clip, ProceduralClip, StoredClip, bilinear, clips_of
from sb3_crc.envs.distractions.labels import what_they_are
from sb3_crc.envs.distractions.masks import GREEN, background_mask, green_mask
from sb3_crc.envs.distractions.textures import GRID, SKYBOX, Scene

#: How many clips are made if none are given: as many as the benchmark has
PROCEDURAL_CLIPS = {"video_easy": 10, "video_hard": 100}


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
        self._paths = None if data is None else clips_of(data, mode)
        self._count = PROCEDURAL_CLIPS[mode] if self._paths is None else len(self._paths)
        for path in self._paths or ():  # now, so that a broken clip is not found out after hours
            StoredClip(path, side)
        what = "procedural" if self._paths is None else what_they_are(self._paths, mode)
        self.label = f"{mode} ({what}{'' if self._chroma else ', segmentation'})"
        self._scene: Scene | None = None
        self._clip: Clip | None = None
        self._number, self._frame = 0, 0
        self.visible = True
        self.restart(None)

    def restart(self, seed: int | None) -> None:
        """Nothing is drawn by lot: whatever the seed, the next episode is the first."""
        self._episode = 0

    def begin(self, scene: Scene) -> None:
        """The next clip, from its beginning."""
        self._episode += 1  # before it is used: the first episode shows the second clip
        self._number, self._frame = self._episode % self._count, 0
        self._show(scene)

    def advance(self) -> None:
        """The next frame, or the first one after the last."""
        self._frame += 1

    def draw(self, render: Callable[..., np.ndarray], **settings: Any) -> np.ndarray:
        """:return: the picture with the clip's frame behind it"""
        picture = np.array(render(**settings))
        if self._clip is None:
            return picture
        mask = green_mask(picture) if self._chroma else self._segmented(render, settings)
        self.visible = bool(mask.any())
        background = bilinear(self._clip.frame(self._frame % len(self._clip)), picture.shape[0])
        np.copyto(picture, background, where=mask[..., None])
        return picture

    def get_state(self) -> dict[str, Any]:
        """:return: where clips and frames stand"""
        return {"label": self.label, "episode": self._episode, "clip": self._number, "frame": self._frame}

    def set_state(self, state: dict[str, Any], scene: Scene) -> None:
        """:param state: of :meth:`get_state`; :param scene: is painted"""
        self._episode, self._number, self._frame = state["episode"], state["clip"], state["frame"]
        self._show(scene)

    def _show(self, scene: Scene) -> None:
        number = self._number
        self._clip = ProceduralClip(number, self._side) if self._paths is None else StoredClip(self._paths[number], self._side)
        if self._scene is not scene:
            self._scene = scene
            for name in self._replaced if self._chroma else ():
                scene.texture(name)[...] = GREEN
                scene.upload(name)

    def _segmented(self, render: Callable[..., np.ndarray], settings: dict[str, Any]) -> np.ndarray:
        assert self._scene is not None
        flagless = {name: value for name, value in settings.items() if name != "render_flag_overrides"}
        floors = self._scene.geoms_of(GRID) if GRID in self._replaced else np.array([], int)
        return background_mask(render(**flagless, segmentation=True), floors)
