"""The GPU's benchmark as far as a CPU can show it: the work that it times, and what it says without a GPU."""

from functools import partial

import pytest
import torch as th
from typer.testing import CliRunner

from benchmarks.__main__ import app
from benchmarks.flops import matrix_peak
from benchmarks.gpu import FORMS, UPDATES, WAYS, memory_and_operations, ours, seconds_per_decision, stock
from benchmarks.update import count
from benchmarks.update import ours as on_cpu


@pytest.mark.parametrize("form", FORMS)
def test_all_forms_need_the_same_operations(form: str) -> None:
    _, needed = memory_and_operations(partial(ours, "rad", form, "laptop", 8, device="cpu"))
    assert needed == pytest.approx(count(partial(on_cpu, "rad", "laptop", 8, 2)) / 2, rel=1e-6)


def test_stock_is_timed_over_as_many_updates() -> None:
    model = partial(stock, "laptop", 8, channels_last=True, device="cpu")
    _, needed = memory_and_operations(model)
    assert needed > 0 and UPDATES % 2 == 0
    assert matrix_peak(64, 3, th.bfloat16) > 0


@pytest.mark.parametrize(
    "way", [pytest.param(way, marks=pytest.mark.slow if number else ()) for number, way in enumerate(WAYS)]
)
def test_a_decision_is_timed_with_its_update(way: str) -> None:
    seconds = seconds_per_decision("rad", way, "laptop", 8, 4, "cpu", "fast")
    assert 0.001 < seconds < 10


def test_without_a_gpu_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(th.cuda, "is_available", lambda: False)
    done = CliRunner().invoke(app, ["gpu"])
    assert done.exit_code == 2 and "there is no GPU that torch can use" in " ".join(done.stderr.split())
