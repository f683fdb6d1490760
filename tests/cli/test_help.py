"""Help: grouped by what people want to do, an example that works for each command, every option explained."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sb3_crc import __version__
from sb3_crc.cli import app
from sb3_crc.command import Group
from tests.cli.tree import COMMANDS, PROGRAM, examples, options, parse

ROOT = Path(__file__).parents[2]
HEAVY = {"torch", "stable_baselines3", "matplotlib", "sklearn", "scipy", "pandas", "plotly", "dm_control", "mujoco", "shimmy"}
HEAVY |= {"ray", "submitit", "rl_zoo3", "tensorboard", "rliable", "onnx", "av", "yaml"}


def test_the_program_says_how_to_begin_and_groups_the_commands() -> None:
    text = CliRunner().invoke(app, ["--help"]).stdout
    sections = re.findall(r"^(\S[^\n]*):\n((?:  \S.*\n|   .*\n)+)", text, re.MULTILINE)
    found = {title: re.findall(r"^  ([a-z][a-z-]*)  ", body, re.MULTILINE) for title, body in sections}
    assert [title for title in found if title != "Options"] == [group.value for group in Group]
    assert [name for group in Group for name in found[group.value]] == list(COMMANDS)
    assert "\n    python train.py --algo crc --env dmc_pixels/cartpole-swingup-v0\n" in text
    assert "..." not in text.replace("[ARGS]...", ""), "what a command does is cut off"
    assert all(f"{code} " in text for code in (0, 1, 2, 130, 143)) and "Exit codes" in text


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_explained_down_to_an_example(name: str) -> None:
    command = COMMANDS[name]
    assert Group(command.rich_help_panel) and command.help
    text = CliRunner().invoke(app, [name, "--help"]).stdout
    ended = "\n" + "".join(f"  {line}\n" for line in examples(name))
    assert text.endswith(ended) and len(examples(name)) >= 1
    assert all(len(line) <= 100 for line in examples(name))
    for parameter in command.params:
        assert parameter.help and parameter.help.endswith("."), f"{name}: {parameter.name} is not explained"
    own = {flag for option in options(command) for flag in option.opts}
    assert "--json" in own


@pytest.mark.parametrize("name", COMMANDS)
def test_an_example_works(name: str) -> None:
    """It is parsed, values of closed sets are among them, and files that come with the project are there."""
    for line in examples(name):
        command, values = parse(line)
        assert command is COMMANDS[name], line
        context = command.make_context(name, [], resilient_parsing=True)
        for parameter in command.params:
            value = values.get(parameter.name)
            for one in value if isinstance(value, list | tuple) else [value]:
                if isinstance(one, str):
                    known = [item.value for item in parameter.shell_complete(context, one)]
                    if parameter._custom_shell_complete is not None and one not in known:
                        assert "," in one and _each_is_known(parameter, context, one), (line, one)
                if isinstance(one, Path) and one.parts[:1] in (("zoo_configs",), ("results",)):
                    assert (ROOT / one).exists(), (line, one)


def _each_is_known(parameter: object, context: object, value: str) -> bool:
    """Of values that are separated by commas"""
    return all(parameter.shell_complete(context, one) for one in value.split(","))  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "line",
    [
        "sb3-crc compare --taks cartpole-swingup",
        "sb3-crc compare --presets crc",
        "sb3-crc comprae --task cartpole-swingup",
        "sb3-crc compare --task cartpole-swingup --seeds three",
        "sb3-crc doctor runs",
    ],
)
def test_a_typo_in_an_example_would_be_found(line: str) -> None:
    with pytest.raises(Exception, match=r"No such|Missing|valid|unexpected"):
        parse(line)


def test_version() -> None:
    assert CliRunner().invoke(app, ["--version"]).stdout == f"sb3-crc {__version__}\n"


def test_help_of_everything_imports_nothing_heavy() -> None:
    code = (
        "import sys\nfrom sb3_crc.cli import app\n"
        f"for words in [[], *([name] for name in {list(COMMANDS)!r})]:\n"
        "    try:\n        app([*words, '--help'])\n    except SystemExit as ended:\n        assert ended.code == 0\n"
        "print({name.partition('.')[0] for name in sys.modules}, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.count("--json") > len(COMMANDS)
    assert not HEAVY & eval(done.stderr)


def test_flags_that_commands_share_are_the_same() -> None:
    """How runs are executed is defined once."""
    own, other = ({one.name: one for one in options(COMMANDS[name])} for name in ("compare", "sweep"))
    shared = {"engine", "jobs", "address", "cpus", "gpus", "memory", "slurm", "checkpoint_every", "dry_run"}
    assert shared < own.keys() & other.keys()
    assert all((own[name].help, own[name].default) == (other[name].help, other[name].default) for name in shared)
    assert PROGRAM.commands.keys() == COMMANDS.keys()
