"""The stock SAC that our methods are compared with: it is SB3's, takes what is matched, and can be saved and resumed."""

from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rl_zoo3
import torch as th
import yaml
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.torch_layers import FlattenExtractor, NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sb3_crc import PRESETS, FrameReplayBuffer, PixelEncoder, QBiasEvalCallback, TrainingCheckpoint, make_dmc
from sb3_crc.configurations import settings_for
from sb3_crc.stock import STOCK, shared_settings
from sb3_crc.zoo import CRCExperimentManager, register
from sb3_crc.zoo.algorithms import watched
from sb3_crc.zoo.resume import CHECKPOINTS, Plan
from tests.conftest import POLICY_KWARGS, NoiseEnv, make_model

ENV = "dmc_pixels/cartpole-swingup-v0"
ENV_KWARGS = {"image_size": 36, "frame_stack": 2, "render_quality": "fast", "action_repeat": 40}
#: One file for all: what our methods are trained with
SHARED: dict[str, Any] = {
    "n_timesteps": 40,
    "policy": "CnnPolicy",
    "env_kwargs": ENV_KWARGS,
    "buffer_size": 60,
    "learning_rate": 0.0007,
    "batch_size": 12,
    "train_freq": 2,
    "gradient_steps": 3,
    "learning_starts": 30,
    "gamma": 0.97,
    "tau": 0.03,
    "ent_coef": "auto_0.2",
    "encoder_tau": 0.1,
    "n_steps": 3,
    "reward_scale": 0.1,
    "policy_delay": 2,
    "augmentation": "random_shift",
    "augmentation_kwargs": {"pad": 2},
    "policy_kwargs": {**POLICY_KWARGS, "layer_norm": True},
    "presets": {"crc": {"objectives": {"contrastive": 1.0}}, "sac": {"batch_size": 16, "learning_starts": 30}},
}


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs of the zoo in this process, in one folder each."""
    register()
    (tmp_path / "config.yml").write_text(yaml.safe_dump({ENV: SHARED}))

    def make(algorithm: str, plan: Plan | None = None, folder: str = "logs", **kwargs: Any) -> CRCExperimentManager:
        monkeypatch.setattr(CRCExperimentManager, "plan", plan or Plan([], None, None))
        settings = {"config": str(tmp_path / "config.yml"), "verbose": 0, "device": "cpu", "seed": 1, "eval_freq": -1}
        settings["log_interval"] = -1
        arguments = Namespace(), algorithm, ENV, str(tmp_path / folder)
        return CRCExperimentManager(*arguments, **{**settings, **kwargs})

    return make


def assert_equal_networks(one: SAC, other: SAC) -> None:
    states = one.policy.state_dict(), other.policy.state_dict()
    assert states[0].keys() == states[1].keys()
    for name, values in states[0].items():
        assert th.equal(values, states[1][name]), name


# -- What they are -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ["sac", "state_sac"])
def test_it_learns_what_sb3s_sac_learns(algorithm: str, manager: Any) -> None:
    """Weight by weight, with our buffer beside SB3's own."""
    run = manager(algorithm, hyperparams={"learning_starts": 30, "batch_size": 16, "gamma": 0.99})
    model, _ = run.setup_experiment()
    run.learn(model)
    observation = {"action_repeat": 40, "observation": "state"} if algorithm == "state_sac" else ENV_KWARGS
    policy = "MlpPolicy" if algorithm == "state_sac" else "CnnPolicy"
    env = make_dmc("cartpole-swingup", **observation)
    stock = SAC(policy, env, buffer_size=60, learning_starts=30, batch_size=16, seed=1, device="cpu").learn(40)
    assert type(stock.replay_buffer) is ReplayBuffer and type(model.replay_buffer) is FrameReplayBuffer
    assert model._n_updates == stock._n_updates == 10
    assert_equal_networks(model, stock)
    assert th.equal(model.log_ent_coef, stock.log_ent_coef)


def test_sac_has_sb3s_defaults(manager: Any) -> None:
    ours, _ = manager("sac", hyperparams={"learning_starts": 100, "batch_size": 256}).setup_experiment()
    stock = SAC("CnnPolicy", ours.env, buffer_size=60, seed=1, device="cpu")
    own = {"replay_buffer_class", "replay_buffer_kwargs", "tensorboard_log", "verbose"}
    plain = {name: value for name, value in vars(stock).items() if isinstance(value, int | float | str | None | tuple)}
    assert len(plain) > 20
    for name, value in plain.items():
        assert name in own or getattr(ours, name) == value, name
    assert type(ours.critic.features_extractor) is NatureCNN
    ours.env.close()


