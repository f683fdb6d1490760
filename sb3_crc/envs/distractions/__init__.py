"""Distracted test environments: DMControl-GB's colours and videos, and the Distracting Control Suite."""

from __future__ import annotations

import warnings
from pathlib import Path

from sb3_crc.envs.distractions.control_suite import SCALES, ControlSuite
from sb3_crc.envs.distractions.wrapper import Colours, Distraction, DistractionWrapper, Video

STATIC = "_static"
DISTRACTIONS = ("color_easy", "color_hard", "video_easy", "video_hard", *SCALES, *(f"{mode}{STATIC}" for mode in SCALES))
"""Values of :func:`~sb3_crc.make_dmc`'s ``distraction``."""
MASKS = ("chroma", "segmentation")

__all__ = ["DISTRACTIONS", "MASKS", "DistractionWrapper", "make_distraction"]


def make_distraction(
    mode: str, data: str | Path | None, mask: str, *, domain: str, image_size: int, camera_id: int, action_repeat: int
) -> Distraction:
    """
    :param mode: of :data:`DISTRACTIONS`
    :param data: table of colours or folder of clips; None: generated ones
    :param mask: of :data:`MASKS`, for videos
    :param domain: of the suite
    :param image_size: side of the picture in pixels
    :param camera_id: of the picture
    :param action_repeat: simulator steps per decision
    :return: what differs
    :raises FileNotFoundError: if ``data`` is missing
    :raises ValueError: naming the file, if ``data`` is not what the mode needs
    """
    path = None if data is None else Path(data).expanduser()
    scale = mode.removesuffix(STATIC)
    if scale in SCALES:
        dynamic = scale == mode
        return ControlSuite(scale, path, domain=domain, camera_id=camera_id, action_repeat=action_repeat, dynamic=dynamic)
    if mode.startswith("color"):
        return Colours(mode, path)
    if mode == "video_easy" and domain == "reacher":
        warnings.warn("video_easy changes nothing of reacher: its camera looks straight down and sees no sky", stacklevel=3)
    return Video(mode, path, image_size, mask)
