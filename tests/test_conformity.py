"""What SB3's own tests ask of SAC and no other test here answers; docs/contributing.md lists them side by side."""

import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecTransposeImage, is_vecenv_wrapped
from torch import nn

from sb3_crc import CRCSAC, PixelEncoder
from sb3_crc.policies import CRCActor
from tests.fixtures.make import SMALL, Stripes, new_model, observations

PICTURES = observations()


def actions(model: Any) -> np.ndarray:
    return model.predict(PICTURES, deterministic=True)[0]


def with_policy(**arguments: Any) -> dict[str, Any]:
    return {**SMALL["policy_kwargs"], **arguments}


# -- Save and load -----------------------------------------------------------------------------------------------------


def test_parameters_that_do_not_fit_are_refused_and_a_part_may_be_given() -> None:
    model = new_model()
    parameters = model.get_parameters()
    for exact_match in (True, False):
        with pytest.raises(ValueError, match="nobody"):
            model.set_parameters({**parameters, "nobody": {}}, exact_match=exact_match)
    policy = dict(parameters["policy"])
    kept = policy.popitem()
    with pytest.raises(RuntimeError, match="Missing key"):
        model.set_parameters({**parameters, "policy": policy}, exact_match=True)
    ones = {name: th.ones_like(value) for name, value in policy.items()}
    model.set_parameters({"policy": ones}, exact_match=False)
    state = model.policy.state_dict()
    assert all(bool((state[name] == 1).all()) for name in ones)
    assert th.equal(state[kept[0]], kept[1])


def test_what_is_saved_can_be_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = new_model(verbose=2)
    model.save(tmp_path / "without", exclude=["verbose"])
    assert CRCSAC.load(tmp_path / "without").verbose == 0
    model.save(tmp_path / "with", exclude=["verbose"], include=["verbose"])
    objects = {"learning_rate": 2e-5, "no_attribute": 1}
    loaded = CRCSAC.load(tmp_path / "with", custom_objects=objects, print_system_info=True)
    assert (loaded.verbose, loaded.learning_rate) == (2, 2e-5)
    assert not hasattr(loaded, "no_attribute")
    assert "Stable-Baselines3" in capsys.readouterr().out


def test_an_actor_saves_and_loads_alone(tmp_path: Path) -> None:
    actor = new_model().learn(14).actor
    actor.save(tmp_path / "actor.pth")
    loaded = CRCActor.load(tmp_path / "actor.pth", device="cpu")
    assert np.array_equal(actions(loaded), actions(actor))


@pytest.mark.filterwarnings("error")
def test_files_are_closed_and_streams_left_open(tmp_path: Path) -> None:
    model = new_model()
    for path in (tmp_path / "model", str(tmp_path / "model")):
        model.save(path)
        CRCSAC.load(path, device="cpu")
    for path in (tmp_path / "buffer", str(tmp_path / "buffer")):
        model.save_replay_buffer(path)
        model.load_replay_buffer(path)
    with tempfile.TemporaryFile() as stream:
        model.save(stream)
        stream.seek(0)
        assert np.array_equal(actions(CRCSAC.load(stream, device="cpu")), actions(model))
        assert not stream.closed
    with tempfile.TemporaryFile() as stream:
        model.save_replay_buffer(stream)
        stream.seek(0)
        model.load_replay_buffer(stream)
        assert not stream.closed


@pytest.mark.filterwarnings("ignore:.*pickle")
def test_a_schedule_of_numpys_numbers_gives_plain_ones_also_after_load(tmp_path: Path) -> None:
    model = new_model(learning_rate=lambda left: left * np.sin(1.0))
    model.save(tmp_path / "model")
    for one in (model, CRCSAC.load(tmp_path / "model")):
        assert type(one.lr_schedule(1.0)) is float
        assert one.lr_schedule(0.5) == pytest.approx(0.5 * np.sin(1.0))


def test_networks_of_the_default_size_are_loaded(tmp_path: Path) -> None:
    new_model(policy_kwargs=with_policy(net_arch=None)).save(tmp_path / "model")
    loaded = CRCSAC.load(tmp_path / "model")
    assert [layer.out_features for layer in loaded.actor.latent_pi if isinstance(layer, nn.Linear)] == [1024, 1024]