def test_sac_matched_has_our_networks_and_settings(manager: Any) -> None:
    model, saved = manager("sac_matched").setup_experiment()
    for extractor in (model.critic.features_extractor, model.actor.features_extractor):
        assert isinstance(extractor, PixelEncoder)
        assert (extractor.channels, extractor.strides, extractor.features_dim) == ((8, 8), (2, 2), 16)
        assert extractor.input_shape == (6, 36, 36)
    assert model.actor.features_extractor is not model.critic.features_extractor
    assert [layer.out_features for layer in model.critic.q_networks[0] if hasattr(layer, "out_features")] == [32, 32, 1]
    assert model.lr_schedule(1) == model.actor.optimizer.param_groups[0]["lr"] == SHARED["learning_rate"]
    for name in ("batch_size", "gradient_steps", "learning_starts", "gamma", "tau", "ent_coef", "buffer_size"):
        assert getattr(model, name) == saved[name] == SHARED[name], name
    assert model.train_freq.frequency == 2
    assert model.log_ent_coef.exp().item() == pytest.approx(0.2)
    assert (model.n_steps, model.target_update_interval, model.replay_buffer.n_steps) == (1, 1, 1)
    model.env.close()


def test_state_sac_sees_states(manager: Any) -> None:
    model, _ = manager("state_sac").setup_experiment()
    assert model.observation_space.shape == (5,) and model.observation_space.dtype == np.float32
    assert type(model.critic.features_extractor) is FlattenExtractor
    assert model.env.get_attr("action_repeat") == [40]
    assert (model.learning_rate, model.batch_size, model.learning_starts, model.gamma) == (3e-4, 256, 30, 0.97)
    assert model.replay_buffer.frame_channels is None
    model.env.close()


# -- What they take of a configuration for others ----------------------------------------------------------------------


def test_shared_settings() -> None:
    environment = {"n_timesteps": 40, "env_kwargs": ENV_KWARGS, "buffer_size": 60}
    assert shared_settings("sac", SHARED) == {**environment, "policy": "CnnPolicy"}
    names = ("learning_rate", "batch_size", "train_freq", "gradient_steps", "learning_starts", "gamma", "tau", "ent_coef")
    assert shared_settings("sac_matched", SHARED) == {
        **environment,
        "policy": "CnnPolicy",
        **{name: SHARED[name] for name in names},
        "policy_kwargs": POLICY_KWARGS,
    }
    assert shared_settings("state_sac", {**SHARED, "n_envs": 2}) == {
        "n_timesteps": 40,
        "n_envs": 2,
        "policy": "MlpPolicy",
        "env_kwargs": {"action_repeat": 40, "observation": "state"},
        "buffer_size": 60,
        "learning_starts": 30,
        "gamma": 0.97,
    }


def test_what_is_matched_has_our_default_where_nothing_is_said() -> None:
    settings = shared_settings("sac_matched", {"n_timesteps": 40, "policy": "CnnPolicy"})
    for name in ("learning_rate", "batch_size", "learning_starts", "gamma", "tau", "ent_coef", "buffer_size"):
        assert settings[name] == PRESETS["crc"][name], name
    model = STOCK["sac_matched"](env=NoiseEnv(size=100), **{k: v for k, v in settings.items() if k != "n_timesteps"})
    ours = make_model(NoiseEnv(size=100), policy_kwargs={}, buffer_size=50, image_size=100, augmentation="center_crop")
    one, other = model.critic.features_extractor, ours.critic.features_extractor
    assert {name: value.shape for name, value in one.state_dict().items()} == {
        name: value.shape for name, value in other.state_dict().items()
    }
    assert model.policy.net_arch == ours.policy.net_arch
    assert shared_settings("state_sac", {})["env_kwargs"] == {"observation": "state"}


@pytest.mark.parametrize(
    ("settings", "size"),
    [
        ({"augmentation": "random_crop", "env_kwargs": {"image_size": 100}}, 84),
        ({"env_kwargs": {"image_size": 50}}, 42),  # random_crop is CRCSAC's default
        ({"augmentation": "random_shift", "env_kwargs": {"image_size": 64}}, None),
        ({"image_size": 32, "env_kwargs": {"image_size": 64}}, 32),
        ({"augmentation": "random_crop"}, None),
        (
            {
                "env_kwargs": {"image_size": 100},
                "policy_kwargs": {"features_extractor_kwargs": {"image_size": 76}},
            },
            76,
        ),
    ],
)
def test_sac_matched_sees_as_much_of_a_frame_as_ours(settings: dict[str, Any], size: int | None) -> None:
    encoder = shared_settings("sac_matched", settings)["policy_kwargs"]["features_extractor_kwargs"]
    assert encoder.get("image_size") == size


