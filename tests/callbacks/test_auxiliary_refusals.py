"""AuxiliaryLossCallback: what it refuses, and what it does not."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_crc.callbacks import AuxiliaryLossCallback
from tests.callbacks.stock_models import SIZE, TINY, live_extractor, moved, noise_env, stock, weights
from tests.conftest import make_model


class Observe(gym.ObservationWrapper[Any, Any, Any]):
    """The frames as floats, or as a Dict."""

    def __init__(self, env: gym.Env[Any, Any], kind: str):
        super().__init__(env)
        self.kind = kind
        space = gym.spaces.Box(0, 1, (3, SIZE, SIZE), np.float32)
        self.observation_space = gym.spaces.Dict({"image": env.observation_space}) if kind == "dict" else space

    def observation(self, observation: np.ndarray) -> Any:
        return {"image": observation} if self.kind == "dict" else (observation / 255).astype(np.float32)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"objectives": {}}, "objectives={} leaves nothing to train"),
        ({"objectives": {"contrastive": 0}}, "all weights of objectives are zero; leave the callback away"),
        ({"objectives": {"contrastive": -1}}, "must be a finite number >= 0, got -1"),
        ({"gradient_steps": 0}, "gradient_steps=0 must be an integer of at least 1"),
        ({"gradient_steps": None}, "gradient_steps=None must be an integer of at least 1"),
        ({"batch_size": 2.5}, "batch_size=2.5 must be an integer of at least 1"),
        ({"encoder_tau": 0}, "encoder_tau=0 must be above 0 and at most 1"),
        ({"learning_rate": 0.0}, "learning_rate=0.0 must be finite and above 0"),
        ({"learning_rate": lambda progress: progress}, "must be a number or 'lin_x'"),
        ({"learning_rate": "linear"}, "unknown learning rate 'linear'"),
        ({"augmentation": "random_shfit"}, "unknown augmentation 'random_shfit'; did you mean 'random_shift'"),
        ({"augmentation_kwargs": {"pad": th.ones(1)}}, "settings must be plain values"),
    ],
)
def test_bad_arguments_are_refused_at_once(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        AuxiliaryLossCallback(**kwargs)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"objectives": {"contrastiv": 1.0}}, "unknown objective 'contrastiv'; did you mean 'contrastive'"),
        (
            {"augmentation": "random_crop", "augmentation_kwargs": {"size": 30}},
            r"turns images of \(3, 36, 36\) into \(3, 30, 30\)",
        ),
        ({"augmentation": "random_crop"}, r"augmentation_kwargs={} do not suit 'random_crop': .*missing.*'size'"),
        ({"augmentation_kwargs": {"padding": 2}}, "augmentation_kwargs 'padding'; did you mean 'pad'"),
        ({"batch_size": 101}, "batch_size=101 is more than the replay buffer holds: 100"),
    ],
)
def test_settings_that_do_not_go_with_the_model_are_refused_before_the_first_step(
    kwargs: dict[str, Any], message: str
) -> None:
    model = stock()
    with pytest.raises(ValueError, match=message):
        model.learn(16, callback=AuxiliaryLossCallback(**kwargs))
    assert model.num_timesteps == 0


def unsuitable(kind: str) -> BaseAlgorithm:
    if kind == "on-policy":
        return PPO("CnnPolicy", noise_env(), n_steps=8, batch_size=8, policy_kwargs=TINY, device="cpu")
    if kind == "crc_sac":
        return make_model()
    if kind == "dict":
        return SAC("MultiInputPolicy", Observe(noise_env(), "dict"), buffer_size=10, device="cpu")
    if kind == "float":
        return SAC("MlpPolicy", Observe(noise_env(), "float"), buffer_size=10, device="cpu")
    if kind == "state":
        return SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, device="cpu")
    if kind == "normalized":
        env = VecNormalize(DummyVecEnv([noise_env]), norm_obs=True)
        return SAC("MlpPolicy", env, buffer_size=10, device="cpu")
    assert kind == "flatten"
    return SAC("MlpPolicy", noise_env(), buffer_size=10, device="cpu")


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("on-policy", "PPO has no replay buffer"),
        ("crc_sac", r"CRCSAC trains objectives itself: .*CRCSAC\(objectives=...\)"),
        ("dict", "expected uint8 images .* got Dict"),
        ("float", "expected uint8 images .* got Box.*float32"),
        ("state", "expected uint8 images"),
        ("normalized", r"use VecNormalize\(norm_obs=False\)"),
        ("flatten", "FlattenExtractor has no trainable parameters"),
    ],
)
def test_unsuitable_models_are_refused_before_the_first_step(kind: str, message: str) -> None:
    model = unsuitable(kind)
    steps = model.num_timesteps
    with pytest.raises(ValueError, match=message):
        model.learn(steps + 1, callback=AuxiliaryLossCallback(), reset_num_timesteps=False)
    assert model.num_timesteps == steps
    assert "save" not in vars(model)


def test_normalised_rewards_are_fine() -> None:
    model = stock(env=VecNormalize(DummyVecEnv([noise_env]), norm_obs=False))
    before = weights(live_extractor(model))
    model.learn(16, callback=AuxiliaryLossCallback())
    assert moved(before, live_extractor(model))


def test_one_callback_per_model() -> None:
    with pytest.raises(ValueError, match="a model takes one AuxiliaryLossCallback"):
        stock().learn(16, callback=[AuxiliaryLossCallback(), AuxiliaryLossCallback()])
