"""What is installed fits together, and importing the package stays light."""

import subprocess
import sys

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
