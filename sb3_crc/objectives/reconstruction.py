"""The reconstruction loss of SAC+AE and CRC-RL: does the latent hold what the image shows?

B batch, C channels, H, W height and width, Z latent.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch as th
from torch.autograd.function import once_differentiable
from torch.nn import functional as F
from typing_extensions import Self

from sb3_crc.decoder import PixelDecoder
from sb3_crc.encoder import PixelEncoder, scale_pixels
from sb3_crc.objectives.base import AuxiliaryObjective
from sb3_crc.settings import check_name, is_count
from sb3_crc.views import View, Views

REDUCTIONS = ("mean", "sum")
TARGETS = ("anchor", "clean")


def reconstruction_loss(decoded: th.Tensor, target: th.Tensor, reduction: str = "mean") -> th.Tensor:
    """
    Squared error: -log p(x|s) of CRC-RL's L_r for a Gaussian, up to constants.

    :param decoded: ``(B, C, H, W)``
    :param target: ``(B, C, H, W)``
    :param reduction: ``"mean"`` or ``"sum"`` over channels and pixels; over the batch it is always the mean
    :return: scalar
    :raises ValueError: for an unknown reduction
    """
    check_name("reduction", reduction, REDUCTIONS)
    squared_error: th.Tensor = _SquaredError.apply(decoded, target)  # type: ignore[no-untyped-call]
    return squared_error / (len(target) if reduction == "sum" else target.numel())


class _SquaredError(th.autograd.Function):
    """The sum; torch's mse_loss hands a gradient on in its default layout, which the decoder would have to rearrange."""

    @staticmethod
    def forward(ctx: Any, decoded: th.Tensor, target: th.Tensor) -> th.Tensor:
        error = decoded - target
        ctx.save_for_backward(error)
        total: th.Tensor = th.linalg.vector_norm(error).square()
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor, th.Tensor | None]:
        (error,) = ctx.saved_tensors
        to_decoded = error * (2 * gradient)
        return to_decoded, -to_decoded if ctx.needs_input_grad[1] else None


def quantize(images: th.Tensor, bits: int) -> th.Tensor:
    """
    Keep the highest bits, and spread each level evenly by uniform noise.

    :param images: uint8 ``(B, C, H, W)``
    :param bits: to keep, 1 to 8
    :return: float32 in [-0.5, 0.5), channels last in memory
    """
    levels = 2**bits
    kept = (images >> (8 - bits)).to(th.float32, memory_format=th.channels_last)
    return (kept + th.rand_like(kept)).div_(levels).sub_(0.5)


