"""Whether a command line of the pages would be understood, by the parser of the program that it calls, which does not run."""

import argparse
import contextlib
import importlib
import inspect
import os
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium as gym
import typer
from stable_baselines3 import SAC

from sb3_crc.augmentations import AUGMENTATIONS
from sb3_crc.presets import PRESETS
from sb3_crc.stock import STOCK
from tests.docs.fences import ROOT

#: Folders of the repository: a path into one of them must be there
FOLDERS = ("zoo_configs", "results", "examples", "benchmarks", "tests", "docs", "sb3_crc")
OUTPUTS = ("-o", "--output", "-f", "--log-folder")


class NotUnderstood(AssertionError):
    """The program would refuse this line, or nobody knows how to ask it."""


def check_command_line(line: str) -> None:
    """:param line: a command, or several with pipes between them; :raises NotUnderstood: with the reason"""
    words: list[str] = []
    for word in [*shlex.split(line, comments=True), "|"]:
        if word != "|":
            words.append(word)
            continue
        _check_command(line, words)
        words = []


def _check_command(line: str, words: list[str]) -> None:
    path = list(sys.path)
    while words and (variable := re.fullmatch(r"([A-Z_0-9]+)=(.*)", words[0])):  # VARIABLE=value before the command
        if variable[1] == "PYTHONPATH":
            path.insert(0, str(ROOT / variable[2]))
        words = words[1:]
    if not words or {"&&", "||", ";", ">"} & {*words} or any(word.endswith(";") for word in words):
        raise NotUnderstood(f"{line}: one command a line, without the shell's own words")
    for programs, check in PROGRAMS.items():
        for program in programs:
            start = program.split()
            if words[: len(start)] == start:
                _check_paths(line, words)
                with _refusals_told(line), mock.patch.object(sys, "path", path):
                    check(words[len(start) :])
                return
    raise NotUnderstood(f"{line}: there is no checker for {words[0]!r}; add one to PROGRAMS in {Path(__file__).name}")


@contextlib.contextmanager
def _refusals_told(line: str) -> Iterator[None]:
    try:
        yield
    except NotUnderstood as error:
        raise NotUnderstood(f"{line}: {error}") from error
    except SystemExit as error:
        if error.code not in (None, 0):
            raise NotUnderstood(f"{line}: refused ({error.code})") from error
    except Exception as error:
        said = error.format_message() if hasattr(error, "format_message") else str(error)  # click's
        raise NotUnderstood(f"{line}: {said}") from error


def _check_paths(line: str, words: list[str]) -> None:
    for before, word in zip(["", *words], words, strict=False):
        if before not in OUTPUTS and word.partition("/")[0] in FOLDERS and "/" in word and not any(ROOT.glob(word)):
            raise NotUnderstood(f"{line}: there is no {word}")


# -- Our commands ------------------------------------------------------------------------------------------------------


def check_typer(app: typer.Typer, words: list[str]) -> dict[str, Any]:
    """:return: what the command would be given, ``command`` being its name"""
    command: Any = typer.main.get_command(app)
    name, context = "program", None
    while True:
        context = command.make_context(name, list(words), parent=context)
        if not hasattr(command, "resolve_command"):
            return {**context.params, "command": name}
        words = [*getattr(context, "_protected_args", []), *context.args]
        if not words:
            raise NotUnderstood("a command is missing")
        name, command, words = command.resolve_command(context, words)


def check_sb3_crc(words: list[str]) -> None:
    """Options as the command line reads them; presets, tasks and sweeps as the comparison does."""
    from sb3_crc.cli import app
    from sb3_crc.envs.tasks import split_task
    from sb3_crc.experiments.specs import compared, read_sweep

    if words in ([], ["--help"], ["--version"]):
        return
    given = check_typer(app, words)
    if given["command"] == "compare":
        presets = [name.strip() for name in given["presets"].split(",")]
        for task in given["task"]:
            split_task(task)
        conf_file = None if given["conf_file"] is None else ROOT / given["conf_file"]
        compared(presets, given["task"], [0], env_steps=given["env_steps"], eval_every=given["env_steps"], conf_file=conf_file)
    if given["command"] == "sweep" and (file := ROOT / given["file"]).is_file():
        conf_file = None if given["conf_file"] is None else ROOT / given["conf_file"]
        read_sweep(file, conf_file=conf_file)


def check_benchmarks(words: list[str]) -> None:
    """``python -m benchmarks``."""
    from benchmarks.__main__ import app

    check_typer(app, words)


# -- rl_zoo3's scripts -------------------------------------------------------------------------------------------------


