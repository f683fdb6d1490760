"""Python 3.10 to 3.12: files compile for each, use nothing of a later standard library, and dependencies can be solved.

The tests run on one of them; the others are asked where they are installed.
"""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
VERSIONS = ("3.10", "3.11", "3.12")
#: What mypy says where a module or a name of the standard library came later
LATER = ("attr-defined", "import-not-found", "import-untyped", "syntax", "name-defined")
COMPILE = "import sys\nfor name in sys.stdin.read().split('\\0'):\n    compile(open(name, 'rb').read(), name, 'exec')"


def sources() -> list[Path]:
    folders = ("sb3_crc", "tests", "benchmarks", "examples", "docs")
    return [ROOT / "train.py", *(path for folder in folders for path in (ROOT / folder).rglob("*.py"))]


def interpreter(version: str) -> str | None:
    """One of that version that starts: pyenv's stand-ins are there without it."""
    found = [shutil.which(f"python{version}"), *map(str, Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))]
    for program in filter(None, found):
        if subprocess.run([program, "-c", ""], capture_output=True, check=False).returncode == 0:
            return program
    return None


def test_the_versions_are_those_that_are_promised() -> None:
    promised = re.search(r'^requires-python = ">=3\.(\d+),<3\.(\d+)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert promised is not None
    assert [f"3.{minor}" for minor in range(int(promised[1]), int(promised[2]))] == [*VERSIONS]
    assert f"{sys.version_info[0]}.{sys.version_info[1]}" in VERSIONS


@pytest.mark.parametrize("version", VERSIONS)
def test_every_file_compiles(version: str) -> None:
    program = interpreter(version)
    if program is None:  # the grammar alone, as far as this interpreter knows it
        minor = int(version.split(".")[1])
        for path in sources():
            ast.parse(path.read_text(), str(path), feature_version=(3, minor))
        return
    names = "\0".join(map(str, sources()))
    outcome = subprocess.run([program, "-c", COMPILE], input=names, capture_output=True, text=True, check=False)
    assert outcome.returncode == 0, outcome.stderr


def test_a_later_grammar_would_be_noticed() -> None:
    with pytest.raises(SyntaxError):
        ast.parse("try:\n    pass\nexcept* ValueError:\n    pass", feature_version=(3, 10))


def later_names(package: Path, folder: Path, version: str) -> list[str]:
    """:return: what mypy does not find in the standard library of that version"""
    options = ["--python-version", version, "--follow-imports", "silent", "--cache-dir", str(folder / "cache")]
    command = [sys.executable, "-m", "mypy", *options, str(package)]
    outcome = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert outcome.returncode in (0, 1), outcome.stdout + outcome.stderr
    return [line for line in outcome.stdout.splitlines() if line.endswith(tuple(f"[{code}]" for code in LATER))]


@pytest.mark.slow
def test_nothing_of_a_later_standard_library_is_used(tmp_path: Path) -> None:
    assert later_names(ROOT / "sb3_crc", tmp_path, "3.10") == []


@pytest.mark.slow
def test_what_is_of_a_later_standard_library_would_be_noticed(tmp_path: Path) -> None:
    (tmp_path / "later.py").write_text("import tomllib\nfrom enum import StrEnum\nfrom typing import Self\n")
    assert len(later_names(tmp_path / "later.py", tmp_path, "3.10")) == 3


@pytest.mark.slow
@pytest.mark.parametrize("version", VERSIONS)
def test_the_versions_of_constraints_txt_can_be_installed(version: str) -> None:
    """All extras together, on this platform."""
    options = ["--python-version", version, "--all-extras", "--constraints", "constraints.txt", "--quiet"]
    command = [sys.executable, "-m", "uv", "pip", "compile", *options, "pyproject.toml"]
    outcome = subprocess.run(
        command, cwd=ROOT, env={**os.environ, "UV_HTTP_TIMEOUT": "30"}, capture_output=True, text=True, check=False
    )
    if "Failed to fetch" in outcome.stderr or "error sending request" in outcome.stderr:
        pytest.skip("uv reaches no package index")
    assert outcome.returncode == 0, outcome.stderr
    pinned = dict(re.findall(r"^([\w.-]+)==(\S+)", outcome.stdout, re.MULTILINE))
    tested = set(re.findall(r"^([\w.-]+)==(\S+)", (ROOT / "constraints.txt").read_text(), re.MULTILINE))
    assert {"torch", "stable-baselines3", "dm-control", "ray", "sphinx"} <= pinned.keys()
    assert set(pinned.items()) <= tested  # nothing is left open


@pytest.mark.long
@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_the_lowest_allowed_versions_pass_the_fast_tests() -> None:
    outcome = subprocess.run(["make", "test-lowest"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert outcome.returncode == 0, outcome.stdout[-5000:] + outcome.stderr[-5000:]
