"""What the networks of a saved policy make of images: latents, values, reconstructions.

n images, C channels (of the whole frame stack), H, W height and width, Z latent, A action, P proprioception.
"""

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_crc.augmentations import center_crop
from sb3_crc.crc_sac import CRCSAC
from sb3_crc.encoder import PixelEncoder, scale_pixels
from sb3_crc.image_spaces import image_shape, image_space
from sb3_crc.objectives.reconstruction import Reconstruction

BATCH = 256


def encode(model: SAC, images: np.ndarray, extractor: BaseFeaturesExtractor | None = None) -> np.ndarray:
    """
    What the Q heads read: the query encoder's latent, or the output of the critic's features extractor of stock SAC.

    :param model: any SAC that sees pictures
    :param images: uint8 ``(n, C, H, W)``
    :param extractor: another of the same kind, for instance :func:`untrained_extractor`
    :return: float32 ``(n, Z)``
    :raises ValueError: if the model is for images of another shape, or joins images and vectors before its heads
    """
    extractor = model.critic.features_extractor if extractor is None else extractor
    space, shape = image_space(model.observation_space), image_shape(image_space(model.observation_space))
    if images.shape[1:] != shape:
        raise ValueError(f"observations {images.shape[1:]} (channels, height, width) do not fit a policy that sees {shape}")
    if isinstance(model.observation_space, spaces.Dict) and not isinstance(extractor, PixelEncoder):
        raise ValueError(f"{type(extractor).__name__} joins images and vectors: it has no latent of the images alone")
    latents = []
    with th.no_grad():
        for start in range(0, len(images), BATCH):
            batch = th.from_numpy(images[start : start + BATCH])
            pixels = preprocess_obs(batch, space, normalize_images=model.policy.normalize_images)
            latents.append(extractor(pixels))
    return np.asarray(th.cat(latents).numpy(), dtype=np.float32)


def untrained_extractor(model: SAC, seed: int) -> BaseFeaturesExtractor:
    """:return: an encoder of the model's architecture with random weights, as a training with this seed might start"""
    with th.random.fork_rng(devices=[]):
        th.manual_seed(seed)
        extractor = model.policy.make_features_extractor()
    extractor.train(False)
    return extractor


def min_q_values(model: SAC, pixels: th.Tensor, actions: th.Tensor, proprioception: th.Tensor | None = None) -> th.Tensor:
    """
    :param model: any SAC that sees pictures
    :param pixels: floats in [0, 1], ``(n, C, H, W)``
    :param actions: in [-1, 1], ``(n, A)``
    :param proprioception: ``(n, P)`` of Dict observations
    :return: the lowest of the critics' values, ``(n,)``, with gradient to the pixels
    """
    latents = model.critic.features_extractor(pixels)
    inputs = th.cat([latents, *([] if proprioception is None else [proprioception]), actions], dim=1)
    values: th.Tensor = th.cat([head(inputs) for head in model.critic.q_networks], dim=1).min(dim=1).values
    return values


def reconstruct(model: SAC, images: np.ndarray) -> np.ndarray | None:
    """
    :param model: any SAC that sees pictures
    :param images: uint8 ``(n, C, H, W)``, some dozens or more if the decoder paints standardised images: their mean image and
        standard deviation are put back
    :return: what the decoder paints of their latents, floats in [0, 1], ``(n, C, h, w)`` with the size of the encoder's
        input; with frame differences only the newest frame is a picture. None if the model has no decoder
    """
    if not isinstance(model, CRCSAC):
        return None
    objective = next((one for one in model.policy.objectives.values() if isinstance(one, Reconstruction)), None)
    encoder = model.critic.features_extractor
    if objective is None or not isinstance(encoder, PixelEncoder):
        return None
    seen = center_crop(th.from_numpy(images), encoder.input_shape[1:])
    with th.no_grad(), th.random.fork_rng(devices=[]):  # quantisation draws noise
        decoded: th.Tensor = th.cat([objective.decoder(encoder(scale_pixels(part))) for part in th.split(seen, BATCH)])
        painted: np.ndarray = objective.as_pixels(decoded, seen).numpy()
    return painted
