"""The encoder's mirror: latents back to images.

B batch, C channels (of the whole frame stack), H, W image height and width, Z latent.
"""

from collections.abc import Sequence

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_crc.convolutions import Deconvolution
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
        #: See :func:`~sb3_crc.convolutions.set_precision`
        self.convolution_dtype = th.float32
        frame_stack, *size = observation_shape
        sizes = [(size[0], size[1])]  # of the encoder's input and of each of its convolutions' output
        for stride in strides:
            height, width = ((side - kernel_size) // stride + 1 for side in sizes[-1])
            sizes.append((height, width))
        self.start_shape = (channels[-1], *sizes[-1])
        self.linear = nn.Linear(latent_dim, channels[-1] * sizes[-1][0] * sizes[-1][1])

        layers: list[nn.Module] = []
        outputs = (frame_stack, *channels)
        for depth in reversed(range(len(channels))):
            widths = channels[depth], outputs[depth]
            layers.append(Deconvolution(*widths, kernel_size, strides[depth], size=sizes[depth], relu=depth > 0))
        self.deconvolutions = nn.Sequential(*layers)
        self.apply(init_orthogonal)
        self.deconvolutions.to(memory_format=th.channels_last)  # type: ignore[call-overload]

    def forward(self, latents: th.Tensor) -> th.Tensor:
        """:param latents: ``(B, Z)``; :return: images ``(B, C, H, W)``, unbounded floats meant to match pixels / 255"""
        channels, *size = self.start_shape
        start = F.relu(self.linear(latents)).view(-1, *size, channels)
        images: th.Tensor = self.deconvolutions(start.permute(0, 3, 1, 2).to(self.convolution_dtype))
        return images.float()
