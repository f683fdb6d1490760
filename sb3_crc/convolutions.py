"""Convolutions with their ReLU as one step of autograd, three quarters of the time of torch's own on a CPU.

What is saved: the ReLU works in place, and only its output is kept for the backward pass; the bias's gradient is a plain sum,
where oneDNN takes longer; and a transposed convolution is computed as what it is, the gradient of a convolution, where torch's
own takes slower paths. docs/performance.md has the figures.

B batch, C channels, H, W height and width.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import torch as th
from torch import nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from sb3_crc.memory import memory_kept
from sb3_crc.settings import check_name

Pair = tuple[int, int]
NO_PADDING = (0, 0)
#: Types in which convolutions may compute
PRECISIONS = {"float32": th.float32, "bfloat16": th.bfloat16}


def set_precision(networks: nn.Module, precision: str) -> None:
    """
    Choose the type in which the convolutions of all encoders and decoders in ``networks`` compute. Weights, latents and images
    stay float32, and so does all the rest.

    :param precision: in :data:`PRECISIONS`
    :raises ValueError: for any other
    """
    check_name("precision", precision, PRECISIONS)
    for module in networks.modules():
        if hasattr(module, "convolution_dtype"):
            setattr(module, "convolution_dtype", PRECISIONS[precision])  # noqa: B010


@contextmanager
def fastest_convolutions() -> Iterator[None]:
    """
    Let cuDNN try which of its algorithms is the fastest for each shape, unless it was told to be deterministic, which SB3 does
    for a model with a seed.
    """
    before = th.backends.cudnn.benchmark
    th.backends.cudnn.benchmark = not (th.backends.cudnn.deterministic or th.are_deterministic_algorithms_enabled())
    try:
        yield
    finally:
        th.backends.cudnn.benchmark = before


def fast_updates(device: th.device) -> AbstractContextManager[None]:
    """
    What ``learn()`` sets in the process to learn fast on ``device``: on a CPU :func:`~sb3_crc.memory.memory_kept`, otherwise
    :func:`fastest_convolutions`.
    """
    return memory_kept() if device.type == "cpu" else fastest_convolutions()


def conv_relu(images: th.Tensor, weight: th.Tensor, bias: th.Tensor, stride: Pair) -> th.Tensor:
    """
    ReLU of a convolution without padding.

    :param images: ``(B, C, H, W)``
    :param weight: ``(out, C, height, width)``
    :param bias: ``(out,)``
    :param stride: along both axes
    :return: ``(B, out, ...)``
    """
    if not th.is_grad_enabled():
        return F.conv2d(images, weight, bias, stride).relu_()
    output: th.Tensor = _ConvReLU.apply(images, weight, bias, stride)  # type: ignore[no-untyped-call]
    return output


def conv_transpose(
    images: th.Tensor, weight: th.Tensor, bias: th.Tensor, stride: Pair, size: Pair, *, relu: bool
) -> th.Tensor:
    """
    Transposed convolution without padding.

    :param images: ``(B, C, H, W)``
    :param weight: ``(C, out, height, width)``
    :param bias: ``(out,)``
    :param stride: along both axes
    :param size: height and width of the output, whose convolution has the size of ``images``
    :param relu: ReLU after it
    :return: ``(B, out, *size)``
    """
    output: th.Tensor = _ConvTranspose.apply(images, weight, bias, stride, size, relu)  # type: ignore[no-untyped-call]
    return output


class ConvReLU(nn.Conv2d):
    """
    A convolution without padding, and its ReLU, in the type of its input.

    :param in_channels: as in Conv2d, like what follows
    """

    def __init__(self, in_channels: int, out_channels: int, kernel_size: int, stride: int):
        super().__init__(in_channels, out_channels, kernel_size, stride)

    def forward(self, input: th.Tensor) -> th.Tensor:
        """:param input: ``(B, C, H, W)``; :return: as Conv2d, then ReLU"""
        assert self.bias is not None
        weight, bias = self.weight.to(input.dtype), self.bias.to(input.dtype)
        return conv_relu(input, weight, bias, (self.stride[0], self.stride[1]))


class Deconvolution(nn.ConvTranspose2d):
    """
    A transposed convolution without padding, in the type of its input.

    :param in_channels: as in ConvTranspose2d, like what follows
    :param size: height and width of the output
    :param relu: ReLU after it
    """

    def __init__(self, in_channels: int, out_channels: int, kernel_size: int, stride: int, *, size: Pair, relu: bool):
        super().__init__(in_channels, out_channels, kernel_size, stride)
        self.size = size
        self.relu = relu

    def forward(self, input: th.Tensor, output_size: Any = None) -> th.Tensor:
        """:param input: ``(B, C, H, W)``; :return: ``(B, out, *size)``"""
        assert self.bias is not None
        weight, bias = self.weight.to(input.dtype), self.bias.to(input.dtype)
        return conv_transpose(input, weight, bias, (self.stride[0], self.stride[1]), self.size, relu=self.relu)


class _ConvReLU(th.autograd.Function):
    @staticmethod
    def forward(ctx: Any, images: th.Tensor, weight: th.Tensor, bias: th.Tensor, stride: Pair) -> th.Tensor:
        output = F.conv2d(images, weight, bias, stride).relu_()
        ctx.save_for_backward(images, weight, output)
        ctx.stride = stride
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        images, weight, output = ctx.saved_tensors
        gradient = _through_relu(gradient, output)
        wanted = [*ctx.needs_input_grad[:2], False]
        to_images, to_weight, _ = _convolution_backward(gradient, images, weight, ctx.stride, wanted)
        return to_images, to_weight, gradient.sum(dim=(0, 2, 3)), None


class _ConvTranspose(th.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, images: th.Tensor, weight: th.Tensor, bias: th.Tensor, stride: Pair, size: Pair, relu: bool
    ) -> th.Tensor:
        shape = len(images), weight.shape[1], *size
        painted = th.empty(
            shape, dtype=images.dtype, device=images.device, memory_format=th.channels_last
        )  # only its shape counts
        output, _, _ = _convolution_backward(images, painted, weight, stride, [True, False, False])
        output += bias[:, None, None]
        if relu:
            output.relu_()
        ctx.save_for_backward(images, weight, output if relu else None)
        ctx.stride = stride
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        images, weight, output = ctx.saved_tensors
        if output is not None:
            gradient = _through_relu(gradient, output)
        to_images = F.conv2d(gradient, weight, None, ctx.stride) if ctx.needs_input_grad[0] else None
        _, to_weight, _ = _convolution_backward(images, gradient, weight, ctx.stride, [False, True, False])
        return to_images, to_weight, gradient.sum(dim=(0, 2, 3)), None, None, None


def _through_relu(gradient: th.Tensor, output: th.Tensor) -> th.Tensor:
    passed: th.Tensor = th.ops.aten.threshold_backward(gradient, output, 0)
    return passed


def _convolution_backward(
    gradient: th.Tensor, images: th.Tensor, weight: th.Tensor, stride: Pair, wanted: list[bool]
) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """As torch.nn.grad calls it, but for several gradients at once."""
    gradients: tuple[th.Tensor, th.Tensor, th.Tensor] = th.ops.aten.convolution_backward(
        gradient, images, weight, None, stride, NO_PADDING, (1, 1), False, NO_PADDING, 1, wanted
    )
    return gradients