@pytest.mark.parametrize(
    ("algorithm", "settings", "message"),
    [
        ("sac_match", {}, "unknown stock algorithm 'sac_match'; did you mean 'sac_matched'"),
        ("sac_matched", {"policy_kwargs": "dict(net_arch=[8])"}, "policy_kwargs must be a mapping"),
        ("state_sac", {"env_kwargs": [1]}, r"env_kwargs must be a mapping, .* it is \[1\]"),
    ],
)
def test_what_cannot_be_shared_is_named(algorithm: str, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        shared_settings(algorithm, settings)


# -- Replay buffers ----------------------------------------------------------------------------------------------------


def test_the_buffer_is_ours_where_it_can_be() -> None:
    def buffer(env: Any, policy: str = "CnnPolicy", **kwargs: Any) -> Any:
        return STOCK["sac"](policy, env, buffer_size=20, device="cpu", **kwargs).replay_buffer

    pixels = {"image_size": 36, "render_quality": "fast"}
    assert buffer(make_dmc("cartpole-swingup", **pixels)).frame_channels == 3
    assert buffer(VecFrameStack(DummyVecEnv([lambda: NoiseEnv(channels=3)]), 2)).frame_channels == 3
    states = DummyVecEnv([lambda: make_dmc("cartpole-swingup", observation="state")])
    for env in (states, VecFrameStack(states, 2)):
        assert (type(buffer(env, "MlpPolicy")), buffer(env, "MlpPolicy").frame_channels) == (FrameReplayBuffer, None)
    assert type(buffer(NoiseEnv(), replay_buffer_class=ReplayBuffer)) is ReplayBuffer
    assert type(buffer(NoiseEnv(), optimize_memory_usage=True, replay_buffer_kwargs=UNTRUNCATED)) is ReplayBuffer
    assert type(buffer(NoiseEnv(), n_steps=3)) is NStepReplayBuffer
    mixed = make_dmc("cartpole-swingup", observation="dict", **pixels)
    assert type(buffer(mixed, "MultiInputPolicy")) is DictReplayBuffer


UNTRUNCATED = {"handle_timeout_termination": False}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_states_are_stored_whole_and_sampled_as_by_sb3(dtype: type) -> None:
    space, actions = spaces.Box(-np.inf, np.inf, (5,), dtype), spaces.Box(-1, 1, (2,))
    ours, theirs = FrameReplayBuffer(8, space, actions, device="cpu"), ReplayBuffer(8, space, actions, device="cpu")
    random = np.random.default_rng(0)
    obs = random.normal(size=(1, 5)).astype(dtype)
    for step in range(13):
        following = random.normal(size=(1, 5)).astype(dtype)
        done = np.array([step % 4 == 3])
        for buffer in (ours, theirs):
            buffer.add(obs, following, np.zeros((1, 2)), np.array([float(step)]), done, [{"TimeLimit.truncated": step == 3}])
        obs = random.normal(size=(1, 5)).astype(dtype) if done[0] else following
    samples = []
    for buffer in (ours, theirs):
        np.random.seed(0)
        samples.append(buffer.sample(32))
    for name in ("observations", "next_observations", "actions", "rewards", "dones"):
        one, other = (getattr(sample, name) for sample in samples)
        assert one.dtype == other.dtype and th.equal(one, other), name


def test_states_are_no_stacks_of_frames() -> None:
    env = make_dmc("cartpole-swingup", observation="state")
    model = STOCK["state_sac"]("MlpPolicy", env, buffer_size=20, replay_buffer_kwargs={"frame_channels": 1})
    with pytest.raises(ValueError, match=r"store them whole: replay_buffer_kwargs=\{'frame_channels': None\}"):
        model.learn(3)


# -- Runs --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", STOCK)
def test_a_run_is_saved_and_goes_on_as_if_it_had_not_ended(algorithm: str, manager: Any) -> None:
    def trained(run: CRCExperimentManager) -> tuple[SAC, Path]:
        model, _ = run.setup_experiment()
        run.learn(model)
        return model, Path(run.save_path)

    whole, evaluated = trained(manager(algorithm, Plan([], 10, None), "whole", eval_freq=16, n_eval_episodes=1))
    first, folder = trained(manager(algorithm, Plan([], 10, None), "parts", n_timesteps=34))
    second, same = trained(manager(algorithm, Plan([], 10, folder), "parts"))
    assert same == folder and sorted((folder / CHECKPOINTS).glob("0*"))[-1].name == "000000000040"
    assert 0 < first._n_updates < second._n_updates == whole._n_updates
    assert_equal_networks(second, whole)

    second.save(folder / "model.zip")
    for path in (folder / "model.zip", evaluated / "best_model.zip"):  # the latter was saved while it was training
        for loaded in (SAC.load(path, device="cpu"), STOCK[algorithm].load(path, device="cpu")):
            assert type(loaded.replay_buffer) is FrameReplayBuffer
            assert loaded.replay_buffer.frame_channels == second.replay_buffer.frame_channels
            if path.name == "model.zip":
                assert_equal_networks(loaded, second)
    assert watched(STOCK[algorithm]).load(folder / "model.zip", device="cpu").replay_buffer.buffer_size == 1


def test_training_goes_on_from_a_saved_model(manager: Any, tmp_path: Path) -> None:
    model, _ = manager("sac_matched").setup_experiment()
    model.save(tmp_path / "model.zip")
    model.env.close()
    again, _ = manager("sac_matched", trained_agent=str(tmp_path / "model.zip")).setup_experiment()
    assert_equal_networks(again, model)
    assert again.learn(32)._n_updates == 3
    again.env.close()


def test_checkpoints_beside_an_evaluation_that_saves_the_best(tmp_path: Path) -> None:
    """What a TrainingCheckpoint hangs on a model that trains must not be pickled with it."""
    env = make_dmc("cartpole-swingup", observation="state", action_repeat=40)
    model = STOCK["state_sac"]("MlpPolicy", env, buffer_size=50, seed=0, device="cpu")
    evaluation = QBiasEvalCallback(Monitor(env), eval_freq=5, n_eval_episodes=1, best_model_save_path=str(tmp_path), verbose=0)
    model.learn(8, callback=[evaluation, TrainingCheckpoint(tmp_path / "checkpoints")])
    assert SAC.load(tmp_path / "best_model.zip").num_timesteps == 5


# -- In the zoo --------------------------------------------------------------------------------------------------------


def test_they_are_algorithms_of_the_zoo() -> None:
    register()
    for name, algorithm in STOCK.items():
        assert rl_zoo3.ALGOS[name] is algorithm and issubclass(algorithm, SAC)


def test_the_zoos_own_sac_configurations_stay_for_other_environments(tmp_path: Path) -> None:
    register()
    arguments = (str(tmp_path),)
    own = CRCExperimentManager(Namespace(), "sac", ENV, *arguments, verbose=0).config
    other = CRCExperimentManager(Namespace(), "sac", "Pendulum-v1", *arguments, verbose=0).config
    assert Path(own).parent.name == "zoo_configs" and Path(other).parent.name == "hyperparams"
    for path in (own, other):
        assert Path(path).name == "sac.yml" and Path(path).is_file()


def test_flags_count_instead_of_what_is_shared(manager: Any) -> None:
    consumed, saved = manager("sac", hyperparams={"gamma": 0.5, "batch_size": 64}).read_hyperparameters()
    assert consumed == saved == {**settings_for("sac", SHARED), "gamma": 0.5, "batch_size": 64}


def test_a_search_that_draws_nothing_is_refused(manager: Any) -> None:
    run = manager("sac_matched", optimize_hyperparameters=True)
    with pytest.raises(ValueError, match="-optimize draws nothing for 'sac_matched'"):
        run.hyperparameters_optimization()


def test_a_search_of_the_zoos_own_leaves_a_usable_best_trial(manager: Any, tmp_path: Path) -> None:
    search = {"optimize_hyperparameters": True, "n_trials": 1, "n_eval_episodes": 1, "pruner": "none", "study_name": "s"}
    storage = f"sqlite:///{tmp_path}/study.db"
    run = manager("state_sac", storage=storage, n_timesteps=31, **search)
    run.setup_experiment()
    run.hyperparameters_optimization()
    best = yaml.safe_load((tmp_path / "logs" / "state_sac" / "best_s.yml").read_text())[ENV]
    assert best["env_kwargs"]["observation"] == "state" and best["policy"] == "MlpPolicy"
    assert best["gradient_steps"] == best["train_freq"] and best["policy_kwargs"]["net_arch"]
    chosen, _ = manager("state_sac", storage=storage, study_name="s", trial_id=0).read_hyperparameters()
    assert chosen == best
