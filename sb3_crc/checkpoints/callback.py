"""The callback that saves a training and goes on with it."""

import json
import os
import socket
import time
import warnings
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch as th
from filelock import FileLock, Timeout
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_crc.atomic import atomic_write
from sb3_crc.buffers import FrameReplayBuffer
from sb3_crc.buffers.files import contents, read_contents
from sb3_crc.checkpoints.logs import distant_monitors, endure, set_distant_monitors
from sb3_crc.checkpoints.signals import StopRequest, TrainingStopped
from sb3_crc.checkpoints.store import INDEX, CheckpointStore
from sb3_crc.checkpoints.training import callback_tree, set_training_state, training_state
from sb3_crc.checkpoints.tree import Tree
from sb3_crc.disk import outlived

LOCK, OWNER, DONE = "lock", "owner.json", "DONE"


class TrainingCheckpoint(BaseCallback):
    """
    Save the whole training now and then, and go on from the newest checkpoint when training starts: run the same script again,
    and it ends as it would have without the interruption, bit for bit on a CPU with the same number of threads.

    Checkpoints are taken where a rollout starts, the only point at which environments, replay buffer, counters and networks
    agree, and at the end; they are written beside the training. The file DONE tells that the training has ended. SIGINT and
    SIGTERM are such a point too: a checkpoint is saved, and :class:`~sb3_crc.checkpoints.signals.TrainingStopped`, a
    KeyboardInterrupt, is raised. Where none comes within 5 seconds, training stops between two updates or steps, and the last
    checkpoint is the one to go on from. A second signal ends the process at once.

    A disk that is full, read-only or failing does not end the training: each checkpoint that cannot be written is told of at
    once, and all of them at the end, with the last one that is whole. The log's and Monitor's files get what fits.

    :param folder: of the checkpoints of this run
    :param every: agent steps between two checkpoints, rounded up to the next start of a rollout
    :param keep: how many of the newest stay
    :param monitor_dir: of :func:`~stable_baselines3.common.env_util.make_vec_env`, whose files would begin anew after an
        interruption where environments live in other processes; in this process the files are found without it
    :param verbose: 1: say from where the training goes on
    :raises ValueError: for arguments that cannot work; when training starts, if another process uses the folder, if what is in
        it is damaged or does not fit the model, or if the model's replay buffer is not a FrameReplayBuffer
    """

    model: OffPolicyAlgorithm

    def __init__(
        self,
        folder: str | Path,
        every: int = 1_000,
        keep: int = 2,
        monitor_dir: str | Path | None = None,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        if every < 1:
            raise ValueError(f"every={every} must be at least 1")
        self.every = every
        self.store = CheckpointStore(Path(folder), keep)
        self.monitor_dir = None if monitor_dir is None else Path(monitor_dir)
        self._saved_at = 0
        self._lock = FileLock(Path(folder) / LOCK)
        self._writer: ThreadPoolExecutor | None = None
        self._writing: Future[Path] | None = None
        self._whole: Path | None = None
        self._segments: tuple[Any, ...] = ()
        self._failures = 0
        self._saved_whole = True
        self._request = StopRequest()

    @property
    def stopped_by(self) -> int | None:
        """The signal that asked for the end of this training; None: there was none."""
        return self._request.signum

    def _init_callback(self) -> None:
        if not isinstance(getattr(self.model, "replay_buffer", None), FrameReplayBuffer):
            name = type(getattr(self.model, "replay_buffer", None)).__name__
            raise ValueError(
                f"TrainingCheckpoint saves a FrameReplayBuffer, frame by frame; the model has a {name}: "
                "replay_buffer_class=FrameReplayBuffer"
            )
        self._take_lock()

    def _on_training_start(self) -> None:
        self._writer = ThreadPoolExecutor(1, "checkpoint")
        self._failures = 0
        endure(self.logger, self.training_env, self.monitor_dir)
        self._request = StopRequest()
        self._request.listen()
        if hasattr(self.model, "between_updates"):  # an attribute that a stock algorithm does not know would be saved with it
            self.model.between_updates = self._stop_if_overdue
        checkpoint = self.store.newest()
        if checkpoint is None:
            self._saved_at = self.model.num_timesteps
            return
        if checkpoint.threads != th.get_num_threads():
            warnings.warn(
                f"{checkpoint.path} was written with {checkpoint.threads} threads, now there are {th.get_num_threads()}: the "
                "training goes on, but rounds otherwise",
                stacklevel=2,
            )
        buffer = self.model.replay_buffer
        assert isinstance(buffer, FrameReplayBuffer)
        read_contents(buffer, self.store.segments, checkpoint.path / INDEX)
        self._whole = checkpoint.path
        set_training_state(self.model, self.locals["callback"], checkpoint.state)
        self._saved_at = self.num_timesteps = self.model.num_timesteps
        for one in callback_tree(self.locals["callback"]):
            if isinstance(one, ProgressBarCallback):
                one.pbar.update(self.num_timesteps)
        if self.verbose > 0:
            print(f"Going on from {checkpoint.path}")

    def _on_rollout_start(self) -> None:
        signum = self.stopped_by
        if self.model.num_timesteps - self._saved_at >= (self.every if signum is None else 1):
            self._save()
        if signum is not None:
            self.close()
            raise TrainingStopped(signum)

    def _on_step(self) -> bool:
        self._stop_if_overdue()
        return True

    def _stop_if_overdue(self) -> None:
        if self._request.overdue and self.stopped_by is not None:
            self.close()
            raise TrainingStopped(self.stopped_by)

    def _on_training_end(self) -> None:
        if self._writer is None:  # rl_zoo3 calls this once more
            return
        if self.model.num_timesteps > self._saved_at:
            self._save()
        at_end = self._finish_writing()
        if self._failures > 0:
            last = f"the last whole one is {self._whole}" if self._whole else "there is no whole one"
            number = f"{self._failures} checkpoint{'s' * (self._failures > 1)}"
            warnings.warn(f"{number} of this training could not be written; {last}", stacklevel=2)
        if at_end and self.model.num_timesteps >= self.model._total_timesteps:
            with outlived(self.store.folder / DONE), atomic_write(self.store.folder / DONE) as unfinished:
                unfinished.write_text(f"{self.model.num_timesteps}\n", encoding="utf-8")
        self.close()

    def training_state(self) -> Tree:
        """:return: files of Monitor that only ``monitor_dir`` leads to"""
        return distant_monitors(self.training_env, self.monitor_dir)

    def set_training_state(self, state: Tree) -> None:
        """:param state: of :meth:`training_state`"""
        set_distant_monitors(self.training_env, self.monitor_dir, state)

    def close(self) -> None:
        """Finish what is being written, and leave folder and signals to others; done where training ends by itself."""
        self._request.ignore()
        if hasattr(self, "model"):
            vars(self.model).pop("between_updates", None)
        try:
            self._finish_writing()
        finally:
            if self._writer is not None:
                self._writer.shutdown()
                self._writer = None
            self._lock.release()

    def _save(self) -> None:
        """Copy what is to be written, and leave the writing to another thread."""
        self._finish_writing()
        buffer, steps = self.model.replay_buffer, self.model.num_timesteps
        assert isinstance(buffer, FrameReplayBuffer)
        assert self._writer is not None
        self._saved_at, self._segments = steps, buffer.segments
        replay = contents(buffer, self.store.segments, buffer.segments)
        state = training_state(self.model, self.locals["callback"])
        buffer.segments = replay.segments
        self._writing = self._writer.submit(self.store.save, steps, state, replay)

    def _finish_writing(self) -> bool:
        """
        Wait for the last checkpoint. One that could not be written is told of; its frames are written with the next one.

        :return: whether it is whole
        """
        writing, self._writing = self._writing, None
        if writing is None:
            return self._saved_whole
        try:
            self._whole = writing.result()
        except OSError as error:
            self._failures += 1
            buffer = self.model.replay_buffer
            assert isinstance(buffer, FrameReplayBuffer)
            buffer.segments = self._segments
            self.store.remove_unfinished()
            before = f"{self._whole} is whole" if self._whole else "there is none before it"
            warnings.warn(
                f"the checkpoint of {self._saved_at} agent steps could not be written: {error}. Training goes on, {before}, "
                f"and the next one is due {self.every} steps later",
                stacklevel=2,
            )
            self._saved_whole = False
        else:
            self._saved_whole = True
        return self._saved_whole

    def _take_lock(self) -> None:
        self.store.folder.mkdir(parents=True, exist_ok=True)
        owner = self.store.folder / OWNER
        try:
            self._lock.acquire(timeout=0)
        except Timeout:
            who = owner.read_text(encoding="utf-8").strip() if owner.exists() else "unknown"
            raise ValueError(f"{self.store.folder} is in use by another training: {who}") from None
        (self.store.folder / DONE).unlink(missing_ok=True)
        about = {"pid": os.getpid(), "host": socket.gethostname(), "since": time.strftime("%Y-%m-%d %H:%M:%S")}
        owner.write_text(json.dumps(about) + "\n", encoding="utf-8")
