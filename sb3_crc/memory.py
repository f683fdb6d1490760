"""How much memory is free, and who keeps it."""

import ctypes
import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import psutil
import torch as th

GIGABYTE = 1e9  # decimal, as in the papers' and SB3's figures

# mallopt(3)
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD, M_MMAP_MAX = -1, -2, -3, -4
MEBIBYTE = 1 << 20
KEEPING = {M_TRIM_THRESHOLD: -1, M_TOP_PAD: 64 * MEBIBYTE, M_MMAP_MAX: 0}
#: glibc's defaults, at the thresholds that it comes to by itself where large blocks are freed
RETURNING = {M_TRIM_THRESHOLD: 64 * MEBIBYTE, M_TOP_PAD: MEBIBYTE // 8, M_MMAP_THRESHOLD: 32 * MEBIBYTE, M_MMAP_MAX: 65_536}
_keepers = 0


@contextmanager
def memory_kept() -> Iterator[None]:
    """
    Within it freed memory stays with the process for the next allocation, where glibc would give large blocks back to the
    kernel, which clears every page anew: up to a third of an update on a CPU. At the end it is given back and glibc's defaults
    are set again. Without glibc (macOS, musl) it does nothing.
    """
    global _keepers
    libc = _glibc()
    if libc is None:
        yield
        return
    if _keepers == 0:
        for option, value in KEEPING.items():
            libc.mallopt(option, value)
    _keepers += 1
    try:
        yield
    finally:
        _keepers -= 1
        if _keepers == 0:
            for option, value in RETURNING.items():
                libc.mallopt(option, value)
            libc.malloc_trim(0)


@lru_cache(maxsize=1)
def _glibc() -> ctypes.CDLL | None:
    try:
        libc = ctypes.CDLL(None)
        libc.gnu_get_libc_version  # noqa: B018
    except (AttributeError, OSError, TypeError):
        return None
    return libc


def is_out_of_memory(error: BaseException) -> bool:
    """:return: whether torch or Python could not allocate something"""
    words = ("not enough memory", "can't allocate memory", "out of memory", "could not create a primitive", "Cannot allocate")
    return isinstance(error, MemoryError | th.OutOfMemoryError) or (
        isinstance(error, RuntimeError) and any(word in str(error) for word in words)
    )


@contextmanager
def named_shortage() -> Iterator[list[str]]:
    """
    Catch the error that comes where memory is short.

    :return: a list that is empty, and afterwards holds what the error said
    """
    said: list[str] = []
    try:
        yield said
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        said.append(f"{type(error).__name__}: {str(error).partition(chr(10))[0]}")


def largest_that_fits(attempt: Callable[[int], object], size: int) -> int:
    """
    :param attempt: does something with a batch of a size, and raises if memory is short
    :param size: that does not fit
    :return: the first of its halves, quarters and so on that does; 0: none
    """
    while (size := size // 2) > 0:
        gc.collect()
        if th.cuda.is_available():
            th.cuda.empty_cache()
        with named_shortage() as shortage:
            attempt(size)
        if not shortage:
            return size
    return 0


def free_memory(device: th.device) -> int:
    """:return: bytes that can still be allocated on ``device``"""
    if device.type == "cuda":
        return int(th.cuda.mem_get_info(device)[0])
    return available_memory()


def available_memory(control_groups: Path = Path("/sys/fs/cgroup")) -> int:
    """
    :param control_groups: where the kernel shows the process's control group (version 2, or version 1 under ``memory/``)
    :return: bytes this process can still allocate: the machine's free memory, or what a container's limit leaves if that is
        less
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
