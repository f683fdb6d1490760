"""Is the Q bias that is logged the one that is defined?"""

import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.logger import KVWriter, Logger

from sb3_crc.evaluation import FIRST_SEED, SEED_STEP, QBiasEvalCallback, q_value_and_soft_return
from tests.conftest import ClockEnv, NoiseEnv, make_model

OPTIMUM = {False: 10.0, True: 1 + 0.9 + 0.81 + 0.729 + 0.6561}


def constant_critic(model: Any, value: float) -> None:
    """A critic that always answers ``value``."""
    with th.no_grad():
        for head in model.critic.q_networks:
            head[-1].weight.zero_()
            head[-1].bias.fill_(value)


@pytest.mark.parametrize("terminates", [False, True])
def test_the_soft_return_bootstraps_at_a_time_limit_only(terminates: bool) -> None:
    model = make_model(ClockEnv(terminates), image_size=36, gamma=0.9, ent_coef=0.0)
    constant_critic(model, 10.0)
    frames = [ClockEnv(terminates).reset()[0]] * 5
    episode = [(frame, np.zeros(1, np.float32), 1.0) for frame in frames]
    q_value, soft_return = q_value_and_soft_return(model, episode, None if terminates else frames[0])
    assert q_value == pytest.approx(10.0)
    assert soft_return == pytest.approx(OPTIMUM[terminates], rel=1e-5)


def test_entropy_counts_from_the_second_step_on_and_rewards_are_scaled() -> None:
    model = make_model(ClockEnv(True), image_size=36, gamma=0.5, ent_coef=2.0, reward_scale=3.0)
    model.actor.action_log_prob = lambda images: (th.zeros(len(images), 1), th.full((len(images),), -0.25))
    frame = ClockEnv(True).reset()[0]
    episode = [(frame, np.zeros(1, np.float32), reward) for reward in (1.0, 2.0, 4.0)]
    expected = 3.0 + 0.5 * (6.0 + 2 * 0.25) + 0.25 * (12.0 + 2 * 0.25)
    assert q_value_and_soft_return(model, episode, None)[1] == pytest.approx(expected)


class Record(KVWriter):
    """Keeps what the logger is told to write."""

    def __init__(self) -> None:
        self.written: dict[str, Any] = {}

    def write(self, key_values: dict[str, Any], *_: Any) -> None:
        self.written.update(key_values)

    def close(self) -> None: ...


def test_the_bias_is_logged_at_each_evaluation() -> None:
    model = make_model(ClockEnv(False), image_size=36, gamma=0.9, ent_coef=0.0, learning_rate=0.0, encoder_learning_rate=0.0)
    constant_critic(model, 4.0)
    record = Record()
    model.set_logger(Logger(None, [record]))
    callback = QBiasEvalCallback(ClockEnv(False), eval_freq=6, n_eval_episodes=3, verbose=0, warn=False)
    model.learn(6, callback=callback, reset_num_timesteps=False)
    soft_return = OPTIMUM[True] + 0.9**5 * 4.0
    assert record.written["eval/q_value"] == pytest.approx(4.0, abs=1e-4)
    assert record.written["eval/soft_return"] == pytest.approx(soft_return, rel=1e-4)
    assert record.written["eval/q_bias"] == pytest.approx(4.0 - soft_return, rel=1e-4)


@pytest.mark.parametrize(
    "device", ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not th.cuda.is_available(), reason="no GPU"))]
)
def test_evaluating_draws_no_random_numbers_of_the_run(device: str) -> None:
    model = make_model(device=device)
    frame = NoiseEnv().reset(seed=0)[0]
    episode = [(frame, np.zeros(2, np.float32), 1.0)] * 3
    states = []
    for _ in range(2):
        states.append([th.get_rng_state(), *([th.cuda.get_rng_state()] if device == "cuda" else [])])
        q_value_and_soft_return(model, episode, frame)
    assert all(map(th.equal, *states))


class ChannelLastEnv(NoiseEnv):
    """As :class:`NoiseEnv`, frames with channels last."""

    def __init__(self) -> None:
        super().__init__()
        channels, *size = self.observation_space.shape
        self.first = self.observation_space
        self.observation_space = gym.spaces.Box(0, 255, (*size, channels), np.uint8)

    def _frame(self) -> np.ndarray:
        return self.np_random.integers(0, 256, self.first.shape, dtype=np.uint8).transpose(1, 2, 0)


@pytest.mark.filterwarnings("ignore:Training and eval env are not of the same type")
def test_channels_may_come_last() -> None:
    """SB3 turns them round for the training, not for evaluations: there only ``predict`` does."""
    logged = []
    for env in (NoiseEnv, ChannelLastEnv):
        model = make_model(env())
        callback = QBiasEvalCallback(env(), eval_freq=6, n_eval_episodes=1, verbose=0, warn=False)
        model.learn(6, callback=callback, reset_num_timesteps=False)
        logged.append([model.logger.name_to_value[f"eval/{name}"] for name in ("q_value", "soft_return")])
    assert logged[0] == pytest.approx(logged[1])


def test_other_algorithms_are_evaluated_as_ever() -> None:
    model = SAC("CnnPolicy", NoiseEnv(), buffer_size=100, learning_starts=50)
    callback = QBiasEvalCallback(NoiseEnv(), eval_freq=10, n_eval_episodes=1, verbose=0, warn=False)
    model.learn(20, callback=callback)
    assert np.isfinite(callback.last_mean_reward)
    assert "eval/q_bias" not in model.logger.name_to_value


