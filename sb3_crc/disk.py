"""What a training outlives: a disk that is full, gone or read-only. The user is told, and writing is tried again later."""

import errno
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO

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
    A text file whose errors are warnings, one until it can be written again. What does not fit stays in its buffer, and is
    written with the next line if there is room then.

    :param file: opened for writing
    """

    def __init__(self, file: TextIO):
        self._file = file
        self._told = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._file)

    def write(self, text: str) -> int:
        """:param text: to write; :return: its length"""
        self._try(lambda: self._file.write(text))
        return len(text)

    def flush(self) -> None:
        """Bring what was written to the disk."""
        if self._try(self._file.flush):
            self._told = False

    def close(self) -> None:
        """Close it; what does not fit then is lost."""
        self._try(self._file.close)

    def _try(self, work: Callable[[], Any]) -> bool:
        try:
            work()
        except OSError as error:
            if not is_of_disk(error):
                raise
            if not self._told:
                warn_of(getattr(self._file, "name", "a log"), error)
            self._told = True
            return False
        return True
