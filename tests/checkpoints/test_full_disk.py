"""A disk that is full at any file of a checkpoint does not end a training."""

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor

from sb3_crc import CRCSAC
from sb3_crc.checkpoints.callback import DONE, TrainingCheckpoint
from sb3_crc.checkpoints.store import CheckpointStore
from tests.checkpoints.runs import SETTINGS, STEPS, assert_equal, train
from tests.conftest import NoiseEnv


class Full(OSError):
    pass


@pytest.mark.parametrize("function", ["numpy.lib.format.write_array", "tree._write_arrays", "numpy.savez", "os.replace"])
@pytest.mark.parametrize("call", [1, 3])
def test_a_training_outlives_a_disk_that_is_full(
    function: str, call: int, whole: CRCSAC, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At any file of any checkpoint: the user is told, the next checkpoint is whole, and the same script goes on from it."""
    from sb3_crc.checkpoints import tree

    calls = 0

    def failing(original: Any) -> Any:
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls == call:
                raise Full("no space left")
            return original(*args, **kwargs)

        return wrapper

    with monkeypatch.context() as patch:
        module, _, name = function.rpartition(".")
        target = {"numpy.lib.format": np.lib.format, "tree": tree, "numpy": np, "os": os}[module]
        patch.setattr(target, name, failing(getattr(target, name)))
        with pytest.warns(UserWarning, match="could not be written") as told:
            train(tmp_path, seed=0, stop=45)
    assert sum("could not be written: no space left. Training goes on" in str(one.message) for one in told) == 1
    assert CheckpointStore(tmp_path).names()[0] == "000000000040"
    assert_equal(train(tmp_path, seed=0), whole)


def test_a_disk_that_stays_full_is_told_of_at_the_end(whole: CRCSAC, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train(tmp_path, seed=0, stop=25)
    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", full)
        with pytest.warns(UserWarning, match="could not be written") as told:
            assert_equal(train(tmp_path, seed=1), whole)
    messages = [str(one.message) for one in told]
    assert (
        messages[-1]
        == f"4 checkpoints of this training could not be written; the last whole one is {tmp_path / '000000000020'}"
    )
    assert len([message for message in messages if "Training goes on, " in message]) == 4
    assert not (tmp_path / DONE).exists() and not list(tmp_path.glob(".*unfinished*"))
    assert CheckpointStore(tmp_path).names() == ["000000000020", "000000000010"]
    assert_equal(train(tmp_path, seed=2), whole)  # there is room again
    assert (tmp_path / DONE).exists()


def full(*args: Any, **kwargs: Any) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_whole_one_after_one_that_was_not_is_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the last checkpoint knows of the one before it must not keep DONE from a training that goes on from it."""
    savez, calls = np.savez, 0

    def fifth_fails(*args: Any, **kwargs: Any) -> None:
        nonlocal calls
        calls += 1
        (full if calls == 5 else savez)(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", fifth_fails)
        with pytest.warns(UserWarning, match="checkpoint of 50 agent steps could not be written"):
            train(tmp_path, seed=0)
    assert CheckpointStore(tmp_path).names()[0] == "000000000060"
    (tmp_path / DONE).unlink()  # killed before it was written
    train(tmp_path, seed=1)
    assert (tmp_path / DONE).exists()


class Deleting(BaseCallback):
    """Takes a file away in the middle of a training."""

    def __init__(self, path: Path):
        super().__init__()
        self.path = path

    def _on_step(self) -> bool:
        if self.num_timesteps == 25:
            self.path.unlink()
        return True


def test_a_log_that_is_gone_comes_back_with_its_next_line(tmp_path: Path) -> None:
    """Also where SB3 reads it again, for a new column of its table."""
    model = CRCSAC("CnnPolicy", Monitor(NoiseEnv(), str(tmp_path / "monitor.csv")), seed=0, **SETTINGS)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    deleting = [Deleting(tmp_path / name) for name in ("progress.csv", "monitor.csv")]
    checkpoint = TrainingCheckpoint(tmp_path / "checkpoints", every=10)
    model.learn(STEPS, callback=[*deleting, checkpoint], log_interval=1)
    assert CheckpointStore(tmp_path / "checkpoints").names()[0] == "000000000060"
    assert len((tmp_path / "progress.csv").read_text().splitlines()) == 1 + STEPS // 10
    assert len((tmp_path / "monitor.csv").read_text().splitlines()) == 2 + STEPS // 10


def test_a_file_that_cannot_be_read_costs_a_checkpoint_and_not_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Monitor's files of other processes are read for each checkpoint."""
    monkeypatch.setattr("sb3_crc.checkpoints.callback.endure", lambda *args: None)
    monkeypatch.setattr("sb3_crc.checkpoints.callback.distant_monitors", full)
    model = CRCSAC("CnnPolicy", NoiseEnv(), seed=0, **SETTINGS)
    with pytest.warns(UserWarning, match="checkpoint of 20 agent steps could not be written: .*there is none before it"):
        model.learn(20, callback=TrainingCheckpoint(tmp_path, every=20))
    assert model.num_timesteps == 20 and CheckpointStore(tmp_path).names() == [] and not (tmp_path / DONE).exists()
