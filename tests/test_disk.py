"""Logs, episodes and evaluations outlive a disk that fails, and tell of it once."""

import csv
import errno
import io
import shutil
import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import HumanOutputFormat, Logger, TensorBoardOutputFormat, configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_crc import CRCSAC
from sb3_crc.checkpoints.callback import TrainingCheckpoint
from sb3_crc.checkpoints.logs import endure
from sb3_crc.checkpoints.store import CheckpointStore
from sb3_crc.disk import EnduringEvents, EnduringFile, outlived
from sb3_crc.evaluation import QBiasEvalCallback
from tests.conftest import POLICY_KWARGS, NoiseEnv

FULL = OSError(errno.ENOSPC, "No space left on device")


class FullDisk(io.FileIO):
    """Takes three more bytes."""

    def write(self, data: Any) -> int:
        super().write(data[:3])
        raise FULL


def written(file: EnduringFile) -> list[str]:
    """:return: what the user is told while the file is brought to the disk"""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        file.flush()
    return [str(one.message) for one in caught]


def test_a_file_tells_once_until_it_can_be_written_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "log.csv"
    file = EnduringFile(path.open("w"))
    told, on_disk = [], []
    for full in (False, True, True, False, True):
        if full:
            monkeypatch.setattr("sb3_crc.disk.open", lambda path, *_, **__: FullDisk(path, "r+b"), raising=False)
        else:
            monkeypatch.undo()
        file.write("a line\n")
        told.append(written(file))
        on_disk.append(path.read_text().count("a line\n"))
        assert path.read_text() == "a line\n" * on_disk[-1], "half a line"
    message = f"{path} could not be written: [Errno 28] No space left on device. Training goes on"
    assert told == [[], [message], [], [], [message]] and on_disk == [1, 1, 1, 4, 4]
    monkeypatch.undo()
    assert file.contents() == "a line\n" * 5
    file.close()
    assert path.read_text() == "a line\n" * 5


def test_a_file_whose_head_changes_is_replaced_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As SB3's CSV does for a new column, on a disk that fails at that moment."""
    path = tmp_path / "log.csv"
    path.write_text("a\n1\n")
    file = EnduringFile(path.open("r+"))

    def fail(*paths: Any) -> None:
        raise FULL

    monkeypatch.setattr("sb3_crc.atomic.os.replace", fail)
    file.seek(0)
    rows = file.readlines()
    file.seek(0)
    for text in ("a,b\n", rows[1].strip() + ",\n", "2,3\n"):
        file.write(text)
    assert len(written(file)) == 1 and path.read_text() == "a\n1\n"
    file.write("4,5\n")
    monkeypatch.undo()
    assert written(file) == [] and path.read_text() == "a,b\n1,\n2,3\n4,5\n"
    file.write("6,7\n")
    file.flush()
    assert path.read_text() == "a,b\n1,\n2,3\n4,5\n6,7\n" and [one.name for one in tmp_path.iterdir()] == ["log.csv"]


def test_a_file_stays_where_it_is_when_the_process_goes_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path("log.csv")
    file = EnduringFile(path.open("w"))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    file.write("a line\n")
    assert written(file) == [] and (tmp_path / "log.csv").read_text() == "a line\n"


def test_streams_of_others_are_left_alone_and_tensorboard_is_found(tmp_path: Path) -> None:
    """Standard output is not always what it was when the logger was made; callbacks look for TensorBoard's class."""
    with (tmp_path / "stream").open("w") as stream:
        logger = Logger(str(tmp_path), [HumanOutputFormat(stream), TensorBoardOutputFormat(str(tmp_path))])
        for _ in range(2):  # of the same logger, in two trainings
            endure(logger, DummyVecEnv([NoiseEnv]), None)
        human, events = logger.output_formats
        assert isinstance(human, HumanOutputFormat) and human.file is stream and not stream.closed
        assert isinstance(events, TensorBoardOutputFormat) and isinstance(events, EnduringEvents)
        events.writer.add_text("told", "by a callback")
        logger.record("a", 1.0)
        logger.dump()
        logger.close()
    assert len(list(tmp_path.glob("events.out.*"))) == 1 and "a" in (tmp_path / "stream").read_text()


def test_errors_that_are_not_the_disks_are_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BrokenPipeError), outlived("a file"):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")
    file = EnduringFile((tmp_path / "log.csv").open("w"))
    file.write("a line\n")
    reset = ConnectionResetError(errno.ECONNRESET, "reset")
    monkeypatch.setattr(file, "_append", lambda more: (_ for _ in ()).throw(reset))
    with pytest.raises(ConnectionResetError):
        file.flush()


