"""Nothing in a file that CRCSAC has saved is executed when it is loaded; what would be is named, or refused."""

import io
import json
import warnings
import zipfile
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import SAC
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule
from torch import nn

from sb3_crc import CRCSAC, FrameReplayBuffer, PixelEncoder, make_dmc
from sb3_crc.plain import NotPlain, from_plain, read_plain_attributes, to_plain
from sb3_crc.saved_model import PICKLE, PLAIN
from sb3_crc.zoo.manager import CRCExperimentManager
from tests.conftest import POLICY_KWARGS, NoiseEnv, make_model


@pytest.fixture
def no_pickles(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any, **kwargs: Any) -> Any:
        raise AssertionError("something was unpickled")

    monkeypatch.setattr("stable_baselines3.common.save_util.cloudpickle.loads", refuse)
    monkeypatch.setattr("pickle.loads", refuse)


def data_of(path: Path) -> dict[str, Any]:
    with zipfile.ZipFile(path) as archive:
        content: dict[str, Any] = json.loads(archive.read("data"))
        return content


def rewritten(path: Path, target: Path, **members: str) -> Path:
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            if members.get(name, "") is not None:
                new.writestr(name, members.get(name, old.read(name)))
    return target


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"learning_rate": "lin_0.001"},
        {"policy_kwargs": {**POLICY_KWARGS, "activation_fn": nn.ELU, "features_extractor_class": PixelEncoder}},
        {"replay_buffer_class": FrameReplayBuffer, "replay_buffer_kwargs": {"frame_channels": None}},
        {"objectives": {"contrastive": {"weight": 0.5, "key": "bootstrap"}}, "n_steps": 3, "train_freq": (2, "step")},
    ],
    ids=["defaults", "schedule", "classes", "buffer", "objectives"],
)
@pytest.mark.usefixtures("no_pickles")
def test_our_own_files_unpickle_nothing(tmp_path: Path, settings: dict[str, Any]) -> None:
    model = make_model(**settings)
    model.learn(4, reset_num_timesteps=False)
    model.save(tmp_path / "model")
    assert any(isinstance(value, dict) and PICKLE in value for value in data_of(tmp_path / "model.zip").values())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = CRCSAC.load(tmp_path / "model", env=NoiseEnv(), device="cpu", safe=True)
    observations = np.random.default_rng(0).integers(0, 256, (3, *NoiseEnv().observation_space.shape), np.uint8)  # type: ignore[misc]
    assert np.array_equal(
        loaded.predict(observations, deterministic=True)[0], model.predict(observations, deterministic=True)[0]
    )
    for name in data_of(tmp_path / "model.zip"):
        mine, theirs = getattr(loaded, name), getattr(model, name)
        if name not in ("_last_obs", "_last_original_obs", "lr_schedule", "_last_episode_starts") and not callable(mine):
            assert mine == theirs or name == "learning_rate", name
    loaded.learn(60, reset_num_timesteps=True)
    assert loaded.lr_schedule(0.5) == model.lr_schedule(0.5)


@pytest.mark.parametrize(("learning_rate", "share"), [("lin_0.001", 0.25), ("lin_0.001_0.9", 1 / 6), (0.001, 1)])
def test_what_the_zoo_trains_is_saved_without_pickles(learning_rate: float | str, share: float, tmp_path: Path) -> None:
    settings = CRCExperimentManager._preprocess_schedules({"learning_rate": learning_rate, "batch_size": 8})
    assert settings["batch_size"] == 8 and callable(settings["learning_rate"])
    make_model(learning_rate=settings["learning_rate"]).save(tmp_path / "model")
    loaded = CRCSAC.load(tmp_path / "model", device="cpu", safe=True)
    assert loaded.lr_schedule(0.25) == pytest.approx(0.001 * share) and loaded.learning_rate(0.25) == loaded.lr_schedule(0.25)  # type: ignore[operator]


@pytest.mark.usefixtures("no_pickles")
def test_beside_a_folder_of_its_name(tmp_path: Path) -> None:
    """As rl_zoo3 does it."""
    (tmp_path / "model").mkdir()
    model = make_model()
    model.save(tmp_path / "model")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model", "model.zip"]
    CRCSAC.load(tmp_path / "model.zip", device="cpu", safe=True)


@pytest.mark.usefixtures("no_pickles")
def test_streams_and_dicts(tmp_path: Path) -> None:
    env = make_dmc("cartpole-swingup", seed=0, image_size=36, frame_stack=2, render_quality="fast", observation="dict")
    model = CRCSAC("MultiInputPolicy", env, buffer_size=50, policy_kwargs=POLICY_KWARGS, device="cpu")
    stream = io.BytesIO()
    model.save(stream)  # type: ignore[arg-type]
    stream.seek(0)
    loaded = CRCSAC.load(stream, device="cpu", safe=True)  # type: ignore[arg-type]
    assert loaded.observation_space == model.observation_space and loaded.action_space == model.action_space
    env.close()


class Own(PixelEncoder):
    pass


