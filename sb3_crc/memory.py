"""How much memory is free."""

from pathlib import Path

import psutil
import torch as th

GIGABYTE = 1e9  # decimal, as in the papers' and SB3's figures


def free_memory(device: th.device) -> int:
    """:return: bytes that can still be allocated on ``device``"""
    if device.type == "cuda":
        return int(th.cuda.mem_get_info(device)[0])
    return available_memory()


def available_memory(control_groups: Path = Path("/sys/fs/cgroup")) -> int:
    """Bytes this process can still allocate: the machine's free memory, or what a container's limit leaves if that is less.

    :param control_groups: where the kernel shows the process's control group (version 2, or version 1 under ``memory/``)
    """
    available = psutil.virtual_memory().available
    for limit, usage, cache in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "total_inactive_file"),
    ):
        try:
            allowed = int((control_groups / limit).read_text(encoding="ascii"))
            used = int((control_groups / usage).read_text(encoding="ascii"))
        except (OSError, ValueError):  # no such group, or the limit reads "max"
            continue
        # The page cache counts as used but is given back under pressure.
        reclaimable = _read_statistic((control_groups / limit).parent / "memory.stat", cache)
        available = min(available, max(0, allowed - used + reclaimable))
    return available


def _read_statistic(path: Path, name: str) -> int:
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith(f"{name} ")), 0)