def model_in(folder: Path) -> CRCSAC:
    env = DummyVecEnv([lambda: Monitor(NoiseEnv(), str(folder / "0.monitor.csv"))])
    model = CRCSAC(
        "CnnPolicy", env, batch_size=8, buffer_size=100, learning_starts=20, policy_kwargs=POLICY_KWARGS, seed=0, device="cpu"
    )
    model.set_logger(configure(str(folder), ["csv", "json", "log", "tensorboard"]))
    return model


def callbacks(folder: Path) -> list[Any]:
    evaluation = QBiasEvalCallback(
        DummyVecEnv([lambda: Monitor(NoiseEnv())]),
        log_path=str(folder),
        best_model_save_path=str(folder),
        n_eval_episodes=1,
        eval_freq=20,
        verbose=0,
    )
    return [evaluation, TrainingCheckpoint(folder / "checkpoints", every=20)]


def rows_but_times(path: Path) -> list[dict[str, str]]:
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    return [{name: cell for name, cell in row.items() if name != "t" and not name.startswith("time/")} for row in rows]


def test_files_of_a_training_are_the_same_as_ever(tmp_path: Path) -> None:
    """What endures writes what was written before."""
    plain, enduring = tmp_path / "plain", tmp_path / "enduring"
    for folder in (plain, enduring):
        folder.mkdir()
        model = model_in(folder)
        model.learn(60, callback=callbacks(folder)[: 1 if folder == plain else 2], log_interval=1)
        model.logger.close()
        model.get_env().close()  # type: ignore[union-attr]
    for name in ("0.monitor.csv", "progress.csv"):
        mine, theirs = (rows_but_times(folder / name) for folder in (enduring, plain))
        assert mine == theirs and len(mine) >= 3, name
    assert isinstance(model.logger.output_formats[0].file, EnduringFile)  # type: ignore[attr-defined]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 8 MB; where none can be mounted, nothing can be shown."""
    folder = tmp_path / "small"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(command, check=False, capture_output=True).returncode != 0:
        pytest.skip("no tmpfs can be mounted; the next test needs none")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


class Filling(BaseCallback):
    """Leaves nothing of the disk from the first decision on."""

    def __init__(self, path: Path):
        super().__init__()
        self.path = path

    def _on_rollout_start(self) -> None:
        if not self.path.exists():
            with self.path.open("wb", buffering=0) as file, suppress(OSError):
                while True:
                    file.write(bytes(4096))

    def _on_step(self) -> bool:
        return True


def test_a_training_on_a_full_disk_comes_to_its_end(small_disk: Path, tmp_path: Path) -> None:
    model = model_in(small_disk)
    with pytest.warns(UserWarning, match="Training goes on") as told:
        model.learn(80, callback=[Filling(small_disk / "ballast"), *callbacks(small_disk)], log_interval=1)
    assert model.num_timesteps == 80 and model._n_updates == 60
    messages = " ".join(str(one.message) for one in told)
    for what in ("the checkpoint of", "the best model in", "TensorBoard's events", "of this training could not be written"):
        assert what in messages, messages
    assert len(rows_but_times(small_disk / "progress.csv")) == 0
    (small_disk / "ballast").unlink()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(40, callback=callbacks(small_disk)[1:], reset_num_timesteps=False)
    assert CheckpointStore(small_disk / "checkpoints").names()
    assert (small_disk / "0.monitor.csv").stat().st_size > 0


@pytest.mark.skipif(sys.platform == "win32", reason="Windows limits no files")
def test_files_that_may_not_grow_are_outlived(tmp_path: Path) -> None:
    """The kernel's own limit, which needs no mount."""
    import resource

    model = model_in(tmp_path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        with pytest.warns(UserWarning, match="File too large") as told:
            model.learn(80, callback=callbacks(tmp_path), log_interval=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert model.num_timesteps == 80 and model._n_updates == 60
    messages = " ".join(str(one.message) for one in told)
    for what in ("the checkpoint of", "the best model in", "of this training could not be written"):
        assert what in messages, messages
    model.learn(40, callback=callbacks(tmp_path)[1:], reset_num_timesteps=False)
    assert CheckpointStore(tmp_path / "checkpoints").names()


def test_a_folder_that_becomes_read_only_is_outlived(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    savez = np.savez

    def refuse(file: Any, *args: Any, **kwargs: Any) -> None:
        if not isinstance(file, io.BytesIO):  # memory is no disk
            raise OSError(errno.EROFS, "Read-only file system")
        savez(file, *args, **kwargs)

    model = model_in(tmp_path)
    own = callbacks(tmp_path)
    monkeypatch.setattr(np, "savez", refuse)
    with pytest.warns(UserWarning, match="Read-only file system"):
        model.learn(60, callback=own)
    assert model.num_timesteps == 60 and len(own[0].evaluations_results) == 3
    monkeypatch.undo()
    own[0]._write_evaluations()
    assert len(np.load(tmp_path / "evaluations.npz")["results"]) == 3
