"""Observations and actions that cannot be trained on are refused, with what would be allowed."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_crc import CRCSAC
from sb3_crc.image_spaces import _warn_of_scaled, as_bytes
from tests.conftest import NoiseEnv, construct


class SpacesEnv(NoiseEnv):
    """NoiseEnv with other spaces."""

    def __init__(self, observation_space: gym.Space[Any] | None = None, action_space: gym.Space[Any] | None = None):
        super().__init__()
        self.observation_space = observation_space or self.observation_space
        self.action_space = action_space or self.action_space


def images(*shape: int, high: float = 255, dtype: Any = np.uint8) -> gym.spaces.Box:
    return gym.spaces.Box(0, high, shape, dtype)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (images(3, 40, 40, high=1, dtype=np.float32), r"uint8 images.*float32"),
        (images(3, 40, 40, dtype=np.float32), r"uint8 images.*float32"),
        (images(3, 40, 40, high=254), r"values in \[0, 255\].*254"),
        (images(40, 40), r"uint8 images.*\(40, 40\)"),
        (images(3, 3, 40, 40), r"uint8 images.*\(3, 3, 40, 40\)"),
        (gym.spaces.Box(-1, 1, (7,), np.float32), r"uint8 images.*\(7,\)"),
        (gym.spaces.Discrete(5), r"uint8 images.*Discrete\(5\)"),
    ],
)
@pytest.mark.parametrize("image_size", [None, 30])
def test_observations_that_are_not_byte_images_are_refused(space: Any, message: str, image_size: int | None) -> None:
    with pytest.raises(ValueError, match=message):
        construct(SpacesEnv(space), image_size=image_size)


SPEED = gym.spaces.Box(-1, 1, (2,), np.float32)


@pytest.mark.parametrize("settings", [{}, {"n_steps": 3, "image_size": 30}])
def test_the_policy_must_suit_the_observations(settings: dict[str, Any]) -> None:
    env = SpacesEnv(gym.spaces.Dict(image=images(3, 40, 40), speed=SPEED))
    with pytest.raises(ValueError, match=r"CnnPolicy.*Dict.*MultiInputPolicy"):
        CRCSAC("CnnPolicy", env, buffer_size=50, **settings)
    with pytest.raises(ValueError, match=r"MultiInputPolicy.*one image.*CnnPolicy"):
        CRCSAC("MultiInputPolicy", SpacesEnv(images(3, 40, 40)), buffer_size=50, **settings)


@pytest.mark.parametrize("spaces", [{"speed": SPEED}, {"left": images(3, 40, 40), "right": images(3, 40, 40)}])
def test_dict_observations_have_exactly_one_image(spaces: dict[str, gym.Space[Any]]) -> None:
    with pytest.raises(ValueError, match=r"expected one uint8 image.*found (none|2 \(left, right\))"):
        CRCSAC("MultiInputPolicy", SpacesEnv(gym.spaces.Dict(spaces)), buffer_size=50)


def test_pixels_that_seem_scaled_are_warned_of_once() -> None:
    """Rounded to bytes, they are black."""
    _warn_of_scaled.cache_clear()
    space, pixels = images(3, 4, 4), th.rand(2, 3, 4, 4)
    with pytest.warns(UserWarning, match="values from 0 to 255 are expected"):
        as_bytes(pixels, space)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for others in (pixels, 255 * pixels, 0 * pixels, pixels[:0]):
            assert as_bytes(others, space).dtype == th.uint8
    _warn_of_scaled.cache_clear()


def test_masks_are_images_too() -> None:
    mask = th.rand(2, 3, 4, 4) > 0.5
    assert th.equal(as_bytes(mask, images(3, 4, 4)), mask.to(th.uint8))


@pytest.mark.parametrize("space", [gym.spaces.Discrete(3), gym.spaces.MultiBinary(2), gym.spaces.MultiDiscrete([2, 2])])
def test_discrete_actions_are_refused(space: gym.Space[Any]) -> None:
    with pytest.raises((AssertionError, ValueError), match=r"Box.*" + type(space).__name__):
        construct(SpacesEnv(action_space=space))


def test_unbounded_actions_are_refused() -> None:
    with pytest.raises((AssertionError, ValueError), match="finite lower and upper bound"):
        construct(SpacesEnv(action_space=gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)))


@pytest.mark.parametrize(
    ("size", "strides", "minimum"), [(16, (2, 1, 1, 1), 15), (36, (2, 2, 2, 2), 31), (40, (3, 3, 2, 1), None)]
)
def test_images_too_small_for_the_encoder_are_refused_with_the_minimum(
    size: int, strides: tuple[int, ...], minimum: int | None
) -> None:
    policy_kwargs = {"net_arch": [8], "features_extractor_kwargs": {"channels": [8] * 4, "strides": strides}}
    if minimum is None:
        minimum = 63  # the first side from which every convolution leaves a pixel
    with pytest.raises(ValueError, match=f"{round(0.84 * size)}x{round(0.84 * size)}.*{minimum}x{minimum}"):
        construct(SpacesEnv(images(3, size, size)), policy_kwargs=policy_kwargs)
    enough = {"features_extractor_kwargs": {**policy_kwargs["features_extractor_kwargs"], "image_size": minimum}}
    large = SpacesEnv(images(3, 64, 64))
    assert construct(large, policy_kwargs={"net_arch": [8], **enough}).policy.key_encoder.convolution_shape == (8, 1, 1)
