"""Encoder and decoder: shapes, scaling, cropping, initialisation."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sb3_crc import CRCSAC, PixelDecoder, PixelEncoder
from sb3_crc.encoder import difference_mixing
from tests.conftest import POLICY_KWARGS, NoiseEnv


def image_space(channels: int = 9, height: int = 100, width: int | None = None) -> spaces.Box:
    return spaces.Box(0, 255, (channels, height, width or height), np.uint8)


def test_the_papers_encoder_has_the_published_shapes() -> None:
    encoder = PixelEncoder(image_space(), image_size=84)
    assert encoder.input_shape == (9, 84, 84)
    assert encoder.convolution_shape == (32, 35, 35)  # SAC+AE, CURL: 4 layers, 84 pixels
    assert encoder(th.zeros(2, 9, 100, 100, dtype=th.uint8)).shape == (2, 50)


def test_bytes_and_sb3s_scaled_floats_give_the_same_latent() -> None:
    space = image_space(3, 48)
    images = th.randint(0, 256, (4, 3, 48, 48), dtype=th.uint8)
    for center_input in (False, True):
        encoder = PixelEncoder(space, center_input=center_input)
        assert th.equal(encoder(images), encoder(preprocess_obs(images, space)))


def test_larger_frames_are_cropped_in_the_middle() -> None:
    encoder = PixelEncoder(image_space(3, 60), image_size=(48, 40))
    images = th.randint(0, 256, (4, 3, 60, 60), dtype=th.uint8)
    assert th.equal(encoder(images), encoder(images[:, :, 6:54, 10:50]))


def test_centred_input_is_a_half_lower() -> None:
    centred, plain = PixelEncoder(image_space(3, 40), center_input=True), PixelEncoder(image_space(3, 40))
    centred.load_state_dict(plain.state_dict())
    images = th.rand(2, 3, 40, 40)
    assert th.allclose(centred.convolve(images), plain.convolve(images - 0.5), atol=1e-5)  # the bias takes the shift


def test_tanh_bounds_the_latent() -> None:
    images = th.randint(0, 256, (8, 3, 40, 40), dtype=th.uint8)
    latents = PixelEncoder(image_space(3, 40), latent_activation="tanh")(images)
    assert latents.abs().max() < 1
    assert PixelEncoder(image_space(3, 40))(images).abs().max() > 1


def test_initialisation_is_orthogonal_and_delta_orthogonal() -> None:
    encoder = PixelEncoder(image_space(9, 48))
    kernel = encoder.convolutions[2].weight  # (32, 32, 3, 3)
    middle = kernel[:, :, 1, 1]
    assert th.allclose(middle @ middle.T, 2 * th.eye(32), atol=1e-5)  # gain sqrt 2
    assert kernel.count_nonzero() == middle.count_nonzero()  # nothing but the middle
    linear = encoder.projection[0]
    assert th.allclose(linear.weight @ linear.weight.T, th.eye(50), atol=1e-5)
    assert not linear.bias.any()


def test_orthogonal_kernels_are_dense_and_orthogonal() -> None:
    encoder = PixelEncoder(image_space(9, 48), initialization="orthogonal")
    kernel = encoder.convolutions[2].weight.flatten(start_dim=1)  # (32, 288)
    assert th.allclose(kernel @ kernel.T, 2 * th.eye(32), atol=1e-5)  # gain sqrt 2
    assert kernel.count_nonzero() == kernel.numel()
    with pytest.raises(ValueError, match=r"initialization 'ortogonal'.*did you mean 'orthogonal'"):
        PixelEncoder(image_space(9, 48), initialization="ortogonal")


@pytest.mark.parametrize("center_input", [False, True])
def test_the_encoder_is_fed_amplified_differences_and_the_newest_frame(center_input: bool) -> None:
    mixed = PixelEncoder(image_space(9, 40), frame_differences=4.0, center_input=center_input)
    plain = PixelEncoder(image_space(9, 40))
    plain.load_state_dict(mixed.state_dict())
    images = th.rand(2, 9, 40, 40)
    oldest, older, newest = images.split(3, dim=1)
    fed = th.cat([4 * (older - oldest), 4 * (newest - older), newest - 0.5 * center_input], dim=1)
    assert th.allclose(mixed.convolve(images), plain.convolve(fed), atol=1e-4)

    direction = th.randn(2, mixed.convolution_dim)
    for encoder, inputs in ((mixed, images), (plain, fed)):  # and learns as if it were
        (encoder.convolve(inputs) * direction).sum().backward()
    for mine, theirs in zip(mixed.convolutions.parameters(), plain.convolutions.parameters(), strict=True):
        assert th.allclose(mine.grad, theirs.grad, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("channels", "frame_channels"), [(3, 3), (9, 2), (4, 4)])
def test_differences_need_two_whole_frames(channels: int, frame_channels: int) -> None:
    with pytest.raises(ValueError, match=f"{frame_channels} channels, at least two: the stack has {channels}"):
        PixelEncoder(image_space(channels, 40), frame_differences=4.0, frame_channels=frame_channels)


@pytest.mark.parametrize(("size", "strides"), [(84, (2, 1, 1, 1)), (64, (2, 2, 2, 1)), (41, (2, 2)), (36, (2, 1, 1, 1))])
def test_the_decoder_mirrors_the_encoder(size: int, strides: tuple[int, ...]) -> None:
    channels = (8, 16, 16, 16)[: len(strides)]
    encoder = PixelEncoder(image_space(3, size), channels=channels, strides=strides)
    decoder = PixelDecoder(50, (3, size, size), channels=channels, strides=strides)
    assert decoder.start_shape == encoder.convolution_shape
    assert decoder(th.zeros(2, 50)).shape == (2, 3, size, size)


def test_the_encoder_serves_stock_sac() -> None:
    model = SAC(
        "CnnPolicy", NoiseEnv(), policy_kwargs={"features_extractor_class": PixelEncoder}, buffer_size=100, batch_size=8
    )
    model.learn(102)
    assert model.predict(NoiseEnv().reset()[0])[0].shape == (2,)


def test_bad_input_is_named() -> None:
    with pytest.raises(ValueError, match="12x12.*needs 15x15"):
        PixelEncoder(image_space(3, 12), channels=(8,) * 4, strides=(2, 1, 1, 1))
    with pytest.raises(ValueError, match=r"14x14 pixels, cut out of frames of 16x16 \(image_size.*84 %.*needs 15x15"):
        PixelEncoder(image_space(3, 16), image_size=(14, 14))
    with pytest.raises(ValueError, match="image_size=90.*64x64"):
        PixelEncoder(image_space(3, 64), image_size=90)
    with pytest.raises(ValueError, match="relu.*none, tanh"):
        PixelEncoder(image_space(3, 64), latent_activation="relu")
    with pytest.raises(ValueError, match="expected uint8 images"):
        PixelEncoder(spaces.Box(0, 1, (3, 64, 64), np.float32))


def test_differences_are_those_of_the_environments_frames() -> None:
    """Of gray pictures a frame has one channel."""

    def gray() -> NoiseEnv:
        return NoiseEnv(channels=1)

    own = {**POLICY_KWARGS["features_extractor_kwargs"], "frame_differences": 4.0}
    env = VecFrameStack(DummyVecEnv([gray]), 4, channels_order="first")
    model = CRCSAC("CnnPolicy", env, buffer_size=50, policy_kwargs={**POLICY_KWARGS, "features_extractor_kwargs": own})
    mixing = model.policy.critic.features_extractor.mixing
    assert mixing is not None and th.equal(mixing, difference_mixing(4, 1, 4.0))
