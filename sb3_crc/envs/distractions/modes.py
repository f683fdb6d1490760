"""The names of the distractions, and what each of them is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from sb3_crc.envs.distractions.colours import Colours
from sb3_crc.envs.distractions.control_suite import SCALES, ControlSuite
from sb3_crc.envs.distractions.textures import Scene
from sb3_crc.envs.distractions.videos import Video

STATIC = "_static"
DISTRACTIONS = ("color_easy", "color_hard", "video_easy", "video_hard", *SCALES, *(f"{mode}{STATIC}" for mode in SCALES))
"""Values of :func:`~sb3_crc.make_dmc`'s ``distraction``."""
MASKS = ("chroma", "segmentation")

Render = Callable[..., np.ndarray]
State = dict[str, Any]


class Distraction(Protocol):
    """What differs from the environment of the training."""

    label: str
    visible: bool
    """Whether the last picture differs."""

    def restart(self, seed: int | None) -> None:
        """From the next episode on, draw as if new and made with this seed; what is shown until then stays."""

    def begin(self, scene: Scene) -> None:
        """An episode begins; its task has been initialised."""

    def advance(self) -> None:
        """A decision has been carried out."""

    def draw(self, render: Render, **settings: Any) -> np.ndarray:
        """:param render: of dm_control's Physics; :param settings: of it; :return: uint8 ``(height, width, 3)``"""

    def get_state(self) -> State:
        """Arrays, strings and numbers on which what follows depends."""

    def set_state(self, state: State, scene: Scene) -> None:
        """:param state: of :meth:`get_state`; :param scene: to be changed accordingly"""


def make_distraction(
    mode: str,
    data: str | Path | None,
    mask: str,
    *,
    task: str,
    image_size: int,
    camera_id: int,
    action_repeat: int,
) -> Distraction:
    """
    :param mode: of :data:`DISTRACTIONS`
    :param data: table of colours or folder of clips; None: generated ones
    :param mask: of :data:`MASKS`, for videos
    :param task: "domain-task"
    :param image_size: side of the picture in pixels
    :param camera_id: of the picture
    :param action_repeat: simulator steps per decision
    :return: what differs
    :raises FileNotFoundError: if ``data`` is missing
    :raises ImportError: for an mp4 without the package ``av``
    :raises ValueError: naming the file, if ``data`` is not what the mode needs
    """
    path = None if data is None else Path(data).expanduser()
    domain, _, _ = task.partition("-")
    scale = mode.removesuffix(STATIC)
    if scale in SCALES:
        dynamic = scale == mode
        return ControlSuite(scale, path, domain=domain, camera_id=camera_id, action_repeat=action_repeat, dynamic=dynamic)
    if mode.startswith("color"):
        return Colours(mode, path)
    return Video(mode, path, image_size, mask)
