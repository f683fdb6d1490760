"""Whatever the input is: it works, or one clear error of a documented kind says why not."""

import json
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from hypothesis import strategies as st

from sb3_crc import CRCSAC, FrameReplayBuffer
from sb3_crc.augmentations import AUGMENTATIONS
from sb3_crc.checkpoints.callback import TrainingCheckpoint
from sb3_crc.checkpoints.store import CheckpointError, CheckpointStore
from sb3_crc.configurations import read_settings, with_overrides
from sb3_crc.experiments.specs import read_sweep
from sb3_crc.export import PolicyFileError, export_policy, load_policy
from tests.conftest import POLICY_KWARGS, NoiseEnv, make_model
from tests.fuzz.tiers import tiers
from tests.test_zoo import ROOT

#: What bad input may raise; FileNotFoundError where a file is named
DOCUMENTED = (ValueError, TypeError, FileNotFoundError)


@contextmanager
def quietly() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def says_why(error: BaseException, name: str = "") -> None:
    message = str(error)
    assert message.strip() and name in message, repr(error)


# -- Arguments ---------------------------------------------------------------------------------------------------------

NUMBERS = st.sampled_from([0, 1, 2, 3, -1, 0.0, 0.5, 1.0, 1.5, -0.1, 1e-3, 1e9, float("nan"), float("inf"), True])
ANYTHING = NUMBERS | st.none() | st.text(max_size=6) | st.just([]) | st.just({}) | st.just([1, 2]) | st.just({"weight": 1})
RATES = NUMBERS | st.sampled_from(["lin_0.001", "lin_x", "lin_", "exp_1", "lin_-1"])
OWN_SETTINGS = st.dictionaries(
    st.sampled_from(["weight", "key", "reduction", "bits", "target", "standardize", "half_size", "symmetric", "nothing"]),
    ANYTHING | st.sampled_from(["positive", "next", "bootstrap", "mean", "sum", "clean", "anchor"]),
    max_size=3,
)
OBJECTIVES = st.dictionaries(
    st.sampled_from(["contrastive", "reconstruction", "consistency", "contrastve", "os.path", "tests.fuzz.Missing", ""]),
    NUMBERS | OWN_SETTINGS,
    max_size=3,
)
ENCODER = st.fixed_dictionaries(
    {},
    optional={
        "channels": st.lists(st.integers(-1, 8), max_size=3),
        "strides": st.lists(st.integers(-1, 3), max_size=3),
        "features_dim": st.integers(-1, 16),
        "latent_activation": st.sampled_from(["none", "tanh", "relu", ""]),
        "frame_differences": NUMBERS,
        "frame_channels": st.integers(-1, 5),
        "initialization": st.sampled_from(["orthogonal", "delta_orthogonal", "zero"]),
        "center_input": st.booleans(),
        "image_size": st.integers(-1, 50) | st.none(),
        "unknown": st.just(1),
    },
)
POLICY = st.fixed_dictionaries(
    {"net_arch": st.just([16]) | st.lists(st.integers(0, 16), max_size=2), "features_extractor_kwargs": ENCODER},
    optional={
        "n_critics": st.integers(-1, 3),
        "actor_features": st.sampled_from(["conv", "latent", "none"]),
        "layer_norm": st.booleans(),
        "encoder_steps": st.integers(-1, 3),
        "log_std_bounds": st.sampled_from([(-10, 2), (2, -10), (0, 0)]),
    },
)
ARGUMENTS: dict[str, st.SearchStrategy[Any]] = {
    **dict.fromkeys(["learning_rate", "qf_learning_rate", "encoder_learning_rate", "ent_coef_learning_rate"], RATES),
    **dict.fromkeys(["tau", "encoder_tau", "gamma", "reward_scale", "max_grad_norm"], NUMBERS | st.none()),
    **dict.fromkeys(["target_update_interval", "policy_delay", "auxiliary_interval", "n_steps"], NUMBERS),
    **dict.fromkeys(["q_augmentations", "target_augmentations"], st.integers(-1, 3) | st.just(1.5)),
    "initial_updates": st.integers(-1, 2) | st.just(0.5),
    "gradient_steps": st.integers(-2, 2),
    "batch_size": st.integers(-1, 12) | st.just(2.5),
    "buffer_size": st.integers(-1, 30),
    "ent_coef": st.sampled_from(["auto", "auto_0.1", "auto_x", 0.1, 0, -1, "0.1", ""]),
    "objectives": OBJECTIVES,
    "augmentation": st.sampled_from([*AUGMENTATIONS, "random_crp", ""]),
    "augmentation_kwargs": st.none()
    | st.dictionaries(st.sampled_from(["pad", "size", "alpha", "source", "x"]), NUMBERS | st.just("nowhere"), max_size=2),
    "objective_augmentation": st.none() | st.sampled_from([*AUGMENTATIONS, "no"]),
    "image_size": st.none() | st.integers(-1, 60) | st.just((36, 30)),
    "anchor": st.sampled_from(["augmented", "center_crop", "other"]),
    "balance": st.sampled_from(["none", "grad_norm", "other"]),
    "precision": st.sampled_from(["float32", "bfloat16", "float16"]),
    "replay_device": st.sampled_from(["auto", "model", "cpu", "gpu"]),
    "on_nonfinite": st.sampled_from(["stop", "skip", "go"]),
    **dict.fromkeys(["joint_update", "reencode", "compile", "overlap"], st.booleans()),
    "policy_kwargs": POLICY,
    "no_such_argument": st.just(1),
}
TINY: dict[str, Any] = {
    "batch_size": 4,
    "buffer_size": 30,
    "learning_starts": 8,
    "policy_kwargs": POLICY_KWARGS,
    "objectives": {},
    "device": "cpu",
}


