"""Augmentations of image batches: bytes in, bytes out.

B batch, C channels (of the whole frame stack), H, W height and width. One offset is drawn per sample and used for its whole
stack, from torch's global CPU generator, whatever the device; every offset is possible, both ends included.

Crops also take images that still lie in a replay buffer (:class:`StoredImages`) and copy no more than the windows.
"""

import inspect
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch as th
from torch.nn import functional as F

from sb3_crc.settings import check_name, described, height_and_width
from sb3_crc.transfers import to_device

ImageSize = int | tuple[int, int]
#: Of a picture that is read from a file
MOST_PIXELS = 1 << 26
#: Share of red, green and blue in gray (ITU-R BT.601)
LUMINANCE = (0.299, 0.587, 0.114)


class StoredImages(Protocol):
    """Images ``(B, C, H, W)``, to be copied as a whole or window by window (:class:`~sb3_crc.buffers.store.FrameStacks`)."""

    @property
    def shape(self) -> tuple[int, ...]:
        """``(B, C, H, W)``"""

    def whole(self) -> th.Tensor:
        """:return: the images"""

    def windows(self, tops: th.Tensor, lefts: th.Tensor, size: tuple[int, int]) -> th.Tensor:
        """:param tops: ``(B,)``; :param lefts: ``(B,)``; :param size: height and width; :return: ``(B, C, *size)``"""


Images = th.Tensor | StoredImages


def random_crop(images: Images, size: ImageSize, *, last_offset: bool = True) -> th.Tensor:
    """
    Cut a window at a random place out of each sample (RAD, arXiv 2004.14990; CURL, arXiv 2004.04136).

    :param images: uint8 ``(B, C, H, W)``
    :param size: height and width of the window in pixels, or one number for both
    :param last_offset: False: the window never touches the lower and right border (the released code of CRC-RL)
    :return: uint8 ``(B, C, *size)``
    :raises ValueError: if the window is larger than the images
    """
    height, width = checked_size(images, size)
    batch, _, rows, columns = images.shape
    tops = th.randint(max(1, rows - height + last_offset), (batch,))
    lefts = th.randint(max(1, columns - width + last_offset), (batch,))
    if not isinstance(images, th.Tensor):
        return images.windows(tops, lefts, (height, width))
    if _on_gpu(images):
        return gather_pixels(images, tops[:, None] + th.arange(height), lefts[:, None] + th.arange(width))
    # Slices copy whole rows: four times faster on a CPU than one advanced index
    corners = zip(images.unbind(), tops.tolist(), lefts.tolist(), strict=True)
    return th.stack([image[:, top : top + height, left : left + width] for image, top, left in corners])


def center_crop(images: Images, size: ImageSize) -> th.Tensor:
    """
    Cut the window in the middle out of each sample: what the encoder does to frames that are larger than its input.

    :param images: ``(B, C, H, W)``, any type
    :param size: height and width of the window in pixels, or one number for both
    :return: ``(B, C, *size)``, of a tensor a view
    :raises ValueError: if the window is larger than the images
    """
    height, width = checked_size(images, size)
    top, left = (images.shape[2] - height) // 2, (images.shape[3] - width) // 2
    if not isinstance(images, th.Tensor):
        batch = images.shape[0]
        return images.windows(th.full((batch,), top), th.full((batch,), left), (height, width))
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
    batch, _, height, width = images.shape
    if not _on_gpu(images):
        return random_crop(F.pad(images, (pad, pad, pad, pad), mode="replicate"), (height, width))
    tops, lefts = (th.randint(2 * pad + 1, (batch, 1)) for _ in range(2))
    rows, columns = (th.arange(side) - pad for side in (height, width))
    return gather_pixels(images, (tops + rows).clamp(0, height - 1), (lefts + columns).clamp(0, width - 1))


def _on_gpu(images: th.Tensor) -> bool:
    return images.device.type != "cpu"


def gather_pixels(images: th.Tensor, rows: th.Tensor, columns: th.Tensor) -> th.Tensor:
    """
    One piece of work on a GPU, which is not waited for.

    :param images: ``(B, C, H, W)``, on any device
    :param rows: which of H to take of each sample, ``(B, h)``, on the host
    :param columns: which of W, ``(B, w)``
    :return: ``(B, C, h, w)``
    """
    rows, columns = (to_device(index, images.device) for index in (rows, columns))
    batch, channels = (th.arange(length, device=images.device) for length in images.shape[:2])
    return images[batch[:, None, None, None], channels[:, None, None], rows[:, None, :, None], columns[:, None, None, :]]


