"""CRCSAC on Dict observations: an image, whose frames are stored once, and vectors beside it."""

import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_crc import CRCSAC, DictFrameReplayBuffer
from tests.buffers.test_training import SETTINGS, FrameEnv, StackEnv, parameters
from tests.buffers.worlds import assert_same
from tests.conftest import SIZE

Observation = dict[str, np.ndarray]


class Both(gym.Wrapper[Observation, np.ndarray, np.ndarray, np.ndarray]):
    """What the environment shows, and numbers that tell which observation of the episode it is."""

    def __init__(self, env: gym.Env[np.ndarray, np.ndarray], names: bool = True):
        super().__init__(env)
        entries: dict[str, spaces.Space[Any]] = {
            "time": spaces.Box(-np.inf, np.inf, (1,), np.float64),
            "camera": env.observation_space,
            "state": spaces.Box(-np.inf, np.inf, (2, 2), np.float32),
        }
        if names:
            entries["mode"] = spaces.Discrete(3)
        self.observation_space = spaces.Dict(entries)
        self.time = 0

    @property
    def frame_channels(self) -> Any:
        return getattr(self.env, "frame_channels", None)

    def _both(self, image: np.ndarray) -> Observation:
        state = np.array([[self.time, 1], [0, -self.time]], np.float32)
        observation = {"time": np.array([self.time]), "camera": image, "state": state, "mode": np.array(self.time % 3)}
        return {key: observation[key] for key in self.observation_space}

    def reset(self, **kwargs: Any) -> tuple[Observation, dict[str, Any]]:
        image, info = self.env.reset(**kwargs)
        self.time = 0
        return self._both(image), info

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        image, *rest = self.env.step(action)
        self.time += 1
        return self._both(image), *rest


def make(env: Any = None, **kwargs: Any) -> CRCSAC:
    return CRCSAC("MultiInputPolicy", env or Both(StackEnv()), **{**SETTINGS, **kwargs})


def buffer_of(model: CRCSAC) -> DictFrameReplayBuffer:
    assert isinstance(model.replay_buffer, DictFrameReplayBuffer)
    return model.replay_buffer


ENVS: dict[str, Any] = {
    "stacks": lambda: Both(StackEnv()),
    "single frames": lambda: Both(FrameEnv()),
    "channels last": lambda: Both(FrameEnv(channel_last=True)),
    "three environments": lambda: DummyVecEnv([lambda: Both(StackEnv())] * 3),
    "sb3's stacks": lambda: VecFrameStack(DummyVecEnv([lambda: Both(FrameEnv(channel_last=True), names=False)] * 2), 2),
}


@pytest.mark.parametrize("name", ENVS)
def test_training_is_the_same_as_with_sb3s_buffer(name: str) -> None:
    models = [make(ENVS[name](), replay_buffer_class=cls, learning_starts=28).learn(40) for cls in (None, DictReplayBuffer)]
    channels = {"stacks": 3, "three environments": 3, "sb3's stacks": 3}.get(name)
    assert buffer_of(models[0]).frame_channels == channels and type(models[1].replay_buffer) is DictReplayBuffer
    assert models[0]._n_updates == models[1]._n_updates >= 4
    one, other = (parameters(model) for model in models)
    assert [key for key in one if not th.equal(one[key], other[key])] == []
    before = parameters(make(ENVS[name]()))
    changed = {key.split(".")[0] for key in one if not th.equal(one[key], before[key])}
    assert {"actor", "critic", "objectives"} <= changed


def test_three_steps() -> None:
    """SB3 has no n-step returns for Dict observations."""
    model = make(n_steps=3).learn(30)
    buffer = buffer_of(model)
    samples = buffer._get_samples(np.arange(30))
    time, after, one_step = (
        samples._asdict()[key]["time"] for key in ("observations", "next_observations", "one_step_observations")
    )
    assert th.equal(one_step, time + 1)
    taken = (after - time)[:, 0]
    assert set(taken.tolist()) == {1, 2, 3}
    assert np.allclose(samples.discounts[:, 0], 0.99**taken)
    assert set(samples.dones[:, 0].tolist()) == {0, 1}


def observations(count: int = 4) -> dict[str, th.Tensor]:
    generator = th.Generator().manual_seed(0)
    return {
        "time": th.ones(count, 1, dtype=th.float64),
        "camera": th.randint(256, (count, 9, SIZE, SIZE), dtype=th.uint8, generator=generator),
        "state": th.ones(count, 2, 2),
        "mode": th.ones(count, 1, dtype=th.long),
    }


@pytest.mark.parametrize("key", ["time", "state", "mode"])
def test_proprioception_reaches_actor_and_critic(key: str) -> None:
    model = make().learn(14)
    obs = observations()
    other = {**obs, key: obs[key] + 1}
    actions = th.zeros(4, 2)
    with th.no_grad():
        assert not th.equal(model.actor(obs, deterministic=True), model.actor(other, deterministic=True))
        for one, two in zip(model.critic(obs, actions), model.critic(other, actions), strict=True):
            assert not th.equal(one, two)


