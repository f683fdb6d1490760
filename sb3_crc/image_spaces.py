"""Which part of an observation is the image, and which is proprioception.

B batch, C channels (of the whole frame stack), H, W image height and width, P proprioception.
"""

import warnings
from collections.abc import Mapping
from functools import cache
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import (
    get_flattened_obs_dim,
    is_image_space,
    is_image_space_channels_first,
    preprocess_obs,
)


def image_shape(observation_space: spaces.Space[Any]) -> tuple[int, ...]:
    """
    :return: ``(C, H, W)`` of a space of byte images
    :raises ValueError: if the space is anything else
    """
    if not is_image_space(observation_space) or not is_image_space_channels_first(observation_space):  # type: ignore[arg-type]
        if isinstance(observation_space, spaces.Dict):
            hint = "; of Dict observations choose one image (a gymnasium ObservationWrapper)"
        elif observation_space.shape is not None and len(observation_space.shape) == 3:
            hint = "; if a VecNormalize is around the environment, give it norm_obs=False"
        else:
            hint = ""
        raise ValueError(
            f"expected uint8 images (channels, height, width) with values in [0, 255], got {observation_space}{hint}"
        )
    assert observation_space.shape is not None
    channels, *size = observation_space.shape
    if channels >= min(size):
        raise ValueError(
            f"channels must be fewer than rows and columns, got {observation_space.shape} as (channels, rows, columns)"
        )
    return observation_space.shape


def image_key(observation_space: spaces.Space[Any]) -> str:
    """
    :return: the key of the one image in a Dict space
    :raises ValueError: if it is no Dict, or there is not exactly one image in it
    """
    if not isinstance(observation_space, spaces.Dict):
        raise ValueError(f"expected Dict observations, got {observation_space}")
    keys = [key for key, space in observation_space.spaces.items() if is_image_space(space)]
    if len(keys) != 1:
        found = f"{len(keys)} ({', '.join(keys)})" if keys else "none"
        raise ValueError(f"expected one uint8 image among the Dict observations, found {found} in {observation_space}")
    return keys[0]


def image_space(observation_space: spaces.Space[Any]) -> spaces.Space[Any]:
    """
    :return: of a Dict space the one image in it, of any other itself
    :raises ValueError: if there is not exactly one image in a Dict
    """
    if isinstance(observation_space, spaces.Dict):
        return observation_space[image_key(observation_space)]
    return observation_space


def proprioception_dim(observation_space: spaces.Space[Any]) -> int:
    """:return: P, the numbers that come with the image, side by side; 0 for an image alone"""
    return sum(get_flattened_obs_dim(space) for space in _proprioception_spaces(observation_space).values())


def split_observations(observations: Any, observation_space: spaces.Space[Any]) -> tuple[Any, th.Tensor | None]:
    """
    :param observations: a batch of images, or a mapping with such a batch and vectors ``(B, *)``
    :param observation_space: what they belong to
    :return: the images, and proprioception ``(B, P)``: the vectors side by side, in the order of their keys; None without any
    """
    if not isinstance(observations, Mapping):
        return observations, None
    vectors = [
        preprocess_obs(observations[key], space).reshape(len(observations[key]), -1)  # type: ignore[union-attr]
        for key, space in _proprioception_spaces(observation_space).items()
    ]
    return observations[image_key(observation_space)], th.cat(vectors, dim=1) if vectors else None


def as_bytes(observations: Any, observation_space: spaces.Space[Any]) -> Any:
    """
    :param observations: a batch of images with values in [0, 255], or a mapping with such, of any type: environments need not
        keep to their space's, and SB3 takes them by their space
    :param observation_space: what they belong to
    :return: the same with uint8 images; a warning, once, if they seem to be scaled to [0, 1], and would be black
    """
    if isinstance(observations, Mapping):
        key = image_key(observation_space)
        return {**observations, key: as_bytes(observations[key], observation_space[key])}  # type: ignore[index]
    if not observations.is_floating_point():
        return observations.to(th.uint8)
    if observations.numel() and 0 < observations.max() <= 1:
        _warn_of_scaled()
    return observations.round().to(th.uint8)


@cache
def _warn_of_scaled() -> None:
    warnings.warn(
        "an observation's pixels are floats of at most 1: values from 0 to 255 are expected, the encoder scales them itself",
        stacklevel=3,
    )


def _proprioception_spaces(observation_space: spaces.Space[Any]) -> dict[str, spaces.Space[Any]]:
    if not isinstance(observation_space, spaces.Dict):
        return {}
    image = image_key(observation_space)
    return {key: space for key, space in observation_space.spaces.items() if key != image}
