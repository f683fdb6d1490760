"""A mistake is one clear line and exit code 2; failed work is 1; a signal is 128 and its number; a bug keeps its traceback."""

import ctypes
import errno
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from inspect import signature
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.envs.rendering import RenderingUnavailable
from sb3_crc.experiments import baselines
from sb3_crc.export import export_policy
from tests.cli.cases import CASES
from tests.cli.tree import COMMANDS, options
from tests.conftest import make_model

#: Command and which of its words is a file or folder that is read
READ = [(name, place) for name, words in CASES.items() for place, word in enumerate(words) if word.startswith("{")]
READ = [(name, place) for name, place in READ if not CASES[name][place].startswith("{out}")]
BASELINES = ["baselines", "pendulum-swingup", "--episodes", "2", "--action-repeat", "100"]


def call(name: str, place: int, instead: Path, places: dict[str, Path], out: Path) -> Result:
    out.mkdir(exist_ok=True)
    words = [word.format(**places, out=out) for word in CASES[name]]
    words[place] = str(instead)
    return CliRunner().invoke(app, [name, *words])


def is_one_clear_line(done: Result, *named: str) -> None:
    assert done.exit_code == 2 and isinstance(done.exception, SystemExit), (done.output, done.exception)
    *_, line = said = done.stderr.strip().splitlines()
    assert len([one for one in said if not one.startswith("[1/1]")]) == 1 and any(name in line for name in named), said
    assert not done.stdout


@pytest.mark.parametrize(("name", "place"), READ)
def test_what_is_not_there(name: str, place: int, places: dict[str, Path], tmp_path: Path) -> None:
    done = call(name, place, tmp_path / "nowhere", places, tmp_path / "out")
    is_one_clear_line(done, str(tmp_path / "nowhere"))


@pytest.mark.parametrize(("name", "place"), READ)
@pytest.mark.parametrize("content", [b"", b"\x80\x04 nonsense {[ \n\x00\xff", b"- a\n- b\n"], ids=["empty", "bytes", "text"])
def test_what_is_something_else(name: str, place: int, content: bytes, places: dict[str, Path], tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.write_bytes(content)
    is_one_clear_line(call(name, place, other, places, tmp_path / "out"), str(other))


@pytest.mark.parametrize(("name", "place"), READ)
def test_a_folder_without_anything(name: str, place: int, places: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    done = call(name, place, tmp_path / "empty", places, tmp_path / "out")
    if name == "table":  # the published scores are a table without any of ours
        assert done.exit_code == 0 and "CRC-RL" in done.stdout
        return
    is_one_clear_line(done, str(tmp_path / "empty"), "no scores")


#: Of capabilities(7): CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH, by which root reads what its owner may not
READS_ANYTHING = 1 << 1 | 1 << 2


@contextmanager
def no_more_than_the_owner() -> Iterator[None]:
    """Within it root, too, is refused what a file's mode refuses to its owner; only this thread is."""
    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)  # version 3, this thread
    before = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable; lower and higher half
    assert libc.capget(header, before) == 0
    less = (ctypes.c_uint32 * 6)(*before)
    less[0] &= ~READS_ANYTHING
    assert libc.capset(header, less) == 0
    try:
        yield
    finally:
        assert libc.capset(header, before) == 0


@pytest.mark.skipif(sys.platform != "linux", reason="capabilities are Linux's")
@pytest.mark.parametrize(("name", "place"), READ)
def test_what_may_not_be_read(name: str, place: int, places: dict[str, Path], tmp_path: Path) -> None:
    locked = tmp_path / "locked"
    locked.touch(mode=0)
    with no_more_than_the_owner():
        with pytest.raises(PermissionError):
            locked.read_bytes()
        is_one_clear_line(call(name, place, locked, places, tmp_path / "out"), str(locked))


@pytest.mark.parametrize("name", COMMANDS)
def test_values_that_cannot_be(name: str) -> None:
    annotations = {key: one.annotation for key, one in signature(COMMANDS[name].callback).parameters.items()}
    numbers = [one for one in options(COMMANDS[name]) if re.search(r"\b(int|float)\b", str(annotations.get(one.name)))]
    for option in numbers:
        done = CliRunner().invoke(app, [name, option.opts[0], "three"])
        assert done.exit_code == 2 and "Invalid value for" in done.stderr and not done.stdout, option.name
    done = CliRunner().invoke(app, [name, "--no-such-option"])
    assert done.exit_code == 2 and "No such option: --no-such-option" in done.stderr and "╭" not in done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["baselines", "cartpole-swngup"], "Did you mean 'cartpole-swingup'?"),
        (["baselines", "cartpole-swingup", "--episodes", "1"], "Invalid value for '--episodes'"),
        (["landmarks", "--task", "walker"], "Unknown task 'walker'"),
        (["ladder", "stairs"], "'stairs' is none of state, screen, seen, probe, teach, overfit"),
        (["ladder", "probe", "--set", "n_steps=1"], "--set is an option of screen and teach; this is rung probe"),
        (["ladder", "seen", "--reward-scale", "0"], "--reward-scale is an option of state; this is rung seen"),
        (["table", "200k", "{csv}"], "200k"),
        (["contact-sheet", "--tasks", "cartpole"], "Unknown task 'cartpole'"),
        (["contact-sheet", "--tasks", " ,"], "no task is given"),
        (["contact-sheet", "--tasks", "lqr-lqr_2_1", "--render-quality", "best"], "best"),
        (["compare", "--task", "walker-walk", "--engine", "lcoal"], "did you mean 'local'?"),
        (["compare", "--task", "walker-walk", "--presets", "crcc"], "did you mean 'crc'?"),
        (["comprae"], "Did you mean 'compare'"),
        (
            ["baselines", "pendulum-swingup", "--episodes", "2", "--action-repeat", "500", "--output", "/nowhere/x"],
            "/nowhere/x",
        ),
    ],
)
def test_values_that_are_none(words: list[str], message: str, places: dict[str, Path]) -> None:
    done = CliRunner().invoke(app, [word.format(**places) for word in words])
    assert done.exit_code == 2 and message in done.stderr and isinstance(done.exception, SystemExit), (
        done.stderr,
        done.exception,
    )


