"""SB3's callbacks around a CRCSAC: the best model, a threshold that ends training, checkpoints."""

import math
from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.monitor import Monitor

from sb3_crc import CRCSAC
from tests.conftest import NoiseEnv, make_model


def test_eval_callback_keeps_the_best_model(tmp_path: Path, observations: np.ndarray) -> None:
    model = make_model()
    callback = EvalCallback(
        Monitor(NoiseEnv()), n_eval_episodes=2, eval_freq=4, best_model_save_path=tmp_path, log_path=tmp_path, verbose=0
    )
    predictions: list[np.ndarray] = []

    class Remember(StopTrainingOnRewardThreshold):
        def _on_step(self) -> bool:
            predictions.append(self.model.predict(observations, deterministic=True)[0])
            return True

    callback.callback_on_new_best = Remember(0.0)
    callback.callback_on_new_best.parent = callback
    model.learn(12, callback, reset_num_timesteps=False)
    with np.load(tmp_path / "evaluations.npz") as evaluations:
        assert evaluations["timesteps"].tolist() == [44, 48, 52]
        means = evaluations["results"].mean(axis=1)
    assert len(predictions) == sum(mean > max(means[:index], default=-math.inf) for index, mean in enumerate(means))
    best = CRCSAC.load(tmp_path / "best_model.zip")
    assert best.num_timesteps == 44 + 4 * int(means.argmax())
    assert np.array_equal(best.predict(observations, deterministic=True)[0], predictions[-1])


def test_training_stops_at_the_reward_threshold() -> None:
    for threshold, steps in ((-1e9, 44), (1e9, 50)):
        model = make_model()
        stop = StopTrainingOnRewardThreshold(reward_threshold=threshold, verbose=0)
        model.learn(10, EvalCallback(Monitor(NoiseEnv()), stop, eval_freq=4, verbose=0), reset_num_timesteps=False)
        assert model.num_timesteps == steps


def test_checkpoint_callback_saves_model_and_replay_buffer(tmp_path: Path) -> None:
    model = make_model()
    model.learn(10, CheckpointCallback(5, str(tmp_path), save_replay_buffer=True), reset_num_timesteps=False)
    names = {f"rl_model_{steps}_steps.zip" for steps in (45, 50)}
    names |= {f"rl_model_replay_buffer_{steps}_steps.pkl" for steps in (45, 50)}
    assert {path.name for path in tmp_path.iterdir()} == names

    loaded = CRCSAC.load(tmp_path / "rl_model_45_steps.zip", env=NoiseEnv())
    loaded.load_replay_buffer(tmp_path / "rl_model_replay_buffer_45_steps.pkl")
    assert (loaded.num_timesteps, loaded._n_updates) == (45, 4)  # SB3 calls back before it stores and trains
    assert np.array_equal(loaded.replay_buffer.observations[:44], model.replay_buffer.observations[:44])
    loaded.learn(3, reset_num_timesteps=False)
    assert (loaded.num_timesteps, loaded._n_updates) == (48, 7)
