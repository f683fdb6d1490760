"""Which pixels the value depends on.

n images, C channels (of the whole frame stack), H, W height and width, A action.
"""

from collections.abc import Callable

import numpy as np
import torch as th
from stable_baselines3 import SAC

from sb3_crc.analysis.networks import min_q_values
from sb3_crc.image_spaces import proprioception_dim

BATCH = 64
#: Of 255: what differs by more from the episode's median frame moves
MOVING = 16


def saliency(values: Callable[[th.Tensor], th.Tensor], pixels: th.Tensor, frame_channels: int) -> np.ndarray:
    """
    Absolute gradient of a value with respect to the newest frame (Simonyan et al. 2013, arXiv 1312.6034), summed over its
    channels.

    :param values: pixels ``(n, C, H, W)`` -> ``(n,)``, each image for itself
    :param pixels: floats in [0, 1], ``(n, C, H, W)``
    :param frame_channels: of one frame; the newest frame is the last of the stack
    :return: ``(n, H, W)``, in units of value per unit of a pixel
    """
    leaf = pixels.clone().requires_grad_(True)
    (gradient,) = th.autograd.grad(values(leaf).sum(), leaf)
    return np.asarray(gradient[:, -frame_channels:].abs().sum(dim=1).numpy())


def q_saliency(model: SAC, images: np.ndarray, actions: np.ndarray, frame_channels: int) -> np.ndarray:
    """
    :func:`saliency` of min Q(s, a), the action held.

    :param model: any SAC that sees pictures alone
    :param images: uint8 ``(n, C, H, W)``
    :param actions: in [-1, 1], ``(n, A)``
    :param frame_channels: of one frame
    :return: ``(n, H, W)``
    :raises ValueError: for observations that hold vectors too
    """
    if proprioception_dim(model.observation_space):
        raise ValueError("saliency is for policies that see pictures alone: this one reads vectors beside them")
    found = []
    for start in range(0, len(images), BATCH):
        rows = slice(start, start + BATCH)
        of_actions = th.from_numpy(actions[rows])

        def values(pixels: th.Tensor, held: th.Tensor = of_actions) -> th.Tensor:
            return min_q_values(model, pixels, held)

        found.append(saliency(values, th.from_numpy(images[rows]).float() / 255, frame_channels))
    return np.concatenate(found)


def saliency_on_motion(maps: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Does the critic look at what moves, that is, at what differs from the episode's median frame?

    :param maps: ``(n, H, W)``
    :param frames: uint8 ``(n, 3 or 1, H, W)``, of one episode under a camera that stands still
    :return: ``(n,)`` share of the saliency on moving pixels, and ``(n,)`` their share of the frame, which is what an even map
        would give; NaN for a map of zeros
    """
    difference = np.abs(frames.astype(np.int16) - np.median(frames, axis=0).astype(np.int16)).max(axis=1)
    moving = difference > MOVING
    total = maps.sum(axis=(1, 2))
    with np.errstate(invalid="ignore"):
        return (maps * moving).sum(axis=(1, 2)) / np.where(total > 0, total, np.nan), moving.mean(axis=(1, 2))