def raising(error: BaseException) -> Callable[..., Any]:
    def measure(*_: object, **__: object) -> None:
        raise error

    return measure


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "x.csv"), 1, "x.csv: No space left on device"),
        (ConnectionError("the Hub refuses"), 1, "the Hub refuses"),
        (RenderingUnavailable("nothing draws"), 1, "nothing draws"),
        (PermissionError(errno.EACCES, "Permission denied", "x.csv"), 2, "x.csv: Permission denied"),
        (ValueError("seed=-1 must be at least 0"), 2, "seed=-1 must be at least 0"),
        (ImportError("a.mp4 needs the package av: pip install it"), 2, "a.mp4 needs the package av: pip install it"),
        (KeyboardInterrupt(), 130, "Stopped."),
    ],
)
def test_exit_codes(error: BaseException, code: int, line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "measure_baselines", raising(error))
    for flags in ([], ["--json"]):
        done = CliRunner().invoke(app, [*BASELINES, *flags])
        assert (done.exit_code, done.stderr, done.stdout) == (code, line + "\n", "")


SIGNALLED = """
import os, sys, time
from sb3_crc.cli import app
from sb3_crc.experiments import baselines

def measure(*_, **__):
    try:
        os.kill(os.getpid(), signum)
        time.sleep(30)
    finally:
        print("tidied up", file=sys.stderr)

signum = int(sys.argv.pop(1))
baselines.measure_baselines = measure
app()
"""


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_command_with_its_number(signum: signal.Signals) -> None:
    """In a process of its own: signals reach main threads, and a test need not run in one."""
    command = [sys.executable, "-c", SIGNALLED, str(int(signum)), *BASELINES]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr, done.stdout) == (128 + signum, "tidied up\nStopped.\n", "")


@pytest.mark.parametrize("error", [TypeError("a bug"), ModuleNotFoundError("No module named 'sb3'", name="sb3")])
def test_a_bug_keeps_its_traceback(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "measure_baselines", raising(error))
    done = CliRunner().invoke(app, BASELINES)
    assert done.exit_code == 1 and done.exception is error


def test_a_policy_of_an_environment_of_ones_own_is_for_python(tmp_path: Path) -> None:
    policy = export_policy(make_model(), tmp_path / "policy.sb3crc", task="own/CentreTheDisc-v0")
    done = CliRunner().invoke(app, ["enjoy", str(policy)])
    assert done.exit_code == 2
    assert "'own/CentreTheDisc-v0', which is no task of dm_control: load it in Python" in " ".join(done.output.split())
