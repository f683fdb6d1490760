from pathlib import Path
from typing import Any

import pytest
import torch as th

from benchmarks.end_to_end import PARTS, STOCK, TASK, Stopwatch, acting, instrumented, learn, measure, predict, rows_of
from benchmarks.networks import Networks, NoiseFrames
from benchmarks.report import publish
from sb3_crc import make_dmc

TINY = Networks("tiny", 48, 40, {"channels": [8, 8], "strides": [2, 2], "features_dim": 16}, (32, 32))


@pytest.mark.parametrize("method", ["crc", "rad", STOCK])
def test_every_part_takes_time(method: str) -> None:
    seconds = learn(method, TINY, 6, 16, "fast")
    assert set(seconds) == set(PARTS)
    assert {part for part in PARTS if seconds[part] <= 0} == ({"augment"} if method == STOCK else set())


@pytest.mark.slow
def test_shares_make_the_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = measure(networks=TINY, presets=(), decisions=4, batch_size=16, render_quality="fast")
    milliseconds, shares = rows
    assert [row["unit"] for row in rows] == ["ms per decision", "share"]
    assert all((row["networks"], row["method"]) == ("tiny", STOCK) for row in rows)
    assert sum(milliseconds[part] for part in PARTS) == pytest.approx(milliseconds["total"])
    assert sum(shares[f"{part} %"] for part in PARTS) == pytest.approx(100)
    assert all(milliseconds[part] > 0 for part in PARTS if part != "augment")
    publish("end_to_end", "Title", rows, "command", by=("networks", "unit"), folder=tmp_path)
    assert "unit share" in capsys.readouterr().out


def test_ours_is_judged_by_its_rest() -> None:
    seconds = dict.fromkeys(PARTS, 1.0)
    _, ours = rows_of(seconds, 1, {"method": "crc"}, judge=True)
    _, stock = rows_of(seconds, 1, {"method": STOCK}, judge=False)
    assert ours["targets"] == {"rest %": "<= 3 MISS"} and stock["targets"] == {}


def test_acting() -> None:
    assert len(predict("crc", TINY, 3)) == 3 and min(predict(STOCK, TINY, 3)) > 0


def test_acting_is_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.end_to_end.in_fresh_process", lambda program: [0.001, 0.002, 0.006])
    paper = Networks("paper", 48, 40, TINY.encoder, (32, 32))
    ours, stock = acting(paper)
    assert ours["ms"] == 2 and ours["targets"] == {"ms": "<= 4 PASS"} and stock["targets"] == {}


class Clock:
    """Stands still unless it is told to go on."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_nested_parts_do_not_count_twice() -> None:
    clock = Clock()
    stopwatch = Stopwatch(("rest", "forward", "backward"), clock)

    def passes(seconds: float) -> None:
        clock.now += seconds

    backward = stopwatch.timed(passes, "backward")

    def train() -> None:
        passes(2)
        backward(3)
        stopwatch.timed(backward, "backward")(4)  # a part within itself
        passes(5)

    passes(7)  # before it runs
    with stopwatch.running("rest"):
        passes(11)
        stopwatch.timed(train, "forward")()
        passes(13)
    passes(17)  # and after
    assert stopwatch.seconds == {"rest": 24, "forward": 7, "backward": 7}


def test_an_error_ends_its_part() -> None:
    clock = Clock()
    stopwatch = Stopwatch(("rest", "forward"), clock)

    def fail() -> None:
        clock.now += 1
        raise RuntimeError

    with stopwatch.running("rest"):
        with pytest.raises(RuntimeError):
            stopwatch.timed(fail, "forward")()
        clock.now += 2
    assert stopwatch.seconds == {"rest": 2, "forward": 1}


def test_functions_are_given_back() -> None:
    make_dmc(TASK, image_size=36, render_quality="fast").close()  # chooses a back end
    model = TINY.crc_sac("crc", 4)
    places: list[tuple[Any, str]] = [(model, "train"), (model, "_augment"), (th.autograd, "grad"), (th.Tensor, "backward")]
    before = [getattr(*place) for place in places]
    with instrumented(model, Stopwatch(PARTS)):
        assert all(getattr(*place) != function for place, function in zip(places, before, strict=True))
    assert [getattr(*place) for place in places] == before
    assert "train" not in vars(model)
    model.predict(NoiseFrames(48).reset()[0])
