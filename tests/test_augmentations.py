"""Augmentations: bytes in, bytes out, every offset, one offset per stack."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch as th
from PIL import Image
from torch.nn import functional as F

from sb3_crc.augmentations import (
    AUGMENTATIONS,
    augmented_input,
    center_crop,
    random_conv,
    random_crop,
    random_overlay,
    random_shift,
    takes_size,
)


def coordinates(batch: int, size: int) -> th.Tensor:
    """Images whose pixels tell where they are: channel 0 and 2 the row, channel 1 and 3 the column."""
    rows = th.arange(size, dtype=th.uint8).view(-1, 1).expand(size, size)
    return th.stack([rows, rows.T, rows, rows.T]).expand(batch, 4, size, size).contiguous()


def test_random_crop_draws_every_offset_ends_included() -> None:
    th.manual_seed(0)
    crops = random_crop(coordinates(2_000, 12), 8)
    offsets = {(int(top), int(left)) for top, left in crops[:, :2, 0, 0]}
    assert offsets == {(top, left) for top in range(5) for left in range(5)}


def test_random_crop_cuts_one_window_for_the_whole_stack() -> None:
    crops = random_crop(coordinates(64, 12), (8, 6))
    assert crops.shape == (64, 4, 8, 6)
    for crop in crops:
        top, left = crop[0, 0, 0], crop[1, 0, 0]
        assert th.equal(crop, coordinates(1, 12)[0, :, top : top + 8, left : left + 6])


def test_random_shift_draws_every_shift_and_repeats_the_border() -> None:
    th.manual_seed(0)
    shifted = random_shift(coordinates(2_000, 9), pad=2)
    assert shifted.shape == (2_000, 4, 9, 9)
    offsets = {(int(row) - 4, int(column) - 4) for row, column in shifted[:, :2, 4, 4]}
    assert offsets == {(down, right) for down in range(-2, 3) for right in range(-2, 3)}
    for image in shifted[:50]:
        down, right = int(image[0, 4, 4]) - 4, int(image[1, 4, 4]) - 4
        rows = (th.arange(9) + down).clamp(0, 8)
        columns = (th.arange(9) + right).clamp(0, 8)
        assert th.equal(image, coordinates(1, 9)[0][:, rows][:, :, columns])


def test_center_crop_cuts_the_middle() -> None:
    crop = center_crop(coordinates(1, 100), 84)
    assert crop[0, 0, 0, 0] == crop[0, 1, 0, 0] == 8 and crop[0, 0, -1, -1] == 91


@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_contract_of_the_registry(name: str) -> None:
    images = th.randint(0, 256, (5, 9, 20, 20), dtype=th.uint8)
    before = images.clone()
    augmented = AUGMENTATIONS[name](images, **({"size": 16} if takes_size(name) else {}))
    assert augmented.dtype == th.uint8 and augmented.shape[:2] == (5, 9)
    assert th.equal(images, before), "the sampled batch must not be changed in place"


def test_random_conv_recolours_each_frame_of_a_stack_alike() -> None:
    frames = th.randint(0, 256, (6, 3, 10, 12), dtype=th.uint8)
    images = frames.repeat(1, 3, 1, 1)  # stacks of three equal frames
    th.manual_seed(0)
    recoloured = random_conv(images)
    th.manual_seed(0)
    kernels = th.randn(18, 3, 3, 3).view(6, 3, 3, 3, 3)
    for image, frame, kernel in zip(recoloured, frames, kernels, strict=True):
        padded = F.pad(frame[None] / 255, (1, 1, 1, 1), mode="replicate")
        expected = (255 * F.conv2d(padded, kernel).sigmoid()).round()
        for index in range(3):
            assert th.allclose(image[3 * index : 3 * index + 3].float(), expected[0], atol=1)  # a level of rounding
    with pytest.raises(ValueError, match="RGB frames, got 4"):
        random_conv(coordinates(2, 9))


def test_gray_frames_are_recoloured_and_overlaid_each_alike() -> None:
    images = th.randint(0, 256, (6, 1, 10, 12), dtype=th.uint8).repeat(1, 3, 1, 1)  # three gray frames, not one of RGB
    for augment in (random_conv, random_overlay):
        changed = augment(images, frame_channels=1)
        assert not th.equal(changed, images)
        assert th.equal(changed, changed[:, :1].expand_as(changed))
        assert augment(images[:, :2], frame_channels=1).shape == (6, 2, 10, 12)  # nor need there be a multiple of three
        with pytest.raises(ValueError, match=r"frame_channels=4 must be 3 \(RGB\) or 1 \(gray\)"):
            augment(images, frame_channels=4)
    th.manual_seed(0)
    colours = random_overlay(images, alpha=1.0).float()
    th.manual_seed(0)
    gray = random_overlay(images, alpha=1.0, frame_channels=1).float()
    assert th.allclose(gray[:, 0], 0.299 * colours[:, 0] + 0.587 * colours[:, 1] + 0.114 * colours[:, 2], atol=0.51)


def test_augmentations_are_reproducible_from_torchs_seed() -> None:
    images = th.randint(0, 256, (32, 3, 20, 20), dtype=th.uint8)
    for augment in (lambda: random_crop(images, 12), lambda: random_shift(images), lambda: random_conv(images)):
        th.manual_seed(1)
        first = augment()
        assert not th.equal(first, augment())
        th.manual_seed(1)
        assert th.equal(first, augment())


def test_bad_sizes_are_named() -> None:
    images = th.zeros(2, 3, 20, 20, dtype=th.uint8)
    with pytest.raises(ValueError, match="21x21.*20x20"):
        random_crop(images, 21)
    with pytest.raises(ValueError, match="pad=-1"):
        random_shift(images, -1)


@pytest.mark.parametrize(
    ("function", "returned"),
    [
        (lambda images: images / 255, r"Tensor of shape \(1, 3, 20, 20\) and type float32"),
        (lambda images: images[:, :1], r"Tensor of shape \(1, 1, 20, 20\) and type uint8"),
        (lambda images: images[0], r"Tensor of shape \(3, 20, 20\) and type uint8"),
        (lambda images: images.numpy(), r"ndarray of shape \(1, 3, 20, 20\) and type uint8"),
        (lambda images: None, "None"),
    ],
)
def test_what_is_no_batch_of_bytes_is_refused_before_training(
    monkeypatch: pytest.MonkeyPatch, function: Callable[[th.Tensor], Any], returned: str
) -> None:
    """Floats trained on black pictures."""
    monkeypatch.setitem(AUGMENTATIONS, "own", function)
    with pytest.raises(
        ValueError, match=rf"'own' turned.*into (a )?{returned}: it must return.*\(1, 3, height, width\).*uint8"
    ):
        augmented_input("own", {}, (3, 20, 20), (20, 20))


def test_pictures_may_lie_in_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No shell expands what a configuration says."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "places").mkdir()
    Image.new("RGB", (8, 8), (10, 20, 30)).save(tmp_path / "places" / "one.png")
    overlaid = random_overlay(th.zeros(1, 3, 6, 6, dtype=th.uint8), alpha=1.0, source="~/places")
    assert overlaid[0, :, 0, 0].tolist() == [10, 20, 30]