def test_environments_are_changed_kept_or_multiplied(tmp_path: Path) -> None:
    model = new_model().learn(14)
    model.set_env(Stripes())
    assert model._last_obs is None  # of the environment before
    model.learn(14)
    model.set_env(model.get_env(), force_reset=False)
    assert model._last_obs is not None
    model.learn(4, reset_num_timesteps=False)
    assert model.num_timesteps == 18
    model.save(tmp_path / "model")

    several = CRCSAC.load(tmp_path / "model", env=DummyVecEnv([Stripes] * 2))
    assert several.replay_buffer.n_envs == several.n_envs == 2
    several.learn(16)
    assert (several.num_timesteps, several._n_updates) == (16, model._n_updates + 2)


# -- Train mode and eval mode ------------------------------------------------------------------------------------------


class Restless(PixelEncoder):
    """Batch normalisation and dropout at the end of the encoder: alike only in eval mode."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.norm = nn.BatchNorm1d(self.features_dim)
        self.dropout = nn.Dropout(0.5)

    def forward(self, images: th.Tensor) -> th.Tensor:
        return self.dropout(self.norm(super().forward(images)))

    def project(self, features: th.Tensor) -> th.Tensor:
        return self.dropout(self.norm(super().project(features)))


def statistics(model: CRCSAC) -> dict[str, th.Tensor]:
    state = model.policy.state_dict()
    return {name: value.clone() for name, value in state.items() if "running" in name or "num_batches" in name}


def differing(first: dict[str, th.Tensor], second: dict[str, th.Tensor]) -> set[str]:
    return {name for name in first if not th.equal(first[name], second[name])}


def test_acting_changes_no_statistics_and_draws_no_dropout() -> None:
    objectives = {"contrastive": 0.5, "consistency": {"weight": 0.5, "predictor": "batch_norm"}}
    model = new_model(policy_kwargs=with_policy(features_extractor_class=Restless), objectives=objectives)
    start = statistics(model)
    assert any("features_extractor.norm" in name for name in start) and any("predictor" in name for name in start)
    model.learn(SMALL["learning_starts"])  # acts, and does not learn yet
    assert np.array_equal(actions(model), actions(model))
    assert differing(start, statistics(model)) == set()
    assert not model.actor.training

    model.learn(4, reset_num_timesteps=False)
    assert any("predictor" in name for name in differing(start, statistics(model)))
    trained = statistics(model)
    assert np.array_equal(actions(model), actions(model))
    assert differing(trained, statistics(model)) == set()
    assert not model.critic_target.training


# -- Spaces ------------------------------------------------------------------------------------------------------------


class OwnBox(gym.spaces.Box):
    """A subclass of a space is such a space."""


@pytest.mark.parametrize(
    ("observation_space", "action_space"),
    [
        (Stripes.observation_space, gym.spaces.Box(-1, 1, (2,), np.float64)),
        (Stripes.observation_space, gym.spaces.Box(-1, 1, (2, 3), np.float32)),
        (OwnBox(0, 255, (3, 24, 24), np.uint8), OwnBox(-2, 3, (1,), np.float32)),
    ],
    ids=["float64", "matrix", "subclass"],
)
def test_action_spaces_of_any_precision_and_shape(observation_space: gym.Space[Any], action_space: gym.Space[Any]) -> None:
    class Other(Stripes):
        def __init__(self) -> None:
            super().__init__()
            self.observation_space, self.action_space = observation_space, action_space

        def step(self, action: np.ndarray) -> Any:
            assert action_space.contains(np.asarray(action, action_space.dtype))
            return super().step(np.ravel(action))

    model = CRCSAC("CnnPolicy", Other(), **SMALL).learn(14)
    chosen, _ = model.predict(PICTURES)
    assert chosen.shape == (4, *action_space.shape)
    assert model._n_updates == 2


@pytest.mark.parametrize("train_freq", ["4", ("1", "episode"), "non_sense", (1, "dog"), (1.0, "step")])
def test_a_training_frequency_that_is_none_is_refused(train_freq: Any) -> None:
    with pytest.raises(ValueError, match=r"train|frequency|TrainFrequencyUnit"):
        new_model(train_freq=train_freq)


# -- Prediction --------------------------------------------------------------------------------------------------------


def test_environments_are_wrapped_as_needed() -> None:
    class ChannelsLast(Stripes):
        observation_space = gym.spaces.Box(0, 255, (24, 24, 3), np.uint8)

        def step(self, action: np.ndarray) -> Any:
            observation, *others = super().step(action)
            return observation.transpose(1, 2, 0), *others

        def reset(self, **kwargs: Any) -> Any:
            observation, info = super().reset(**kwargs)
            return observation.transpose(1, 2, 0), info

    for env, transposed in ((Stripes(), False), (ChannelsLast(), True)):
        model = CRCSAC("CnnPolicy", env, **SMALL)
        assert model.get_env().env_is_wrapped(Monitor) == [True]
        assert is_vecenv_wrapped(model.get_env(), VecTransposeImage) == transposed


def test_what_gymnasiums_reset_returns_is_no_observation() -> None:
    with pytest.raises(ValueError, match=r"mixing Gym API with SB3 VecEnv API"):
        new_model().predict(Stripes().reset())


# -- Callbacks ---------------------------------------------------------------------------------------------------------


def test_sb3s_callbacks_together(tmp_path: Path) -> None:
    calls: list[int] = []

    class Counted(BaseCallback):
        def _on_step(self) -> bool:
            calls.append(self.num_timesteps)
            return True

    def evaluation(stop: BaseCallback) -> EvalCallback:
        return EvalCallback(
            Monitor(Stripes()),
            callback_on_new_best=StopTrainingOnRewardThreshold(1e9),
            callback_after_eval=stop,
            best_model_save_path=str(tmp_path),
            eval_freq=5,
            n_eval_episodes=1,
            verbose=0,
        )

    model = new_model()
    callbacks = [
        CheckpointCallback(8, str(tmp_path)),
        evaluation(StopTrainingOnNoModelImprovement(100)),
        EveryNTimesteps(6, Counted()),
        LogEveryNTimesteps(4),
        Counted(),
    ]
    model.learn(20, CallbackList(callbacks), progress_bar=True)
    assert calls.count(6) == calls.count(12) == 2 and calls.count(7) == 1
    assert {path.name for path in tmp_path.glob("*.zip")} == {
        "rl_model_8_steps.zip",
        "rl_model_16_steps.zip",
        "best_model.zip",
    }
    model.learn(1_000, lambda own, _: own["self"].num_timesteps < 9)  # a function is a callback too
    assert model.num_timesteps == 9
    model.learn(1_000, StopTrainingOnMaxEpisodes(2))
    assert model.num_timesteps == 14  # two episodes of seven steps


class Until(BaseCallback):
    """Ends the training at a step."""

    def __init__(self, end: int, answer: Callable[[bool], Any] = bool) -> None:
        super().__init__()
        self.end, self.answer = end, answer

    def _on_step(self) -> Any:
        return self.answer(self.num_timesteps < self.end)


@pytest.mark.parametrize("overlap", [False, True])
def test_a_callback_that_ends_training_loses_no_step(overlap: bool) -> None:
    """SB3 returns before it stores the last one: what follows would not continue the stack of frames."""
    model = new_model(overlap=overlap).learn(1_000, Until(18))
    assert (model.num_timesteps, model.replay_buffer.size()) == (18, 18)
    model.learn(6, reset_num_timesteps=False)
    assert (model.num_timesteps, model.replay_buffer.size()) == (24, 24)
    buffer = model.replay_buffer
    middle = buffer.frame_numbers[17:19, 0]
    assert np.array_equal(middle[0, 1:], middle[1, :-1]) and not buffer.interrupted[17, 0]


@pytest.mark.parametrize("false", [False, np.bool_(False)])
def test_numpys_false_ends_a_training_too(false: Any) -> None:
    assert new_model().learn(16, Until(3, lambda go_on: go_on or false)).num_timesteps == 3


def test_successes_are_logged(tmp_path: Path) -> None:
    class Half(Stripes):
        episodes = 0

        def step(self, action: np.ndarray) -> Any:
            *others, ended, info = super().step(action)
            if ended:
                self.episodes += 1
                info["is_success"] = self.episodes % 2 == 0
            return *others, ended, info

    model = new_model()
    model.set_env(Half())
    evaluation = EvalCallback(Monitor(Half()), eval_freq=14, n_eval_episodes=4, log_path=str(tmp_path), verbose=0)
    model.learn(15, evaluation, log_interval=1_000)
    with np.load(tmp_path / "evaluations.npz") as evaluations:
        assert evaluations["successes"].tolist() == [[False, True, False, True]]
    assert list(model.ep_success_buffer) == [False, True]


# -- Logs --------------------------------------------------------------------------------------------------------------


def test_names_of_logs_may_hold_brackets(tmp_path: Path) -> None:
    for number in (1, 2):
        new_model(tensorboard_log=str(tmp_path)).learn(2, tb_log_name="crc[1]")
        assert (tmp_path / f"crc[1]_{number}").is_dir()


def test_a_second_training_at_once_divides_by_no_time() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = new_model().learn(2)
        model.dump_logs()
        model.dump_logs()
