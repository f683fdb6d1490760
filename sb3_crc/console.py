"""What the commands say, and where: results on stdout, progress and whatever went wrong on stderr.

Rich leaves colours out where the output is no terminal or ``NO_COLOR`` is set, and forces them where ``FORCE_COLOR`` is.
"""

from io import StringIO
from typing import TYPE_CHECKING

from rich.console import Console

if TYPE_CHECKING:
    from rich.table import Table

console = Console()
errors = Console(stderr=True)
#: Characters in a line of a table that nobody looks at: a row is one line, however long
WIDE = 10_000


def say(line: str, where: Console = console) -> None:
    """:param line: printed as it is, unbroken, so that a path or a command in it can be copied; :param where: or ``errors``"""
    where.print(line, markup=False, emoji=False, highlight=False, soft_wrap=True)


def tell(line: str) -> None:
    """:param line: of progress, or about what is missing or wrong: as :func:`say`, on stderr"""
    say(line, errors)


def on_a_screen(where: Console) -> bool:
    """:return: whether somebody looks at it: ``is_terminal`` is also true of a pipe, where ``FORCE_COLOR`` is set"""
    return where.file.isatty()


def show(table: "Table") -> None:
    """:param table: a result; drawn with lines on a screen, and else a line for each row, without lines or anything cut off"""
    if on_a_screen(console) or console.quiet:
        console.print(table)
        return
    table.box = None
    wide = Console(file=StringIO(), width=WIDE)
    wide.print(table)
    assert isinstance(wide.file, StringIO)
    for line in wide.file.getvalue().splitlines():
        console.file.write(line.rstrip() + "\n")
