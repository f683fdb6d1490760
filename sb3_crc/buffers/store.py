"""A ring of frames, each stored once, from which stacks of frames are gathered.

B batch, k frames in a stack, C channels of a frame, H, W height and width.
"""

from typing import Any

import numpy as np
import torch as th

from sb3_crc.transfers import to_device

#: More frames than transitions that a new store has room for, as a share of these: each episode has one more
SLACK = 1 / 64
#: Share by which a full store grows
GROWTH = 1 / 16


class FrameStore:
    """
    Frames in the order in which they came. Each has a number, which never changes; old ones are dropped, new ones take their
    places in memory. Memory is taken when the first frame comes, on a CPU even then only page by page as frames come.

    :param shape: of a frame, ``(C, H, W)`` or any other
    :param dtype: of a frame
    :param capacity: frames that fit; a store that is full grows
    :param device: where the frames lie
    :raises ValueError: if torch has no such type
    """

    def __init__(self, shape: tuple[int, ...], dtype: np.typing.DTypeLike, capacity: int, device: th.device | str):
        self.shape = shape
        self.dtype = np.dtype(dtype)
        self.capacity = capacity
        self.device = th.device(device)
        #: Number of the oldest frame that is kept
        self.first = 0
        #: Number that the next frame will have
        self.end = 0
        self._frames: th.Tensor | None = None
        try:
            self._torch_dtype = th.from_numpy(np.empty(0, self.dtype)).dtype
        except TypeError as error:
            raise ValueError(f"frames of type {self.dtype} cannot be stored: torch has no such type") from error

    def __len__(self) -> int:
        return self.end - self.first

    @property
    def frame_bytes(self) -> int:
        """Size of one frame in bytes."""
        return int(np.prod(self.shape, dtype=np.int64)) * self.dtype.itemsize

    @property
    def taken_bytes(self) -> int:
        """Memory that is taken already: on a CPU that of the frames that have come, on a GPU all of it at once."""
        if self._frames is None:
            return 0
        return (len(self) if self.device.type == "cpu" else self.capacity) * self.frame_bytes

    def allocate(self) -> th.Tensor:
        """:return: the memory, ``(capacity, *shape)``, which is there from the first call on"""
        if self._frames is None:
            self._frames = self._room(self.capacity)
        return self._frames

    def append(self, frame: np.ndarray) -> int:
        """
        Store a frame.

        :param frame: ``shape``
        :return: its number
        """
        if len(self) == self.capacity:
            self._grow(1)
        self.allocate()[self.end % self.capacity] = to_device(np.array(frame), self.device)
        self.end += 1
        return self.end - 1

    def extend(self, frames: np.ndarray) -> None:
        """:param frames: ``(n, *shape)``, appended in order"""
        missing = len(self) + len(frames) - self.capacity
        if missing > 0:
            self._grow(missing)
        self.allocate()[self._places(self.end, self.end + len(frames))] = th.from_numpy(frames).to(self.device)
        self.end += len(frames)

    def drop_before(self, number: int) -> None:
        """Give the places of all frames with lower numbers free."""
        self.first = max(self.first, min(number, self.end))

    def clear(self) -> None:
        """Drop all frames and start to count anew."""
        self.first = self.end = 0

    def read(self, first: int, end: int) -> np.ndarray:
        """:return: a copy of the frames with numbers from ``first`` to before ``end``, ``(end - first, *shape)``"""
        if first == end:
            return np.empty((0, *self.shape), self.dtype)
        frames: np.ndarray = self.allocate()[self._places(first, end)].cpu().numpy()
        return frames

    def stacks(self, numbers: np.ndarray) -> th.Tensor:
        """
        :param numbers: of the frames of each stack, ``(B, k)``
        :return: the stacks, ``(B, k C, H, W)``
        """
        frames, places = self.allocate(), numbers % self.capacity
        if self.device.type == "cpu":  # numpy copies whole frames, several times faster than torch's index
            gathered = th.from_numpy(frames.numpy()[places])
        else:
            gathered = frames[to_device(places, frames.device)]
        return _side_by_side(gathered)

    def windows(self, numbers: np.ndarray, tops: np.ndarray, lefts: np.ndarray, size: tuple[int, int]) -> th.Tensor:
        """
        Cut a window out of each stack, copying no more than the windows.

        :param numbers: of the frames of each stack, ``(B, k)``
        :param tops: first row of each window, ``(B,)``
        :param lefts: first column of each window, ``(B,)``
        :param size: height and width of the windows
        :return: ``(B, k C, *size)``
        """
        frames, places = self.allocate(), numbers % self.capacity
        if self.device.type == "cpu":
            views = np.lib.stride_tricks.sliding_window_view(frames.numpy(), size, axis=(2, 3))
            return _side_by_side(th.from_numpy(views[places, :, tops[:, None], lefts[:, None]]))
        at = [to_device(index, frames.device) for index in (places, tops, lefts)]
        rows = at[1][:, None, None, None, None] + th.arange(size[0], device=frames.device)[:, None]  # (B, 1, 1, h, 1)
        columns = at[2][:, None, None, None, None] + th.arange(size[1], device=frames.device)  # (B, 1, 1, 1, w)
        channels = th.arange(self.shape[0], device=frames.device)[:, None, None]
        return _side_by_side(frames[at[0][:, :, None, None, None], channels, rows, columns])

    def to(self, device: th.device | str) -> None:
        """Move to another device."""
        self.device = th.device(device)
        if self._frames is not None:
            self._frames = self._frames.to(self.device)

    def _places(self, first: int, end: int) -> th.Tensor:
        return th.arange(first, end, device=self.device) % self.capacity

    def _grow(self, least: int) -> None:
        capacity = self.capacity + max(least, round(GROWTH * self.capacity))
        if self._frames is not None:
            grown = self._room(capacity)  # where memory runs out here, the frames are still there
            for start in range(self.first, self.end, 1024):
                numbers = th.arange(start, min(start + 1024, self.end), device=self.device)
                grown[numbers % capacity] = self._frames[numbers % self.capacity]
            self._frames = grown
        self.capacity = capacity

    def _room(self, capacity: int) -> th.Tensor:
        return th.empty((capacity, *self.shape), dtype=self._torch_dtype, device=self.device)

    def __getstate__(self) -> dict[str, Any]:
        # The memory that no frame has touched yet must not become bytes on a disk
        return {**self.__dict__, "_frames": self.read(self.first, self.end)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({**state, "_frames": None, "end": state["first"]})
        if self.device.type == "cuda" and not th.cuda.is_available():
            self.device = th.device("cpu")  # a buffer can be loaded where there is no GPU, as SB3's can
        if len(state["_frames"]):
            self.extend(state["_frames"])


class FrameStacks:
    """
    Stacks of frames that still lie in their store: what an augmentation cuts out of them is all that is copied.

    They show what the store holds: read them before frames are added.

    :param store: the frames
    :param numbers: of the frames of each stack, ``(B, k)``
    :param device: where what is read is needed; None: where the frames lie
    """

    def __init__(self, store: FrameStore, numbers: np.ndarray, device: th.device | None = None):
        self._store = store
        self.numbers = numbers
        self._device = device

    @property
    def shape(self) -> tuple[int, ...]:
        """``(B, k C, H, W)``"""
        batch, k = self.numbers.shape
        channels, *size = self._store.shape
        return batch, k * channels, *size

    @property
    def device(self) -> th.device:
        """Where what is read comes to lie."""
        return self._store.device if self._device is None else self._device

    def whole(self) -> th.Tensor:
        """:return: the stacks, ``(B, k C, H, W)``"""
        return to_device(self._store.stacks(self.numbers), self.device)

    def windows(self, tops: th.Tensor, lefts: th.Tensor, size: tuple[int, int]) -> th.Tensor:
        """
        :param tops: first row of each window, ``(B,)``
        :param lefts: first column of each window, ``(B,)``
        :param size: height and width of the windows
        :return: ``(B, k C, *size)``
        """
        return to_device(self._store.windows(self.numbers, tops.numpy(), lefts.numpy(), size), self.device)


def _side_by_side(frames: th.Tensor) -> th.Tensor:
    """:param frames: ``(B, k, C, ...)``; :return: ``(B, k C, ...)``"""
    return frames.flatten(start_dim=1, end_dim=2) if frames.dim() > 2 else frames
