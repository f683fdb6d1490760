"""What is installed fits together, and importing the package stays light."""

import ast
import subprocess
import sys
from pathlib import Path

import gymnasium as gym

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
