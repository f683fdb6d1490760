"""The networks that are compared, and a world that costs nothing."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import yaml

from sb3_crc import CRCSAC, PRESETS

LAPTOP = Path(__file__).parents[1] / "zoo_configs" / "laptop.yml"


@dataclass(frozen=True)
class Networks:
    """
    Encoder and heads, and the images that they see.

    :param name: "paper" or "laptop"
    :param frame_size: side of the frames that are stored, in pixels
    :param input_size: side of what the encoder sees
    :param encoder: arguments of :class:`~sb3_crc.PixelEncoder`
    :param net_arch: hidden layers of actor and Q heads
    :param layer_norm: LayerNorm in the heads
    :param augmentation: what CRCSAC is told where a preset crops, of frames that are not larger than the input
    """

    name: str
    frame_size: int
    input_size: int
    encoder: Mapping[str, Any]
    net_arch: tuple[int, ...]
    layer_norm: bool = False
    augmentation: Mapping[str, Any] = field(default_factory=dict)

    def crc_sac(self, preset: str, batch_size: int, **settings: Any) -> CRCSAC:
        """:return: a model of ``preset`` with these networks, ready to be trained on batches of noise"""
        arguments = {**PRESETS[preset], **settings}
        if self.augmentation and arguments.get("augmentation") == "random_crop":
            arguments |= self.augmentation
        heads = {"net_arch": list(self.net_arch), "layer_norm": self.layer_norm}
        own = arguments.get("policy_kwargs", {})
        arguments["policy_kwargs"] = {**own, **heads, "features_extractor_kwargs": dict(self.encoder)}
        steps = batch_size + EPISODE
        arguments |= {"batch_size": batch_size, "buffer_size": steps, "learning_starts": steps}
        model = CRCSAC("CnnPolicy", NoiseFrames(self.frame_size), **{"seed": 0, "device": "cpu", **arguments})
        return model.learn(steps)


def laptop_networks() -> Networks:
    """:return: those of zoo_configs/laptop.yml"""
    settings = yaml.safe_load(LAPTOP.read_text(encoding="utf-8"))["default"]
    policy, size = settings["policy_kwargs"], settings["env_kwargs"]["image_size"]
    augmentation = {name: settings[name] for name in ("augmentation", "augmentation_kwargs")}
    encoder = policy["features_extractor_kwargs"]
    return Networks("laptop", size, size, encoder, tuple(policy["net_arch"]), policy["layer_norm"], augmentation)


PAPER = Networks("paper", 100, 84, {}, (1024, 1024))
NETWORKS = {"paper": PAPER, "laptop": laptop_networks()}

EPISODE = 125


class NoiseFrames(gym.Env[np.ndarray, np.ndarray]):
    """
    Stacks of three frames of noise, drawn beforehand; episodes of 125 steps that end by truncation.

    :param size: side of the frames in pixels
    """

    frame_channels = 3

    def __init__(self, size: int):
        self.observation_space = gym.spaces.Box(0, 255, (9, size, size), np.uint8)
        self.action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
        self._frames = np.random.default_rng(0).integers(0, 256, (64, 3, size, size), dtype=np.uint8)
        self._steps = 0

    def _observation(self) -> np.ndarray:
        numbers = np.maximum([self._steps - 2, self._steps - 1, self._steps], 0) % len(self._frames)
        return self._frames[numbers].reshape(self.observation_space.shape)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Show the first frame three times."""
        super().reset(seed=seed)
        self._steps = 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Show the next frame; the reward is the action."""
        self._steps += 1
        return self._observation(), float(action[0]), False, self._steps >= EPISODE, {}
