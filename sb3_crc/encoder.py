"""The convolutional encoder that critic, actor and objectives share.

B batch, C channels (of the whole frame stack), H, W image height and width, F flattened convolution output, Z latent.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_crc.augmentations import ImageSize, center_crop
from sb3_crc.convolutions import ConvReLU, conv_relu
from sb3_crc.image_spaces import image_shape, image_space, split_observations
from sb3_crc.settings import check_name, check_sizes, height_and_width

#: A batch of images, or a mapping in which there is one
Observations = th.Tensor | Mapping[str, th.Tensor]
INITIALIZATIONS = ("delta_orthogonal", "orthogonal")
LATENT_ACTIVATIONS: dict[str, type[nn.Module]] = {"none": nn.Identity, "tanh": nn.Tanh}


class PixelEncoder(BaseFeaturesExtractor):
    """
    Convolutions, then a linear projection with LayerNorm: the encoder of SAC+AE (arXiv 1910.01741), CURL and CRC-RL.

    It takes bytes, which it scales to [0, 1] itself, or floats that are scaled already (as SB3 hands them to any features
    extractor), and cuts the middle out of images that are larger than ``image_size``.

    :param observation_space: channel-first uint8 images ``(C, H, W)``, or a Dict with one such image, which alone is encoded
    :param features_dim: latent dimension Z
    :param image_size: height and width of the input of the convolutions in pixels (one number: both); None: the whole image
    :param channels: filters of each convolution
    :param strides: stride of each convolution
    :param kernel_size: side of each kernel
    :param latent_activation: ``"none"`` or ``"tanh"``, after the LayerNorm
    :param center_input: feed pixels / 255 - 0.5 instead of pixels / 255
    :param frame_differences: feed the newest frame as it is, and instead of each older one how the next differs from it, times
        this factor: what stands still vanishes, and velocities can be read from single channels; None: the frames as they are
    :param frame_channels: channels of one frame of the stack, for ``frame_differences``
    :param initialization: of the convolutions: ``"orthogonal"`` (DrQ), or ``"delta_orthogonal"`` (CURL: only the kernels'
        middle, so that layers of stride 2 start blind to three pixels of four)
    :raises ValueError: if the space is not one of images, these are too small for the convolutions, or not a stack of frames
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        features_dim: int = 50,
        *,
        image_size: ImageSize | None = None,
        channels: Sequence[int] = (32, 32, 32, 32),
        strides: Sequence[int] = (2, 1, 1, 1),
        kernel_size: int = 3,
        latent_activation: str = "none",
        center_input: bool = False,
        frame_differences: float | None = None,
        frame_channels: int = 3,
        initialization: str = "delta_orthogonal",
    ):
        frame_stack, *frame_size = image_shape(image_space(observation_space))
        check_sizes(channels=channels, strides=strides, features_dim=features_dim, kernel_size=kernel_size)
        check_sizes(frame_channels=frame_channels)
        super().__init__(observation_space, features_dim)
        _check_one_each(channels=channels, strides=strides)
        height, width = frame_size if image_size is None else height_and_width("image_size", image_size)
        if not (0 < height <= frame_size[0] and 0 < width <= frame_size[1]):
            raise ValueError(f"image_size={image_size} must lie within the frame of {frame_size[0]}x{frame_size[1]} pixels")

        self.input_shape = (frame_stack, height, width)
        self.channels = tuple(channels)
        self.strides = tuple(strides)
        self.kernel_size = kernel_size
        self.latent_activation = latent_activation
        self.center_input = center_input
        #: See :func:`~sb3_crc.convolutions.set_precision`
        self.convolution_dtype = th.float32

        layers: list[nn.Module] = []
        for c_in, c_out, stride in zip((frame_stack, *channels), channels, strides, strict=False):
            layers.append(ConvReLU(c_in, c_out, kernel_size, stride))
        #: What the convolutions are fed instead of each channel, ``(C, C)``; None: the channels as they are
        self.mixing: th.Tensor | None = None
        shift = th.full((frame_stack,), 0.5 * center_input)
        if frame_differences is not None:
            self.mixing = difference_mixing(frame_stack, frame_channels, frame_differences)
            shift[:-frame_channels] = 0  # differences are centred as they are
        if center_input or frame_differences is not None:
            mixing = th.eye(frame_stack) if self.mixing is None else self.mixing
            layers[0] = MixedConvReLU(mixing, shift, channels[0], kernel_size, strides[0])
        self.convolutions = nn.Sequential(*layers)
        minimum = smallest_input(self.strides, kernel_size)
        if min(height, width) < minimum:
            cut = ""
            if [height, width] != frame_size:
                frame = f"{frame_size[0]}x{frame_size[1]}"
                cut = f", cut out of frames of {frame} (image_size, which for crops is 84 % of the frame by default),"
            raise ValueError(
                f"images of {height}x{width} pixels{cut} are too small for this encoder: it needs {minimum}x{minimum}"
            )
        with th.no_grad():
            output = self.convolutions(th.zeros(1, *self.input_shape))
        #: Shape of the last convolution's output, ``(channels, height, width)``; flattened, the channels come last
        self.convolution_shape = tuple(output.shape[1:])
        #: F
        self.convolution_dim: int = output.numel()
        self.projection = latent_projection(self.convolution_dim, features_dim, latent_activation)
        check_name("initialization", initialization, INITIALIZATIONS)
        self.apply(init_orthogonal)
        if initialization == "orthogonal":
            for layer in layers:
                nn.init.orthogonal_(layer.weight, nn.init.calculate_gain("relu"))  # type: ignore[arg-type]
        self.convolutions.to(memory_format=th.channels_last)  # type: ignore[call-overload]  # 3x faster on CPU

    @property
    def observation_space(self) -> spaces.Space[Any]:
        """What observations it was built for."""
        return self._observation_space

    def forward(self, observations: Observations) -> th.Tensor:
        """:param observations: ``(B, C, H, W)``, uint8 or floats in [0, 1]; :return: latents ``(B, Z)``"""
        return self.project(self.convolve(observations))

    def convolve(self, observations: Observations) -> th.Tensor:
        """:param observations: ``(B, C, H, W)``, uint8 or floats in [0, 1]; :return: convolution output ``(B, F)``"""
        images, _ = split_observations(observations, self.observation_space)
        images = center_crop(images, self.input_shape[1:])
        pixels = scale_pixels(images) if images.dtype == th.uint8 else images.contiguous(memory_format=th.channels_last)
        features: th.Tensor = self.convolutions(pixels.to(self.convolution_dtype)).float()
        return features.permute(0, 2, 3, 1).flatten(start_dim=1)  # as they lie in memory

    def project(self, features: th.Tensor) -> th.Tensor:
        """:param features: convolution output ``(B, F)``; :return: latents ``(B, Z)``"""
        latents: th.Tensor = self.projection(features)
        return latents


