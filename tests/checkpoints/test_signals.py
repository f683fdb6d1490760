"""SIGINT and SIGTERM stop a training where nothing is lost."""

import os
import signal
import threading
from pathlib import Path

import pytest
from stable_baselines3.common.callbacks import BaseCallback

from sb3_crc import CRCSAC
from sb3_crc.checkpoints.callback import TrainingCheckpoint
from sb3_crc.checkpoints.signals import TrainingStopped
from sb3_crc.checkpoints.store import CheckpointStore
from tests.checkpoints.runs import SETTINGS, STEPS, Stop, StoppedError, assert_equal, cartpole


class Signal(BaseCallback):
    """Sends signals to this process."""

    def __init__(self, signum: int, at: int):
        super().__init__()
        self.signum, self.at = signum, at

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            os.kill(os.getpid(), self.signum)
        return True


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_and_stops(signum: int, whole: CRCSAC, tmp_path: Path) -> None:
    before = signal.getsignal(signum)
    model = CRCSAC("CnnPolicy", cartpole(0), seed=0, **SETTINGS)
    with pytest.raises(TrainingStopped, match=signal.Signals(signum).name) as stop:
        model.learn(STEPS, callback=[Signal(signum, 33), TrainingCheckpoint(tmp_path, every=10)])
    assert isinstance(stop.value, KeyboardInterrupt)
    assert CheckpointStore(tmp_path).names()[0] == "000000000033"  # not 30: nothing of what was done is lost
    assert signal.getsignal(signum) is before
    model = CRCSAC("CnnPolicy", cartpole(7), seed=7, **SETTINGS)
    assert_equal(model.learn(STEPS, callback=[Signal(signum, 0), TrainingCheckpoint(tmp_path, every=10)]), whole)


def test_a_signal_need_not_wait_for_long_updates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_crc.checkpoints.signals.GRACE", 0.2)
    model = CRCSAC("CnnPolicy", cartpole(0), seed=0, **{**SETTINGS, "initial_updates": 100_000})
    threading.Timer(6.0, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(TrainingStopped):
        model.learn(STEPS, callback=TrainingCheckpoint(tmp_path, every=10))
    assert 0 < model._n_updates < 100_000
    assert CheckpointStore(tmp_path).names()[0] == "000000000020"  # the last one before those updates
    TrainingCheckpoint(tmp_path)._lock.take()


def test_after_an_error_a_signal_is_what_it_was_before(tmp_path: Path) -> None:
    """SB3 tells callbacks of no exception, and nobody would look for the request any more."""
    before = signal.default_int_handler
    signal.signal(signal.SIGINT, before)  # not what a training of another test has left
    checkpoint = TrainingCheckpoint(tmp_path)
    with pytest.raises(StoppedError):
        CRCSAC("CnnPolicy", cartpole(0), seed=0, **SETTINGS).learn(STEPS, callback=[checkpoint, Stop(5)])
    with pytest.raises(KeyboardInterrupt) as interrupt:
        signal.raise_signal(signal.SIGINT)
    assert type(interrupt.value) is KeyboardInterrupt
    assert signal.getsignal(signal.SIGINT) is before
    checkpoint.close()
    assert signal.getsignal(signal.SIGINT) is before
