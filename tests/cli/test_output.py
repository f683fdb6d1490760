"""Results on stdout, for people or as one JSON document; everything else on stderr; nothing cut off or coloured in a pipe."""

import json
import os
import pty
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from click.testing import Result
from typer.testing import CliRunner

from sb3_crc.cli import app
from sb3_crc.command import Group, No, command
from sb3_crc.console import say, tell
from sb3_crc.experiments import campaign, ladder
from sb3_crc.experiments.needs import Needs
from tests.cli.cases import CASES
from tests.cli.tree import COMMANDS
from tests.experiments.test_evidence import scores

Call = Callable[..., Result]
ANALYSES = ("latents", "tsne", "correlate", "probe", "film", "generalize")
#: What takes seconds: it simulates, learns or draws
SLOW = (*ANALYSES, "curves", "contact-sheet", "doctor")
PROGRESS = re.compile(r"^\[\d+/\d+\]|: \d+\.\d s$|^measuring|^missing:|^rollout", re.MULTILINE)


@pytest.fixture
def call(places: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Call:
    """Call a command as :data:`CASES` say."""
    needs = Needs(memory=1_000_000_000, gpu_memory=0, disk=2_000_000_000, seconds=3600.0)
    monkeypatch.setattr(campaign, "measure_needs", lambda specs, threads: ({spec.name: needs for spec in specs}, {}))
    measured = {"task": "cartpole-swingup", "r2": {"latent": {"position": 0.5, "velocity": float("nan")}}}
    monkeypatch.setattr(ladder, "probe_random_encoder", lambda *_, **__: measured)

    def invoke(name: str, *flags: str) -> Result:
        out = tmp_path / f"out_{len(list(tmp_path.iterdir()))}"
        out.mkdir()
        words = [one.format(**places, out=out) for one in CASES[name]]
        return CliRunner().invoke(app, [name, *words, *flags])

    return invoke


def document(done: Result) -> Any:
    """One JSON document and nothing beside it; NaN is not JSON."""

    def refuse(constant: str) -> None:
        raise ValueError(constant)

    assert done.exit_code == 0, (done.output, done.exception)
    return json.loads(done.stdout, parse_constant=refuse)


def test_every_command_is_called() -> None:
    assert CASES.keys() == COMMANDS.keys()


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in CASES])
def test_a_command_answers_people_and_programs(call: Call, name: str) -> None:
    found = document(call(name, "--json"))
    assert found and isinstance(found, dict)
    done = call(name)
    assert done.exit_code == 0 and done.stdout.strip(), (done.output, done.exception)
    assert not PROGRESS.search(done.stdout) and "\x1b" not in done.stdout and not set("│┃╭") & set(done.stdout)
    assert all(line == line.rstrip() for line in done.stdout.splitlines())


def test_numbers_in_the_documents(call: Call) -> None:
    (run,) = document(call("evaluate", "--json"))["runs"]
    assert (run["method"], run["task"], run["seed"], run["mean"]) == ("crc", "cartpole-swingup", 0, 801)
    watched = {one["name"]: one for one in document(call("watch", "--json"))["runs"]}
    assert watched["crc, cartpole-swingup, seed 0"]["final"] == 801
    assert watched["rad, cartpole-swingup, seed 1"]["final"] is None
    plan = document(call("compare", "--json"))
    assert plan["to_do"] == 1 and plan["in_total"]["seconds"] == 3600 and plan["runs"][0]["needs"]["disk"] == 2_000_000_000
    assert plan["runs"][0]["environment_steps"] == 100_000 and plan["runs"][0]["agent_steps"] == 12_500
    assert document(call("reproduced", "--json"))["agrees"] is True
    assert document(call("ladder", "--json"))["r2"]["latent"] == {"position": 0.5, "velocity": None}
    assert "r2.latent.position: 0.5\n" in call("ladder").stdout
    enjoyed = document(call("enjoy", "--json"))
    assert len(enjoyed["returns"]) == 1 and enjoyed["film"] is None and enjoyed["task"] == "cartpole-balance"
    assert document(call("table", "--json"))["published"]["CRC-RL"]["cartpole-swingup"]["mean"] == 813


def test_an_answer_that_is_no_is_printed_too(tmp_path: Path) -> None:
    new, old = scores(tmp_path / "new.csv", "crc", {7: 300}), scores(tmp_path / "old.csv", "crc", {0: 800, 1: 820, 2: 840})
    done = CliRunner().invoke(app, ["reproduced", str(new), str(old), "--json"])
    assert done.exit_code == 1 and json.loads(done.stdout)["agrees"] is False and "outside of it" in done.stderr


def test_what_libraries_print_is_not_in_the_document() -> None:
    @dataclass(frozen=True)
    class Found:
        path: Path
        value: float

    small = typer.Typer()

    @command(small, Group.MACHINE, "sb3-crc one")
    def one() -> object:
        """Of a test."""
        print("a library")
        tell("progress")
        say("a result [x] :smile:")
        return {"found": Found(Path("a/b"), float("inf")), "array": np.array([1.0, float("nan")]), 3: ("x",)}

    @command(small, Group.MACHINE, "sb3-crc other")
    def other() -> object:
        """Of a test."""
        return No({})

    done = CliRunner().invoke(small, ["one", "--json"])
    assert json.loads(done.stdout) == {"found": {"path": "a/b", "value": None}, "array": [1.0, None], "3": ["x"]}
    assert done.stderr.splitlines() == ["a library", "progress"]
    done = CliRunner().invoke(small, ["one"])
    assert done.stdout.splitlines() == ["a library", "a result [x] :smile:"] and done.stderr == "progress\n"
    assert CliRunner().invoke(small, ["other"]).exit_code == 1


SETTINGS = {"TERM": "xterm-256color", "COLUMNS": "30"}


def watch(places: dict[str, Path], **variables: str) -> tuple[list[str], dict[str, str]]:
    environment = {name: value for name, value in os.environ.items() if name not in ("NO_COLOR", "FORCE_COLOR")}
    return [sys.executable, "-m", "sb3_crc", "watch", str(places["runs"])], environment | SETTINGS | variables


@pytest.mark.parametrize("forced", [False, True])
def test_in_a_pipe_nothing_is_cut_off_and_colours_are_asked_for(places: dict[str, Path], forced: bool) -> None:
    command, environment = watch(places, **({"FORCE_COLOR": "1"} if forced else {}))
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=100)  # one look: it is a pipe
    assert done.returncode == 0 and ("\x1b[" in done.stdout) == forced, done.stderr
    lines = re.sub(r"\x1b\[[0-9;]*m", "", done.stdout).splitlines()
    assert lines[0].rstrip() == "1 of 2 runs ended, 100% of all decisions made" and "…" not in done.stdout
    assert any(line.split()[:4] == ["crc,", "cartpole-swingup,", "seed", "0"] and "final 801" in line for line in lines)
    assert not set("│┃━") & set(done.stdout)


@pytest.mark.parametrize("colours", [False, True])
def test_on_a_screen_there_are_lines_and_colours(places: dict[str, Path], colours: bool) -> None:
    command, environment = watch(places, **({} if colours else {"NO_COLOR": "1"}))
    main, sub = pty.openpty()
    process = subprocess.Popen([*command[:3], "rendering", "--help"], env=environment, stdout=sub, stderr=sub)
    os.close(sub)
    shown = b""
    while True:
        try:
            shown += os.read(main, 1000)
        except OSError:
            break
    os.close(main)
    assert process.wait(100) == 0 and "╭".encode() in shown
    assert bool(re.search(rb"\x1b\[[0-9;]*3[0-7]m", shown)) == colours
