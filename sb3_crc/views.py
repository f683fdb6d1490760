"""The views of one batch, each augmented once and encoded at most once per network.

========== ============================= =========== ============== ===================================================
view       what it is                    online      key encoder    who reads it
========== ============================= =========== ============== ===================================================
anchor     augmented o_t                 yes, with   no             critic; actor (features detached); query of the
                                         gradient                   contrastive loss; input and target of the
                                                                    reconstruction; s of the consistency loss
positive   o_t, augmented anew           no          yes            key of the contrastive loss; s' of the consistency
                                                                    loss
bootstrap  augmented o_{t+n}             yes,        yes            next actions (online), Q targets (key encoder)
                                         detached
========== ============================= =========== ============== ===================================================

For every preset: what no consumer asks for is neither augmented nor encoded, so ``rad`` and ``pixel_sac`` make no positive.
B batch, C channels (of the whole frame stack), H, W height and width of the encoder's input, F flattened convolution
output, Z latent, A action.
"""

from collections.abc import Callable
from functools import cached_property

import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_crc.encoder import PixelEncoder, scale_pixels


class View:
    """
    One augmented batch of images; pixels and encodings are computed on first use and kept.

    :param images: uint8 ``(B, C, H, W)``
    :param encoder: the online encoder
    :param key_encoder: its exponential moving average
    :param trains_encoder: keep the graph of the online encoding
    """

    def __init__(self, images: th.Tensor, encoder: PixelEncoder, key_encoder: PixelEncoder, *, trains_encoder: bool):
        self.images = images
        self._encoder = encoder
        self._key_encoder = key_encoder
        self._trains_encoder = trains_encoder

    @cached_property
    def pixels(self) -> th.Tensor:
        """The images as floats in [0, 1], ``(B, C, H, W)``."""
        return scale_pixels(self.images)

    @cached_property
    def features(self) -> th.Tensor:
        """Convolution output of the online encoder, ``(B, F)``."""
        with th.set_grad_enabled(self._trains_encoder):
            return self._encoder.convolve(self.pixels)

    @cached_property
    def latent(self) -> th.Tensor:
        """Latent of the online encoder, ``(B, Z)``."""
        with th.set_grad_enabled(self._trains_encoder):
            return self._encoder.project(self.features)

    @cached_property
    def key_latent(self) -> th.Tensor:
        """Latent of the key encoder, ``(B, Z)``, without gradient."""
        with th.no_grad():
            latents: th.Tensor = self._key_encoder(self.pixels)
        return latents


class Views:
    """
    What one update sees of a sampled batch.

    :param batch: a sample of the replay buffer, images on the training device as uint8
    :param augment: maps uint8 ``(B, C, *, *)`` to uint8 of the encoder's input size, anew at each call
    :param encoder: the online encoder
    :param key_encoder: its exponential moving average
    :param gamma: discount for buffers that return none of their own
    :param reward_scale: factor on the rewards
    """

    def __init__(
        self,
        batch: ReplayBufferSamples,
        augment: Callable[[th.Tensor], th.Tensor],
        encoder: PixelEncoder,
        key_encoder: PixelEncoder,
        *,
        gamma: float = 0.99,
        reward_scale: float = 1.0,
    ):
        self._batch = batch
        self._augment = augment
        self._encoders = encoder, key_encoder
        self.actions = batch.actions  # (B, A)
        self.rewards = batch.rewards * reward_scale  # (B, 1)
        discounts = gamma if batch.discounts is None else batch.discounts
        self.discounts = (1 - batch.dones) * discounts  # (B, 1), zero where the episode has terminated

    @cached_property
    def anchor(self) -> View:
        """Augmented o_t, the one view whose online encoding carries gradients."""
        return self._view(self._batch.observations, trains_encoder=True)

    @cached_property
    def positive(self) -> View:
        """o_t again, augmented independently of the anchor."""
        return self._view(self._batch.observations)

    @cached_property
    def bootstrap(self) -> View:
        """Augmented o_{t+n}, from which the return is bootstrapped."""
        return self._view(self._batch.next_observations)

    def _view(self, observations: th.Tensor, trains_encoder: bool = False) -> View:
        return View(self._augment(observations), *self._encoders, trains_encoder=trains_encoder)
