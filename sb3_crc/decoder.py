"""The encoder's mirror: latents back to images.

B batch, C channels (of the whole frame stack), H, W image height and width, Z latent.
"""

from collections.abc import Sequence

import torch as th
from torch import nn

from sb3_crc.encoder import init_orthogonal


class PixelDecoder(nn.Module):
    """
    A linear layer, then the encoder's convolutions in reverse order: the decoder of SAC+AE (arXiv 1910.01741) and CRC-RL.

    :param latent_dim: Z
    :param observation_shape: ``(C, H, W)`` of the images to paint, those that the encoder is fed
    :param channels: filters of the encoder's convolutions, in the encoder's order
    :param strides: strides of the encoder's convolutions, in the encoder's order
    :param kernel_size: side of each kernel
    """

    def __init__(
        self,
        latent_dim: int,
        observation_shape: tuple[int, int, int],
        *,
        channels: Sequence[int] = (32, 32, 32, 32),
        strides: Sequence[int] = (2, 1, 1, 1),
        kernel_size: int = 3,
    ):
        super().__init__()
        frame_stack, *size = observation_shape
        sizes = [tuple(size)]  # of the encoder's input and of each of its convolutions' output
        for stride in strides:
            sizes.append(tuple((side - kernel_size) // stride + 1 for side in sizes[-1]))
        self.start_shape = (channels[-1], *sizes[-1])
        self.linear = nn.Linear(latent_dim, channels[-1] * sizes[-1][0] * sizes[-1][1])

        layers: list[nn.Module] = []
        outputs = (frame_stack, *channels)
        for depth in reversed(range(len(channels))):
            layers += [nn.ReLU(), _mirrored(channels[depth], outputs[depth], kernel_size, strides[depth], sizes[depth])]
        self.deconvolutions = nn.Sequential(*layers)
        self.apply(init_orthogonal)
        self.deconvolutions.to(memory_format=th.channels_last)  # type: ignore[call-overload]

    def forward(self, latents: th.Tensor) -> th.Tensor:
        """:param latents: ``(B, Z)``; :return: images ``(B, C, H, W)``, unbounded floats meant to match pixels / 255"""
        start = self.linear(latents).unflatten(1, self.start_shape)
        images: th.Tensor = self.deconvolutions(start.contiguous(memory_format=th.channels_last))
        return images


def _mirrored(c_in: int, c_out: int, kernel_size: int, stride: int, size: tuple[int, ...]) -> nn.Module:
    """The layer that undoes the shape of a convolution of an image of ``size``."""
    if stride == 1:  # the same map as a transposed convolution (kernels flipped), but on oneDNN's fast path
        return nn.Conv2d(c_in, c_out, kernel_size, padding=kernel_size - 1)
    output_padding = tuple((side - kernel_size) % stride for side in size)
    return nn.ConvTranspose2d(c_in, c_out, kernel_size, stride, output_padding=output_padding)  # type: ignore[arg-type]