def random_overlay(images: th.Tensor, *, alpha: float = 0.5, source: str | None = None, frame_channels: int = 3) -> th.Tensor:
    """
    Blend each sample with a random picture, the same for its whole stack (SODA, arXiv 2011.13389).

    :param images: uint8 ``(B, C, H, W)``, C a multiple of ``frame_channels``
    :param alpha: share of the picture, in [0, 1]
    :param source: a folder of pictures, for instance of Places365, of which at most 1 000 are read; None: 64 pictures of
        smooth random colours, always the same
    :param frame_channels: of each frame of the stack: 3 (RGB) or 1 (gray: the pictures' luminance is blended in)
    :return: uint8 ``(B, C, H, W)``
    :raises ValueError: for an alpha outside [0, 1], stacks of other frames, or a folder without pictures
    """
    if not 0 <= alpha <= 1:
        raise ValueError(f"random_overlay: alpha={alpha} must be within [0, 1]")
    frames = _frames("random_overlay", images, frame_channels)
    pictures = _pictures(source, (images.shape[2], images.shape[3]), images.device)
    chosen = pictures[to_device(th.randint(len(pictures), (len(images),)), images.device)].float()
    if frame_channels == 1:
        chosen = (chosen * th.tensor(LUMINANCE, device=chosen.device)[:, None, None]).sum(1, keepdim=True)
    return th.lerp(images.float(), chosen.repeat(1, frames, 1, 1), alpha).round_().to(th.uint8)


def random_crop_overlay(
    images: Images,
    size: ImageSize,
    *,
    last_offset: bool = True,
    alpha: float = 0.5,
    source: str | None = None,
    frame_channels: int = 3,
) -> th.Tensor:
    """
    :func:`random_crop`, then :func:`random_overlay` (the released code of CRC-RL).

    :param images: uint8 ``(B, C, H, W)``, C a multiple of ``frame_channels``
    :param size: as for :func:`random_crop`
    :param last_offset: as for :func:`random_crop`
    :param alpha: as for :func:`random_overlay`
    :param source: as for :func:`random_overlay`
    :param frame_channels: as for :func:`random_overlay`
    :return: uint8 ``(B, C, *size)``
    """
    cropped = random_crop(images, size, last_offset=last_offset)
    return random_overlay(cropped, alpha=alpha, source=source, frame_channels=frame_channels)


def random_conv(images: th.Tensor, *, frame_channels: int = 3) -> th.Tensor:
    """
    Recolour and blur each sample by a random 3x3 convolution, the same for each frame of its stack, and a sigmoid (SODA,
    arXiv 2011.13389, after arXiv 1910.05396).

    :param images: uint8 ``(B, C, H, W)``, C a multiple of ``frame_channels``
    :param frame_channels: of each frame of the stack: 3 (RGB) or 1 (gray)
    :return: uint8 ``(B, C, H, W)``
    :raises ValueError: for stacks of other frames
    """
    (batch, _, height, width), k = images.shape, _frames("random_conv", images, frame_channels)
    kernels = to_device(th.randn(frame_channels * batch, frame_channels, 3, 3), images.device)
    frames = images.view(batch, k, frame_channels, height, width).transpose(0, 1).flatten(1, 2) / 255  # (k, channels B, H, W)
    recoloured = F.conv2d(F.pad(frames, (1, 1, 1, 1), mode="replicate"), kernels, groups=batch).sigmoid_()
    stacks = recoloured.view(k, batch, frame_channels, height, width).transpose(0, 1).reshape(images.shape)
    return stacks.mul_(255).round_().to(th.uint8)


def random_crop_conv(images: Images, size: ImageSize, *, last_offset: bool = True, frame_channels: int = 3) -> th.Tensor:
    """
    :func:`random_crop`, then :func:`random_conv`.

    :param images: uint8 ``(B, C, H, W)``, C a multiple of ``frame_channels``
    :param size: as for :func:`random_crop`
    :param last_offset: as for :func:`random_crop`
    :param frame_channels: as for :func:`random_conv`
    :return: uint8 ``(B, C, *size)``
    """
    return random_conv(random_crop(images, size, last_offset=last_offset), frame_channels=frame_channels)


def _frames(name: str, images: th.Tensor, frame_channels: int) -> int:
    """:return: how many frames a stack has; :raises ValueError: if they do not have ``frame_channels`` each, 1 or 3"""
    if frame_channels not in (1, 3):
        raise ValueError(f"{name}: frame_channels={frame_channels!r} must be 3 (RGB) or 1 (gray)")
    channels = images.shape[1]
    if channels % frame_channels != 0:
        raise ValueError(f"{name}: needs stacks of RGB frames, got {channels} channels (frame_channels=1: gray frames)")
    return channels // frame_channels


@lru_cache(maxsize=4)
def _pictures(source: str | None, size: tuple[int, int], device: th.device) -> th.Tensor:
    """:return: uint8 ``(pictures, 3, *size)``"""
    if device.type != "cpu":
        return _pictures(source, size, th.device("cpu")).to(device)
    if source is None:
        coarse = th.rand(64, 3, 6, 6, generator=th.Generator().manual_seed(0))
        smooth = F.interpolate(coarse, size, mode="bicubic", align_corners=False)
        return (255 * smooth.clamp(0, 1)).to(th.uint8)
    endings = (".jpg", ".jpeg", ".png", ".webp")
    files = sorted(path for path in Path(source).expanduser().rglob("*") if path.suffix.lower() in endings)[:1_000]
    if not files:
        raise ValueError(f"random_overlay: no pictures ({', '.join(endings)}) in {source!r}")
    pictures = np.stack([_picture(file, size) for file in files])
    return th.from_numpy(pictures).permute(0, 3, 1, 2).contiguous()


