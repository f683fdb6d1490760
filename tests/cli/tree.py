"""All commands as the parser knows them: what is asked of one is asked of every other, also of those that are to come."""

import shlex
from typing import Any

import typer

from sb3_crc.cli import app

PROGRAM: Any = typer.main.get_command(app)
COMMANDS: dict[str, Any] = {name: PROGRAM.commands[name] for name in PROGRAM.list_commands(None)}


def options(command: Any) -> list[Any]:
    return [one for one in command.params if one.param_type_name == "option"]


def examples(name: str) -> list[str]:
    heading, *lines = (COMMANDS[name].epilog or "").split("\n\n")
    assert heading in ("Example:", "Examples:"), f"{name}: its help has no example"
    return [line.strip() for line in lines]


def parse(line: str) -> tuple[Any, dict[str, Any]]:
    """:return: the command of a line, and its values. A mistake in it raises, as it would in a shell"""
    program, *words = shlex.split(line.partition(" > ")[0])
    assert program == "sb3-crc"
    whole = PROGRAM.make_context("sb3-crc", words)
    name, command, rest = PROGRAM.resolve_command(whole, [*whole._protected_args, *whole.args])
    return command, command.make_context(name, rest, parent=whole).params
