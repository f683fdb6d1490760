"""The callback that saves a training and goes on with it."""

import warnings
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_crc.atomic import atomic_write
from sb3_crc.buffers import FrameReplayBuffer
from sb3_crc.buffers.files import contents, read_contents
from sb3_crc.checkpoints.lock import RunLock
from sb3_crc.checkpoints.logs import distant_monitors, endure, set_distant_monitors
from sb3_crc.checkpoints.signals import StopRequest, TrainingStopped
from sb3_crc.checkpoints.store import INDEX, CheckpointStore
from sb3_crc.checkpoints.training import callback_tree, other_arguments, set_training_state, training_state
from sb3_crc.checkpoints.tree import Tree
from sb3_crc.disk import is_of_disk, outlived
from sb3_crc.whole_rollouts import WholeRollouts

#: File in the folder of a training that has ended
DONE = "DONE"
#: Name of the thread that writes a checkpoint
THREAD = "checkpoint"


class TrainingCheckpoint(BaseCallback):
    """
    Save the whole training now and then, and go on from the newest checkpoint when training starts: run the same script again,
    and it ends as it would have without the interruption, bit for bit on a CPU with the same number of threads.

    Checkpoints are taken where a rollout starts, the only point at which environments, replay buffer, counters and networks
    agree, and at the end; they are written by another thread. The file DONE tells that the training has ended. After SIGINT or
    SIGTERM one more is saved at the next such point, and :class:`~sb3_crc.checkpoints.signals.TrainingStopped`, a
    KeyboardInterrupt, is raised. Where none comes within 5 seconds, training stops between two updates or steps, and the last
    checkpoint is the one to go on from. A second signal ends the process at once.

    An error that ends the training, of the environment for instance, is not seen by callbacks: folder and signals are held
    until :meth:`close`, or until this process trains into the folder again or gets a signal.

    A disk that is full, read-only or failing does not end the training: each checkpoint that cannot be written is told of at
    once, and all of them at the end, with the last one that is whole. The log's and Monitor's files get what fits.

    :param folder: of the checkpoints of this run
    :param every: agent steps between two checkpoints, rounded up to the next start of a rollout
    :param keep: how many of the newest stay
    :param monitor_dir: of :func:`~stable_baselines3.common.env_util.make_vec_env`, whose files would begin anew after an
        interruption where environments live in other processes; in this process the files are found without it
    :param verbose: 1: say from where the training goes on
    :raises ValueError: for arguments that cannot work; when training starts, if another training uses the folder, if what is
        in it is damaged or does not fit the model, or if the model's replay buffer is not a FrameReplayBuffer
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
        self._lock = RunLock(Path(folder), self.close)
        self._begun = False
        self._writing: Future[Path] | None = None
        self._whole: Path | None = None
        #: The buffer that is being written, and its segments before
        self._before: tuple[FrameReplayBuffer, tuple[Any, ...]] | None = None
        self._failures = 0
        self._saved_whole = True
        self._in_rollout = False
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
        self._lock.take()
        (self.store.folder / DONE).unlink(missing_ok=True)

    def _on_training_start(self) -> None:
        if not self._lock.is_held:
            raise ValueError(f"{self.store.folder}: two TrainingCheckpoints of one training cannot share a folder")
        self._begun = True
        self._failures, self._saved_whole = 0, True
        endure(self.logger, self.training_env, self.monitor_dir)
        self._request = StopRequest()
        self._request.listen(self.model)
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
        own_size = buffer.buffer_size
        read_contents(buffer, self.store.segments, checkpoint.path / INDEX)
        self._warn_of_differences(checkpoint.path, own_size)
        if others := other_arguments(self.model, checkpoint.state):
            warnings.warn(
                f"{checkpoint.path} is of a training with {'; '.join(others)}: its weights, replay buffer and random numbers "
                "go on here. Another training needs another folder",
                stacklevel=2,
            )
        self._whole = checkpoint.path
        set_training_state(self.model, self.locals["callback"], checkpoint.state)
        self._saved_whole = True  # unlike the one before it, perhaps, as that state has it
        self._saved_at = self.num_timesteps = self.model.num_timesteps
        self.model._num_timesteps_at_start = self.num_timesteps  # time/fps is of this process
        for one in callback_tree(self.locals["callback"]):
            if isinstance(one, ProgressBarCallback):
                one.pbar.update(self.num_timesteps)
        if self.num_timesteps >= self.model._total_timesteps:
            warnings.warn(f"{checkpoint.path} is of a training that has ended: there is nothing left to train", stacklevel=2)
        elif self.verbose > 0:
            print(f"Going on from {checkpoint.path}")

    def _warn_of_differences(self, path: Path, own_size: int) -> None:
        buffer = self.model.replay_buffer
        assert buffer is not None
        if buffer.buffer_size != own_size:
            warnings.warn(
                f"the replay buffer of {path} has {buffer.buffer_size} rows: this one has as many now, and not {own_size}",
                stacklevel=4,
            )
        if self.model.use_sde:
            warnings.warn(
                "use_sde=True: its noise is not in checkpoints, so the run will not be bit for bit the one that was stopped",
                stacklevel=4,
            )

    def _on_rollout_start(self) -> None:
        self._in_rollout = True
        signum = self.stopped_by
        if self.model.num_timesteps - self._saved_at >= (self.every if signum is None else 1):
            self._save()
        if signum is not None:
            self.close()
            raise TrainingStopped(signum)

    def _on_rollout_end(self) -> None:
        self._in_rollout = False

    def _on_step(self) -> bool:
        self._stop_if_overdue()
        return True

    def _stop_if_overdue(self) -> None:
        if self._request.overdue and self.stopped_by is not None:
            self.close()
            raise TrainingStopped(self.stopped_by)

    def _on_training_end(self) -> None:
        if not self._begun:  # rl_zoo3 calls this once more
            return
        # Stopped by a callback, SB3 does not store the last step: what it was made of is gone
        whole = not self._in_rollout or isinstance(self.model, WholeRollouts)
        if whole and self.model.num_timesteps > self._saved_at:
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
            self._begun = False
            self._lock.release()

    def _save(self) -> None:
        """
        Copy what is to be written, and leave the writing to another thread. That ends with its work: while a second thread has
        OpenMP threads of its own, all of them sleep between two operations instead of waiting awake, and updates on several
        cores take half as long again.
        """
        self._finish_writing()
        buffer, steps = self.model.replay_buffer, self.model.num_timesteps
        assert isinstance(buffer, FrameReplayBuffer)
        self._saved_at, self._before = steps, (buffer, buffer.segments)
        try:
            replay = contents(buffer, self.store.segments, buffer.segments)
            state = training_state(self.model, self.locals["callback"])  # reads the files of the log
        except OSError as error:
            if not is_of_disk(error):
                raise
            self._tell_of(error)
            return
        buffer.segments = replay.segments
        writer = ThreadPoolExecutor(1, THREAD)
        self._writing = writer.submit(self.store.save, steps, state, replay)
        writer.shutdown(wait=False)

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
            assert self._before is not None
            buffer, segments = self._before
            buffer.segments = segments
            self.store.remove_unfinished()
            self._tell_of(error)
        else:
            self._saved_whole = True
        return self._saved_whole

    def _tell_of(self, error: OSError) -> None:
        self._failures += 1
        self._saved_whole = False
        before = f"{self._whole} is whole" if self._whole else "there is none before it"
        warnings.warn(
            f"the checkpoint of {self._saved_at} agent steps could not be written: {error}. Training goes on, {before}, "
            f"and the next one is due {self.every} steps later",
            stacklevel=3,
        )
