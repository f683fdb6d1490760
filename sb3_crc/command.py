"""What all commands of ``sb3-crc`` have in common: a group, an example, ``--json``, one line for a mistake, exit codes.

::

    @command(app, Group.RUNS, "sb3-crc evaluate runs")
    def evaluate(runs: ..., episodes: ... = 10) -> object:
        tell("progress, on stderr")
        say("a result, for people")
        return {"the": "same result, for --json"}

A parameter whose type is a dataclass stands for its fields, which are options: what several commands have is written once.
"""

import errno
import importlib.util
import json
import math
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from dataclasses import asdict, fields, is_dataclass
from enum import Enum
from functools import wraps
from inspect import Parameter, signature
from itertools import groupby
from pathlib import PurePath
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup

from sb3_crc.console import console, on_a_screen, tell

if TYPE_CHECKING:
    from typer.core import MarkupMode

#: Exit codes: the answer is no, or some of the work failed; wrong usage or input. A signal's is 128 and its number
NO, MISUSED = 1, 2
Json = Annotated[bool, typer.Option("--json", help="Print the result as one JSON document, for programs.")]


class Group(str, Enum):
    """What people want to do, in the order of ``sb3-crc --help``."""

    COMPARE = "Train and compare"
    RUNS = "Look at runs"
    INSIDE = "Look inside a policy"
    SHARE = "Share a policy"
    TASKS = "Measure a task"
    EVIDENCE = "Publish evidence"
    MACHINE = "This machine"


class No:
    """:param document: an answer that is no, or work of which some failed: printed like any other; the exit code is 1"""

    def __init__(self, document: object):
        self.document = document


def command(
    app: typer.Typer, group: Group, *examples: str, name: str | None = None
) -> Callable[[Callable[..., object]], Callable[..., object]]:
    """
    :param app: to which the decorated function is added
    :param group: under which ``sb3-crc --help`` lists it
    :param examples: command lines that can be copied; a test parses them
    :param name: None: the function's
    :return: a decorator. The function prints for people with :mod:`~sb3_crc.console`, and returns what ``--json`` prints
    """

    def register(function: Callable[..., object]) -> Callable[..., object]:
        epilog = "\n\n".join(("Example:" if len(examples) == 1 else "Examples:", *(f"  {one}" for one in examples)))
        app.command(name=name, cls=Command, rich_help_panel=group.value, epilog=epilog)(_guarded(function))
        return function

    return register


def separated(names: str) -> list[str]:
    """:param names: separated by commas; :return: them, without the spaces around them"""
    return [name.strip() for name in names.split(",") if name.strip()]


def require(extra: str, *packages: str) -> None:
    """
    Ask for what a command needs before it works for hours.

    :param extra: of this package, which brings them
    :param packages: to be imported later
    :raises ValueError: if one is not installed, naming the extra
    """
    for package in packages:
        if importlib.util.find_spec(package) is None:
            raise ValueError(f"this needs {package}, of the extra '{extra}': pip install 'sb3-crc[{extra}]'")


def as_json(document: object) -> str:
    """:return: it as JSON, in which what is not finite is null, and a dataclass the mapping of its fields"""
    return json.dumps(_plain(document), indent=2, allow_nan=False)


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, PurePath):
        return str(value)
    if hasattr(value, "tolist"):  # of NumPy
        return _plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


class _Terminated(KeyboardInterrupt):
    """By SIGTERM."""

    signum = signal.SIGTERM