def _check_one_each(**layers: Sequence[int]) -> None:
    """:raises ValueError: unless they are sequences of the same length"""
    for name, numbers in layers.items():
        if not isinstance(numbers, Sequence):
            raise ValueError(f"{name}={numbers!r} must be a sequence: one number for each convolution")
    if len({len(numbers) for numbers in layers.values()}) > 1:
        each = " and ".join(f"{name}={tuple(numbers)}" for name, numbers in layers.items())
        raise ValueError(f"{each} must have the same length")


class MixedConvReLU(ConvReLU):
    """
    A convolution of ``mixing @ input - shift``, and its ReLU: its kernels are mixed, not the pixels, and the bias takes the
    shift, so that neither needs a pass over the images.

    :param mixing: ``(C, C)``, what each channel becomes
    :param shift: ``(C,)``
    :param out_channels: as in Conv2d, like what follows
    """

    mixing: th.Tensor
    shift: th.Tensor

    def __init__(self, mixing: th.Tensor, shift: th.Tensor, out_channels: int, kernel_size: int, stride: int):
        super().__init__(len(mixing), out_channels, kernel_size, stride)
        self.register_buffer("mixing", mixing, persistent=False)
        self.register_buffer("shift", shift, persistent=False)

    def forward(self, input: th.Tensor) -> th.Tensor:
        """:param input: ``(B, C, H, W)``; :return: as ConvReLU"""
        assert self.bias is not None
        weight = th.einsum("oihw,ij->ojhw", self.weight, self.mixing).contiguous(memory_format=th.channels_last)
        bias = self.bias - self.weight.sum(dim=(2, 3)) @ self.shift
        return conv_relu(input, weight.to(input.dtype), bias.to(input.dtype), (self.stride[0], self.stride[1]))


def difference_mixing(channels: int, frame_channels: int, factor: float) -> th.Tensor:
    """
    :param channels: C, of the whole stack, oldest frame first
    :param frame_channels: of one frame
    :param factor: of the differences
    :return: ``(C, C)``, maps a stack to the differences between neighbouring frames and, last, the newest frame
    :raises ValueError: if there are not at least two whole frames
    """
    if channels < 2 * frame_channels or channels % frame_channels:
        raise ValueError(
            f"frame_differences needs frames of {frame_channels} channels, at least two: the stack has {channels}"
        )
    mixing = th.eye(channels)
    older = channels - frame_channels
    mixing[:older, :older] *= -factor
    mixing[:older, frame_channels:] += factor * th.eye(older)
    return mixing


def latent_projection(in_features: int, latent_dim: int, activation: str) -> nn.Sequential:
    """
    What turns convolution output into a latent: Linear, LayerNorm and, if named, an activation.

    :raises ValueError: for an unknown activation
    """
    check_name("latent_activation", activation, LATENT_ACTIVATIONS)
    return nn.Sequential(nn.Linear(in_features, latent_dim), nn.LayerNorm(latent_dim), LATENT_ACTIVATIONS[activation]())


def scale_pixels(images: th.Tensor) -> th.Tensor:
    """The one place where bytes become floats. :return: float32 in [0, 1], channels last in memory"""
    # Bytes are cheaper to rearrange than floats
    return images.contiguous(memory_format=th.channels_last).to(th.float32).div_(255.0)


def smallest_input(strides: Sequence[int], kernel_size: int) -> int:
    """:return: the smallest side in pixels from which convolutions without padding leave at least one pixel"""
    side = 1
    for stride in reversed(strides):
        side = (side - 1) * stride + kernel_size
    return side


def init_orthogonal(module: nn.Module) -> None:
    """
    Initialise one layer in place (use with ``module.apply``): linear layers orthogonal with zero bias, convolutions
    delta-orthogonal (Xiao et al. 2018, arXiv 1806.05393) with gain sqrt 2 where their kernel has a middle.
    """
    if isinstance(module, nn.Linear):
        nn.init.orthogonal_(module.weight)
        nn.init.zeros_(module.bias)
    elif isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
        height, width = module.kernel_size
        gain = nn.init.calculate_gain("relu")
        if height == width and height % 2 == 1:
            nn.init.zeros_(module.weight)
            nn.init.orthogonal_(module.weight.data[:, :, height // 2, width // 2], gain)
        else:
            nn.init.orthogonal_(module.weight, gain)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
