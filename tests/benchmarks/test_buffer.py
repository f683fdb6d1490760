"""The measurements of benchmarks/buffer.py, with buffers that are full in a second."""

import time
from functools import partial

import pytest

from benchmarks import buffer
from benchmarks.buffer import COMPRESSED, FRAME_BYTES, OURS, STOCK, computed, installed, measure
from benchmarks.interleave import in_fresh_process

SIZE = 2_000


def once_each(programs):
    """:return: as ``interleave``, but seconds of one call of each program's work"""
    seconds = {}
    for name, set_up in programs.items():
        work = set_up()
        start = time.perf_counter()
        work()
        seconds[name] = [time.perf_counter() - start]
    return seconds


@pytest.fixture(scope="module")
def rows():
    with pytest.MonkeyPatch.context() as patch:  # one process instead of one for each program
        patch.setattr(buffer, "interleave", lambda programs, **_: in_fresh_process(partial(once_each, programs)))
        return {row["buffer"]: row for row in measure((SIZE,), repeats=1, batch_size=8, peers=(OURS, STOCK))}


@pytest.mark.slow
def test_each_peer_has_a_row_of_positive_figures(rows):
    assert list(rows) == [OURS, STOCK]
    for row in rows.values():
        for column in (
            "resident MB",
            "/ SB3",
            "add us",
            "frame copy us",
            "growing add us",
            "growing frame copy us",
            "sample ms",
        ):
            assert row[column] > 0, column
    assert set(rows[OURS]["targets"]) == {"add - copy us", "growing add - copy us", "sample ms"}


@pytest.mark.slow
def test_a_sixth_of_the_memory_is_measured(rows):
    ours, stock = rows[OURS], rows[STOCK]
    assert ours["/ SB3"] < 0.25
    assert stock["resident MB"] == pytest.approx(computed(STOCK, SIZE) / 1e6, rel=0.1)
    assert ours["resident MB"] == pytest.approx(computed(OURS, SIZE) / 1e6, rel=0.2)


@pytest.fixture
def no_time(monkeypatch):
    monkeypatch.setattr(buffer, "interleave", lambda programs, **_: {name: [1.0] for name in programs})


@pytest.mark.usefixtures("no_time")
def test_what_memory_cannot_hold_is_computed(monkeypatch):
    monkeypatch.setattr(buffer, "available_memory", lambda: 0)
    ours, stock = measure((SIZE,), repeats=1, peers=(OURS, STOCK))
    assert stock["resident MB"] == 6 * SIZE * FRAME_BYTES / 1e6
    assert ours["/ SB3"] == pytest.approx(1 / 6, rel=0.02)
    assert "computed" in ours["note"] and "add us" not in ours


@pytest.mark.usefixtures("no_time")
def test_a_missing_package_is_noted(monkeypatch):
    monkeypatch.setattr(buffer, "find_spec", lambda package: None)
    assert not installed(COMPRESSED)
    assert measure((SIZE,), repeats=1, peers=(COMPRESSED,)) == [
        {"transitions": SIZE, "buffer": COMPRESSED, "note": "not installed"}
    ]
