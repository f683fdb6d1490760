"""Environments as SB3's users bring and change them: evaluated, normalised, replaced, with action noise."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from tests.compared_models import train_on
from tests.conftest import NoiseEnv, make_model


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
