"""TrainingCheckpoint beside what else happens in a training."""

from pathlib import Path

import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import EvalCallback

from sb3_crc import CRCSAC, FrameReplayBuffer, PixelEncoder
from sb3_crc.checkpoints.callback import TrainingCheckpoint
from tests.checkpoints.runs import SETTINGS, STEPS, assert_equal, cartpole
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