def check_arguments(arguments: dict[str, Any]) -> None:
    """A model is made and trains, or what is wrong is said before anything is learned."""
    with quietly():
        try:
            model = CRCSAC("CnnPolicy", NoiseEnv(size=36, length=5), **{**TINY, **arguments})
        except DOCUMENTED as error:
            says_why(error)
            return
        with suppress(FloatingPointError, *DOCUMENTED):  # a rate of 1e9 diverges; a buffer may be smaller than a batch
            model.learn(10)


test_arguments, test_arguments_long = tiers(
    3_000,
    arguments=st.lists(st.sampled_from(sorted(ARGUMENTS)), min_size=1, max_size=4, unique=True).flatmap(
        lambda names: st.fixed_dictionaries({name: ARGUMENTS[name] for name in names})
    ),
)(check_arguments)


# -- Spaces ------------------------------------------------------------------------------------------------------------

TYPES = st.sampled_from([np.uint8, np.float32, np.int64, np.int8])
SHAPES = st.lists(st.sampled_from([1, 2, 3, 4, 9, 12, 36, 40]), min_size=0, max_size=4).map(tuple)
SIZED = st.sampled_from([(9, 40, 40), (3, 36, 44), (40, 40, 9), (12, 40, 40), (1, 36, 36), (4, 36, 36)])


@st.composite
def boxes(draw: st.DrawFn) -> gym.Space[Any]:
    dtype = draw(TYPES)
    high = draw(st.sampled_from([255, 1, 127]))
    low = draw(st.sampled_from([0, 0, 0, -1])) if np.issubdtype(dtype, np.signedinteger) or dtype is np.float32 else 0
    high = min(high, np.iinfo(dtype).max) if np.issubdtype(dtype, np.integer) else high
    return gym.spaces.Box(low, high, draw(SIZED | SHAPES), dtype)


