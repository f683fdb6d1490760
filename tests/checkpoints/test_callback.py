"""TrainingCheckpoint beside what else happens in a training."""

import warnings
from pathlib import Path

import gymnasium as gym
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback

from sb3_crc import CRCSAC, FrameReplayBuffer, PixelEncoder
from sb3_crc.checkpoints.callback import TrainingCheckpoint
from sb3_crc.checkpoints.store import CheckpointStore
from sb3_crc.stock import StockSAC
from tests.checkpoints.runs import SETTINGS, STEPS, Stop, assert_equal, cartpole, train
from tests.conftest import NoiseEnv


def test_it_costs_nothing_to_the_run(whole: CRCSAC, tmp_path: Path) -> None:
    """A run without checkpoints draws the same random numbers."""
    model = CRCSAC("CnnPolicy", cartpole(0), seed=0, **SETTINGS)
    assert_equal(model.learn(STEPS), whole)


def test_a_stock_algorithm_is_saved_while_checkpoints_are_made(tmp_path: Path) -> None:
    model = SAC(
        "CnnPolicy",
        NoiseEnv(channels=3),
        learning_starts=100,
        replay_buffer_class=FrameReplayBuffer,
        replay_buffer_kwargs={"frame_channels": 3},
        buffer_size=100,
        policy_kwargs={"features_extractor_class": PixelEncoder, "net_arch": [8]},
    )
    best = EvalCallback(NoiseEnv(channels=3), eval_freq=10, best_model_save_path=str(tmp_path), verbose=0, warn=False)
    model.learn(15, callback=[best, TrainingCheckpoint(tmp_path / "checkpoints", every=5)])
    assert SAC.load(tmp_path / "best_model").num_timesteps == 10


def test_bad_arguments_and_other_buffers_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="every=0 must be at least 1"):
        TrainingCheckpoint(tmp_path, every=0)
    with pytest.raises(ValueError, match="keep=0 must be at least 1"):
        TrainingCheckpoint(tmp_path, keep=0)
    model = SAC("CnnPolicy", NoiseEnv(), buffer_size=20, policy_kwargs={"net_arch": [4]})
    with pytest.raises(ValueError, match="the model has a ReplayBuffer: replay_buffer_class=FrameReplayBuffer"):
        model.learn(10, callback=TrainingCheckpoint(tmp_path))


class End(BaseCallback):
    """Ends a training within a rollout."""

    def __init__(self, at: int):
        super().__init__()
        self.at = at

    def _on_step(self) -> bool:
        return self.num_timesteps != self.at


def frames_alone(cls: type[SAC]) -> SAC:
    own = {"replay_buffer_class": FrameReplayBuffer, "replay_buffer_kwargs": {"frame_channels": 3}} if cls is SAC else {}
    kwargs = {"features_extractor_class": PixelEncoder, "net_arch": [8]}
    return cls("CnnPolicy", cartpole(0), learning_starts=100, buffer_size=100, policy_kwargs=kwargs, **own)  # type: ignore[arg-type]


@pytest.mark.parametrize(("cls", "newest"), [(StockSAC, 25), (SAC, 20)])
def test_a_stock_algorithm_that_a_callback_ended_goes_on_from_its_checkpoint(
    cls: type[SAC], newest: int, tmp_path: Path
) -> None:
    """SB3 does not store the step at which it ends, without which the frames are no stacks any more."""
    frames_alone(cls).learn(60, callback=[TrainingCheckpoint(tmp_path, every=10), End(25)])
    assert CheckpointStore(tmp_path).names()[0] == f"{newest:012d}"
    model = frames_alone(cls).learn(60, callback=[TrainingCheckpoint(tmp_path, every=10), End(0)])
    assert model.num_timesteps == model.replay_buffer.size() == 60  # type: ignore[union-attr]


def test_a_stock_algorithm_that_a_callback_ended_goes_on_in_the_same_process() -> None:
    model = frames_alone(StockSAC).learn(60, callback=End(25))
    model.learn(35, reset_num_timesteps=False)
    assert model.num_timesteps == model.replay_buffer.size() == 60  # type: ignore[union-attr]


def test_speed_is_that_of_this_process(tmp_path: Path) -> None:
    train(tmp_path, stop=45)
    assert train(tmp_path)._num_timesteps_at_start == 40


def test_what_does_not_go_on_as_asked_is_warned_of(tmp_path: Path) -> None:
    train(tmp_path, stop=25)
    model = CRCSAC("CnnPolicy", cartpole(0), **{**SETTINGS, "buffer_size": 60})
    with pytest.warns(UserWarning, match="has 40 rows: this one has as many now, and not 60"):
        model.learn(STEPS, callback=[TrainingCheckpoint(tmp_path), Stop(None)])
    for steps in (10, 20):
        sde = SAC(
            "MlpPolicy",
            gym.make("Pendulum-v1"),
            use_sde=True,
            learning_starts=100,
            replay_buffer_class=FrameReplayBuffer,
            replay_buffer_kwargs={"frame_channels": None},
            buffer_size=50,
            policy_kwargs={"net_arch": [4]},
        )
        checkpoint = TrainingCheckpoint(tmp_path / "sde", every=5)
        if steps == 10:
            sde.learn(steps, callback=checkpoint)
        else:
            with pytest.warns(UserWarning, match="use_sde=True: its noise is not in checkpoints"):
                sde.learn(steps, callback=checkpoint)


def test_the_folder_of_another_training_is_told_of(tmp_path: Path) -> None:
    train(tmp_path, stop=25)
    model = CRCSAC("CnnPolicy", cartpole(0), seed=1, **{**SETTINGS, "batch_size": 8}, reward_scale=0.5)
    message = r"000000000020 is of a training with batch_size=16, not 8; reward_scale=1.0, not 0.5; seed=0, not 1: its weights"
    with pytest.warns(UserWarning, match=message):
        model.learn(STEPS, callback=[TrainingCheckpoint(tmp_path), Stop(None)])


def test_nothing_is_left_to_train_is_said(tmp_path: Path) -> None:
    train(tmp_path)
    with pytest.warns(UserWarning, match="000000000060 is of a training that has ended: there is nothing left to train"):
        train(tmp_path)


def test_the_same_training_goes_on_without_a_word(tmp_path: Path) -> None:
    train(tmp_path, stop=25)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train(tmp_path)
