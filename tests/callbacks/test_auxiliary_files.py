"""AuxiliaryLossCallback: what it saves beside a model, and how training goes on from that."""

import io
import json
import subprocess
import sys
import zipfile
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback
from stable_baselines3.common.monitor import Monitor

from sb3_crc import PixelEncoder
from sb3_crc.callbacks import AuxiliaryLossCallback
from tests.callbacks.stock_models import BatchNormCNN, live_extractor, moved, noise_env, seed, stock, weights

LOAD_WITHOUT_US = """
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "sb3_crc":
            raise ImportError("sb3_crc is blocked")
sys.meta_path.insert(0, Block())
import warnings
warnings.simplefilter("error")
import numpy as np, stable_baselines3
model = stable_baselines3.SAC.load(sys.argv[1], device="cpu")
print(model.predict(np.zeros((3, 36, 36), np.uint8), deterministic=True)[0].shape, "save" in vars(model))
assert not any(name.startswith("sb3_crc") for name in sys.modules)
"""


def test_the_models_zip_needs_nothing_of_ours(tmp_path: Path) -> None:
    model = stock()
    callback = AuxiliaryLossCallback()
    model.learn(16, callback=callback)
    model.save(tmp_path / "model", include=["save"])
    assert (tmp_path / "model.aux.zip").exists()
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        assert "save" not in json.loads(archive.read("data"))
        assert not any(b"sb3_crc" in archive.read(name) for name in archive.namelist())
    command = [sys.executable, "-c", LOAD_WITHOUT_US, str(tmp_path / "model.zip")]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.stdout.strip() == "(2,) False", result.stderr


def test_every_save_writes_the_file_beside_it(tmp_path: Path) -> None:
    model = stock()
    callbacks = [
        CheckpointCallback(8, str(tmp_path / "checkpoints")),
        EvalCallback(
            Monitor(noise_env()), n_eval_episodes=1, eval_freq=10, best_model_save_path=str(tmp_path / "best"), verbose=0
        ),
        AuxiliaryLossCallback(),
    ]
    model.learn(16, callback=callbacks)
    model.save(str(tmp_path / "after.zip"))
    model.save(tmp_path / "model.v2")
    zips = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert zips == {
        "checkpoints/rl_model_8_steps.zip",
        "checkpoints/rl_model_8_steps.aux.zip",
        "checkpoints/rl_model_16_steps.zip",
        "checkpoints/rl_model_16_steps.aux.zip",
        "best/best_model.zip",
        "best/best_model.aux.zip",
        "after.zip",
        "after.aux.zip",
        "model.v2",  # SB3 adds .zip to names without a dot only
        "model.v2.aux.zip",
    }
    for path in tmp_path.rglob("*.aux.zip"):
        AuxiliaryLossCallback.load(path)


def test_save_alone_streams_and_giving_save_back(tmp_path: Path) -> None:
    model = stock()
    callback = AuxiliaryLossCallback()
    with pytest.raises(RuntimeError, match="nothing to save"):
        callback.save(tmp_path / "model")
    model.learn(16, callback=callback)
    stream = io.BytesIO()
    with pytest.warns(UserWarning, match=r"AuxiliaryLossCallback.save\(path\)"):
        model.save(stream)
    assert stream.tell() > 0
    assert callback.save(tmp_path / "new" / "model.zip") == tmp_path / "new" / "model.aux.zip"
    del model.save  # type: ignore[method-assign]
    model.save(tmp_path / "plain")
    assert not (tmp_path / "plain.aux.zip").exists()