def test_what_has_no_plain_form_is_named_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(policy_kwargs={**POLICY_KWARGS, "features_extractor_class": Own})
    model.save(tmp_path / "model")
    with pytest.warns(UserWarning, match="reading policy_kwargs executes what is in the file"):
        assert CRCSAC.load(tmp_path / "model", device="cpu").policy.features_extractor_class is Own
    with pytest.raises(ValueError, match="reading policy_kwargs would execute what is in the file"):
        CRCSAC.load(tmp_path / "model", device="cpu", safe=True)
    monkeypatch.setenv("SB3_CRC_SAFE_LOAD", "1")
    with pytest.raises(ValueError, match="would execute"):
        CRCSAC.load(tmp_path / "model", device="cpu")
    given = {"policy_kwargs": model.policy_kwargs}
    assert CRCSAC.load(tmp_path / "model", device="cpu", custom_objects=given).policy.features_extractor_class is Own


def test_files_of_before_and_of_strangers(tmp_path: Path) -> None:
    make_model().save(tmp_path / "model")
    older = rewritten(tmp_path / "model.zip", tmp_path / "older.zip", **{PLAIN: "{}"})
    with pytest.warns(UserWarning, match=r"reading policy_class, .* executes"):
        CRCSAC.load(older, device="cpu")
    with pytest.raises(ValueError, match="would execute"):
        CRCSAC.load(older, device="cpu", safe=True)
    deep = '{"type": "list", "items": [' * 400 + "]}" * 400
    box = '{"type": "box", "shape": [3], "dtype": "f4,(2,"}'
    forms = ('{"type": "class", "name": "Popen"}', '{"type": "discrete", "n": Infinity, "start": 0}', box, deep)
    for text in ("[]", "{", '{"a": 1, "a": 2}', "[" * 100_000, *(f'{{"a": {form}}}' for form in forms)):
        hostile = rewritten(tmp_path / "model.zip", tmp_path / "hostile.zip", **{PLAIN: text})
        with pytest.raises(ValueError, match=r"plain\.json cannot be read"):
            CRCSAC.load(hostile, device="cpu")


def test_damaged_files_are_named(tmp_path: Path) -> None:
    """Whatever zipfile raises of them."""
    make_model().save(tmp_path / "model")
    whole = (tmp_path / "model.zip").read_bytes()
    entry, path = whole.rindex(b"PK\x01\x02"), tmp_path / "damaged.zip"
    for place, byte in ((8, 1), (10, 99), (10, 8)):  # encrypted; by an unknown method; compressed
        content = bytearray(whole)
        content[entry + place] = byte
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"damaged\.zip wasn't a zip-file, or is truncated or damaged: ."):
            CRCSAC.load(path, device="cpu")
    for data, message in (("{", "damaged: "), ("[]", "not saved by CRCSAC"), ('{"policy_class": 1}', "not saved by CRCSAC")):
        with pytest.raises(ValueError, match=rf"damaged\.zip.*{message}"):
            CRCSAC.load(rewritten(tmp_path / "model.zip", path, data=data), device="cpu")


def test_sb3_reads_them_too(tmp_path: Path) -> None:
    """Its own SAC cannot hold our arguments, but its reader takes the file as one of its own."""
    from stable_baselines3.common.save_util import load_from_zip_file

    model = make_model()
    model.save(tmp_path / "model")
    data, parameters, _ = load_from_zip_file(tmp_path / "model.zip", device="cpu")
    assert data is not None and data["observation_space"] == model.observation_space
    assert all(th.equal(parameters["policy"][key], value) for key, value in model.policy.state_dict().items())
    assert issubclass(CRCSAC, SAC)


VALUES: list[Any] = [
    spaces.Box(-np.inf, np.inf, (3,), np.float32),
    spaces.Box(np.array([0, -1], np.float32), np.array([1, 2], np.float32)),
    spaces.Dict({"pixels": spaces.Box(0, 255, (9, 4, 4), np.uint8), "position": spaces.Box(-1, 1, (2,))}),
    spaces.Dict({"mode": spaces.Discrete(3, start=1)}),
    TrainFreq(3, TrainFrequencyUnit.EPISODE),
    deque([{"r": 1.5, "l": 3}], maxlen=100),
    {"a": (1, [2, None]), 3: nn.ReLU},
    np.float32(1.5),
]


@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
def test_plain_forms(value: Any) -> None:
    read = from_plain(json.loads(json.dumps(to_plain(value))))
    assert read == value and type(read) is type(value)
    if isinstance(value, deque):
        assert read.maxlen == value.maxlen


def test_arrays_and_schedules() -> None:
    for array in (
        np.arange(6, dtype=np.uint8).reshape(2, 3),
        np.zeros((0, 2)),
        np.asfortranarray(np.eye(3, dtype=np.float32)),
    ):
        read = from_plain(to_plain(array))
        assert np.array_equal(read, array) and read.dtype == array.dtype
    schedule = from_plain(to_plain(FloatSchedule(LinearSchedule(1.0, 0.2, 0.5))))
    assert [schedule(left) for left in (1.0, 0.75, 0.2)] == [1.0, 0.6, 0.2]
    for value in (lambda left: left, FloatSchedule(lambda left: left), np.array([{}]), Own, object()):
        with pytest.raises(NotPlain):
            to_plain(value)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**12), 10**12) | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(
                ["type", "items", "shape", "dtype", "low", "high", "npy", "length", "name", "frequency", "unit", "linear"]
            ),
            inner
            | st.sampled_from(
                ["box", "array", "deque", "class", "schedule", "mapping", "dict space", "train_freq", "float32"]
            ),
            max_size=5,
        )
    ),
    max_leaves=12,
)


@given(form=JSON)
def test_any_json_is_read_or_refused(form: Any) -> None:
    with suppress(NotPlain):
        read_plain_attributes(json.dumps({"attribute": form}))
