"""What a shell offers, asked as a shell asks."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sb3_crc import completion
from sb3_crc.cli import app
from sb3_crc.envs.distractions.modes import DISTRACTIONS
from sb3_crc.presets import PRESETS
from sb3_crc.stock import STOCK
from tests.cli.test_help import HEAVY
from tests.cli.tree import COMMANDS


def offered(line: str) -> list[str]:
    """:param line: up to the cursor; its last word is unfinished"""
    words = line.split(" ")
    asked = {"_SB3_CRC_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
    return CliRunner().invoke(app, [], prog_name="sb3-crc", env=asked).stdout.split()


def test_commands_and_options() -> None:
    assert offered("sb3-crc ") == list(COMMANDS)
    assert offered("sb3-crc cur") == ["curves", "curve"]
    assert "--json" in offered("sb3-crc doctor --")


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("sb3-crc compare --task cartpole-sw", ["cartpole-swingup", "cartpole-swingup_sparse"]),
        ("sb3-crc compare --presets so", ["soda"]),
        ("sb3-crc compare --presets crc,sac,st", ["crc,sac,state_sac"]),
        ("sb3-crc compare --presets crc,crc", ["crc,crc_release"]),
        ("sb3-crc compare --engine ", ["local", "ray", "slurm"]),
        ("sb3-crc generalize --modes none,video", ["none,video_easy", "none,video_hard"]),
        ("sb3-crc contact-sheet --modes n", []),
        ("sb3-crc table ", ["100k", "500k"]),
        ("sb3-crc table 100k runs --format l", ["latex"]),
        ("sb3-crc ladder s", ["state", "screen", "seen"]),
        ("sb3-crc contact-sheet --tasks walker-walk,lqr", ["walker-walk,lqr-lqr_2_1", "walker-walk,lqr-lqr_6_2"]),
    ],
)
def test_values(line: str, expected: list[str]) -> None:
    assert offered(line) == expected


def test_names_are_those_of_the_library() -> None:
    assert set(completion.methods("")) == {*PRESETS, *STOCK}
    assert set(completion.distractions("")) == {*DISTRACTIONS}
    assert set(completion.modes("")) == {"none", *DISTRACTIONS}


def test_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "logs" / "crc" / "cartpole_1"
    (run / "cartpole").mkdir(parents=True)
    (run / "cartpole" / "args.yml").touch()
    (tmp_path / "lost").mkdir()
    (tmp_path / "long.csv").touch()
    (tmp_path / ".hidden" / "deep").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    assert offered("sb3-crc watch lo") == ["logs/", "long.csv", "lost/", "logs/crc/cartpole_1"]
    assert offered("sb3-crc evaluate logs/crc/") == ["logs/crc/cartpole_1/", "logs/crc/cartpole_1"]
    assert offered(f"sb3-crc evaluate {tmp_path}/logs/c") == [f"{tmp_path}/logs/crc/", f"{tmp_path}/logs/crc/cartpole_1"]
    assert offered("sb3-crc evaluate nowhere/") == []


def test_a_large_tree_is_not_walked_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[str] = []
    monkeypatch.setattr(completion.os, "listdir", lambda folder: looked.append(str(folder)) or ["deeper"])
    monkeypatch.setattr(Path, "is_dir", lambda path: True)
    completion.runs("")
    assert len(looked) <= completion.LOOKS + 1


def test_a_key_press_imports_nothing_heavy(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom sb3_crc.cli import app\ntry:\n    app([], prog_name='sb3-crc')\nexcept SystemExit:\n    pass\n"
        "print({name.partition('.')[0] for name in sys.modules}, file=sys.stderr)"
    )
    asked = {"_SB3_CRC_COMPLETE": "complete_bash", "COMP_WORDS": "sb3-crc compare --presets ", "COMP_CWORD": "3"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=os.environ | asked, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "crc_release" in done.stdout.split() and not HEAVY & eval(done.stderr)


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash")
def test_bash_completes_with_the_script_that_the_program_shows() -> None:
    script = 'eval "$(sb3-crc --show-completion)"; COMP_WORDS=(sb3-crc compare --task cartpole-b); COMP_CWORD=3; '
    script += '_sb3_crc_completion sb3-crc; printf "%s\\n" "${COMPREPLY[@]}"'
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(["bash", "-c", script], env=environment, capture_output=True, text=True)
    assert done.stdout.split() == ["cartpole-balance", "cartpole-balance_sparse"], done.stderr