SPACES = boxes() | st.dictionaries(st.sampled_from(["image", "state", "other"]), boxes(), max_size=3).map(gym.spaces.Dict)
ACTIONS = st.sampled_from(
    [
        gym.spaces.Box(-1, 1, (2,), np.float32),
        gym.spaces.Box(-2, 5, (1,), np.float32),
        gym.spaces.Box(-np.inf, np.inf, (2,), np.float32),
        gym.spaces.Box(-1, 1, (2, 2), np.float32),
        gym.spaces.Discrete(3),
        gym.spaces.MultiBinary(2),
    ]
)


class Sampled(gym.Env[Any, Any]):
    """Observations drawn from a space."""

    def __init__(self, observation_space: gym.Space[Any], action_space: gym.Space[Any]):
        self.observation_space, self.action_space = observation_space, action_space
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self.observation_space.sample(), 0.5, False, self.steps >= 4, {}


def check_spaces(observation_space: gym.Space[Any], action_space: gym.Space[Any], policy: str) -> None:
    """Any space of observations and actions trains, or is refused by name."""
    with quietly():
        try:
            model = CRCSAC(policy, Sampled(observation_space, action_space), **TINY)
        except (*DOCUMENTED, AssertionError) as error:  # SB3 asserts that it supports an action space
            says_why(error)
            return
        model.learn(10)
        assert model._n_updates > 0


test_spaces, test_spaces_long = tiers(
    2_000, observation_space=SPACES, action_space=ACTIONS, policy=st.sampled_from(["CnnPolicy", "MultiInputPolicy"])
)(check_spaces)


# -- Configurations ----------------------------------------------------------------------------------------------------

LAPTOP = (ROOT / "zoo_configs" / "laptop.yml").read_text(encoding="utf-8")
SWEEP = (ROOT / "zoo_configs" / "sweeps" / "ablation_1.yml").read_text(encoding="utf-8")
EDITS = st.lists(
    st.tuples(
        st.floats(0, 1),
        st.sampled_from(
            ["", "\n", ": ", "- ", "{", "]", "'", "&a ", "*a", "!!python/name:os.system ", "null", "  ", "\t", "\x00"]
        )
        | st.text(max_size=3),
        st.integers(0, 30),
    ),
    min_size=1,
    max_size=4,
)


def edited(text: str, edits: list[tuple[float, str, int]]) -> str:
    for where, new, length in edits:
        place = round(where * len(text))
        text = text[:place] + new + text[place + length :]
    return text


def check_configurations(edits: list[tuple[float, str, int]], algorithm: str) -> None:
    """A configuration is read, or the error names the file."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "edited.yml"
        file.write_text(edited(LAPTOP, edits), encoding="utf-8", errors="surrogatepass")
        try:
            settings = read_settings(file, algorithm, "dmc_pixels/cartpole-swingup-v0")
        except ValueError as error:
            says_why(error, "" if isinstance(error, UnicodeDecodeError) else "edited.yml")
            return
        assert isinstance(settings, dict)


test_configurations, test_configurations_long = tiers(
    2_000, edits=EDITS, algorithm=st.sampled_from(["crc", "rad", "sac", "sac_matched", "state_sac"])
)(check_configurations)


def check_sweeps(edits: list[tuple[float, str, int]]) -> None:
    """A sweep is read, or refused."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "edited.yml"
        shutil.copy(ROOT / "zoo_configs" / "laptop.yml", folder)
        file.write_text(edited(SWEEP, edits), encoding="utf-8", errors="surrogatepass")
        with suppress(*DOCUMENTED):
            assert read_sweep(file)


test_sweeps, test_sweeps_long = tiers(2_000, edits=EDITS)(check_sweeps)


def check_overrides(settings: dict[str, Any], path: str, value: Any) -> None:
    """A path leads somewhere, or is refused; what it was applied to stays as it was."""
    before = json.dumps(settings)
    with suppress(ValueError):
        with_overrides(settings, {path: value})
    assert json.dumps(settings) == before


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=3),
    lambda inner: st.dictionaries(st.text("ab.", max_size=3), inner, max_size=3) | st.lists(inner, max_size=2),
    max_leaves=6,
)
test_overrides, test_overrides_long = tiers(
    2_000, settings=st.dictionaries(st.sampled_from("ab"), PLAIN, max_size=2), path=st.text("ab.", max_size=6), value=PLAIN
)(check_overrides)


