"""Wheel and sdist: the same bytes wherever they are built, what belongs in them, and a wheel that is enough to work with."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import time
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = (
    "sb3_crc",
    "zoo_configs",
    "pyproject.toml",
    "README.md",
    "LICENSE",
    "CHANGELOG.md",
    "CITATION.cff",
    "constraints.txt",
    ".gitignore",
)
#: What README's first example is run with here: (its own text, a smaller budget)
BUDGET = (
    ("env, seed=0)", "env, seed=0, learning_starts=10, batch_size=8, buffer_size=100)"),
    ("learn(12_500,", "learn(14,"),
    ("n_eval_episodes=10", "n_eval_episodes=1"),
)


def checkout(path: Path, mask: int, moment: float) -> Path:
    """A copy of what is packed, as another person's checkout would have it: other permissions, other times."""
    path.mkdir()
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, path / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, path / name)
    for one in path.rglob("*"):
        one.chmod((0o777 if one.is_dir() else 0o666) & ~mask)
        os.utime(one, (moment, moment))
    return path


def build(source: Path, target: Path) -> tuple[Path, Path]:
    """
    :return: sdist, and the wheel that is built from it
    """
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(target), str(source)]  # as `make dist`
    outcome = subprocess.run(command, capture_output=True, text=True, check=False)
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr
    sdist, wheel = target.glob("*.tar.gz"), target.glob("*.whl")
    return next(sdist), next(wheel)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    path = tmp_path_factory.mktemp("distribution")
    return build(checkout(path / "checkout", 0o022, 1.6e9), path / "dist")


def test_two_builds_are_the_same_bytes(built: tuple[Path, Path], tmp_path: Path) -> None:
    again = build(checkout(tmp_path / "elsewhere", 0o077, time.time()), tmp_path / "dist")
    for first, second in zip(built, again, strict=True):
        assert first.name == second.name
        assert first.read_bytes() == second.read_bytes(), first.name


def test_the_wheel_holds_the_package_with_its_data_and_nothing_else(built: tuple[Path, Path]) -> None:
    files = {
        top: {
            path.relative_to(ROOT).as_posix() for path in (ROOT / top).rglob("*") if path.is_file() and path.suffix != ".pyc"
        }
        for top in ("sb3_crc", "zoo_configs")
    }
    package = files["sb3_crc"] | {f"sb3_crc/{name}" for name in files["zoo_configs"]}
    with zipfile.ZipFile(built[1]) as wheel:
        names = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert names == package
    assert {"sb3_crc/py.typed", "sb3_crc/experiments/published.csv", "sb3_crc/experiments/report/page.js"} <= names


def test_the_wheel_brings_its_configurations(built: tuple[Path, Path], tmp_path: Path) -> None:
    with zipfile.ZipFile(built[1]) as wheel:
        wheel.extractall(tmp_path / "site")
    read = "from pathlib import Path; from sb3_crc.configurations import CONFIGS, read_settings; print(CONFIGS); "
    read += "print(read_settings(Path('zoo_configs/laptop.yml'), 'crc', 'dmc_pixels/cartpole-swingup-v0')['batch_size'])"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}
    command = [sys.executable, "-c", read]
    outcome = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert outcome.stdout.splitlines() == [str(tmp_path / "site/sb3_crc/zoo_configs"), "128"], outcome.stderr


def test_the_sdist_is_small_and_holds_no_results(built: tuple[Path, Path]) -> None:
    with tarfile.open(built[0]) as sdist:
        tops = {name.split("/")[1] for name in sdist.getnames()}
    assert tops == {*SOURCES, "PKG-INFO"}
    assert built[0].stat().st_size < 1_000_000


def readme_example() -> str:
    """The first block of Python in README, with a budget that suits a test."""
    example = (ROOT / "README.md").read_text().split("```python\n", 1)[1].split("```", 1)[0]
    for own, smaller in BUDGET:
        assert example.count(own) == 1, f"README's example has no {own!r} any more"
        example = example.replace(own, smaller)
    return example


def run_example(python: Path, folder: Path) -> None:
    """README's example outside of the checkout, where only what was installed can be imported."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "COV"))}
    command = [str(python), "-c", readme_example()]
    example = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert example.returncode == 0, example.stderr
    reward, spread = map(float, re.findall(r"\d+\.\d+", example.stdout.splitlines()[-1]))
    assert 0 <= reward <= 1000
    assert spread == 0  # of one episode
    assert (folder / "crc-cartpole.zip").stat().st_size > 1_000_000


@pytest.mark.slow
def test_readmes_example_runs_with_the_wheel_in_an_empty_environment(built: tuple[Path, Path], tmp_path: Path) -> None:
    """The user's way: `pip install sb3_crc.whl` and nothing else."""
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "venv")], check=True)
    python = tmp_path / "venv/bin/python"
    options = ["--quiet", "--no-compile", "--disable-pip-version-check", "--retries", "1", "-c", str(ROOT / "constraints.txt")]
    installation = subprocess.run(
        [str(python), "-m", "pip", "install", *options, str(built[1])], capture_output=True, text=True, check=False
    )
    if "No matching distribution" in installation.stderr and "NewConnectionError" in installation.stderr:
        pytest.skip("pip reaches no package index")
    assert installation.returncode == 0, installation.stderr
    assert subprocess.run([str(python), "-m", "pip", "check"], check=False).returncode == 0
    run_example(python, tmp_path)
    commands = subprocess.run([str(tmp_path / "venv/bin/sb3-crc"), "--help"], capture_output=True, text=True, check=False)
    assert commands.returncode == 0, commands.stderr
