"""Which pixels of a picture a video replaces: those that look green, as DMControl-GB has it, or those that are background.

H, W height and width in pixels.
"""

from __future__ import annotations

import numpy as np

GREEN = (51, 204, 51)


def green_mask(picture: np.ndarray) -> np.ndarray:
    """
    The benchmark's test in whole numbers: hue of 100 to 185 degrees, saturation at least 80, value at least 70 of 255.

    It can differ from the benchmark's floats only where a colour lies exactly on a threshold. At 84 and 100 pixels it also
    takes cartpole's whole rail, whose edges multisampling has mixed with green: so does the benchmark.

    :param picture: uint8 ``(H, W, 3)``
    :return: bool ``(H, W)``
    """
    red, green, blue = (np.ascontiguousarray(picture[..., channel], np.int32) for channel in range(3))
    highest = np.maximum(np.maximum(red, green), blue)
    spread = highest - np.minimum(np.minimum(red, green), blue)
    mostly_green = (green == highest) & (3 * (blue - red) >= -spread)
    mostly_blue = (blue == highest) & (12 * (green - red) >= 11 * spread)
    mask: np.ndarray = (mostly_green | mostly_blue) & (255 * spread >= 80 * highest) & (highest >= 70) & (spread > 0)
    return mask


def background_mask(seen: np.ndarray, replaced_geoms: np.ndarray) -> np.ndarray:
    """
    :param seen: dm_control's segmentation, int32 ``(H, W, 2)``: number and type of the object, -1 for none
    :param replaced_geoms: numbers of the geoms that count as background, such as the floor
    :return: bool ``(H, W)``
    """
    import mujoco

    number, kind = seen[..., 0], seen[..., 1]
    # A site has the number of some geom
    mask: np.ndarray = (number == -1) | ((kind == mujoco.mjtObj.mjOBJ_GEOM) & np.isin(number, replaced_geoms))
    return mask
