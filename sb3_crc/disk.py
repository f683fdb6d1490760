"""What a training outlives: a disk that is full, gone or read-only. The user is told, and writing is tried again later."""

import errno
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import StringIO
from pathlib import Path
from typing import Any, TextIO

from stable_baselines3.common.logger import TensorBoardOutputFormat

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
    written is lost: all of it is kept in memory, and what is not on the disk is written with the next line if there is room
    then.

    :param file: opened for writing; it is closed, and opened again for as long as something is written
    """

    def __init__(self, file: TextIO):
        self.name = os.path.abspath(file.name)  # the process may go to another folder
        self._told = False
        with suppress(OSError):
            file.close()
        there = Path(self.name).read_bytes()
        self._text = StringIO(newline="")
        self._size, self._length = len(there), self._text.write(there.decode())  # of what is on the disk: bytes, characters
        self._rewritten = False

    def contents(self) -> str:
        """:return: all that was written, on the disk or not"""
        return self._text.getvalue()

    def write(self, text: str) -> int:
        """:param text: to write; :return: its length"""
        return self._text.write(text)

    def seek(self, position: int) -> int:
        """:param position: where what is written next replaces what is there; :return: it"""
        self._rewritten = True
        return self._text.seek(position)

    def truncate(self) -> int:
        """:return: the length of what is left, up to the position"""
        return self._text.truncate()

    def readlines(self) -> list[str]:
        """:return: those from the position on"""
        return self._text.readlines()

    def flush(self) -> None:
        """Bring what was written to the disk."""
        try:
            if self._rewritten or not os.path.exists(self.name):
                self._replace(self.contents())
            else:
                self._text.seek(self._length)
                if more := self._text.read():
                    self._append(more)
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

    def _append(self, text: str) -> None:
        more = text.encode()
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
        self._length += len(text)

    def _replace(self, text: str) -> None:
        whole = text.encode()
        with atomic_write(Path(self.name)) as unfinished:
            unfinished.write_bytes(whole)
        self._size, self._length = len(whole), len(text)
        self._rewritten = False


class EnduringEvents(TensorBoardOutputFormat):  # for callbacks that look for it, as SB3's documentation shows
    """
    TensorBoard's events, whose writer is of no use after an error: from then on each record tries to begin a new file.

    :param events: SB3's writer of them
    """

    def __init__(self, events: TensorBoardOutputFormat):
        self.writer = events.writer
        self._is_closed = False
        self._told = False

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """:param key_values: to write; :param key_excluded: formats that do without them; :param step: agent steps"""
        try:
            if self._is_closed:
                super().__init__(self.writer.log_dir)
            super().write(key_values, key_excluded, step)
            self._told = False
        except OSError as error:
            if not is_of_disk(error):
                raise
            if not self._told:
                warn_of(f"TensorBoard's events in {self.writer.log_dir}", error)
            self._told = True
            self.close()

    def close(self) -> None:
        """Close the file; what does not fit then is lost."""
        if not self._is_closed:
            with suppress(OSError):
                self.writer.close()
        self._is_closed = True