class Reconstruction(AuxiliaryObjective):
    """
    L_r of CRC-RL: paint the anchor from its own latent, with penalties on the latent and on the decoder's weights (as in
    regularised autoencoders, arXiv 1903.12436). For an encoder that is fed the differences of frames, those are painted.

    :param channels: filters of the encoder's convolutions, which the decoder mirrors
    :param strides: their strides
    :param kernel_size: the side of their kernels
    :param mixing: ``(C, C)``, what the encoder is fed instead of each channel; None: the channels as they are
    :param reduction: see :func:`reconstruction_loss`
    :param target: name of the view that is painted: ``"anchor"`` (the paper), or ``"clean"``: the same frames without the
        augmentation, which the latent then need not hold
    :param half_size: paint only the pixels in the middle of the first convolution's windows, for half of the cost
    :param standardize: paint how the image differs from the batch's mean image, in units of each channel's standard deviation;
        else, where little moves, the mean image is nearly all that there is to gain
    :param bits: quantise the target to so many bits per channel, dithered by uniform noise, and shift it to [-0.5, 0.5)
        (SAC+AE, after Glow, arXiv 1807.03039); None: the pixels as they are, in [0, 1]
    :param latent_penalty: lambda_s, factor of the mean over the batch of ``||s||^2 / 2``
    :param decoder_penalty: lambda_theta, factor of ``||theta||^2 / 2``
    """

    def __init__(
        self,
        latent_dim: int,
        observation_shape: tuple[int, int, int],
        action_dim: int,
        *,
        channels: Sequence[int] = (32, 32, 32, 32),
        strides: Sequence[int] = (2, 1, 1, 1),
        kernel_size: int = 3,
        reduction: str = "mean",
        target: str = "anchor",
        half_size: bool = False,
        standardize: bool = False,
        mixing: th.Tensor | None = None,
        bits: int | None = None,
        latent_penalty: float = 1e-6,
        decoder_penalty: float = 1e-7,
    ):
        super().__init__(latent_dim, observation_shape, action_dim)
        if bits is not None and not (is_count(bits) and bits <= 8):
            raise ValueError(f"reconstruction: bits={bits!r} must be an integer from 1 to 8, or None")
        for name, factor in (("latent_penalty", latent_penalty), ("decoder_penalty", decoder_penalty)):
            if isinstance(factor, bool) or not isinstance(factor, int | float) or not 0 <= factor < math.inf:
                raise ValueError(f"reconstruction: {name}={factor!r} must be a finite number >= 0")
        check_name("reconstruction: reduction", reduction, REDUCTIONS)
        check_name("reconstruction: target", target, TARGETS)
        self.reduction = reduction
        self.target = target
        self.standardize = standardize
        self.bits = bits
        self.register_buffer("mixing", mixing, persistent=False)
        self.latent_penalty = latent_penalty
        self.decoder_penalty = decoder_penalty
        painted, *size = observation_shape
        self.step = strides[0] if half_size else 1
        self.start = kernel_size // 2 if half_size else 0  # the middles of the first convolution's windows
        if half_size:
            if len(channels) < 2:
                raise ValueError(f"reconstruction: half_size needs two convolutions or more, channels={tuple(channels)}")
            size = [(side - kernel_size) // strides[0] + 1 for side in size]
            channels, strides = channels[1:], strides[1:]
        self.ends = tuple(self.start + self.step * side for side in size)
        shape = painted, size[0], size[1]
        self.decoder = PixelDecoder(latent_dim, shape, channels=channels, strides=strides, kernel_size=kernel_size)

    @classmethod
    def for_encoder(cls, encoder: PixelEncoder, action_dim: int, **own: Any) -> Self:
        """Build it with a decoder that mirrors ``encoder``."""
        mirrored = {
            "channels": encoder.channels,
            "strides": encoder.strides,
            "kernel_size": encoder.kernel_size,
            "mixing": encoder.mixing,
        }
        return super().for_encoder(encoder, action_dim, **{**mirrored, **own})

    def forward(self, views: Views) -> th.Tensor:
        """:param views: the views of one batch; :return: the loss, a scalar"""
        latent, view = views.query.latent, views.query if self.target == "anchor" else views.clean
        loss = reconstruction_loss(self.decoder(latent), self._target(view), self.reduction)
        if self.latent_penalty > 0:
            loss = loss + self.latent_penalty * latent.square().sum(dim=1).mean() / 2
        if self.decoder_penalty > 0:
            squares = [parameter.square().sum() for parameter in self.decoder.parameters()]
            loss = loss + self.decoder_penalty * th.stack(squares).sum() / 2
        return loss

    def painted(self, images: th.Tensor, pixels: th.Tensor | None = None) -> th.Tensor:
        """
        :param images: uint8 ``(B, C, H, W)``
        :param pixels: the same in [0, 1], where they are at hand and would be used
        :return: what of them is painted, before it is standardised; its last channels are the newest frame
        """
        thinned = images[:, :, self.start : self.ends[0] : self.step, self.start : self.ends[1] : self.step]
        to_floats = scale_pixels if self.bits is None else partial(quantize, bits=self.bits)
        target = to_floats(thinned) if pixels is None else pixels
        return target if self.mixing is None else F.conv2d(target, self.mixing[:, :, None, None])  # type: ignore[index]

    def center_and_scale(self, painted: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """:param painted: see :meth:`painted`; :return: the batch's mean image, and the standard deviation about it"""
        mean = painted.mean(dim=0)
        return mean, (painted - mean).square().mean(dim=(0, 2, 3), keepdim=True).sqrt().clamp(min=1e-4)

    def as_pixels(self, decoded: th.Tensor, images: th.Tensor) -> th.Tensor:
        """
        What was painted as somebody can look at it: at its place among the pixels, and of their size.

        :param decoded: what the decoder paints of the latents of ``images``
        :param images: uint8 ``(B, C, H, W)``; where the reconstruction is standardised, their mean image is put back
        :return: ``(B, C, H, W)`` in [0, 1]; with frame differences only the newest frame is a picture
        """
        if self.standardize:
            mean, scale = self.center_and_scale(self.painted(images))
            decoded = decoded * scale + mean
        if self.bits is not None:
            decoded = decoded + 0.5  # a quantised target is centred at zero
        return F.interpolate(decoded, images.shape[2:]).clamp(0, 1)

    def _target(self, view: View) -> th.Tensor:
        as_it_is = self.bits is None and self.step == 1
        painted = self.painted(view.images, view.pixels if as_it_is else None)
        if not self.standardize:
            return painted
        mean, scale = self.center_and_scale(painted)
        return (painted - mean) / scale
