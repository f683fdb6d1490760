"""The Makefile: when it installs, what it leaves after a failure, and how Ctrl-C ends a training run.

A stand-in for Python records what it is asked to do, so nothing is downloaded and nothing is installed.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.skipif(shutil.which("make") is None or os.name != "posix", reason="needs make")

STAND_IN = """#!/bin/sh
here=$(dirname "$0")
case "$*" in
  "-m pip --version") [ -e "$here/has-pip" ]; exit ;;
  "-c import sys"*) exit ${FAKE_UNSUITABLE:-0} ;;
  "-c from urllib"*) exit ${FAKE_INDEX:-1} ;;
  "-m venv --clear .venv") mkdir -p .venv/bin; cp "$0" .venv/bin/python; touch .venv/bin/has-pip ;;
esac
echo "$*" >> "$FAKE_LOG"
case "$*" in
  "-m pip install"*) exit ${FAKE_PIP:-0} ;;
  "-m pytest"*) exit ${FAKE_PYTEST:-0} ;;
  train.py*) exec "$FAKE_REAL_PYTHON" train.py ;;
esac
"""

PATIENT_TRAINING = """
import sys, time
try:
    print("training", flush=True)  # the interruption may follow at once
    time.sleep(60)
except KeyboardInterrupt:
    time.sleep(0.3)  # writing results
    print("go on with: -i logs/crc", flush=True)
    sys.exit(130)
"""


class Checkout:
    """A directory with our Makefile, where `python3` is the stand-in."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.log = path / "calls"
        programs = path / "programs"
        programs.mkdir()
        for name in ("Makefile", "pyproject.toml", "constraints.txt"):
            shutil.copy(ROOT / name, path / name)
        for name, text in (("python3", STAND_IN), ("nvidia-smi", "#!/bin/sh\nexit ${FAKE_GPU:-0}\n")):
            (programs / name).write_text(text)
            (programs / name).chmod(0o755)
        self.environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))},
            "PATH": f"{programs}:{os.environ['PATH']}",
            "FAKE_LOG": str(self.log),
            "FAKE_REAL_PYTHON": sys.executable,
        }

    def make(self, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["make", *arguments],
            cwd=self.path,
            env={**self.environment, **environment},
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )

    def calls(self) -> list[str]:
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        self.log.unlink(missing_ok=True)
        return lines


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path)


INSTALL = (
    "-m pip install --disable-pip-version-check -c constraints.txt -e .[zoo,video,track,analysis,cluster,onnx,bench,docs,dev]"
)
RENDERING = "-m sb3_crc rendering --install"
FAST_TESTS = "-m pytest -n 2 --dist worksteal -m not slow and not long"


def test_installs_once_and_again_when_the_dependencies_change(checkout: Checkout) -> None:
    assert checkout.make("test").returncode == 0
    assert checkout.calls() == ["-m venv --clear .venv", INSTALL, RENDERING, FAST_TESTS]
    assert checkout.make("test").returncode == 0
    assert checkout.calls() == [RENDERING, FAST_TESTS]
    os.utime(checkout.path / "pyproject.toml")  # a checkout touches files without changing them
    checkout.make("test")
    assert checkout.calls() == [RENDERING, FAST_TESTS]
    with (checkout.path / "constraints.txt").open("a") as constraints:
        constraints.write("# changed\n")
    checkout.make("test")
    assert checkout.calls() == [INSTALL, RENDERING, FAST_TESTS]


def test_a_failed_installation_is_repeated(checkout: Checkout) -> None:
    outcome = checkout.make("test", FAKE_PIP="1")
    assert outcome.returncode != 0
    assert FAST_TESTS not in checkout.calls()
    assert not list(checkout.path.glob(".venv/.installed-*"))
    assert checkout.make("test").returncode == 0
    assert checkout.calls() == [INSTALL, RENDERING, FAST_TESTS]


def test_unsuitable_interpreters_are_refused(checkout: Checkout) -> None:
    outcome = checkout.make("install", f"PYTHON={checkout.path}/programs/python3", FAKE_UNSUITABLE="1")
    assert outcome.returncode != 0
    assert "Python 3.10 to 3.12" in outcome.stderr
    assert checkout.calls() == []


@pytest.mark.skipif(sys.platform != "linux" or os.uname().machine != "x86_64", reason="the index serves Linux x86-64")
@pytest.mark.parametrize(("gpu", "answers", "used"), [("1", "0", True), ("1", "1", False), ("0", "0", False)])
def test_pytorchs_cpu_index_only_without_gpu_and_if_it_answers(checkout: Checkout, gpu: str, answers: str, used: bool) -> None:
    checkout.make("install", FAKE_GPU=gpu, FAKE_INDEX=answers)
    installation = next(call for call in checkout.calls() if "pip install" in call)
    assert ("--extra-index-url https://download.pytorch.org/whl/cpu" in installation) == used


def test_help_lists_what_there_is(checkout: Checkout) -> None:
    listed = set(re.findall(r"^  make ([a-z-]+) +\S", checkout.make("help").stdout, re.MULTILINE))
    phony = (ROOT / "Makefile").read_text().split(".PHONY: ", 1)[1].split("\n", 1)[0].split()
    assert listed == set(phony) - {"rendering"}  # a part of others
    assert {"format", "lint", "type", "test", "test-long", "test-lowest", "coverage", "bench", "docs", "dist"} <= listed


def test_no_slow_tests_is_no_failure(checkout: Checkout) -> None:
    assert checkout.make("test-slow", FAKE_PYTEST="5").returncode == 0
    assert checkout.make("test-slow", FAKE_PYTEST="1").returncode != 0


def test_train_takes_more_flags(checkout: Checkout) -> None:
    (checkout.path / "train.py").write_text("")
    assert checkout.make("train", "ARGS=--seed 3").returncode == 0
    training = checkout.calls()[-1]
    assert training.startswith("train.py --algo crc --env dmc_pixels/cartpole-swingup-v0 --conf-file zoo_configs/laptop.yml")
    assert training.endswith("--seed 3")


@pytest.mark.parametrize(("status", "expected"), [(0, 0), (130, 0), (143, 0), (1, 2)])
def test_only_a_training_that_saved_and_stopped_is_no_failure(checkout: Checkout, status: int, expected: int) -> None:
    (checkout.path / "train.py").write_text(f"import sys; sys.exit({status})")
    assert checkout.make("train").returncode == expected


def test_control_c_ends_a_training_without_an_error_and_its_last_line_is_the_last(checkout: Checkout) -> None:
    import pty

    (checkout.path / "train.py").write_text(PATIENT_TRAINING)
    checkout.make("install")
    process, terminal = pty.fork()
    if process == 0:
        os.chdir(checkout.path)
        os.execvpe("make", ["make", "train"], checkout.environment)
    screen = b""
    interrupted = False
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        try:
            screen += os.read(terminal, 1024)
        except OSError:  # the terminal's other end was closed
            break
        if b"training" in screen and not interrupted:
            os.write(terminal, b"\x03")
            interrupted = True
    _, status = os.waitpid(process, 0)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(status) == 0
    assert screen.decode().endswith("go on with: -i logs/crc\r\n"), screen  # nothing from make after it
