"""glibc's allocator while a model learns: freed memory stays with the process, and is given back at the end."""

import platform
import subprocess
import sys
from types import SimpleNamespace

import pytest
from stable_baselines3 import SAC

import sb3_crc.memory
from sb3_crc.stock import STOCK
from tests.conftest import NoiseEnv, make_model

FAULTS = """
import resource, sys
import psutil, torch as th
from sb3_crc.memory import memory_kept

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        th.ones(10_000_000)  # 40 MB, 9 766 pages
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

def resident():
    return psutil.Process().memory_info().rss

faults(); before = resident()
outside = faults()
with memory_kept():
    with memory_kept():
        faults()
    within, kept = faults(), resident() - before
print(outside, within, kept, resident() - before, faults())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc has these settings")
def test_pages_are_touched_once_and_given_back() -> None:
    output = subprocess.run([sys.executable, "-c", FAULTS], check=True, capture_output=True, text=True).stdout
    outside, within, kept, afterwards, again = (int(number) for number in output.split())
    assert outside > 45_000  # 195 320, or fewer where the kernel hands out larger pages
    assert again > 9_000  # the same; at least one block, where a small one keeps glibc from returning the place too
    assert within < outside / 5  # mostly 0; a small block that splits a kept one costs the next large one new pages, once
    assert kept > 39e6
    assert afterwards < 5e6


@pytest.mark.parametrize("algorithm", ["crc", "sac", "sac_matched"])
def test_methods_that_are_compared_learn_with_the_same_allocator(algorithm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model: SAC = (
        make_model() if algorithm == "crc" else STOCK[algorithm]("CnnPolicy", NoiseEnv(), buffer_size=20, device="cpu")
    )
    now: dict[int, int] = {}
    glibc = SimpleNamespace(mallopt=now.__setitem__, malloc_trim=lambda pad: None)
    monkeypatch.setattr(sb3_crc.memory, "_glibc", lambda: glibc)
    monkeypatch.setattr(sb3_crc.memory, "_keepers", 0)  # benchmarks of the same process have theirs
    learned_with = []

    def note(local_variables: object, global_variables: object) -> bool:
        learned_with.append(dict(now))
        return True

    model.learn(3, callback=note)
    assert learned_with == [sb3_crc.memory.KEEPING] * 3
    assert now == {**sb3_crc.memory.KEEPING, **sb3_crc.memory.RETURNING}


def test_a_system_without_glibc_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sb3_crc.memory, "_glibc", lambda: None)
    keepers = sb3_crc.memory._keepers
    with sb3_crc.memory.memory_kept():
        assert sb3_crc.memory._keepers == keepers
