"""Arguments and spaces, whatever they are: training works, or one clear error of a documented kind says why not."""

from contextlib import suppress
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import strategies as st

from sb3_crc import CRCSAC
from sb3_crc.augmentations import AUGMENTATIONS
from tests.conftest import POLICY_KWARGS, NoiseEnv
from tests.fuzz.documented import DOCUMENTED, quietly, says_why
from tests.fuzz.tiers import tiers

TINY: dict[str, Any] = {
    "batch_size": 4,
    "buffer_size": 30,
    "learning_starts": 8,
    "policy_kwargs": POLICY_KWARGS,
    "objectives": {},
    "device": "cpu",
}

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


def test_the_defaults_train() -> None:
    """Else the checks above would show nothing."""
    model = CRCSAC("CnnPolicy", NoiseEnv(size=36, length=5), **TINY).learn(10)
    assert model._n_updates == 2
