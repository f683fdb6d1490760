"""What only a GPU can show. Everywhere else these tests are skipped."""

from collections.abc import Iterator
from typing import Any

import pytest
import torch as th

from sb3_crc import CRCSAC, PRESETS
from sb3_crc.augmentations import random_crop, random_shift
from tests.conftest import NoiseEnv, make_model

pytestmark = pytest.mark.skipif(not th.cuda.is_available(), reason="no CUDA")
OWN = ("batch_size", "buffer_size", "learning_starts", "initial_updates")
PRESET_SETTINGS = {name: {k: v for k, v in own.items() if k not in OWN} for name, own in PRESETS.items()}


@pytest.fixture(autouse=True)
def exact() -> Iterator[None]:
    """Convolutions in float32, not in TF32, which torch takes for them by default."""
    before = th.backends.cudnn.allow_tf32
    th.backends.cudnn.allow_tf32 = False
    yield
    th.backends.cudnn.allow_tf32 = before


@pytest.mark.parametrize("preset", PRESETS)
def test_losses_on_a_gpu_are_those_on_a_cpu(preset: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(th.distributions.Normal, "rsample", lambda self, shape=(): self.loc)  # devices draw other actions
    models = [make_model(device=device, **PRESET_SETTINGS[preset]) for device in ("cpu", "cuda")]
    models[1].policy.load_state_dict(models[0].policy.state_dict())
    for model in models:
        model.set_random_seed(1)
        model.auxiliary_interval, model.reencode = 1, False  # Adam's first step makes much of the last digits
        model.train(gradient_steps=1, batch_size=16)
    cpu, cuda = (model.logger.name_to_value for model in models)
    objectives = models[0].policy.objectives.items()
    same = [f"representation/{name}" for name, objective in objectives if getattr(objective, "bits", None) is None]
    for name in ("train/critic_loss", *same):  # what is painted with fewer bits has noise of the device in it
        assert cuda[name] == pytest.approx(cpu[name], rel=1e-4), name


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("preset", PRESETS)
def test_recorded_updates_are_those_that_are_launched_one_by_one(preset: str, precision: str) -> None:
    models = [make_model(device="cuda", compile=on, precision=precision, **PRESET_SETTINGS[preset]) for on in (False, True)]
    for model in models:
        model.set_random_seed(1)  # numpy's too, with which batches are drawn
        model.train(gradient_steps=16, batch_size=16)
    assert models[1]._recorded is not None and models[1]._recorded._recordings
    for one, other in zip(models[0].policy.parameters(), models[1].policy.parameters(), strict=True):
        th.testing.assert_close(one, other, rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("own", [*PRESET_SETTINGS.values(), {"augmentation": "random_shift"}])
def test_an_update_waits_for_nothing(own: dict[str, Any], compiled: bool) -> None:
    model = make_model(device="cuda", compile=compiled, **own)
    model.train(gradient_steps=12, batch_size=16)
    th.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(4):
            model._n_updates += 1
            views = model._sample_views(16)
            _ = model._replayed(views) if compiled else model._update(views)
    finally:
        th.cuda.set_sync_debug_mode("default")


def test_frames_in_the_hosts_memory_train_the_same() -> None:
    models = [make_model(device="cuda", replay_device=place) for place in ("model", "cpu")]
    assert [model.replay_buffer.frame_device.type for model in models] == ["cuda", "cpu"]  # type: ignore[union-attr]
    for model in models:
        model.set_random_seed(1)  # numpy's too, with which batches are drawn
        model.train(gradient_steps=4, batch_size=16)
    for one, other in zip(models[0].policy.parameters(), models[1].policy.parameters(), strict=True):
        th.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


def test_crops_and_shifts_are_those_of_a_cpu() -> None:
    images = th.randint(256, (16, 9, 12, 10), dtype=th.uint8)
    for augment in (lambda x: random_shift(x, 3), lambda x: random_crop(x, (8, 7))):
        results = []
        for device in ("cpu", "cuda"):
            th.manual_seed(0)
            results.append(augment(images.to(device)).cpu())
        assert th.equal(*results)


def test_a_model_of_recorded_updates_learns_saves_and_loads(tmp_path: Any) -> None:
    model = make_model(device="cuda", compile=True, precision="bfloat16")
    model.learn(80)
    model.save(tmp_path / "model")
    for device in ("cpu", "cuda"):
        loaded = CRCSAC.load(tmp_path / "model", env=NoiseEnv(), device=device)
        loaded.learn(60)
        assert all(bool(th.isfinite(parameter).all()) for parameter in loaded.policy.parameters())
