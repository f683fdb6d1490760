"""What a training outlives: a disk that is full, gone or read-only. The user is told, and writing is tried again later."""

import errno
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import StringIO
from pathlib import Path
from typing import Any, TextIO

from stable_baselines3.common.logger import KVWriter, TensorBoardOutputFormat

from sb3_crc.atomic import atomic_write

#: Numbers of such errors
ERRORS = {
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.EACCES, errno.EPERM),
    *(errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.ESTALE, errno.EMFILE, errno.ENFILE),
}


def is_of_disk(error: OSError) -> bool:
    """:return: whether it comes from a disk, and not for instance from a pipe to another process"""
    return error.errno is None or error.errno in ERRORS  # numpy says only how much it could write


def warn_of(what: object, error: OSError) -> None:
    """:param what: could not be written; :param error: that came instead"""
    warnings.warn(f"{what} could not be written: {error}. Training goes on", stacklevel=3)


@contextmanager
def outlived(what: object) -> Iterator[None]:
    """
    Turn the error of a disk into a warning.

    :param what: is written in the context
    """
    try:
        yield
    except OSError as error:
        if not is_of_disk(error):
            raise
        warn_of(what, error)


class EnduringFile:
    """
    A text file in place of one of SB3's, whose errors are warnings, one until it can be written again. Nothing that was
    written is lost: what does not fit is kept, and written with the next line if there is room then.

    :param file: opened for writing; it is closed, and opened again for as long as something is written
    """

    def __init__(self, file: TextIO):
        self.name = file.name
        self._told = False
        self._pending = ""  # after what is on the disk
        self._whole: StringIO | None = None  # in place of what is on the disk
        with suppress(OSError):
            file.close()
        self._size = os.path.getsize(self.name)

    def contents(self) -> str:
        """:return: all that was written, on the disk or not"""
        if self._whole is not None:
            return self._whole.getvalue()
        with open(self.name, "rb") as file:
            return file.read(self._size).decode() + self._pending

    def write(self, text: str) -> int:
        """:param text: to write; :return: its length"""
        if self._whole is not None:
            return self._whole.write(text)
        self._pending += text
        return len(text)

    def seek(self, position: int) -> int:
        """:param position: where what is written next replaces what is there; :return: it"""
        return self._in_memory().seek(position)

    def truncate(self) -> int:
        """:return: the length of what is left, up to the position"""
        return self._in_memory().truncate()

    def readlines(self) -> list[str]:
        """:return: those from the position on"""
        return self._in_memory().readlines()

    def flush(self) -> None:
        """Bring what was written to the disk."""
        try:
            if self._whole is not None:
                self._replace(self._whole.getvalue().encode())
            elif self._pending:
                self._append(self._pending.encode())
            self._told = False
        except OSError as error:
            if not is_of_disk(error):
                raise
            if not self._told:
                warn_of(self.name, error)
            self._told = True

    def close(self) -> None:
        """Write what is left; what does not fit now is lost."""
        self.flush()

    def _in_memory(self) -> StringIO:
        if self._whole is None:
            self._whole = StringIO(self.contents(), newline="")
            self._pending = ""
        return self._whole

    def _append(self, more: bytes) -> None:
        with open(self.name, "r+b", buffering=0) as file:
            file.seek(self._size)
            try:
                written = 0
                while written < len(more):
                    written += file.write(more[written:])
            except OSError:
                file.truncate(self._size)  # no half a line
                raise
        self._size += len(more)
        self._pending = ""

    def _replace(self, whole: bytes) -> None:
        with atomic_write(Path(self.name)) as unfinished:
            unfinished.write_bytes(whole)
        self._size = len(whole)
        self._whole = None


class EnduringEvents(KVWriter):
    """
    TensorBoard's events, whose writer is of no use after an error: from then on each record tries to begin a new file.

    :param events: SB3's writer of them
    """

    def __init__(self, events: TensorBoardOutputFormat):
        self._folder = events.writer.log_dir
        self._events: TensorBoardOutputFormat | None = events
        self._told = False

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """:param key_values: to write; :param key_excluded: formats that do without them; :param step: agent steps"""
        try:
            if self._events is None:
                self._events = TensorBoardOutputFormat(self._folder)
            self._events.write(key_values, key_excluded, step)
            self._told = False
        except OSError as error:
            if not is_of_disk(error):
                raise
            if not self._told:
                warn_of(f"TensorBoard's events in {self._folder}", error)
            self._told = True
            self.close()

    def close(self) -> None:
        """Close the file; what does not fit then is lost."""
        if self._events is not None:
            with suppress(OSError):
                self._events.close()
            self._events = None