class Parsed(Exception):
    """What a script was given; raised where it would begin to work."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__()
        self.options = options


@contextlib.contextmanager
def stopped_when_parsed() -> Iterator[None]:
    """Within it an argparse script ends with :class:`Parsed`, once it knows what it was asked to do."""
    parse = argparse.ArgumentParser.parse_args

    def parse_args(self: argparse.ArgumentParser, *args: Any, **kwargs: Any) -> None:
        raise Parsed(parse(self, *args, **kwargs))

    with mock.patch.object(argparse.ArgumentParser, "parse_args", parse_args):
        yield


def options_of(script: Callable[[], object]) -> argparse.Namespace:
    """Run a script until it has parsed its arguments."""
    try:
        with stopped_when_parsed():
            script()
    except Parsed as parsed:
        return parsed.options
    raise NotUnderstood("the script did not parse its arguments")


def check_train(words: list[str]) -> None:
    """``train.py`` and its zoo: flags, algorithm, environment, file and names of ``-params``."""
    import rl_zoo3

    from sb3_crc.zoo import CRCExperimentManager, train
    from sb3_crc.zoo import commands as zoo_commands

    resumed = words[words.index("--resume") + 1] if "--resume" in words else None
    real = zoo_commands.read_plan

    def read_plan(flags: list[str]) -> Any:
        if resumed is None:
            return real(flags)
        position = list(flags).index("--resume")  # there is no such run
        return real([*flags[:position], *flags[position + 2 :]])

    with (
        mock.patch.object(sys, "argv", ["train.py", *words]),
        mock.patch.dict(rl_zoo3.ALGOS),
        mock.patch.object(CRCExperimentManager, "plan", CRCExperimentManager.plan),
        mock.patch.object(zoo_commands, "read_plan", read_plan),
    ):
        options = options_of(train)
    for module in options.gym_packages:
        importlib.import_module(module)
    if options.env not in gym.registry:
        raise NotUnderstood(f"there is no environment {options.env}")
    known = {*inspect.signature(SAC.__init__).parameters, "env_kwargs", "n_envs", "n_timesteps", "callback"}
    if options.algo in PRESETS:
        from sb3_crc import CRCSAC

        known |= {*inspect.signature(CRCSAC.__init__).parameters}
    elif options.algo not in STOCK and options.algo not in rl_zoo3.ALGOS:
        raise NotUnderstood(f"there is no algorithm {options.algo}")
    if unknown := {*(options.hyperparams or {})} - known:
        raise NotUnderstood(f"-params {sorted(unknown)[0]}: no setting of {options.algo}")


def check_zoo(words: list[str]) -> None:
    """``python -m sb3_crc.zoo``."""
    import rl_zoo3
    import rl_zoo3.utils

    from sb3_crc.zoo import commands, main

    if words[:1] == ["train"]:
        check_train(words[1:])
        return
    if not words or words[0] not in commands.COMMANDS:
        raise NotUnderstood(f"no command of the zoo: {words[:1]}")
    with (
        mock.patch.object(sys, "argv", ["zoo"]),
        mock.patch.dict(rl_zoo3.ALGOS),
        mock.patch.object(rl_zoo3.utils, "create_test_env", rl_zoo3.utils.create_test_env),
        mock.patch.object(commands, "normalized_inputs", contextlib.nullcontext),  # reads a file that is not there
    ):
        options_of(lambda: main(words))


# -- Others ------------------------------------------------------------------------------------------------------------


def check_make(words: list[str]) -> None:
    """Targets, and what is handed on to programs; ``make -n`` runs nothing."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}
    done = subprocess.run(["make", "-n", *words], cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise NotUnderstood(done.stderr.strip())
    for word in words:
        if word.startswith("ARGS="):
            if "train" in words:
                check_train(["--algo", "crc", "--env", "dmc_pixels/cartpole-swingup-v0", *shlex.split(word[5:])])
            elif "bench" in words:
                check_benchmarks(shlex.split(word[5:]))


def check_pip(words: list[str]) -> None:
    """``pip install``: its options, and our extras."""
    from pip._internal.commands import create_command

    if words[:1] != ["install"]:
        raise NotUnderstood(f"pip {words[0]}")
    _, packages = create_command("install").parse_args(words[1:])
    section = (ROOT / "pyproject.toml").read_text().partition("[project.optional-dependencies]")[2].partition("\n[")[0]
    known = {*re.findall(r"^(\w+) = ", section, re.MULTILINE)}
    for package in [*packages, *words]:
        if (extras := re.fullmatch(r"(?:\.|sb3-crc)\[(.*)\]", package)) and (unknown := {*extras[1].split(",")} - known):
            raise NotUnderstood(f"no extra {sorted(unknown)[0]!r}")


def check_script(words: list[str]) -> None:
    """``python <file in examples/>`` with its own parser, or without one."""
    if not words or not words[0].startswith("examples/"):
        raise NotUnderstood(f"python {' '.join(words)}")
    if "argparse" not in (ROOT / words[0]).read_text():
        if words[1:]:
            raise NotUnderstood(f"{words[0]} takes no arguments")
        return
    with (
        mock.patch.object(sys, "argv", words),
        mock.patch.object(sys, "path", [str((ROOT / words[0]).parent), *sys.path]),
        mock.patch.dict(AUGMENTATIONS),  # an example registers its own
        mock.patch.dict(gym.registry),
    ):
        options_of(lambda: runpy.run_path(str(ROOT / words[0]), run_name="__main__"))


def check_jq(words: list[str]) -> None:
    """One filter."""
    if len(words) != 1 or words[0].startswith("-"):
        raise NotUnderstood("jq takes a filter")


#: Beginnings of a command line -> what checks the rest; the longer ones come first
PROGRAMS: dict[tuple[str, ...], Callable[[list[str]], object]] = {
    ("make",): check_make,
    ("sb3-crc",): check_sb3_crc,
    ("python -m sb3_crc.zoo",): check_zoo,
    ("python -m sb3_crc",): check_sb3_crc,
    ("python -m benchmarks",): check_benchmarks,
    ("python train.py",): check_train,
    ("pip", "python -m pip"): check_pip,
    ("jq",): check_jq,
    ("python",): check_script,
}
