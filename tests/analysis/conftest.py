"""Runs of seconds with trained models in them, as train.py leaves them, and rollouts made by hand."""

from collections import OrderedDict
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from stable_baselines3 import SAC

from sb3_crc import CRCSAC, PRESETS, make_dmc
from sb3_crc.analysis.policies import SavedPolicy
from sb3_crc.analysis.rollouts import Rollout
from sb3_crc.analysis.subjects import Subject
from sb3_crc.experiments.runs import Run
from sb3_crc.stock import StockSAC
from tests.conftest import POLICY_KWARGS, NoiseEnv

TASK = "cartpole-balance"
ENV = f"dmc_pixels/{TASK}-v0"
#: 25 decisions make an episode
ENV_KWARGS = {"image_size": 36, "frame_stack": 2, "render_quality": "fast", "action_repeat": 40}
NOISE = "AnalysisNoise-v0"
#: Of rollouts: four whole episodes
SHORT = ["--decisions", "80", "--episodes", "4"]
gym.register(NOISE, entry_point=NoiseEnv)


def make_run(
    folder: Path, preset: str, seed: int = 0, *, env_id: str = ENV, env_kwargs: dict[str, Any] = ENV_KWARGS, train: int = 40
) -> Path:
    """A folder as rl_zoo3 leaves it, with a policy that has learned for a second; without one if ``train`` is 0."""
    name = env_id.replace("/", "-")
    run = folder / preset / f"{name}_1"
    (run / name).mkdir(parents=True)
    (run / name / "args.yml").write_text(yaml.dump(OrderedDict(algo=preset, env=env_id, seed=seed, n_timesteps=train)))
    (run / name / "config.yml").write_text(yaml.dump(OrderedDict(gamma=0.9, env_kwargs=env_kwargs)))
    if train:
        make_model(preset, seed, env_id, env_kwargs).learn(train).save(run / name)
    return run


def make_model(preset: str, seed: int, env_id: str = ENV, env_kwargs: dict[str, Any] = ENV_KWARGS) -> SAC:
    env = make_dmc(TASK, seed=seed, **env_kwargs) if env_id == ENV else gym.make(env_id)
    common: dict[str, Any] = {"buffer_size": 100, "batch_size": 8, "learning_starts": 30, "seed": seed, "device": "cpu"}
    if preset in PRESETS:
        own = {**PRESETS[preset], **common, "policy_kwargs": POLICY_KWARGS, "gamma": 0.9}
        return CRCSAC("CnnPolicy", env, **own)
    kwargs = {"net_arch": [32, 32], "features_extractor_kwargs": {"features_dim": 24}}
    return StockSAC("CnnPolicy", env, policy_kwargs=kwargs, gamma=0.9, **common)


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """crc twice, rad and stock SAC; to be read only, but for the rollouts in them."""
    folder = tmp_path_factory.mktemp("runs")
    made = {preset: make_run(folder / preset, preset, seed) for seed, preset in enumerate(("crc", "rad", "sac"), start=1)}
    return {**made, "crc_4": make_run(folder / "crc_4", "crc", 4)}


def by_hand(rng: np.random.Generator, *, episodes: int = 6, length: int = 20, size: int = 24) -> Rollout:
    """Latents that hold a state of two numbers, and actions that follow from it."""
    n = episodes * length
    state = rng.normal(size=(n, 2))
    latents = np.column_stack([state, 0.1 * rng.normal(size=(n, 4))])
    images = rng.integers(0, 256, (n, 6, size, size), dtype=np.uint8)
    images[:, :, : size // 2] = 40
    number, step = np.repeat(np.arange(episodes), length), np.tile(np.arange(length), episodes)
    about = {"gamma": 0.9, "render_fps": 12.5, "frame_channels": 3, "environment_steps": 1000}
    names = np.array(["position", "velocity"])
    action, ones = np.tanh(state[:, :1]), np.ones(n)
    left = (length - step).astype(float)
    return Rollout(
        latents.astype(np.float32),
        action.astype(np.float32),
        images,
        state,
        names,
        left,
        ones,
        left,
        left,
        number,
        step,
        about,
    )


@pytest.fixture
def subjects(tmp_path: Path) -> list[Subject]:
    """Two of one method and one of another, without models."""
    rng = np.random.default_rng(0)
    found = []
    for preset, seed in (("crc", 1), ("crc", 2), ("rad", 1)):
        run = Run(make_run(tmp_path / f"{preset}_{seed}", preset, seed, train=0))
        policy = SavedPolicy(run, run.model)
        found.append(Subject(policy.name, policy, by_hand(rng)))
    return found
