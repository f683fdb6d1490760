"""Any environment with images and continuous actions: sizes, layouts, stacks, copies, and how many updates it gets."""

from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecFrameStack

from sb3_crc import CRCSAC
from tests.conftest import POLICY_KWARGS, NoiseEnv

SETTINGS: dict[str, Any] = {
    "batch_size": 8,
    "buffer_size": 60,
    "learning_starts": 12,
    "policy_kwargs": POLICY_KWARGS,
    "seed": 1,
}


class FrameEnv(NoiseEnv):
    """Random frames of any shape, all of them kept; episodes of five steps."""

    def __init__(self, height: int = 36, width: int = 36, channels: int = 3, channel_last: bool = False):
        super().__init__(length=5)
        shape = (height, width, channels) if channel_last else (channels, height, width)
        self.observation_space = gym.spaces.Box(0, 255, shape, np.uint8)
        self.seen: list[np.ndarray] = []

    def _frame(self) -> np.ndarray:
        self.seen.append(super()._frame())
        return self.seen[-1]


def steps_of(optimizer: th.optim.Optimizer) -> int:
    """How often it stepped; zero before the first time."""
    counts = {int(state["step"]) for state in optimizer.state.values()}
    assert len(counts) <= 1
    return counts.pop() if counts else 0


def assert_learned(model: CRCSAC, fresh: CRCSAC) -> None:
    for name in ("encoder", "actor"):
        now, before = (
            m.critic.features_extractor.parameters() if name == "encoder" else m.actor.own_parameters() for m in (model, fresh)
        )
        assert not any(map(th.equal, now, before)), name
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())


@pytest.mark.parametrize("channel_last", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 9, 12])
@pytest.mark.parametrize(("height", "width"), [(36, 36), (40, 52), (64, 64)])
def test_frames_of_any_size_and_layout(height: int, width: int, channels: int, channel_last: bool) -> None:
    env = FrameEnv(height, width, channels, channel_last)
    model, fresh = (CRCSAC("CnnPolicy", environment, **SETTINGS) for environment in (env, FrameEnv(height, width, channels)))
    model.learn(14)
    assert model._n_updates == 2
    assert_learned(model, fresh)
    assert model.policy.key_encoder.input_shape == (channels, round(0.84 * height), round(0.84 * width))

    assert model.replay_buffer is not None
    for stored, seen in zip(model.replay_buffer.observations[:5, 0], env.seen, strict=False):
        assert np.array_equal(stored, seen.transpose(2, 0, 1) if channel_last else seen)
    action, _ = model.predict(env.observation_space.sample())
    assert action.shape == (2,) and env.action_space.contains(action)


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("channel_last", [False, True])
@pytest.mark.parametrize("channels_order", ["given", None])
def test_sb3s_frame_stacks(n_envs: int, channel_last: bool, channels_order: str | None) -> None:
    if channels_order is not None:
        channels_order = "last" if channel_last else "first"
    venv = DummyVecEnv([partial(FrameEnv, 40, 52, 2, channel_last)] * n_envs)
    model = CRCSAC("CnnPolicy", VecFrameStack(venv, 3, channels_order), **SETTINGS)
    model.learn(18)
    assert model._n_updates == 6 // n_envs
    assert model.policy.key_encoder.input_shape == (6, 34, 44)

    assert model.replay_buffer is not None
    for index, env in enumerate(venv.envs):  # the third observation holds the first three frames, the oldest first
        frames = [frame.transpose(2, 0, 1) if channel_last else frame for frame in env.seen[:3]]
        assert np.array_equal(model.replay_buffer.observations[2, index], np.concatenate(frames))


#: (n_envs, train_freq, gradient_steps) -> updates after learn(24) with twelve steps of warm-up and episodes of five steps
UPDATES: list[tuple[int, Any, int, int]] = [
    (1, 1, 1, 12),
    (1, 1, -1, 12),
    (1, (2, "step"), 1, 6),
    (1, (2, "step"), 3, 18),
    (1, (2, "step"), -1, 12),
    (1, (1, "episode"), 1, 3),  # ends at steps 15, 20, 25
    (1, (1, "episode"), -1, 15),
    (1, (2, "episode"), 1, 2),  # ends at steps 20, 30
    (1, (2, "episode"), -1, 20),
    (3, 1, 1, 4),  # ends at steps 15, 18, 21, 24
    (3, 1, -1, 12),
    (3, (2, "step"), 1, 2),  # ends at steps 18, 24
    (3, (2, "step"), -1, 12),
]


