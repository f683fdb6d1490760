"""The measurements of benchmarks/checkpoints.py, with tiny networks on a real task."""

import pytest

from benchmarks.checkpoints import collect, measure
from benchmarks.networks import Networks

TINY = Networks("tiny", 40, 24, {"channels": [4, 4], "strides": [2, 2], "features_dim": 8}, (16, 16))


@pytest.mark.parametrize(("buffer_size", "kept"), [(400, 1.0), (100, 2.0)])
def test_segments_hold_each_frame_once_and_those_that_the_checkpoint_before_needs(buffer_size: int, kept: float) -> None:
    costs = collect(TINY, 400, buffer_size, every=100)
    assert len(costs.stalls) == len(costs.writing) == 4 and min(costs.stalls + costs.writing) > 0
    assert costs.frames == pytest.approx(buffer_size * 3 * 40 * 40, rel=0.1)
    assert costs.segments / costs.frames == pytest.approx(kept, abs=0.15)
    assert costs.state > 10_000


@pytest.mark.slow
def test_a_row_is_judged() -> None:
    row = measure(networks=TINY, decisions=300, every=100)
    assert (row["networks"], row["decisions"], row["buffer"]) == ("tiny", 300, 300)
    assert row["disk / frames"] > row["segments / frames"] >= 1
    assert set(row["targets"]) == {"longest stall ms", "longest writing s", "disk / frames"}
