"""ReconstructionImageCallback: what the log's pictures show."""

from typing import Any

import pytest
import torch as th
from stable_baselines3.common.logger import Image, KVWriter, Logger

from sb3_crc.callbacks import ReconstructionImageCallback
from tests.callbacks.stock_models import seed, stock, weights
from tests.conftest import POLICY_KWARGS, NoiseEnv, make_model


class Recorder(KVWriter):
    """Keeps what a writer with images would get."""

    def __init__(self) -> None:
        self.images: list[Image] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        key = ReconstructionImageCallback.key
        if key in key_values:
            assert set(key_excluded[key]) == {"stdout", "log", "json", "csv"}
            self.images.append(key_values[key])

    def close(self) -> None:
        pass


@pytest.mark.parametrize("channels", [9, 4])
def test_reconstructions_reach_the_logger_as_images(channels: int) -> None:
    model = make_model(NoiseEnv(channels=channels))
    recorder = Recorder()
    model.set_logger(Logger(None, [recorder]))
    model.learn(40, callback=ReconstructionImageCallback(10, 3), log_interval=1)
    assert len(recorder.images) == 4  # episodes end every 10 steps
    side = model.critic.features_extractor.input_shape[1]
    image = recorder.images[0].image
    assert recorder.images[0].dataformats == "CHW"
    assert isinstance(image, th.Tensor) and image.dtype == th.uint8 and image.shape == (3, 2 * side, 3 * side)
    assert image[:, :side].float().std() > 30  # noise above, and grey below


@pytest.mark.parametrize("bits", [None, 5])
def test_the_picture_shows_the_newest_frame_and_the_decoders_output(bits: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(objectives={"reconstruction": {"weight": 1.0, "bits": bits}})
    callback = ReconstructionImageCallback(n_images=2)
    callback.init_callback(model)
    seed()
    assert model.replay_buffer is not None
    frames = model.replay_buffer.sample(2).observations
    top = left = (frames.shape[2] - 34) // 2
    expected = th.cat(list(frames[:, 6:, top : top + 34, left : left + 34]), dim=2)

    decoder = model.policy.objectives["reconstruction"].decoder
    monkeypatch.setattr(decoder, "forward", lambda latents: th.full((len(latents), 9, 34, 34), 0.4 if bits is None else -0.1))
    seed()
    picture = callback.picture()
    assert th.equal(picture[:, :34], expected)
    assert (picture[:, 34:] == round(0.4 * 255)).all()


@pytest.mark.parametrize("bits", [None, 5])
def test_a_standardised_decoder_that_knows_nothing_shows_the_mean_image(
    bits: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {"weight": 1.0, "bits": bits, "half_size": True, "standardize": True}
    encoder = {**POLICY_KWARGS["features_extractor_kwargs"], "frame_differences": 4.0}
    model = make_model(
        objectives={"reconstruction": settings}, policy_kwargs={**POLICY_KWARGS, "features_extractor_kwargs": encoder}
    )
    callback = ReconstructionImageCallback(n_images=2)
    callback.init_callback(model)
    decoder = model.policy.objectives["reconstruction"].decoder
    assert decoder(th.zeros(2, decoder.linear.in_features)).shape[2:] == (16, 16)  # of 34
    monkeypatch.setattr(decoder, "forward", lambda latents: th.zeros(len(latents), 9, 16, 16))
    seed()
    before = th.get_rng_state()
    picture = callback.picture()
    assert th.equal(th.get_rng_state(), before)
    assert picture.shape == (3, 68, 68)

    seed()
    assert model.replay_buffer is not None
    frames = model.replay_buffer.sample(64).observations  # noise: their mean image is almost grey
    top = left = (frames.shape[2] - 34) // 2
    mean = frames[:, 6:, top : top + 34, left : left + 34][:, :, 1:33:2, 1:33:2].float().mean(dim=0)
    expected = th.nn.functional.interpolate(mean[None], (34, 34))[0]
    for column in (0, 34):
        difference = picture[:, 34:, column : column + 34] - expected
        assert difference.abs().max() < (1 if bits is None else 5)  # 5 bits: levels of 8, dithered, over 64 frames


def test_pictures_do_not_change_the_run() -> None:
    results = []
    for callback in (None, ReconstructionImageCallback(5)):
        model = make_model()
        model.learn(20, callback=callback, reset_num_timesteps=False)  # past learning_starts
        results.append(weights(model.policy))
    assert all(th.equal(results[0][name], results[1][name]) for name in results[0])


def test_reconstruction_images_refusals() -> None:
    for kwargs, message in (
        ({"every": 0}, "every=0 must be at least 1"),
        ({"n_images": 0}, "n_images=0 must be at least 1"),
        ({"frame_channels": 2}, "frame_channels=2 must be 1, 3 or None"),
    ):
        with pytest.raises(ValueError, match=message):
            ReconstructionImageCallback(**kwargs)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no reconstruction among the model's objectives"):
        make_model(objectives={"contrastive": 1.0}).learn(1, callback=ReconstructionImageCallback())
    with pytest.raises(ValueError, match="ReconstructionImageCallback is for CRCSAC, got SAC"):
        stock().learn(1, callback=ReconstructionImageCallback())