@pytest.mark.parametrize(("n_envs", "train_freq", "gradient_steps", "updates"), UPDATES)
def test_updates_follow_train_freq_and_gradient_steps(n_envs: int, train_freq: Any, gradient_steps: int, updates: int) -> None:
    assert_counts(DummyVecEnv([FrameEnv] * n_envs), train_freq, gradient_steps, updates)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_environments_in_their_own_processes(n_envs: int) -> None:
    venv = SubprocVecEnv([partial(FrameEnv, channel_last=True)] * n_envs, start_method="fork")  # which imports nothing anew
    try:
        assert_counts(venv, (2, "step"), -1, 12)
    finally:
        venv.close()


def assert_counts(venv: VecEnv, train_freq: Any, gradient_steps: int, updates: int) -> None:
    settings = {"train_freq": train_freq, "gradient_steps": gradient_steps, "policy_delay": 3, "target_update_interval": 4}
    model = CRCSAC("CnnPolicy", venv, **SETTINGS, **settings)
    targets: list[int] = []
    update_targets = model._update_targets
    model._update_targets = lambda: targets.append(model._n_updates) or update_targets()
    model.learn(24)
    assert model._n_updates == updates
    assert steps_of(model.critic.optimizer) == updates
    assert steps_of(model.actor.optimizer) == steps_of(model.ent_coef_optimizer) == updates // 3
    assert targets == list(range(4, updates + 1, 4))


def test_training_by_episodes_needs_one_environment() -> None:
    model = CRCSAC("CnnPolicy", DummyVecEnv([FrameEnv] * 3), **SETTINGS, train_freq=(1, "episode"))
    with pytest.raises(AssertionError, match="only one env"):
        model.learn(24)


def test_delays_count_updates_over_calls_of_learn_and_over_load(tmp_path: Path) -> None:
    model = CRCSAC("CnnPolicy", FrameEnv(), **SETTINGS, policy_delay=3, target_update_interval=4)
    model.learn(14)
    assert (model._n_updates, steps_of(model.actor.optimizer)) == (2, 0)
    model.learn(1, reset_num_timesteps=False)
    assert (model._n_updates, steps_of(model.actor.optimizer)) == (3, 1)

    assert model.replay_buffer is not None
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    loaded = CRCSAC.load(tmp_path / "model.zip", env=FrameEnv())
    loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    key_encoder = next(loaded.policy.key_encoder.parameters())
    before = key_encoder.clone()
    loaded.learn(1, reset_num_timesteps=False)
    assert (loaded._n_updates, steps_of(loaded.actor.optimizer)) == (4, 1)
    assert not th.equal(key_encoder, before)
    before = key_encoder.clone()
    loaded.learn(2, reset_num_timesteps=False)
    assert (loaded._n_updates, steps_of(loaded.actor.optimizer)) == (6, 2)
    assert th.equal(key_encoder, before)


@pytest.mark.parametrize(("ent_coef", "start"), [("auto", 1.0), ("auto_0.3", 0.3), (0.3, 0.3)])
def test_the_temperature_is_learned_or_fixed(ent_coef: str | float, start: float) -> None:
    model = CRCSAC("CnnPolicy", FrameEnv(), **SETTINGS, ent_coef=ent_coef)
    assert model._temperature().item() == pytest.approx(start)
    model.learn(16)
    assert (model._temperature().item() == pytest.approx(start, rel=1e-6)) == isinstance(ent_coef, float)


def test_more_channels_than_rows_are_refused() -> None:
    """SB3 would take such frames for channel-last ones, transpose them and go on."""
    with pytest.raises(ValueError, match="channels.*fewer"):
        CRCSAC("CnnPolicy", FrameEnv(channels=40), **SETTINGS)