@pytest.mark.parametrize("algorithm", ["sac", "td3-shared", "tqc", "dqn"])
def test_after_loading_one_step_moves_the_live_extractor(algorithm: str, tmp_path: Path) -> None:
    model = stock(algorithm)
    model.learn(16, callback=AuxiliaryLossCallback())
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")

    loaded = type(model).load(tmp_path / "model", env=model.get_env(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    before = weights(live_extractor(loaded))
    callback = AuxiliaryLossCallback.load(tmp_path / "model")
    loaded.learn(1, callback=callback, reset_num_timesteps=False)
    assert callback.learner is not None and callback.learner.n_updates == 5
    assert moved(before, live_extractor(loaded)) == set(before)


EXTRACTORS: dict[str, dict[str, Any]] = {
    "nature": {},
    "batch_norm": {"features_extractor_class": BatchNormCNN},
    "pixel_encoder": {
        "features_extractor_class": PixelEncoder,
        "features_extractor_kwargs": {"channels": [4], "strides": [2], "features_dim": 8},
    },
}


@pytest.mark.parametrize("extractor", EXTRACTORS)
def test_continuation_is_equal_bit_for_bit(extractor: str, tmp_path: Path) -> None:
    model = stock(learning_rate=1e-3, policy_kwargs=EXTRACTORS[extractor])
    callback = AuxiliaryLossCallback(gradient_steps=2)
    model.learn(20, callback=callback)
    model.save(tmp_path / "model")
    loaded = SAC.load(tmp_path / "model", env=model.get_env(), device="cpu")
    loaded.replay_buffer = deepcopy(model.replay_buffer)
    loaded_callback = AuxiliaryLossCallback.load(tmp_path / "model")
    loaded_callback.init_callback(loaded)
    loaded.set_logger(model.logger)

    for one, its_callback in ((model, callback), (loaded, loaded_callback)):
        seed()
        for _ in range(3):
            its_callback.on_rollout_end()
            one.train(batch_size=8, gradient_steps=1)
        one.save(tmp_path / f"{id(its_callback)}")

    assert not moved(weights(model.policy), loaded.policy)
    first, second = (dict(each.learner._state()) for each in (callback, loaded_callback) if each.learner is not None)
    assert first.keys() == second.keys() and any(name.startswith("adam/encoder/") for name in first)
    assert all(th.equal(first[name], second[name]) for name in first)
    assert callback.settings == loaded_callback.settings


def test_a_second_learn_goes_on_and_another_model_starts_afresh(tmp_path: Path) -> None:
    callback = AuxiliaryLossCallback()
    model, other = stock(), stock()
    model.learn(16, callback=callback)
    first = callback.learner
    model.learn(4, callback=callback, reset_num_timesteps=False)
    assert callback.learner is first and first is not None and first.n_updates == 8
    before = weights(live_extractor(model))
    other.learn(16, callback=callback)
    assert callback.learner is not first and not moved(before, live_extractor(model))
    model.save(tmp_path / "model")  # each model goes on saving what is its own
    assert AuxiliaryLossCallback.load(tmp_path / "model")._loaded[0]["n_updates"] == 8  # type: ignore[index]


def test_loading_with_changes_and_what_does_not_fit(tmp_path: Path) -> None:
    model = stock()
    model.learn(16, callback=AuxiliaryLossCallback({"contrastive": 1.0}))
    model.save(tmp_path / "model")
    changed = AuxiliaryLossCallback.load(tmp_path / "model", gradient_steps=2, learning_rate=0.5)
    changed.init_callback(model)
    assert changed.settings.gradient_steps == 2 and changed.settings.objectives == {"contrastive": 1.0}

    wrong = AuxiliaryLossCallback.load(tmp_path / "model", objectives={"reconstruction": 1.0})
    with pytest.raises(ValueError, match="does not fit this model and these objectives"):
        wrong.init_callback(stock())
    with pytest.warns(UserWarning, match="saved after 4 updates of the model, this model has made 0"):
        AuxiliaryLossCallback.load(tmp_path / "model").init_callback(stock())
    with pytest.raises(FileNotFoundError, match="no auxiliary state at .*absent.aux.zip"):
        AuxiliaryLossCallback.load(tmp_path / "absent")

    saved = (tmp_path / "model.aux.zip").read_bytes()
    (tmp_path / "cut.aux.zip").write_bytes(saved[: len(saved) // 2])
    (tmp_path / "model.zip").rename(tmp_path / "other.aux.zip")
    for damaged in ("cut", "other"):
        with pytest.raises(ValueError, match=f"{damaged}.aux.zip is not an auxiliary state"):
            AuxiliaryLossCallback.load(tmp_path / damaged)
