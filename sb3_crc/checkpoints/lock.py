"""One training at a time in a folder of checkpoints."""

import json
import os
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from weakref import WeakValueDictionary

from filelock import FileLock, Timeout

LOCK, OWNER = "lock", "owner.json"


class RunLock:
    """
    Held by a training in a folder, of which the kernel lets go when the process ends, however it ends.

    SB3 tells callbacks of no exception, so a training that an error has ended still holds its folder. Such a one is closed by
    the next training that wants the folder in this process: in the same thread nothing of the earlier one can be running any
    more, and neither can it where its thread has ended.

    :param folder: of the checkpoints
    :param close: ends what a training has left open; it calls :meth:`release`
    """

    def __init__(self, folder: Path, close: Callable[[], None]):
        self._folder = folder
        self._close = close
        self._file = FileLock(folder / LOCK, thread_local=False)  # another thread may close what its own has left
        self._thread = threading.current_thread()

    def take(self) -> None:
        """:raises ValueError: if another training uses the folder, with what it has written about itself"""
        self._folder.mkdir(parents=True, exist_ok=True)
        place, owner = self._folder.resolve(), self._folder / OWNER
        before = _taken.get(place)
        if before is not None and before._is_left_over():
            before._close()
        try:
            self._file.acquire(timeout=0)
        except Timeout:
            who = owner.read_text(encoding="utf-8").strip() if owner.exists() else "unknown"
            raise ValueError(f"{self._folder} is in use by another training: {who}") from None
        self._thread = threading.current_thread()
        _taken[place] = self
        about = {"pid": os.getpid(), "host": socket.gethostname(), "since": time.strftime("%Y-%m-%d %H:%M:%S")}
        owner.write_text(json.dumps(about) + "\n", encoding="utf-8")

    def release(self) -> None:
        """Leave the folder to others."""
        self._file.release()

    @property
    def is_held(self) -> bool:
        """Whether the folder is still this training's."""
        return self._file.is_locked

    def _is_left_over(self) -> bool:
        return self.is_held and (self._thread is threading.current_thread() or not self._thread.is_alive())


#: Folder -> the lock that this process took there last
_taken: WeakValueDictionary[Path, RunLock] = WeakValueDictionary()
