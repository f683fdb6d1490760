"""Our convolutions are torch's: same values, same gradients, whatever the layout."""

import pytest
import torch as th
from torch.nn import functional as F

from sb3_crc.convolutions import ConvReLU, Deconvolution, conv_relu, conv_transpose


def leaves(*shapes: tuple[int, ...], layout: th.memory_format) -> list[th.Tensor]:
    tensors = [th.randn(shape, dtype=th.float64) for shape in shapes]
    return [(t.contiguous(memory_format=layout) if t.dim() == 4 else t).requires_grad_() for t in tensors]


@pytest.mark.parametrize("layout", [th.contiguous_format, th.channels_last])
@pytest.mark.parametrize("stride", [1, 2])
def test_a_convolution_with_its_relu(stride: int, layout: th.memory_format) -> None:
    tensors = leaves((4, 3, 11, 9), (5, 3, 3, 3), (5,), layout=layout)
    ours = conv_relu(*tensors, (stride, stride))
    theirs = F.relu(F.conv2d(*tensors, stride))
    th.testing.assert_close(ours, theirs)
    assert (ours == 0).any() and (ours > 0).any()
    direction = th.randn_like(ours)
    th.testing.assert_close(th.autograd.grad(ours, tensors, direction), th.autograd.grad(theirs, tensors, direction))
    with th.no_grad():
        th.testing.assert_close(conv_relu(*tensors, (stride, stride)), theirs)


@pytest.mark.parametrize("layout", [th.contiguous_format, th.channels_last])
@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize(("stride", "size"), [(1, (13, 11)), (2, (23, 19)), (2, (24, 20)), (3, (35, 29))])
def test_a_transposed_convolution(stride: int, size: tuple[int, int], relu: bool, layout: th.memory_format) -> None:
    tensors = leaves((4, 3, 11, 9), (3, 5, 3, 3), (5,), layout=layout)
    ours = conv_transpose(*tensors, (stride, stride), size, relu=relu)
    padding = tuple(side - (stride * (start - 1) + 3) for side, start in zip(size, (11, 9), strict=True))
    theirs = F.conv_transpose2d(*tensors, stride, output_padding=padding)
    theirs = F.relu(theirs) if relu else theirs
    th.testing.assert_close(ours, theirs)
    direction = th.randn_like(ours)
    th.testing.assert_close(th.autograd.grad(ours, tensors, direction), th.autograd.grad(theirs, tensors, direction))
    with th.no_grad():
        th.testing.assert_close(conv_transpose(*tensors, (stride, stride), size, relu=relu), theirs)


def test_images_that_need_no_gradient_get_none() -> None:
    layer = ConvReLU(3, 5, 3, 2)
    images = th.randn(2, 3, 9, 9)
    gradients = th.autograd.grad(layer(images).sum(), list(layer.parameters()))
    assert all(gradient.abs().sum() > 0 for gradient in gradients)
    assert images.grad is None


def test_what_a_layer_puts_out_stays_in_the_layout_it_was_given() -> None:
    images = th.randn(2, 3, 9, 9).contiguous(memory_format=th.channels_last)
    down = ConvReLU(3, 5, 3, 2).to(memory_format=th.channels_last)  # type: ignore[call-overload]
    up = Deconvolution(5, 3, 3, 2, size=(9, 9), relu=False).to(memory_format=th.channels_last)  # type: ignore[call-overload]
    assert down(images).is_contiguous(memory_format=th.channels_last)
    assert up(down(images)).shape == images.shape
    assert up(down(images)).is_contiguous(memory_format=th.channels_last)
