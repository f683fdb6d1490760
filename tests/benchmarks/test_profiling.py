"""The profile of an update: all of its time, each part once."""

import pytest
import torch as th

from benchmarks.profiling import REST, table


def test_the_longest_operator_comes_first_and_nothing_is_lost() -> None:
    def program():
        large, small = th.randn(400, 400), th.randn(4)
        return lambda: [large @ large, large @ large, small.exp()]

    rows = table(program, repeats=3, operators=2)
    assert rows[0]["operator"] == "aten::mm" and rows[0]["calls"] == 1  # two of each pair of updates
    assert [row["operator"] for row in rows][-1] == REST and len(rows) == 3
    assert sum(row["%"] for row in rows) == pytest.approx(100)
    assert rows[0]["ms"] > 0
