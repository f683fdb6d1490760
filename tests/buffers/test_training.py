"""CRCSAC, and SB3's SAC, with the buffer that stores each frame once."""

from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecTransposeImage

from sb3_crc import CRCSAC, FrameReplayBuffer
from sb3_crc.objectives import AuxiliaryObjective
from sb3_crc.presets import PRESETS
from sb3_crc.stacking import stacked_frame_channels
from sb3_crc.views import Views
from tests.conftest import POLICY_KWARGS, SIZE

SETTINGS: dict[str, Any] = {
    "batch_size": 8,
    "buffer_size": 30,
    "learning_starts": 12,
    "policy_kwargs": POLICY_KWARGS,
    "seed": 1,
    "device": "cpu",
}


class FrameEnv(gym.Env[np.ndarray, np.ndarray]):
    """Single random frames; every other episode of five steps ends by truncation."""

    def __init__(self, channel_last: bool = False, size: int = SIZE):
        shape = (size, size, 3) if channel_last else (3, size, size)
        self.observation_space = gym.spaces.Box(0, 255, shape, np.uint8)
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.steps = 0

    def _observe(self, new_episode: bool) -> np.ndarray:
        return self.np_random.integers(0, 256, self.observation_space.shape, np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return self._observe(True), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self._observe(False), float(action[0]), self.steps % 10 == 5, self.steps % 10 == 0, {}


class StackEnv(FrameEnv):
    """It stacks three frames itself, and says so."""

    frame_channels: int | None = 3

    def __init__(self, frame_channels: int | None = 3, size: int = SIZE):
        super().__init__(size=size)
        self.frame_channels = frame_channels
        self.frame_space = self.observation_space
        self.observation_space = gym.spaces.Box(0, 255, (9, size, size), np.uint8)

    def _observe(self, new_episode: bool) -> np.ndarray:
        frame = self.np_random.integers(0, 256, self.frame_space.shape, np.uint8)
        self.frames = [frame] * 3 if new_episode else [*self.frames[1:], frame]
        return np.concatenate(self.frames)


def buffer_of(model: SAC) -> FrameReplayBuffer:
    assert isinstance(model.replay_buffer, FrameReplayBuffer)
    return model.replay_buffer


def parameters(model: CRCSAC) -> dict[str, th.Tensor]:
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


# -- Which buffer, and how it splits observations ----------------------------------------------------------------------


def test_stacks_of_an_environment_that_says_so() -> None:
    model = CRCSAC("CnnPolicy", StackEnv(), **SETTINGS).learn(20)
    assert type(model.replay_buffer) is FrameReplayBuffer
    assert (buffer_of(model).frame_channels, buffer_of(model).stack_size) == (3, 3)
    assert len(buffer_of(model).store) == 1 + 20 + 3  # four episodes begin, the fifth with the next step
    assert (model.replay_buffer_class, model.replay_buffer_kwargs, model.n_steps) == (None, {}, 1)  # as given


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("channel_last", [False, True])
def test_stacks_of_sb3s_wrapper(channel_last: bool, n_envs: int) -> None:
    env: VecEnv = VecFrameStack(DummyVecEnv([partial(FrameEnv, channel_last)] * n_envs), 4)
    env = VecTransposeImage(env) if channel_last else env
    assert stacked_frame_channels(env) == 3
    model = CRCSAC("CnnPolicy", env, **SETTINGS).learn(24)
    buffer = buffer_of(model)
    assert (buffer.frame_channels, buffer.stack_size, buffer.size()) == (3, 4, 24 // n_envs)
    episodes = -(-(24 // n_envs) // 5)
    assert len(buffer.store) == 24 + 2 * n_envs * episodes  # each first stack is black and a frame


def test_other_observations_are_stored_whole() -> None:
    model = CRCSAC("CnnPolicy", FrameEnv(), **SETTINGS).learn(14)
    assert (buffer_of(model).frame_channels, buffer_of(model).stack_size) == (None, 1)


def test_environments_that_disagree_are_refused() -> None:
    env = DummyVecEnv([StackEnv, partial(StackEnv, 9)])
    with pytest.raises(ValueError, match=r"disagree about frame_channels: \[3, 9\]"):
        CRCSAC("CnnPolicy", env, **SETTINGS)


def test_what_the_user_says_counts() -> None:
    kwargs = {"frame_channels": None}
    model = CRCSAC("CnnPolicy", StackEnv(), replay_buffer_kwargs=kwargs, **SETTINGS).learn(14)
    assert buffer_of(model).frame_channels is None and model.replay_buffer_kwargs == {"frame_channels": None}
    with pytest.raises(ValueError, match="transition 0 of environment 0"):
        CRCSAC("CnnPolicy", FrameEnv(), replay_buffer_kwargs={"frame_channels": 1}, **SETTINGS).learn(2)


def test_a_model_loaded_without_an_environment_has_the_same_buffer(tmp_path: Path) -> None:
    CRCSAC("CnnPolicy", StackEnv(), n_steps=3, **SETTINGS).save(tmp_path / "model")
    loaded = CRCSAC.load(tmp_path / "model", gamma=0.5)
    buffer = buffer_of(loaded)
    assert (buffer.frame_channels, buffer.n_steps, buffer.gamma, loaded.n_steps) == (3, 3, 0.5, 3)
    loaded.set_env(StackEnv())
    loaded.learn(14)


def test_stock_buffers_still_train() -> None:
    model = CRCSAC("CnnPolicy", StackEnv(), replay_buffer_class=ReplayBuffer, **SETTINGS).learn(16)
    assert type(model.replay_buffer) is ReplayBuffer and model._n_updates == 4


# -- Nothing else changes ----------------------------------------------------------------------------------------------

CONFIGURATIONS: dict[str, dict[str, Any]] = {
    "crc": {},
    "rad with shifts": {"objectives": {}, "augmentation": "random_shift"},
    "crc_release": {"augmentation": "random_crop_overlay", "objectives": PRESETS["crc_release"]["objectives"]},
    "pixel_sac": {"augmentation": "center_crop", "objectives": {}},
    "three steps": {"n_steps": 3},
    "two environments": {"env": lambda: DummyVecEnv([StackEnv] * 2), "gradient_steps": -1},
    "sb3's stacks": {"env": lambda: VecFrameStack(DummyVecEnv([FrameEnv] * 2), 3, "first"), "n_steps": 2},
}


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_training_is_the_same_bit_for_bit(name: str) -> None:
    """As with SB3's buffers, also after the ring has been round."""
    settings = {"env": StackEnv, **SETTINGS, "learning_starts": 28, **CONFIGURATIONS[name]}
    make_env = settings.pop("env")
    n_steps = settings.get("n_steps", 1)
    stock: dict[str, Any] = {"replay_buffer_class": ReplayBuffer}
    if n_steps > 1:
        kwargs = {"n_steps": n_steps, "gamma": 0.99}
        stock = {"replay_buffer_class": NStepReplayBuffer, "replay_buffer_kwargs": kwargs, "n_steps": 1}
    models = [CRCSAC("CnnPolicy", make_env(), **{**settings, **own}).learn(40) for own in ({}, stock)]
    assert buffer_of(models[0]).full and type(models[1].replay_buffer) is stock["replay_buffer_class"]
    assert models[0]._n_updates == models[1]._n_updates >= 6
    one, other = (parameters(model) for model in models)
    assert [key for key in one if not th.equal(one[key], other[key])] == []


def test_no_whole_batch_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    model = CRCSAC("CnnPolicy", StackEnv(), **SETTINGS).learn(12)
    monkeypatch.setattr("sb3_crc.buffers.store.FrameStacks.whole", None)
    model.train(2, 8)


def test_learning_again_is_an_interruption() -> None:
    """SB3 resets the environment then, in the middle of an episode; sums of rewards must not go on."""
    model = CRCSAC("CnnPolicy", StackEnv(), n_steps=3, **SETTINGS).learn(7)
    model.learn(3, reset_num_timesteps=False)
    assert not buffer_of(model).interrupted.any()
    model.learn(6)
    assert np.flatnonzero(buffer_of(model).interrupted).tolist() == []  # step 10 ended an episode
    model.learn(3)
    assert np.flatnonzero(buffer_of(model).interrupted).tolist() == [15]


def test_an_interruption_shows_when_the_reset_looks_like_a_continuation(monkeypatch: pytest.MonkeyPatch) -> None:
    black = np.zeros((9, SIZE, SIZE), np.uint8)
    monkeypatch.setattr(StackEnv, "_observe", lambda self, new_episode: black)
    model = CRCSAC("CnnPolicy", StackEnv(), **SETTINGS).learn(3)
    model.learn(3)
    assert np.flatnonzero(buffer_of(model).interrupted).tolist() == [2]


# -- o_{t+1} beside o_{t+n} --------------------------------------------------------------------------------------------


class Following(AuxiliaryObjective):
    reads_next = True

    def forward(self, views: Views) -> th.Tensor:
        self.seen = views.next, views.bootstrap
        return views.anchor.latent.square().mean()


class Undeclared(Following):
    reads_next = False


def test_an_objective_that_declares_it_gets_the_observation_one_step_on(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {**SETTINGS, "augmentation": "center_crop", "objectives": {f"{__name__}.Following": 1.0}}
    model = CRCSAC("CnnPolicy", StackEnv(), n_steps=3, **settings).learn(12)
    sampled, sample = [], buffer_of(model).sample_frames
    monkeypatch.setattr(buffer_of(model), "sample_frames", lambda *a, **k: sampled.append(sample(*a, **k)) or sampled[-1])
    model.train(1, 8)
    whole = sampled[0].whole()
    one_step, bootstrap = (view.images for view in model.policy.objectives["Following"].seen)
    assert th.equal(one_step, model._augment(whole.one_step_observations))
    assert th.equal(bootstrap, model._augment(whole.next_observations))
    assert not th.equal(one_step, bootstrap)
    assert np.array_equal(sampled[0].one_step_observations.numbers[:, :-1], sampled[0].observations.numbers[:, 1:])


def test_with_one_step_both_are_one_view() -> None:
    model = CRCSAC("CnnPolicy", StackEnv(), **SETTINGS, objectives={f"{__name__}.Following": 1.0}).learn(13)
    one_step, bootstrap = model.policy.objectives["Following"].seen
    assert one_step is bootstrap


@pytest.mark.parametrize("n_steps", [1, 3])
def test_an_objective_that_does_not_declare_it_is_told_to(n_steps: int) -> None:
    model = CRCSAC("CnnPolicy", StackEnv(), n_steps=n_steps, **SETTINGS, objectives={f"{__name__}.Undeclared": 1.0})
    with pytest.raises(RuntimeError, match="must declare it: reads_next = True"):
        model.learn(14)


def test_a_buffer_that_does_not_keep_it_is_refused_at_construction() -> None:
    settings = {**SETTINGS, "objectives": {f"{__name__}.Following": 1.0}, "n_steps": 3}
    kwargs = {"replay_buffer_class": NStepReplayBuffer, "replay_buffer_kwargs": {"n_steps": 3, "gamma": 0.99}}
    message = "'Following' reads the observation one step on, which NStepReplayBuffer"
    with pytest.warns(UserWarning, match="n_steps=3"), pytest.raises(ValueError, match=message):
        CRCSAC("CnnPolicy", StackEnv(), **settings, **kwargs)


@pytest.mark.parametrize("n_steps", [1, 3])
def test_what_counts_is_over_how_many_rewards_the_buffer_sums(n_steps: int) -> None:
    """SB3 tells users of a buffer class of their own to give it ``n_steps`` themselves; one that has none sums none."""
    settings = {**SETTINGS, "objectives": {f"{__name__}.Following": 1.0}}
    kwargs = {"replay_buffer_class": NStepReplayBuffer, "replay_buffer_kwargs": {"n_steps": n_steps, "gamma": 0.99}}
    if n_steps == 3:
        with pytest.raises(ValueError, match="'Following' reads the observation one step on, which NStepReplayBuffer"):
            CRCSAC("CnnPolicy", StackEnv(), **settings, **kwargs)
    else:
        CRCSAC("CnnPolicy", StackEnv(), **settings, **kwargs)
    with pytest.warns(UserWarning, match="n_steps"):
        CRCSAC("CnnPolicy", StackEnv(), **settings, n_steps=3, replay_buffer_class=ReplayBuffer)


# -- SB3's own SAC -----------------------------------------------------------------------------------------------------


def test_sb3s_sac_trains_saves_and_loads_with_it(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"buffer_size": 5_000, "learning_starts": 12, "batch_size": 8, "seed": 1, "device": "cpu"}
    settings["policy_kwargs"] = {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 16}}
    models = []
    for buffer_class, kwargs in ((FrameReplayBuffer, {"frame_channels": 3}), (ReplayBuffer, {})):
        own = {"replay_buffer_class": buffer_class, "replay_buffer_kwargs": kwargs}
        models.append(SAC("CnnPolicy", StackEnv(), **settings, **own).learn(20))
    model, stock = models
    one, other = (m.policy.state_dict() for m in models)
    assert [key for key in one if not th.equal(one[key], other[key])] == []

    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    frames = buffer_of(model).store
    assert (tmp_path / "buffer.pkl").stat().st_size < len(frames) * frames.frame_bytes + 5_000 * 80
    loaded = SAC.load(tmp_path / "model", env=StackEnv())
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert np.array_equal(buffer_of(loaded).observations, stock.replay_buffer.observations[:20])
    loaded.learn(10, reset_num_timesteps=False)
    assert buffer_of(loaded).size() == 30
