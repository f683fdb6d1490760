"""One training at a time in a folder, and what an error that SB3 tells no callback of leaves behind."""

import os
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from sb3_crc import CRCSAC
from sb3_crc.checkpoints.callback import DONE, TrainingCheckpoint
from sb3_crc.checkpoints.signals import SIGNALS
from tests.checkpoints.runs import SETTINGS, STEPS, Stop, StoppedError, assert_equal, cartpole, train
from tests.conftest import NoiseEnv


def fail(checkpoint: TrainingCheckpoint, env: Any) -> CRCSAC:
    model = CRCSAC("CnnPolicy", env, seed=0, **SETTINGS)
    with pytest.raises(StoppedError):
        model.learn(STEPS, callback=[checkpoint, Stop(45)])
    return model


def test_a_folder_in_use_is_refused_with_its_owner(tmp_path: Path) -> None:
    first = TrainingCheckpoint(tmp_path)
    with ThreadPoolExecutor(1) as elsewhere:
        elsewhere.submit(first._lock.take).result()
        with pytest.raises(ValueError, match=rf"in use by another training: .*{os.getpid()}"):
            train(tmp_path)
        first.close()
        train(tmp_path, steps=10)


@pytest.mark.parametrize("same", [True, False], ids=["the same callback", "another callback"])
def test_after_an_error_the_same_process_goes_on(same: bool, whole: CRCSAC, tmp_path: Path) -> None:
    before = [signal.getsignal(signum) for signum in SIGNALS]
    first = TrainingCheckpoint(tmp_path, every=10)
    failed = fail(first, cartpole(0))
    again = first if same else TrainingCheckpoint(tmp_path, every=10)
    model = CRCSAC("CnnPolicy", cartpole(5), seed=5, **SETTINGS)
    assert_equal(model.learn(STEPS, callback=[again, Stop(None)]), whole)
    assert (tmp_path / DONE).exists() and failed.num_timesteps == 45
    assert [signal.getsignal(signum) for signum in SIGNALS] == before


def test_a_thread_that_has_ended_holds_nothing(tmp_path: Path) -> None:
    first = TrainingCheckpoint(tmp_path, every=10)
    thread = threading.Thread(target=fail, args=(first, NoiseEnv()))
    thread.start()
    thread.join()
    model = CRCSAC("CnnPolicy", NoiseEnv(), seed=0, **SETTINGS)
    with pytest.warns(UserWarning, match="no get_state"):
        model.learn(STEPS, callback=[TrainingCheckpoint(tmp_path, every=10), Stop(None)])
    assert (tmp_path / DONE).exists()


def test_what_cannot_be_gone_on_from_holds_nothing_either(tmp_path: Path) -> None:
    train(tmp_path, stop=45)
    model = CRCSAC("CnnPolicy", cartpole(0), seed=0, **SETTINGS)
    checkpoint = TrainingCheckpoint(tmp_path)
    with pytest.raises(ValueError, match="the callbacks are"):
        model.learn(STEPS, callback=checkpoint)
    train(tmp_path, seed=1)


def test_two_of_one_training_are_refused(tmp_path: Path) -> None:
    model = CRCSAC("CnnPolicy", NoiseEnv(), seed=0, **SETTINGS)
    both = [TrainingCheckpoint(tmp_path), TrainingCheckpoint(tmp_path)]
    with pytest.raises(ValueError, match="two TrainingCheckpoints of one training cannot share a folder"):
        model.learn(STEPS, callback=both)
