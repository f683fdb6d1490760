"""Gymnasium's wrappers around an environment that is saved: what they keep goes on as well."""

import warnings
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import NormalizeReward, TimeLimit
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from sb3_crc import WatchedSubprocVecEnv, make_dmc
from tests.checkpoints.runs import assert_equal, train


def task(seed: int) -> gym.Env[Any, Any]:
    return make_dmc("cartpole-swingup", seed=seed, image_size=36, render_quality="fast", action_repeat=50)


def limited(seed: int) -> gym.Env[Any, Any]:
    return Monitor(TimeLimit(task(seed), 7))  # checkpoints lie within episodes


def wrapped(seed: int) -> gym.Env[Any, Any]:
    return Monitor(NormalizeReward(TimeLimit(task(seed), 7)))


def elsewhere(seed: int) -> VecEnv:
    return WatchedSubprocVecEnv([partial(limited, seed)])


class Counting(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps what is no plain data."""

    def __init__(self, env: gym.Env[Any, Any]):
        super().__init__(env)
        self.generator = np.random.default_rng(0)


@pytest.mark.parametrize("make_env", [limited, wrapped, pytest.param(elsewhere, marks=pytest.mark.slow)])
def test_a_run_goes_on_within_an_episode_that_a_wrapper_counts(make_env: Any, tmp_path: Path) -> None:
    whole = train(tmp_path / "whole", make_env=make_env)
    train(tmp_path / "run", stop=45, make_env=make_env)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        resumed = train(tmp_path / "run", make_env=make_env)
    assert_equal(resumed, whole)
    assert [episode["l"] for episode in resumed.ep_info_buffer] == [7] * 8


def test_what_a_wrapper_keeps_beside_plain_data_is_warned_of(tmp_path: Path) -> None:
    def make_env(seed: int) -> gym.Env[Any, Any]:
        return Monitor(Counting(task(seed)))

    train(tmp_path, stop=25, make_env=make_env)
    with pytest.warns(UserWarning, match="Counting keeps generator, of type Generator, which checkpoints do not hold"):
        train(tmp_path, make_env=make_env)


def test_other_wrappers_are_refused(tmp_path: Path) -> None:
    train(tmp_path, stop=25, make_env=limited)
    with pytest.raises(ValueError, match="1 wrappers around an environment were saved, there are 0 now"):
        train(tmp_path, make_env=lambda seed: Monitor(task(seed)))