# -- Files -------------------------------------------------------------------------------------------------------------

DAMAGE = st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 7)), max_size=3)


def damaged(content: bytes, flips: list[tuple[float, int]], kept: float) -> bytes:
    changed = bytearray(content)
    for where, bit in flips:
        changed[int(where * len(changed))] ^= 1 << bit
    return bytes(changed[: round(kept * len(changed))])


@lru_cache
def saved() -> dict[str, Any]:
    """A policy, a model, and a folder of checkpoints, all of a tiny training."""
    folder = Path(tempfile.mkdtemp())
    model = make_model()
    model.save(folder / "model.zip")
    export_policy(model, folder / "policy.sb3crc")
    checkpoint = TrainingCheckpoint(folder / "checkpoints", every=8)
    model.learn(24, callback=checkpoint)
    return {"folder": folder, "observation": np.zeros((9, 40, 40), np.uint8)}


KEPT = st.just(1.0) | st.floats(0, 1)


def check_policies(flips: list[tuple[float, int]], kept: float) -> None:
    """A damaged policy is refused, or acts with finite numbers."""
    about = saved()
    path = about["folder"] / "damaged.sb3crc"
    path.write_bytes(damaged((about["folder"] / "policy.sb3crc").read_bytes(), flips, kept))
    try:
        policy = load_policy(path, "cpu")
    except PolicyFileError:
        return
    assert np.isfinite(policy.predict(about["observation"], deterministic=True)[0]).all()


test_policies, test_policies_long = tiers(2_000, flips=DAMAGE, kept=KEPT)(check_policies)


def check_models(flips: list[tuple[float, int]], kept: float) -> None:
    """A damaged model is refused, or was damaged where it does not matter: every member of the zip has a checksum."""
    about = saved()
    path = about["folder"] / "damaged.zip"
    path.write_bytes(damaged((about["folder"] / "model.zip").read_bytes(), flips, kept))
    with quietly():
        try:
            model = CRCSAC.load(path, device="cpu", safe=True)
        except ValueError:
            return
    assert np.isfinite(model.predict(about["observation"], deterministic=True)[0]).all()


test_models, test_models_long = tiers(1_000, flips=DAMAGE, kept=KEPT)(check_models)


def check_checkpoints(flips: list[tuple[float, int]], kept: float, file: float, older_too: bool) -> None:
    """Damage of the newest checkpoint leads to the one before; damage of all of them is said."""
    about = saved()
    folder = about["folder"] / "damaged"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(about["folder"] / "checkpoints", folder)
    newest, older = CheckpointStore(folder).names()
    changed = False
    for name in (newest, older) if older_too else (newest,):
        files = sorted((folder / name).iterdir())
        path = files[int(file * len(files))]
        before = path.read_bytes()
        path.write_bytes(damaged(before, flips, kept))
        changed |= path.read_bytes() != before
    with quietly():
        try:
            found = CheckpointStore(folder).newest()
        except CheckpointError:
            assert older_too or "format" in str(found_format(folder / newest))
            return
    assert found is not None and (found.path.name == newest or changed)


def found_format(folder: Path) -> str:
    with suppress(ValueError, OSError):
        return "format" if json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["format"] > 1 else ""
    return ""


test_checkpoints, test_checkpoints_long = tiers(
    2_000, flips=DAMAGE, kept=KEPT, file=st.floats(0, 1, exclude_max=True), older_too=st.booleans()
)(check_checkpoints)


