"""What is installed fits together, and importing the package stays light."""

import ast
import os
import statistics
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest

import sb3_crc


def test_pip_check() -> None:
    check = subprocess.run([sys.executable, "-m", "pip", "check"], capture_output=True, text=True)
    assert check.returncode == 0, check.stdout


def test_importing_the_package_loads_no_simulator() -> None:
    code = "import sys, sb3_crc; print({'dm_control', 'shimmy', 'mujoco', 'rl_zoo3', 'av'} & set(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "set()"


def test_public_names_and_ids() -> None:
    for name in ("CRCSAC", "CRCPolicy", "PixelEncoder", "PixelDecoder", "PRESETS", "make_dmc"):
        assert hasattr(sb3_crc, name) and name in sb3_crc.__all__
    assert "dmc_pixels/cartpole-swingup-v0" in gym.registry


def test_public_names_are_imported_when_they_are_asked_for() -> None:
    """And each comes from where type checkers are told that it comes from."""
    code = "import sys, sb3_crc, gymnasium; print('torch' in sys.modules); sb3_crc.CRCSAC; print('torch' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["False", "True"]
    (told,) = [node for node in ast.parse(Path(sb3_crc.__file__).read_text()).body if isinstance(node, ast.If)]
    homes = {
        name.name: str(node.module).removeprefix("sb3_crc.")
        for node in told.body
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    }
    assert homes == {name: home for home, names in sb3_crc._HOMES.items() for name in names}
    assert set(homes) == set(sb3_crc.__all__) and set(homes) < set(dir(sb3_crc))
    assert not hasattr(sb3_crc, "CRCSACK")


def test_a_broken_dependency_is_named(tmp_path: Path) -> None:
    """SB3 sets an option of OpenCV as soon as there is a module of that name."""
    (tmp_path / "cv2.py").write_text("")
    code = "from sb3_crc import CRCSAC"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert result.stderr.splitlines()[-1] == "ImportError: cannot import 'CRCSAC': module 'cv2' has no attribute 'ocl'"


def test_importing_every_public_name_loads_nothing_optional() -> None:
    """What only an extra brings, and what a command alone needs."""
    code = "import sys; from sb3_crc import *; print(*{name.split('.')[0] for name in sys.modules})"
    loaded = set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())
    assert {"torch", "stable_baselines3"} <= loaded
    extras = {"av", "ray", "submitit", "sklearn", "plotly", "rliable", "rl_zoo3", "wandb", "onnx", "onnxruntime", "optuna"}
    from_sb3 = {"matplotlib", "pandas", "tensorboard"}  # SB3 imports those itself where they are installed
    code = "import sys, stable_baselines3; print(*{name.split('.')[0] for name in sys.modules})"
    of_sb3 = set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())
    assert loaded & (extras | from_sb3 | {"typer", "dm_control", "shimmy", "mujoco"}) <= of_sb3
    assert not loaded & extras


SECONDS = """
import resource, sys
exec(sys.argv[1])
used = resource.getrusage(resource.RUSAGE_SELF)
print(used.ru_utime + used.ru_stime)
"""


def seconds(statement: str) -> float:
    """Processor time of a process that imports something: on a busy machine that is steadier than the clock's."""
    command = [sys.executable, "-c", SECONDS, statement]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@pytest.mark.slow
@pytest.mark.alone
def test_importing_takes_little_longer_than_importing_sb3() -> None:
    statements = ("import stable_baselines3", "from sb3_crc import *", "import sb3_crc", "import time; time.sleep(0)")
    rounds = [[seconds(statement) for statement in statements] for _ in range(7)]
    sb3, names, package, nothing = (statistics.median(column) for column in zip(*rounds, strict=True))
    print(
        f"seconds of import: stable_baselines3 {sb3:.2f}, all names {names:.2f}, sb3_crc {package:.2f}, nothing {nothing:.2f}"
    )
    assert names <= 1.2 * sb3
    assert package <= 0.5 * sb3
    assert nothing < 0.5 * sb3  # the measure tells something from nothing
