"""Environments as SB3's users bring and change them: evaluated, normalised, replaced, with action noise."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize

from sb3_crc import CRCSAC, FrameReplayBuffer
from tests.compared_models import train_on
from tests.conftest import POLICY_KWARGS, SIZE, NoiseEnv, make_model


def test_evaluate_policy_returns_what_an_own_loop_returns() -> None:
    model = make_model()
    venv = DummyVecEnv([lambda: Monitor(NoiseEnv())])
    venv.seed(3)
    rewards, lengths = evaluate_policy(model, venv, n_eval_episodes=2, return_episode_rewards=True)
    env = NoiseEnv()
    expected = []
    for seed in (3, None):
        observation, _ = env.reset(seed=seed)
        total, ended = 0.0, False
        while not ended:
            observation, reward, _, ended, _ = env.step(model.predict(observation, deterministic=True)[0])
            total += reward
        expected.append(total)
    assert lengths == [10, 10]
    assert rewards == pytest.approx(expected, abs=1e-5)  # Monitor rounds
    assert len(set(expected)) == 2


def test_vec_normalize_normalises_the_rewards_and_leaves_the_images() -> None:
    venv = VecNormalize(DummyVecEnv([NoiseEnv]), norm_obs=False, gamma=0.9)
    model = make_model(venv)
    venv.ret_rms.var = 0.04
    samples = []
    for env in (None, venv):
        np.random.seed(3)
        samples.append(model.replay_buffer.sample(16, env=env))
    np.random.seed(3)
    views = model._sample_views(16)
    assert th.allclose(views.rewards, samples[0].rewards * 5, rtol=1e-4)
    assert th.equal(views.rewards, samples[1].rewards)
    assert views.anchor.images.dtype == th.uint8
    train_on(model, seed=1)


def test_vec_normalize_of_images_is_refused_with_the_way_out() -> None:
    with pytest.raises(ValueError, match=r"VecNormalize.*norm_obs=False"):
        make_model(VecNormalize(DummyVecEnv([NoiseEnv])))


class ChannelsLast(gym.ObservationWrapper[np.ndarray, np.ndarray, np.ndarray]):
    """RGB pictures as most environments return them, and with ``vector`` five numbers beside them."""

    def __init__(self, vector: bool):
        super().__init__(NoiseEnv(channels=3))
        image = gym.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)
        numbers = gym.spaces.Box(-np.inf, np.inf, (5,), np.float32)
        self.observation_space = gym.spaces.Dict(image=image, numbers=numbers) if vector else image
        self.vector = vector

    def observation(self, observation: np.ndarray) -> Any:
        image = observation.transpose(1, 2, 0)
        return {"image": image, "numbers": observation[0, 0, :5].astype(np.float32)} if self.vector else image


@pytest.mark.parametrize("vector", [False, True])
def test_vec_normalize_may_have_wrappers_around_it(vector: bool) -> None:
    """Frames are stacked and transposed after it, which is rl_zoo3's order; what is stored is as without it."""
    stored = []
    for normalize in (True, False):
        venv: VecEnv = DummyVecEnv([lambda: ChannelsLast(vector)])
        if normalize:
            venv = VecNormalize(venv, norm_obs=vector, norm_obs_keys=["numbers"] if vector else None)
        if not vector:
            venv = VecFrameStack(venv, 2, "last")
        policy = "MultiInputPolicy" if vector else "CnnPolicy"
        settings = {"buffer_size": 200, "learning_starts": 25, "policy_kwargs": POLICY_KWARGS, "seed": 0, "device": "cpu"}
        buffer = CRCSAC(policy, venv, **settings).learn(25).replay_buffer  # two episodes and a half of random actions
        stored += [buffer.observations, buffer.next_observations]
    for with_it, without in zip(stored[:2], stored[2:], strict=True):
        np.testing.assert_equal(with_it, without)


def test_stock_sac_is_told_where_vec_normalize_belongs() -> None:
    venv = VecNormalize(DummyVecEnv([lambda: ChannelsLast(False)]), norm_obs=False)
    model = SAC("CnnPolicy", venv, buffer_size=50, replay_buffer_class=FrameReplayBuffer, device="cpu")
    with pytest.raises(ValueError, match=r"\(1, 40, 40, 3\) do not fit.*VecNormalize belongs around VecTransposeImage"):
        model.learn(5)


def test_set_env() -> None:
    class Bright(NoiseEnv):
        def _frame(self) -> np.ndarray:
            return np.full(self.observation_space.shape, 255, np.uint8)

    model = make_model()
    model.set_env(Bright())
    model.learn(5, reset_num_timesteps=False)
    assert (model.num_timesteps, model._n_updates) == (45, 5)
    assert (model.replay_buffer.observations[40:45] == 255).all()
    assert not (model.replay_buffer.observations[:40] == 255).all()
    with pytest.raises(AssertionError, match="number of environments"):
        model.set_env(DummyVecEnv([NoiseEnv] * 2))


@pytest.mark.parametrize(("reset", "steps", "updates"), [(False, 52, 12), (True, 42, 4)])
def test_learn_twice(reset: bool, steps: int, updates: int) -> None:
    """Going on trains at once; starting to count anew plays random actions until ``learning_starts`` again."""
    model = make_model()
    model.learn(2, reset_num_timesteps=False)
    assert model._n_updates == 2
    model.learn(42 if reset else 10, reset_num_timesteps=reset)
    assert (model.num_timesteps, model._n_updates) == (steps, updates)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_action_noise_is_added(n_envs: int) -> None:
    noise = NormalActionNoise(np.array([10.0, -10.0]), np.zeros(2))
    model = make_model(DummyVecEnv([NoiseEnv] * n_envs), action_noise=noise, learning_starts=20)
    stored = model.replay_buffer.actions[20 // n_envs : 40 // n_envs]
    assert (stored == np.array([1, -1])).all() and len(stored) == 20 // n_envs
    quiet = make_model(DummyVecEnv([NoiseEnv] * n_envs), learning_starts=20)
    assert not (quiet.replay_buffer.actions[20 // n_envs : 40 // n_envs] == np.array([1, -1])).all()
