"""Tiny stock SB3 models, whose own learning rate is zero, and what they see through."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from sb3_contrib import TQC
from stable_baselines3 import DQN, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from tests.conftest import NoiseEnv

SIZE = 36  # the smallest that SB3's NatureCNN takes
TINY = {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 16}}


class Buttons(gym.ActionWrapper[np.ndarray, Any, Any]):
    def __init__(self, env: gym.Env[Any, Any]):
        super().__init__(env)
        self.action_space = gym.spaces.Discrete(3)

    def action(self, action: Any) -> np.ndarray:
        return np.full(2, action / 2, np.float32)


class BatchNormCNN(BaseFeaturesExtractor):
    """Has buffers, one of them of integers, and a layer that it does not use."""

    def __init__(self, observation_space: gym.spaces.Box, features_dim: int = 16):
        super().__init__(observation_space, features_dim)
        self.cnn = nn.Sequential(
            nn.Conv2d(3, 4, 5, 4), nn.BatchNorm2d(4), nn.ReLU(), nn.Flatten(), nn.LazyLinear(features_dim)
        )
        self.unused = nn.Linear(2, 2)
        self.modes: list[bool] = []
        self.largest = 0.0
        self(th.zeros(2, 3, SIZE, SIZE))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        self.modes.append(self.training)
        self.largest = max(self.largest, observations.max().item())
        features: th.Tensor = self.cnn(observations)
        return features


def noise_env() -> NoiseEnv:
    return NoiseEnv(size=SIZE, channels=3, length=5)


def stock(algorithm: str = "sac", env: Any = None, **kwargs: Any) -> OffPolicyAlgorithm:
    """A tiny stock model whose own learning rate is zero: what moves, the auxiliary losses have moved."""
    name, _, shared = algorithm.partition("-")
    cls = {"sac": SAC, "td3": TD3, "tqc": TQC, "dqn": DQN}[name]
    policy_kwargs: dict[str, Any] = {**TINY, **kwargs.pop("policy_kwargs", {})}
    if shared:
        policy_kwargs["share_features_extractor"] = True
    if env is None:
        env = Buttons(noise_env()) if name == "dqn" else noise_env()
    settings = {"learning_rate": 0.0, "buffer_size": 100, "learning_starts": 12, "batch_size": 8, "train_freq": 1, "seed": 0}
    model: OffPolicyAlgorithm = cls("CnnPolicy", env, policy_kwargs=policy_kwargs, device="cpu", **{**settings, **kwargs})
    return model


def live_extractor(model: BaseAlgorithm) -> nn.Module:
    owner = model.q_net if isinstance(model, DQN) else model.critic  # type: ignore[attr-defined]
    extractor: nn.Module = owner.features_extractor
    return extractor


def weights(module: nn.Module) -> dict[str, th.Tensor]:
    return {name: tensor.clone() for name, tensor in module.state_dict().items()}


def moved(before: dict[str, th.Tensor], module: nn.Module) -> set[str]:
    return {name for name, tensor in module.state_dict().items() if not th.equal(tensor, before[name])}


def seed(value: int = 1) -> None:
    th.manual_seed(value)
    np.random.seed(value)