def test_encoder_and_objectives_see_the_image_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make().learn(14)
    batch, losses, proprioception = buffer_of(model).sample(8), [], []
    other = {**batch.observations, "state": batch.observations["state"] + 1, "time": batch.observations["time"] - 1}
    for observations in (batch.observations, other):
        sampled = batch._replace(observations=observations)
        monkeypatch.setattr(buffer_of(model), "sample_frames", lambda *args, sampled=sampled, **kwargs: sampled)
        th.manual_seed(0)
        views = model._sample_views(8)
        losses.append([objective(views).item() for objective in model.policy.objectives.values()])
        proprioception.append(views.anchor.proprioception)
    assert losses[0] == losses[1] and len(losses[0]) == 3
    # The vectors in the order of their keys: mode (one of three), state, time
    assert proprioception[0].shape == (8, 3 + 4 + 1) and not th.equal(*proprioception)


def test_predict_takes_one_observation_or_many_in_any_layout() -> None:
    env = Both(FrameEnv(channel_last=True))
    model = make(env).learn(13)
    observation, _ = env.reset(seed=0)
    assert observation["camera"].shape == (SIZE, SIZE, 3)
    action, _ = model.predict(observation, deterministic=True)
    many = {key: np.stack([value] * 3) for key, value in observation.items()}
    actions, _ = model.predict(many, deterministic=True)
    assert action.shape == (2,) and actions.shape == (3, 2)
    assert np.allclose(actions, action)


def test_model_and_buffer_are_saved_and_loaded(tmp_path: Path) -> None:
    model = make(n_steps=2).learn(20)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = CRCSAC.load(tmp_path / "model", env=Both(StackEnv()))
    loaded.load_replay_buffer(tmp_path / "buffer")
    for key, values in buffer_of(model).next_observations.items():
        assert_same(buffer_of(loaded).next_observations[key], values)
    observation, _ = Both(StackEnv()).reset(seed=3)
    assert np.array_equal(*(m.predict(observation, deterministic=True)[0] for m in (model, loaded)))
    loaded.learn(5, reset_num_timesteps=False)
    assert buffer_of(loaded).size() == 25 and buffer_of(loaded).interrupted.sum() == 0  # step 20 ended an episode
    loaded.learn(4)
    loaded.learn(1)
    assert np.flatnonzero(buffer_of(loaded).interrupted).tolist() == [28]


def test_vec_normalize_normalizes_vectors() -> None:
    env = VecNormalize(DummyVecEnv([lambda: Both(StackEnv())]), norm_obs_keys=["state"], gamma=0.99)
    models = [
        make(VecNormalize(DummyVecEnv([lambda: Both(StackEnv())]), norm_obs_keys=["state"]), replay_buffer_class=cls).learn(20)
        for cls in (None, DictReplayBuffer)
    ]
    one, other = (parameters(model) for model in models)
    assert [key for key in one if not th.equal(one[key], other[key])] == []
    model = make(env).learn(20)
    raw, normalized = (buffer_of(model)._get_samples(np.arange(20), env=e).observations for e in (None, env))
    assert th.equal(raw["camera"], normalized["camera"]) and th.equal(raw["time"], normalized["time"])
    expected = env.normalize_obs({key: value.numpy() for key, value in raw.items()})["state"]
    assert_same(normalized["state"].numpy(), expected)
    assert not th.equal(raw["state"], normalized["state"])


@pytest.mark.parametrize("net_arch", [[], {"pi": [], "qf": [16]}])
def test_heads_without_hidden_layers(net_arch: Any) -> None:
    model = make(policy_kwargs={**SETTINGS["policy_kwargs"], "net_arch": net_arch})
    before = parameters(model)
    model.learn(14)
    after = parameters(model)
    assert not any(th.equal(before[name], after[name]) for name in ("actor.mu.weight", "critic.qf0.0.weight"))
    assert model.predict(model.env.reset())[0].shape == (1, *model.action_space.shape)


class Scalar(gym.Wrapper[Observation, np.ndarray, np.ndarray, np.ndarray]):
    """One number beside the image, without an axis."""

    def __init__(self, env: gym.Env[np.ndarray, np.ndarray]):
        super().__init__(env)
        number = spaces.Box(-1, 1, (), np.float32)
        self.observation_space = spaces.Dict({"camera": env.observation_space, "number": number})
        self.frame_channels = 3

    def reset(self, **kwargs: Any) -> tuple[Observation, dict[str, Any]]:
        image, info = self.env.reset(**kwargs)
        return {"camera": image, "number": np.array(0.5, np.float32)}, info

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        image, *rest = self.env.step(action)
        return {"camera": image, "number": np.array(action[0], np.float32)}, *rest


def test_a_number_without_an_axis_beside_the_image() -> None:
    model = make(Scalar(StackEnv())).learn(20)
    samples = model.replay_buffer.sample(8)
    assert samples.observations["number"].shape == (8,)
    assert np.allclose(samples.next_observations["number"], samples.actions[:, 0], atol=1e-6)