class SeededEnv(NoiseEnv):
    """Keeps the seeds with which it was reset, and dawdles while it is stepped."""

    def __init__(self, seconds: float = 0.0) -> None:
        super().__init__()
        self.seeds: list[int] = []
        self.seconds = seconds

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.seeds += [] if seed is None else [seed]
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        time.sleep(self.seconds)
        return super().step(action)


def test_evaluations_of_all_runs_begin_with_the_same_seeds(tmp_path: Path) -> None:
    seeds = []
    for seed, learning_starts in ((0, 15), (1, 100)):
        env = SeededEnv()
        model = make_model(NoiseEnv(), seed=seed, learning_starts=learning_starts)
        before = model._n_updates
        callback = QBiasEvalCallback(
            env, eval_freq=10, n_eval_episodes=2, verbose=0, warn=False, log_path=str(tmp_path / str(seed))
        )
        model.learn(30, callback=callback)
        seeds.append(env.seeds)
        with np.load(tmp_path / str(seed) / "evaluations.npz") as data:
            assert data["seeds"].tolist() == env.seeds
            assert data["updates"].tolist() == [before + max(0, steps - learning_starts) for steps in (9, 19, 29)]
    assert seeds[0] == seeds[1] == [FIRST_SEED + SEED_STEP, FIRST_SEED + 2 * SEED_STEP, FIRST_SEED + 3 * SEED_STEP]


def test_a_second_training_goes_on_with_the_same_records(tmp_path: Path) -> None:
    model = make_model(NoiseEnv())
    callback = QBiasEvalCallback(NoiseEnv(), eval_freq=10, n_eval_episodes=1, verbose=0, warn=False, log_path=str(tmp_path))
    seconds = []
    for _ in range(2):
        model.learn(20, callback=callback, reset_num_timesteps=False)
        with np.load(tmp_path / "evaluations.npz") as data:
            assert len({len(data[name]) for name in ("timesteps", "seeds", "updates", "seconds")}) == 1
            seconds.append(float(data["training_seconds"]))
            seeds = data["seeds"].tolist()
    assert seeds == [FIRST_SEED + k * SEED_STEP for k in (1, 2, 3, 4)]
    assert 0 < seconds[0] < seconds[1]


@pytest.mark.filterwarnings("ignore:Training and eval env are not of the same type")
def test_an_environments_own_error_is_no_failure_of_the_disk(tmp_path: Path) -> None:
    class Missing(NoiseEnv):
        resets = 0

        def reset(self, *args: Any, **kwargs: Any) -> Any:
            self.resets += 1
            if self.resets > 3:
                raise FileNotFoundError("there is no clip video3.mp4")
            return super().reset(*args, **kwargs)

    model = make_model(NoiseEnv())
    callback = QBiasEvalCallback(
        Missing(), eval_freq=5, n_eval_episodes=1, verbose=0, warn=False, best_model_save_path=str(tmp_path)
    )
    with pytest.raises(FileNotFoundError, match="there is no clip"):
        model.learn(40, callback=callback)
    assert (tmp_path / "best_model.zip").exists() and "save" not in vars(model)


def test_a_best_model_that_cannot_be_written_is_told_of(tmp_path: Path) -> None:
    (tmp_path / "best_model.zip").mkdir()
    model = make_model(NoiseEnv())
    callback = QBiasEvalCallback(
        NoiseEnv(), eval_freq=5, n_eval_episodes=1, verbose=0, warn=False, best_model_save_path=str(tmp_path)
    )
    saved = model.save
    model.save = lambda *args, **kwargs: (_ for _ in ()).throw(OSError(28, "No space left on device"))  # type: ignore[method-assign]
    own = model.save
    with pytest.warns(UserWarning, match="the best model in .* could not be written"):
        model.learn(5, callback=callback)
    assert model.save is own and saved is not own


def test_actions_may_have_several_axes() -> None:
    class Square(NoiseEnv):
        def __init__(self) -> None:
            super().__init__()
            self.action_space = gym.spaces.Box(-1, 1, (2, 3), np.float32)

        def step(self, action: Any) -> Any:
            return super().step(action[0])

    model = make_model(Square())
    callback = QBiasEvalCallback(Square(), eval_freq=5, n_eval_episodes=1, verbose=0, warn=False)
    model.learn(5, callback=callback, reset_num_timesteps=False)
    assert np.isfinite(model.logger.name_to_value["eval/q_bias"])


def test_seconds_are_those_of_training_alone(tmp_path: Path) -> None:
    model = make_model(NoiseEnv(), learning_starts=100)
    callback = QBiasEvalCallback(SeededEnv(0.1), eval_freq=5, n_eval_episodes=2, verbose=0, warn=False, log_path=str(tmp_path))
    begin = time.perf_counter()
    model.learn(10, callback=callback)
    elapsed = time.perf_counter() - begin
    with np.load(tmp_path / "evaluations.npz") as data:
        evaluating = 0.1 * data["ep_lengths"].sum()
        assert 0 < data["seconds"][0] < data["seconds"][1] <= data["training_seconds"] < elapsed - evaluating
    state = callback.training_state()
    callback.set_training_state({"seconds": 100.0})
    assert state["seconds"] < 100 < callback.training_state()["seconds"] < 101