def _picture(file: Path, size: tuple[int, int]) -> np.ndarray:
    """:return: uint8 ``(*size, 3)``; :raises ValueError: for what is no picture, or one that is too large to be decoded"""
    from PIL import Image

    try:
        with Image.open(file) as picture:
            width, height = picture.size
            if width * height > MOST_PIXELS:
                raise ValueError(f"it has {width} x {height} pixels; at most {MOST_PIXELS} of them are decoded")
            return np.asarray(picture.convert("RGB").resize(size[::-1]))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise ValueError(f"random_overlay: {file} cannot be read as a picture: {error}") from error


def checked_size(images: Images, size: ImageSize) -> tuple[int, int]:
    """:return: ``size`` as height and width; :raises ValueError: if it is no size, or not within the images."""
    height, width = height_and_width("size", size)
    if not (0 < height <= images.shape[2] and 0 < width <= images.shape[3]):
        raise ValueError(f"cannot crop to {height}x{width}: the images are {images.shape[2]}x{images.shape[3]}")
    return height, width


#: Name in ``CRCSAC(augmentation=...)`` -> function. A new augmentation is one function and one line here.
AUGMENTATIONS: dict[str, Callable[..., th.Tensor]] = {
    "random_crop": random_crop,
    "center_crop": center_crop,
    "random_shift": random_shift,
    "random_overlay": random_overlay,
    "random_conv": random_conv,
    "random_crop_overlay": random_crop_overlay,
    "random_crop_conv": random_crop_conv,
}
#: Those that take StoredImages; the others are given tensors
CROPS = {"random_crop", "center_crop", "random_crop_overlay", "random_crop_conv"}


def bind_augmentation(name: str, kwargs: Mapping[str, Any], shape: tuple[int, ...]) -> Callable[[Images], th.Tensor]:
    """
    Give an augmentation its arguments, and try it on one black frame, rather than fail after the warm-up of a run.

    :param name: in :data:`AUGMENTATIONS`
    :param kwargs: its arguments
    :param shape: ``(C, H, W)`` of the frames
    :return: maps uint8 ``(B, C, H, W)``, stored or a tensor, to uint8 images
    :raises ValueError: for an unknown name or argument, or one that does not suit the frames, or if what comes out is no uint8
        ``(B, C, h, w)``
    """
    check_name("augmentation", name, AUGMENTATIONS)
    known = list(inspect.signature(AUGMENTATIONS[name]).parameters)[1:]  # after the images
    for key in kwargs:
        check_name(f"argument of {name} in augmentation_kwargs", key, known)
    augmentation = partial(AUGMENTATIONS[name], **kwargs)
    with th.random.fork_rng(devices=[]):  # the trial must not change the run's random numbers
        try:
            tried = augmentation(th.zeros(1, *shape, dtype=th.uint8))
        except TypeError as error:
            raise ValueError(f"augmentation_kwargs={dict(kwargs)} do not suit {name!r}: {error}") from error
    if not (_is_bytes(tried) and tried.ndim == 4 and tried.shape[:2] == (1, shape[0])):
        raise ValueError(
            f"augmentation {name!r} turned one frame of {shape} into {described(tried)}: it must return a Tensor of shape "
            f"(1, {shape[0]}, height, width) and type uint8"
        )
    if name in CROPS:
        return augmentation
    return lambda images: augmentation(images if isinstance(images, th.Tensor) else images.whole())


def _is_bytes(value: object) -> bool:  # a user's own function may return anything
    return isinstance(value, th.Tensor) and value.dtype == th.uint8


def augmented_input(
    name: str, kwargs: Mapping[str, Any] | None, shape: tuple[int, ...], size: tuple[int, int]
) -> Callable[[Images], th.Tensor]:
    """
    As :func:`bind_augmentation`, with what comes out cut to the network's input.

    :param name: in :data:`AUGMENTATIONS`
    :param kwargs: its arguments, apart from a crop's ``size``, which by default is ``size``
    :param shape: ``(C, H, W)`` of the frames
    :param size: height and width of the network's input
    :return: maps uint8 ``(B, C, H, W)``, stored or a tensor, to uint8 ``(B, C, *size)``
    :raises ValueError: as :func:`bind_augmentation`, or if what comes out is smaller than the network's input
    """
    sized = {"size": size} if takes_size(name) else {}
    augment = bind_augmentation(name, {**sized, **(kwargs or {})}, shape)
    with th.random.fork_rng(devices=[]):
        center_crop(augment(th.zeros(1, *shape, dtype=th.uint8)), size)
    return lambda images: center_crop(augment(images), size)


def takes_size(augmentation: str) -> bool:
    """Whether the augmentation of this name cuts its output to a ``size``."""
    return "size" in inspect.signature(AUGMENTATIONS[augmentation]).parameters
