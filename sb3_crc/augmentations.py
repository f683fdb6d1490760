"""Augmentations of image batches: bytes in, bytes out.

B batch, C channels (of the whole frame stack), H, W height and width. One offset is drawn per sample and used for its whole
stack, from torch's global CPU generator, whatever the device; every offset is possible, both ends included.
"""

from collections.abc import Callable

import torch as th
from torch.nn import functional as F

ImageSize = int | tuple[int, int]


def random_crop(images: th.Tensor, size: ImageSize) -> th.Tensor:
    """
    Cut a window at a random place out of each sample (RAD, arXiv 2004.14990; CURL, arXiv 2004.04136).

    :param images: uint8 ``(B, C, H, W)``
    :param size: height and width of the window in pixels, or one number for both
    :return: uint8 ``(B, C, *size)``
    :raises ValueError: if the window is larger than the images
    """
    height, width = checked_size(images, size)
    batch, _, rows, columns = images.shape
    tops = th.randint(rows - height + 1, (batch,)).tolist()
    lefts = th.randint(columns - width + 1, (batch,)).tolist()
    # Slices copy whole rows: four times faster on CPU than one advanced index, and offsets on the host need no device sync
    corners = zip(images.unbind(), tops, lefts, strict=True)
    return th.stack([image[:, top : top + height, left : left + width] for image, top, left in corners])


def center_crop(images: th.Tensor, size: ImageSize) -> th.Tensor:
    """
    Cut the window in the middle out of each sample: what the encoder does to frames that are larger than its input.

    :param images: ``(B, C, H, W)``, any type
    :param size: height and width of the window in pixels, or one number for both
    :return: ``(B, C, *size)``, a view
    :raises ValueError: if the window is larger than the images
    """
    height, width = checked_size(images, size)
    top, left = (images.shape[2] - height) // 2, (images.shape[3] - width) // 2
    return images[:, :, top : top + height, left : left + width]


def random_shift(images: th.Tensor, pad: int = 4) -> th.Tensor:
    """
    Shift each sample by up to ``pad`` pixels along both axes, repeating its border pixels (DrQ, arXiv 2004.13649).

    :param images: uint8 ``(B, C, H, W)``
    :param pad: largest shift in pixels, at least 0
    :return: uint8 ``(B, C, H, W)``
    :raises ValueError: if ``pad`` is negative
    """
    if pad < 0:
        raise ValueError(f"random_shift: pad={pad} must be at least 0")
    height, width = images.shape[2:]
    return random_crop(F.pad(images, (pad, pad, pad, pad), mode="replicate"), (height, width))


def checked_size(images: th.Tensor, size: ImageSize) -> tuple[int, int]:
    """:return: ``size`` as height and width; :raises ValueError: if it is not within the images."""
    height, width = (size, size) if isinstance(size, int) else size
    if not (0 < height <= images.shape[2] and 0 < width <= images.shape[3]):
        raise ValueError(f"cannot crop to {height}x{width}: the images are {images.shape[2]}x{images.shape[3]}")
    return height, width


#: Name in ``CRCSAC(augmentation=...)`` -> function. A new augmentation is one function and one line here.
AUGMENTATIONS: dict[str, Callable[..., th.Tensor]] = {
    "random_crop": random_crop,
    "center_crop": center_crop,
    "random_shift": random_shift,
}
