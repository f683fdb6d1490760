"""Updates made while the environments step have the results that they have afterwards."""

import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecFrameStack

from sb3_crc import CRCSAC
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
