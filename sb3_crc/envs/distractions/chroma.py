"""DMControl-GB's chroma key: which pixels of a picture are green enough to be replaced.

H, W height and width in pixels.
"""

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
