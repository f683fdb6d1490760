"""What bad input may lead to."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

#: What bad input may raise; FileNotFoundError where a file is named
DOCUMENTED = (ValueError, TypeError, FileNotFoundError)


@contextmanager
def quietly() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def says_why(error: BaseException, name: str = "") -> None:
    message = str(error)
    assert message.strip() and name in message, repr(error)