def check_buffers(flips: list[tuple[float, int]], kept: float) -> None:
    """A damaged archive of a replay buffer is refused, and the buffer then stays as it was; or it was not damaged."""
    about = saved()
    model = make_model()
    path = about["folder"] / "buffer.zip"
    if not path.exists():
        with path.open("wb") as file:
            model.save_replay_buffer(file)
    changed = about["folder"] / "damaged-buffer.zip"
    changed.write_bytes(damaged(path.read_bytes(), flips, kept))
    buffer = model.replay_buffer
    assert isinstance(buffer, FrameReplayBuffer)
    before = buffer.size(), buffer.observations.copy()
    with changed.open("rb") as file:
        try:
            model.load_replay_buffer(file)
        except (ValueError, FileNotFoundError):
            assert buffer.size() == before[0] and np.array_equal(buffer.observations, before[1])


test_buffers, test_buffers_long = tiers(500, flips=DAMAGE, kept=KEPT)(check_buffers)


# -- What was found ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["tau", "encoder_tau", "gamma", "policy_delay", "n_steps"])
def test_true_is_no_number(name: str) -> None:
    """``tau=True`` was let through, and failed at the first target update."""
    with pytest.raises(ValueError, match=f"{name}=True must be"):
        CRCSAC("CnnPolicy", NoiseEnv(size=36), **{**TINY, name: True})


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"channels": [8, -1], "strides": [1, 1]}, r"channels=\[8, -1\] must be at least 1"),
        ({"channels": [8, 0], "strides": [1, 1]}, r"channels=\[8, 0\] must be"),
        ({"channels": [8], "strides": [0]}, r"strides=\[0\] must be"),
        ({"channels": [], "strides": []}, r"channels=\[\] must be"),
        ({"features_dim": 0}, "features_dim=0 must be"),
        ({"frame_channels": 0, "frame_differences": 4.0}, "frame_channels=0 must be"),
    ],
)
def test_an_encoder_of_nothing_is_refused(own: dict[str, Any], message: str) -> None:
    """These were torch's errors, or an assertion of SB3's."""
    with pytest.raises(ValueError, match=message):
        CRCSAC("CnnPolicy", NoiseEnv(size=36), **{**TINY, "policy_kwargs": {"features_extractor_kwargs": own}})


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("variants:", "variants: [1]\nconf_file:", "variants must be a mapping from names to changes; it is \\[1\\]"),
        ("seeds: 3", "seeds: [1, x]", "seeds must be a number of trainings, or a list of whole numbers; 'x' is among them"),
        ("seeds: 3", "seeds: true", "seeds must be a number of trainings"),
        ("env_steps:", "env_steps: many #", "env_steps must be a whole number; it is 'many'"),
    ],
)
def test_a_sweep_of_other_types_is_refused(old: str, new: str, message: str, tmp_path: Path) -> None:
    """Lists in place of mappings ended in an AttributeError."""
    text = "env_steps: 100_000\ntasks: [cartpole-swingup]\nseeds: 3\nvariants:\n  C: {preset: crc}\n"
    (tmp_path / "sweep.yml").write_text(text, encoding="utf-8")
    assert len(read_sweep(tmp_path / "sweep.yml")) == 3
    changed = text.replace(old, new) if old != "variants:" else text[: text.index(old)] + "variants: [1]\n"
    (tmp_path / "sweep.yml").write_text(changed, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        read_sweep(tmp_path / "sweep.yml")


def test_a_path_that_is_no_text_is_refused() -> None:
    """A sweep with ``null:`` among a variant's changes ended in an AttributeError."""
    with pytest.raises(ValueError, match="None is no path"):
        with_overrides({"a": 1}, {None: 2})  # type: ignore[dict-item]


def test_the_unedited_files_are_read() -> None:
    """Else the checks above would show nothing."""
    check_configurations([(0.0, "", 0)], "crc")
    assert yaml.safe_load(LAPTOP) and yaml.safe_load(SWEEP)
    check_policies([], 1.0)
    check_models([], 1.0)
    check_checkpoints([], 1.0, 0.0, older_too=False)
    check_buffers([], 1.0)
    check_arguments({})
