"""Convolutions in bfloat16, everything else in float32; frames beside the networks or not."""

from typing import Any

import pytest
import torch as th

from sb3_crc import CRCSAC, FrameReplayBuffer, augmentations
from sb3_crc.augmentations import random_crop, random_shift
from sb3_crc.buffers.placement import PlacedReplayBuffer
from sb3_crc.buffers.store import FrameStacks
from sb3_crc.convolutions import fastest_convolutions
from tests.conftest import make_model

HALF = th.bfloat16


def test_only_convolutions_compute_in_bfloat16() -> None:
    model = make_model(precision="bfloat16")
    types: dict[str, set[th.dtype]] = {}

    def note(name: str) -> Any:
        return lambda module, inputs, output: types.setdefault(name, set()).update({inputs[0].dtype, output.dtype})

    policy = model.policy
    networks = {"encoder": policy.critic.features_extractor, "key": policy.key_encoder}
    for name, encoder in networks.items():
        encoder.convolutions.register_forward_hook(note(name))
        encoder.projection.register_forward_hook(note(f"{name}'s projection"))
    policy.objectives["reconstruction"].decoder.deconvolutions.register_forward_hook(note("decoder"))
    policy.objectives["reconstruction"].decoder.register_forward_hook(note("painted"))
    policy.actor.mu.register_forward_hook(note("actor"))
    policy.critic.q_networks[0].register_forward_hook(note("q"))
    model.train(gradient_steps=2, batch_size=16)
    assert {name for name, found in types.items() if found == {HALF}} == {"encoder", "key", "decoder"}
    assert all(found == {th.float32} for name, found in types.items() if name not in ("encoder", "key", "decoder"))
    assert all(tensor.dtype == th.float32 for tensor in policy.parameters())


def test_bfloat16_is_float32_to_its_eight_bits() -> None:
    models = make_model(), make_model(precision="bfloat16")
    images = th.randint(256, (8, 9, 34, 34), dtype=th.uint8)
    one, other = (model.policy.critic.features_extractor(images) for model in models)
    assert not th.equal(one, other)
    th.testing.assert_close(one, other, rtol=0.1, atol=0.1)
    gradients = []
    for model in models:
        th.manual_seed(0)
        latent = model.policy.critic.features_extractor(images)
        parameters = list(model.policy.critic.features_extractor.parameters())
        found = th.autograd.grad(latent.square().sum() + latent[:, 0].sum(), parameters)
        assert all(gradient.dtype == th.float32 for gradient in found)
        gradients.append(th.cat([gradient.flatten() for gradient in found]))
    assert th.cosine_similarity(*gradients, dim=0) > 0.99


def test_a_decoder_in_bfloat16_paints_the_same_and_passes_gradients_on() -> None:
    decoders = [
        make_model(precision=precision).policy.objectives["reconstruction"].decoder for precision in ("float32", "bfloat16")
    ]
    latents = th.randn(4, 16)
    painted, gradients = [], []
    for decoder in decoders:
        latent = latents.clone().requires_grad_()
        images = decoder(latent)
        painted.append(images)
        gradients.append(th.autograd.grad(images.square().sum(), [latent, *decoder.parameters()]))
    th.testing.assert_close(*painted, rtol=0.1, atol=0.05)
    for one, other in zip(*gradients, strict=True):
        assert other.dtype == th.float32
        assert th.cosine_similarity(one.flatten(), other.flatten(), dim=0) > 0.99


@pytest.mark.parametrize(("name", "value"), [("precision", "float16"), ("replay_device", "gpu")])
def test_what_is_not_known_is_named(name: str, value: str) -> None:
    with pytest.raises(ValueError, match=f"unknown {name} '{value}'"):
        make_model(**{name: value})


def test_frames_that_do_not_fit_beside_the_networks_stay_with_the_host(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(PlacedReplayBuffer, "fits", lambda self, device: asked.append(device) or False)
    buffers = [make_model(replay_device=place).replay_buffer for place in ("auto", "model", "cpu")]
    assert all(isinstance(buffer, FrameReplayBuffer) for buffer in buffers)
    assert [buffer._frame_device and buffer._frame_device.type for buffer in buffers] == ["cpu", None, "cpu"]  # type: ignore[union-attr]
    assert len(asked) == 1


def test_frames_elsewhere_are_brought_to_where_they_are_needed() -> None:
    """``meta`` stands for a GPU: what comes there has shape and type, and meets nothing of the host."""
    model = make_model(replay_device="cpu")
    buffer = model.replay_buffer
    assert isinstance(buffer, FrameReplayBuffer) and buffer.empty_copy(20, None)._frame_device == th.device("cpu")
    whole, frames = buffer.sample(4), buffer.sample_frames(4)
    buffer.device = th.device("meta")
    assert buffer.store.device.type == "cpu"
    brought, lying = buffer.sample(4), buffer.sample_frames(4)
    for name in ("observations", "actions", "next_observations", "dones", "rewards"):
        mine, here = getattr(brought, name), getattr(whole, name)
        assert (mine.device.type, mine.shape, mine.dtype) == ("meta", here.shape, here.dtype)
    assert isinstance(lying.observations, FrameStacks) and lying.observations.shape == frames.observations.shape  # type: ignore[union-attr]
    window = lying.observations.windows(th.zeros(4, dtype=th.int64), th.ones(4, dtype=th.int64), (5, 6))
    assert (window.device.type, tuple(window.shape)) == ("meta", (4, 9, 5, 6))


@pytest.mark.parametrize("pad", [0, 1, 4])
def test_what_a_gpu_gathers_is_what_a_cpu_slices(pad: int, monkeypatch: pytest.MonkeyPatch) -> None:
    images = th.randint(256, (16, 9, 12, 10), dtype=th.uint8)
    results = []
    for on_gpu in (False, True):
        monkeypatch.setattr(augmentations, "_on_gpu", lambda images, on_gpu=on_gpu: on_gpu)
        th.manual_seed(0)
        results.append((random_shift(images, pad), random_crop(images, (8, 7)), random_crop(images, 9, last_offset=False)))
    assert all(map(th.equal, *results))


@pytest.mark.parametrize("deterministic", [False, True])
def test_cudnn_looks_for_its_fastest_only_where_nothing_must_repeat(deterministic: bool) -> None:
    before = th.backends.cudnn.benchmark, th.backends.cudnn.deterministic
    th.backends.cudnn.deterministic = deterministic
    try:
        with fastest_convolutions():
            assert th.backends.cudnn.benchmark is not deterministic
        assert th.backends.cudnn.benchmark is before[0]
    finally:
        th.backends.cudnn.deterministic = before[1]


def test_a_model_in_bfloat16_learns_and_its_policy_is_exported_as_float32(tmp_path: Any) -> None:
    model = make_model(precision="bfloat16")
    model.learn(45)
    model.save(tmp_path / "model")
    loaded = CRCSAC.load(tmp_path / "model")
    assert loaded.policy.critic.features_extractor.convolution_dtype == HALF
    assert loaded.policy.key_encoder.convolution_dtype == HALF
