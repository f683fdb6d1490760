"""What the commands say, and where."""

from collections.abc import Callable
from functools import wraps
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape

console = Console()
errors = Console(stderr=True)


def say(line: str, where: Console = console) -> None:
    """:param line: printed as it is, unbroken, so that a path or a command in it can be copied; :param where: or ``errors``"""
    where.print(escape(line), soft_wrap=True, highlight=False)


def in_one_line(command: Callable[..., None]) -> Callable[..., None]:
    """What the user can mend (ValueError, FileNotFoundError) is said in one line, without a traceback; the exit code is 2."""

    @wraps(command)
    def guarded(*args: Any, **kwargs: Any) -> None:
        try:
            command(*args, **kwargs)
        except (ValueError, FileNotFoundError) as error:
            say(str(error), errors)
            raise typer.Exit(2) from None

    return guarded
