"""When, on what and from which source something was measured."""

import os
import platform
import subprocess
from datetime import datetime, timezone
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import psutil
import torch as th

import sb3_crc

#: Whose versions decide what comes out
PACKAGES = ("torch", "numpy", "stable-baselines3", "gymnasium", "dm-control", "mujoco", "shimmy")


def provenance() -> dict[str, Any]:
    """:return: time (UTC), machine, versions, and the source's revision (None where it has no repository)"""
    return {
        "time": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "machine": {
            "processor": _processor(),
            "cores": os.cpu_count(),
            "threads": th.get_num_threads(),
            "gpu": th.cuda.get_device_name() if th.cuda.is_available() else None,
            "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
            "system": platform.platform(),
        },
        "versions": {"python": platform.python_version(), "sb3_crc": sb3_crc.__version__}
        | {package: version(package) for package in PACKAGES},
        "git_revision": git_revision(),
    }


@lru_cache
def git_revision() -> str | None:
    """:return: the commit of the source that runs, with "-dirty" if files have changed since"""
    package = Path(__file__).resolve().parents[1]
    try:
        # an installed package may lie in somebody else's repository: it counts only where it is part of it
        for command in (["ls-files", "--error-unmatch", "__init__.py"], ["describe", "--always", "--dirty", "--abbrev=12"]):
            done = subprocess.run(["git", "-C", package, *command], capture_output=True, text=True, check=True, timeout=30)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.processor())
