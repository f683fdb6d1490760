"""The measurements of benchmarks/scaling.py, with tiny networks."""

import pytest

from benchmarks.networks import Networks
from benchmarks.scaling import measure

TINY = Networks("tiny", 40, 24, {"channels": [4, 4], "strides": [2, 2], "features_dim": 8}, (16, 16))


@pytest.mark.slow
def test_batches_and_inputs_have_their_rows_and_are_compared_with_the_reference():
    rows = measure(repeats=1, networks=TINY, batch_sizes=(128, 256), input_sizes=(24, 36))
    batches, inputs = ([row for row in rows if row["varied"] == varied] for varied in ("batch", "input"))

    assert [(row["input"], row["batch"]) for row in batches] == [(24, 128), (24, 256)]
    assert [(row["input"], row["batch"]) for row in inputs] == [(24, 128), (36, 128)]
    assert batches[0]["/ batch 128"] == inputs[0]["/ input 24"] == 1
    assert batches[1]["ms per sample"] == pytest.approx(batches[1]["ms"] / 256)
    assert inputs[1]["needed GFLOP"] > inputs[0]["needed GFLOP"] > 0
    assert not batches[0]["targets"] and batches[1]["targets"] and inputs[1]["targets"]