def _guarded(function: Callable[..., object]) -> Callable[..., None]:
    """The function as Typer is to see and call it."""
    own = signature(function, eval_str=True).parameters
    bundles: dict[str, Any] = {name: one.annotation for name, one in own.items() if is_dataclass(one.annotation)}
    parameters: list[Parameter] = []
    for name, one in own.items():
        if name not in bundles:
            parameters.append(one.replace(kind=Parameter.KEYWORD_ONLY))
            continue
        hints = get_type_hints(bundles[name], include_extras=True)
        for field in fields(bundles[name]):
            option = Parameter(field.name, Parameter.KEYWORD_ONLY, annotation=hints[field.name], default=field.default)
            parameters.append(option)
    parameters.append(Parameter("json", Parameter.KEYWORD_ONLY, annotation=Json, default=False))

    @wraps(function)
    def guarded(*, json: bool, **values: Any) -> None:
        for name, bundle in bundles.items():
            values[name] = bundle(**{field.name: values.pop(field.name) for field in fields(bundle)})
        with _one_line_for_mistakes():
            if json:
                with _all_but_the_document_elsewhere():
                    answer = function(**values)
                typer.echo(as_json(answer.document if isinstance(answer, No) else answer))
            else:
                answer = function(**values)
        if isinstance(answer, No):
            raise typer.Exit(NO)

    guarded.__signature__ = signature(function).replace(parameters=parameters, return_annotation=None)  # type: ignore[attr-defined]
    guarded.__annotations__ = {one.name: one.annotation for one in parameters}
    return guarded


@contextmanager
def _all_but_the_document_elsewhere() -> Iterator[None]:
    """Within it results for people are not said, and what libraries print goes to stderr."""
    console.quiet = True
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        console.quiet = False


@contextmanager
def _one_line_for_mistakes() -> Iterator[None]:
    """What the user, the machine or a signal did is said in one line, with its exit code; a traceback is a bug of ours."""
    try:
        with _ended_by_sigterm():
            yield
    except KeyboardInterrupt as stop:
        tell("Stopped.")
        raise typer.Exit(128 + getattr(stop, "signum", signal.SIGINT)) from None
    except (FileNotFoundError, PermissionError, FileExistsError, IsADirectoryError, NotADirectoryError) as error:
        tell(_line(error))
        raise typer.Exit(MISUSED) from None
    except OSError as error:  # full or broken disks
        if error.errno == errno.EPIPE:
            raise
        tell(_line(error))
        raise typer.Exit(NO) from None
    except ValueError as error:
        tell(str(error))
        raise typer.Exit(MISUSED) from None
    except ImportError as error:
        if error.name is not None:  # Python's own, not a library's sentence about a missing extra
            raise
        tell(str(error))
        raise typer.Exit(MISUSED) from None
    except RuntimeError as error:
        from sb3_crc.envs.rendering import RenderingUnavailable

        if not isinstance(error, RenderingUnavailable):
            raise
        tell(str(error))
        raise typer.Exit(NO) from None


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """Within it SIGTERM ends a command as Ctrl-C does, so that what must be tidied up is."""

    def stop(signum: int, frame: object) -> None:
        raise _Terminated

    ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    if ours:
        signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _line(error: OSError) -> str:
    return str(error) if error.filename is None else f"{error.filename}: {error.strerror}"


class _ByWhoLooks:
    """Help with boxes and colours on a screen, and else as plain text, in which nothing of the last lines is broken."""

    epilog: str | None
    rich_markup_mode: "MarkupMode"

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """As :class:`TyperCommand` does."""
        self.rich_markup_mode = "rich" if on_a_screen(console) else None
        super().format_help(ctx, formatter)  # type: ignore[misc]

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Paragraph by paragraph."""
        formatter.write("\n" + (self.epilog or "").replace("\n\n", "\n") + "\n")


class Command(_ByWhoLooks, TyperCommand):
    """One command."""


class Program(_ByWhoLooks, TyperGroup):
    """All commands, by group."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """What it says of mistakes is no box."""
        self.rich_markup_mode = None
        return super().main(*args, **kwargs)

    def list_commands(self, ctx: Any) -> list[str]:
        """:return: their names, by group"""
        return sorted(self.commands, key=lambda name: list(Group).index(self._group(name)))

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """A section for each group."""
        for group, names in groupby(self.list_commands(ctx), self._group):
            with formatter.section(group.value):
                formatter.write_dl([(name, self.commands[name].get_short_help_str(limit=1_000)) for name in names])

    def _group(self, name: str) -> Group:
        return Group(getattr(self.commands[name], "rich_help_panel", None))
