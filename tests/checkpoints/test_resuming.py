"""A training that is stopped goes on to the end that it would have had."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sb3_crc import CRCSAC, AuxiliaryLossCallback, FrameReplayBuffer, PixelEncoder
from sb3_crc.checkpoints.callback import DONE, TrainingCheckpoint
from tests.checkpoints.runs import SETTINGS, STEPS, Stop, StoppedError, assert_equal, cartpole, train
from tests.conftest import POLICY_KWARGS, ClockEnv


@pytest.mark.parametrize("stops", [(15,), (47,), (12, 33, 59)])
def test_stopped_and_run_again_it_ends_the_same(stops: tuple[int, ...], whole: CRCSAC, tmp_path: Path) -> None:
    for number, stop in enumerate(stops):
        train(tmp_path, seed=number, stop=stop)  # only the first one's seed counts: later all comes from the checkpoint
        assert not (tmp_path / DONE).exists()
    assert_equal(train(tmp_path, seed=9), whole)
    assert (tmp_path / DONE).read_text() == "60\n"


def test_updates_made_during_steps_go_on_too(whole: CRCSAC, tmp_path: Path) -> None:
    for number, stop in enumerate((25, 47)):
        train(tmp_path, seed=number, stop=stop, overlap=True)
    assert_equal(train(tmp_path, seed=9, overlap=True), whole)


def test_a_finished_run_can_be_prolonged(tmp_path: Path, whole: CRCSAC) -> None:
    train(tmp_path, steps=30)
    assert (tmp_path / DONE).exists()
    assert train(tmp_path, steps=STEPS).num_timesteps == STEPS


def test_other_networks_are_refused(tmp_path: Path) -> None:
    train(tmp_path, stop=45)
    model = CRCSAC("CnnPolicy", cartpole(0), **{**SETTINGS, "policy_kwargs": {**POLICY_KWARGS, "net_arch": [8]}})
    with pytest.raises(ValueError, match="policy is not the one that was saved"):
        model.learn(STEPS, callback=TrainingCheckpoint(tmp_path))


@pytest.mark.parametrize("stacked", [False, True])
def test_environments_without_a_state_go_on_at_a_new_episode(stacked: bool, tmp_path: Path) -> None:
    """So do wrappers that keep something of the episode, as the frames of a stack."""

    def clock(seed: int) -> Any:
        env = DummyVecEnv([lambda: Monitor(ClockEnv(terminates=False))])
        return VecFrameStack(env, 2) if stacked else env

    train(tmp_path, stop=43, every=9, make_env=clock)  # 36 is in the middle of an episode
    with pytest.warns(UserWarning, match=r"no get_state.*not be bit for bit"):
        model = train(tmp_path, make_env=clock)
    assert model.num_timesteps == STEPS
    assert not model.replay_buffer.dones.all() and model.replay_buffer.full


def test_a_stock_algorithm_with_auxiliary_losses_goes_on_exactly(tmp_path: Path) -> None:
    def run(folder: Path, seed: int, stop: int | None) -> tuple[SAC, AuxiliaryLossCallback]:
        extractor = {
            "features_extractor_class": PixelEncoder,
            "features_extractor_kwargs": POLICY_KWARGS["features_extractor_kwargs"],
        }
        model = SAC(
            "CnnPolicy",
            cartpole(seed),
            replay_buffer_class=FrameReplayBuffer,
            replay_buffer_kwargs={"frame_channels": 3},
            action_noise=OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.1 * np.ones(1)),
            seed=seed,
            **{**SETTINGS, "policy_kwargs": {"net_arch": [16], **extractor}},
        )
        auxiliary = AuxiliaryLossCallback(augmentation_kwargs={"pad": 1})
        checkpoint = TrainingCheckpoint(folder, every=10)
        try:
            model.learn(STEPS, callback=[auxiliary, Stop(stop), checkpoint])
        except StoppedError:
            checkpoint.close()
        return model, auxiliary

    whole, losses = run(tmp_path / "whole", 0, None)
    run(tmp_path / "stopped", 0, 45)
    again, losses_2 = run(tmp_path / "stopped", 8, None)
    for name, value in whole.policy.state_dict().items():
        assert th.equal(value, again.policy.state_dict()[name]), name
    for name, value in losses.learner.state()[1].items():
        assert th.equal(value, losses_2.learner.state()[1][name]), name
