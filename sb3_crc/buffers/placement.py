"""A replay buffer whose frames may lie on another device than the networks, and which says when they will not fit."""

import warnings

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_crc.buffers.store import FrameStore
from sb3_crc.memory import GIGABYTE, free_memory
from sb3_crc.transfers import to_device

#: Share of the free memory that a buffer which "would fit" takes: the rest is the training's
USABLE = 0.9


class PlacedReplayBuffer(ReplayBuffer):
    """SB3's ReplayBuffer with a :class:`~sb3_crc.buffers.store.FrameStore`: where it lies, and whether it fits there."""

    store: FrameStore
    _frame_device: th.device | None = None
    _warned = False

    @property
    def device(self) -> th.device:
        """Where samples are returned, and frames lie that have no device of their own; ``load_replay_buffer`` writes it."""
        return self._device

    @device.setter
    def device(self, device: th.device | str) -> None:
        """Let samples come there, and frames lie there that have no device of their own."""
        self._device = th.device(device)
        if hasattr(self, "store"):
            self.store.to(self.frame_device)

    @property
    def frame_device(self) -> th.device:
        """Where the frames lie."""
        return self._device if self._frame_device is None else self._frame_device

    @frame_device.setter
    def frame_device(self, device: th.device | str | None) -> None:
        """Move the frames."""
        self._frame_device = None if device is None else th.device(device)
        self.store.to(self.frame_device)

    def fits(self, device: th.device) -> bool:
        """:param device: where the frames might lie; :return: whether there is room for all of them"""
        return self.full_bytes <= USABLE * free_memory(device)

    def to_torch(self, array: np.ndarray, copy: bool = True) -> th.Tensor:
        """
        As in SB3, but a GPU is not waited for.

        :param array: on the host
        :param copy: whether the tensor must not share its memory
        :return: the same on ``device``
        """
        return to_device(array.copy() if copy and self.device.type == "cpu" else array, self.device)

    @property
    def full_bytes(self) -> int:
        """What the frames of a full buffer need, with the slack that is kept for the first frames of episodes."""
        return self.store.capacity * self.store.frame_bytes

    def warn_if_too_large(self) -> None:
        """Warn, once, if the full buffer will not fit in free memory, with the size that would."""
        if self._warned:
            return
        self._warned = True
        taken = self.store.taken_bytes
        available = free_memory(self.frame_device) + taken
        if self.full_bytes > available:
            fits = int(USABLE * available / self.full_bytes * self.buffer_size * self.n_envs)
            warnings.warn(
                f"the replay buffer needs {self.full_bytes / GIGABYTE:.2f} GB when its {self.buffer_size * self.n_envs} "
                f"transitions are full, but only {available / GIGABYTE:.2f} GB are free on {self.frame_device}: "
                f"training may be killed then; buffer_size={fits} would fit",
                stacklevel=2,
            )
