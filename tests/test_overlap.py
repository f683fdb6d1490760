"""Updates made while the environments step have the results that they have afterwards."""

import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecFrameStack

from sb3_crc import CRCSAC
from sb3_crc.callbacks import NStepScheduleCallback, ObjectiveScheduleCallback
from tests.conftest import POLICY_KWARGS, NoiseEnv


class Slow(gym.Wrapper[Any, Any, Any, Any]):
    def step(self, action: Any) -> Any:
        time.sleep(0.02)
        return super().step(action)


def frames() -> gym.Env[Any, Any]:
    return NoiseEnv(channels=3, length=7)


def slow_frames() -> gym.Env[Any, Any]:
    return Slow(NoiseEnv(channels=3, length=7))


class Watch(BaseCallback):
    """When updates were made: during a step, or after it."""

    def __init__(self) -> None:
        super().__init__()
        self.made: list[tuple[int, int]] = []

    def _on_rollout_start(self) -> None:
        self.before = self.model._n_updates  # type: ignore[attr-defined]

    def _on_step(self) -> bool:
        self.made.append((self.num_timesteps, self.model._n_updates - self.before))  # type: ignore[attr-defined]
        return True


def environments(kind: Callable[[list[Any]], VecEnv], n_envs: int, make: Any = frames) -> VecEnv:
    return VecFrameStack(kind([make] * n_envs), 3, channels_order="first")


def trained(env: VecEnv, *, steps: int = 60, **own: Any) -> tuple[CRCSAC, Watch]:
    settings: dict[str, Any] = {
        **{"batch_size": 8, "buffer_size": 40, "learning_starts": 16, "gradient_steps": 2, "seed": 3},
        **{"learning_rate": "lin_0.001", "policy_kwargs": POLICY_KWARGS},
    }
    model = CRCSAC("CnnPolicy", env, **{**settings, **own})
    watch = Watch()
    model.learn(steps, callback=watch)
    env.close()
    return model, watch


def assert_same(one: CRCSAC, other: CRCSAC) -> None:
    assert (one.num_timesteps, one._n_updates) == (other.num_timesteps, other._n_updates)
    for name in ("observations", "next_observations", "actions", "rewards", "dones"):
        assert np.array_equal(getattr(one.replay_buffer, name), getattr(other.replay_buffer, name)), name
    for mine, theirs in zip(one.policy.state_dict().values(), other.policy.state_dict().values(), strict=True):
        assert th.equal(mine, theirs)
    for name, value in one.logger.name_to_value.items():
        if not name.startswith("time/"):
            assert other.logger.name_to_value[name] == pytest.approx(value, nan_ok=True), name


@pytest.mark.parametrize(
    "own",
    [
        {},
        {"n_steps": 3},
        {"gradient_steps": -1},
        {"buffer_size": 20},
        {"initial_updates": 3, "policy_delay": 1},
        {"objectives": {}},
    ],
    ids=["plain", "n-step", "as many", "full buffer", "initial updates", "rad"],
)
@pytest.mark.parametrize("n_envs", [1, 2])
def test_what_is_made_early_is_what_is_made_afterwards(n_envs: int, own: dict[str, Any]) -> None:
    afterwards, seen = trained(environments(DummyVecEnv, n_envs), **own)
    early, seen_early = trained(environments(DummyVecEnv, n_envs), overlap=True, **own)
    assert not any(made for _, made in seen.made) and any(made for _, made in seen_early.made)
    assert_same(early, afterwards)


def test_environments_in_processes_step_meanwhile() -> None:
    afterwards, _ = trained(environments(SubprocVecEnv, 2))
    early, _ = trained(environments(SubprocVecEnv, 2), overlap=True)
    assert_same(early, afterwards)


@pytest.mark.slow
@pytest.mark.alone
def test_a_step_costs_nothing_while_an_update_is_made() -> None:
    own = {"steps": 300, "learning_starts": 200, "buffer_size": 400}
    seconds = []
    for overlap in (False, True):
        env = environments(SubprocVecEnv, 1, slow_frames)
        began = time.perf_counter()
        trained(env, overlap=overlap, **own)  # type: ignore[arg-type]
        seconds.append(time.perf_counter() - began)
    assert seconds[0] - seconds[1] > 0.5 * 100 * 0.02  # of a hundred steps with updates, more than half are hidden


def test_no_update_reads_a_transition_that_is_not_there_yet() -> None:
    """Batches as large as all that is stored have the newest transition nearly always."""
    _, watch = trained(environments(DummyVecEnv, 1), overlap=True, batch_size=16, learning_starts=16, steps=19)
    few = sum(made for _, made in watch.made)
    _, watch = trained(
        environments(DummyVecEnv, 1), overlap=True, batch_size=2, learning_starts=200, steps=230, buffer_size=300
    )
    many = sum(made for _, made in watch.made)
    assert few <= 2 and many >= 50


def test_what_cannot_be_known_early_is_not_made_early() -> None:
    for own in ({"train_freq": 4}, {"train_freq": (1, "episode")}, {"gradient_steps": 0}):
        _, watch = trained(environments(DummyVecEnv, 1), overlap=True, **own)
        assert not any(made for _, made in watch.made)


class Stop(BaseCallback):
    def _on_step(self) -> bool:
        return self.num_timesteps < 40


def test_a_training_that_is_stopped_goes_on_with_whole_updates() -> None:
    model, _ = trained(environments(DummyVecEnv, 1), overlap=True, batch_size=2, steps=30)
    model.set_env(environments(DummyVecEnv, 1))
    model.learn(30, callback=Stop(), reset_num_timesteps=False)
    before = model._n_updates
    model.train(gradient_steps=2, batch_size=8)
    assert model._n_updates == before + 2


def test_schedules_are_those_of_the_step_that_updates_follow() -> None:
    def callback() -> CallbackList:
        rates = ObjectiveScheduleCallback({"contrastive": "lin_1.0"}, encoder_learning_rate="lin_0.01")
        return CallbackList([rates, NStepScheduleCallback({0.6: 3})])

    models = []
    for overlap in (False, True):
        model, _ = trained(environments(DummyVecEnv, 1), overlap=overlap, steps=30)
        env = environments(DummyVecEnv, 1)
        env.seed(5)
        model.set_env(env)
        for _ in range(2):
            model.learn(30, callback=callback(), reset_num_timesteps=False)
        models.append(model)
    assert_same(*models)


def test_an_error_during_a_step_leaves_no_answer_behind() -> None:
    model, _ = trained(environments(DummyVecEnv, 2), overlap=True)
    env = environments(SubprocVecEnv, 2)
    model.set_env(env)
    made = model._n_updates

    def fail() -> None:
        if model._n_updates >= made + 20:
            raise KeyboardInterrupt

    model.between_updates = fail  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        model.learn(200, reset_num_timesteps=False)
    model.between_updates = lambda: None  # type: ignore[method-assign]
    model.learn(20, reset_num_timesteps=False)
    _, rewards, _, _ = env.step(np.array([[0.5, 0], [0.25, 0]], np.float32))
    assert rewards.tolist() == [0.5, 0.25]
    buffer = model.replay_buffer
    stored = slice(buffer.pos - 5, buffer.pos)  # the reward is the action's first entry
    assert np.allclose(buffer.rewards[stored], buffer.actions[stored, :, 0])
    env.close()
