"""The features extractor of a stock SB3 algorithm, in the place that PixelEncoder has in CRCSAC.

B batch, C channels (of the whole frame stack), H, W image height and width, Z latent: what the extractor returns.
"""

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_crc.augmentations import Images, bind_augmentation
from sb3_crc.crc_sac import CRCSAC
from sb3_crc.encoder import PixelEncoder
from sb3_crc.image_spaces import image_shape
from sb3_crc.objectives import Reconstruction

#: The networks whose features extractor is trained: of SAC, TD3, DDPG, TQC; of DQN; of sb3-contrib's QR-DQN.
OWNERS = ("critic", "q_net", "quantile_net")


class ExtractorEncoder:
    """
    Any SB3 features extractor in the place of a :class:`~sb3_crc.PixelEncoder` for views and objectives.

    It has no projection of its own: the extractor's output is both features and latent. Objectives that mirror the encoder
    mirror a PixelEncoder, and keep their own defaults for any other extractor.

    :param extractor: maps ``(B, C, H, W)``, scaled as the policy scales it, to ``(B, Z)``
    :param observation_space: channel-first uint8 images
    :param normalize_images: of the policy; False: the extractor expects floats from 0 to 255
    """

    def __init__(self, extractor: BaseFeaturesExtractor, observation_space: spaces.Space[Any], normalize_images: bool):
        self.extractor = extractor
        self.observation_space = observation_space
        self.normalize_images = normalize_images
        self.features_dim = extractor.features_dim
        mirrored = extractor if isinstance(extractor, PixelEncoder) else None
        self.input_shape = mirrored.input_shape if mirrored else image_shape(observation_space)
        for name in ("channels", "strides", "kernel_size", "mixing"):
            default = inspect.signature(Reconstruction.__init__).parameters[name].default
            setattr(self, name, getattr(mirrored, name) if mirrored else default)

    def __call__(self, pixels: th.Tensor) -> th.Tensor:
        """:param pixels: ``(B, C, H, W)``, floats in [0, 1]; :return: latents ``(B, Z)``"""
        return self.project(self.convolve(pixels))

    def convolve(self, pixels: th.Tensor) -> th.Tensor:
        """:param pixels: ``(B, C, H, W)``, floats in [0, 1]; :return: the extractor's output ``(B, Z)``"""
        if not self.normalize_images:  # rounding makes them exactly the bytes that they come from
            pixels = (pixels * 255).round()
        latents: th.Tensor = self.extractor(pixels)
        return latents

    def project(self, features: th.Tensor) -> th.Tensor:
        """:param features: ``(B, Z)``; :return: the same"""
        return features


def trainable_extractor(model: BaseAlgorithm) -> BaseFeaturesExtractor:
    """
    :param model: any SB3 algorithm
    :return: the features extractor of its critic
    :raises ValueError: if objectives cannot be added to it, saying why
    """
    name = type(model).__name__
    if isinstance(model, CRCSAC):
        raise ValueError(f"{name} trains objectives itself: give them to its constructor, {name}(objectives=...)")
    if not isinstance(model, OffPolicyAlgorithm):
        raise ValueError(
            f"{name} has no replay buffer: AuxiliaryLossCallback is for off-policy algorithms (SAC, TD3, DQN, TQC)"
        )
    normalize = model.get_vec_normalize_env()
    if normalize is not None and normalize.norm_obs:
        raise ValueError("VecNormalize(norm_obs=True) hides the images' bytes: use VecNormalize(norm_obs=False)")
    image_shape(model.observation_space)
    networks = [getattr(model, owner) for owner in OWNERS if getattr(model, owner, None) is not None]
    if not networks:
        raise ValueError(f"{name} has no network to train, only algorithms with one of {', '.join(OWNERS)}")
    extractor = networks[0].features_extractor
    if not trainable_parameters(extractor):
        raise ValueError(
            f"{type(extractor).__name__} has no trainable parameters: use 'CnnPolicy', or another features extractor"
        )
    assert isinstance(extractor, BaseFeaturesExtractor)
    return extractor


def checked_augmentation(
    name: str, kwargs: Mapping[str, Any], shape: tuple[int, ...], input_shape: tuple[int, ...]
) -> Callable[[Images], th.Tensor]:
    """
    :param name: in :data:`~sb3_crc.augmentations.AUGMENTATIONS`
    :param kwargs: its arguments
    :param shape: ``(C, H, W)`` of the observations
    :param input_shape: ``(C, H, W)`` of what the extractor is built for: ``shape``, but for a PixelEncoder that cuts
    :return: the augmentation, which has been tried on a blank image
    :raises ValueError: if its arguments are wrong or its output is of another size
    """
    augmentation = bind_augmentation(name, kwargs, shape)
    with th.random.fork_rng(devices=[]):
        result = augmentation(th.zeros((1, *shape), dtype=th.uint8))
    if tuple(result.shape[1:]) not in (shape, input_shape):
        raise ValueError(
            f"augmentation {name!r} with {dict(kwargs)} turns images of {shape} into {tuple(result.shape[1:])}, but the "
            f"extractor was built for {input_shape}: use one that keeps the size, such as 'random_shift'"
        )
    return augmentation


def trainable_parameters(module: nn.Module) -> dict[str, nn.Parameter]:
    """:return: name -> parameter, without the frozen ones"""
    return {name: parameter for name, parameter in module.named_parameters() if parameter.requires_grad}
