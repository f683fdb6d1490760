"""What a buffer takes of memory, and what the user is told before there is none left."""

import json
import re
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import torch as th
from gymnasium import spaces

from sb3_crc import CRCSAC
from sb3_crc.buffers import FrameReplayBuffer, placement
from tests.buffers.test_training import SETTINGS, StackEnv
from tests.buffers.worlds import ACTIONS, World, fill

SPACE = spaces.Box(0, 255, (9, 100, 100), np.uint8)
MEGABYTE = 10**6


def taken() -> np.ndarray:
    """Bytes of memory and of addresses."""
    memory = psutil.Process().memory_info()
    return np.array([memory.rss, memory.vms])


def test_an_empty_buffer_takes_no_memory_and_asks_for_none() -> None:
    before = taken()
    buffer = FrameReplayBuffer(100_000, SPACE, ACTIONS, "cpu", frame_channels=3)
    buffer.warn_if_too_large()
    assert (taken() - before < 50 * MEGABYTE).all()
    assert buffer.store.taken_bytes == 0 and 3e9 < buffer.full_bytes < 3.1e9


def test_neither_does_that_of_a_model_that_is_built_or_loaded(tmp_path: Path) -> None:
    model = CRCSAC("CnnPolicy", StackEnv(), **{**SETTINGS, "buffer_size": 100_000})
    model.save(tmp_path / "model")
    before = taken()
    loaded = CRCSAC.load(tmp_path / "model")
    assert (taken() - before < 50 * MEGABYTE).all()
    assert loaded.replay_buffer.buffer_size == 100_000 and loaded.replay_buffer.store.taken_bytes == 0


FILL = """
import json, resource, time
import numpy as np, psutil
from gymnasium import spaces
from sb3_crc import CRCSAC
from sb3_crc.buffers import FrameReplayBuffer
from tests.buffers.test_training import SETTINGS, StackEnv

def rss():
    return psutil.Process().memory_info().rss

def growth(make):
    before = rss()
    made = make()
    return made, rss() - before

def model(size):
    return growth(lambda: CRCSAC("CnnPolicy", StackEnv(size=100), **{**SETTINGS, "buffer_size": size}))

model(1)
result = {"model": model(100_000)[1] - model(1)[1]}
box, actions = spaces.Box(0, 255, (9, 100, 100), np.uint8), spaces.Box(-1, 1, (6,), np.float32)
pool = np.random.default_rng(0).integers(0, 256, (500, 3, 100, 100), np.uint8)
before = rss()
buffer = FrameReplayBuffer(100_000, box, actions, "cpu", frame_channels=3)
result["empty"] = rss() - before
seconds = 0.0
for t in range(104_000):  # beyond the end of the ring
    if t % 125 == 0:
        stack = np.concatenate([pool[t % 500]] * 3)[None]
    next_stack = np.concatenate([stack[0, 3:], pool[(t + 1) % 500]])[None]
    done = np.array([t % 125 == 124])
    start = time.perf_counter()
    buffer.add(stack, next_stack, np.zeros((1, 6), np.float32), np.zeros(1), done, [{"TimeLimit.truncated": bool(done[0])}])
    seconds += time.perf_counter() - start
    stack = next_stack
result["full"] = rss() - before
result["peak"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
result["milliseconds per add"] = seconds / 104
result["rows"] = buffer.size()
print(json.dumps(result))
"""


@pytest.mark.slow
@pytest.mark.alone
def test_100_000_transitions_of_three_frames_fit_in_3_2_gb(capsys: pytest.CaptureFixture[str]) -> None:
    """SB3's buffer takes 18.0. In a process of its own, whose memory nothing else has touched."""
    assert psutil.virtual_memory().available > 5e9, "this test needs 5 GB of free memory"
    run = subprocess.run([sys.executable, "-c", FILL], capture_output=True, text=True, check=True)
    result = json.loads(run.stdout)
    with capsys.disabled():
        print(f"\n{result}")
    assert result["rows"] == 100_000
    assert result["model"] < 50 * MEGABYTE and result["empty"] < 50 * MEGABYTE
    assert 3.0e9 < result["full"] <= 3.2e9 and result["peak"] <= 3.2e9


# -- The warning -------------------------------------------------------------------------------------------------------


def free(monkeypatch: pytest.MonkeyPatch, gigabytes: float) -> None:
    monkeypatch.setattr(placement, "free_memory", lambda device: int(gigabytes * 1e9))


def test_the_warning_names_what_is_needed_what_is_free_and_what_would_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    free(monkeypatch, 2)
    buffer = FrameReplayBuffer(100_000, SPACE, ACTIONS, "cpu", n_envs=4, frame_channels=3)
    with pytest.warns(UserWarning, match=r"needs 3\.05 GB .* 100000 transitions .* only 2\.00 GB are free on cpu") as caught:
        buffer.warn_if_too_large()
    found = re.search(r"buffer_size=(\d+) would fit", str(caught[0].message))
    assert found is not None
    size = int(found[1])
    assert 55_000 < size < 65_000
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        FrameReplayBuffer(size, SPACE, ACTIONS, "cpu", n_envs=4, frame_channels=3).warn_if_too_large()


def test_it_comes_once_and_only_if_needed(monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder) -> None:
    world = World()
    size = world.buffer(1000).full_bytes / 1e9
    for gigabytes, warned in ((size * 1.001, 0), (size * 0.999, 1)):
        free(monkeypatch, gigabytes)
        buffer = world.buffer(1000)
        assert len(recwarn) == 0
        fill(world.episodes(5), buffer)
        buffer.warn_if_too_large()
        assert len(recwarn) == warned


def test_what_is_taken_already_need_not_be_free(monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder) -> None:
    """Of a loaded buffer that is half full, only the other half is still to come."""
    world = World()
    free(monkeypatch, 1)
    buffer = world.buffer(1000)
    fill(world.episodes(700), buffer)
    free(monkeypatch, (buffer.full_bytes - len(buffer.store) * buffer.store.frame_bytes) * 1.01 / 1e9)
    buffer._warned = False
    buffer.warn_if_too_large()
    assert len(recwarn) == 0
    buffer._warned = False
    free(monkeypatch, 0)
    with pytest.warns(UserWarning, match="GB are free"):
        buffer.warn_if_too_large()


def test_the_gpu_is_asked_where_the_frames_lie_there(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[th.device] = []
    monkeypatch.setattr(placement, "free_memory", lambda device: asked.append(device) or 10**12)
    monkeypatch.setattr(th.cuda, "is_available", lambda: True)
    FrameReplayBuffer(10, SPACE, ACTIONS, "cuda", frame_channels=3).warn_if_too_large()
    assert [device.type for device in asked] == ["cuda"]


class Untouched(StackEnv):
    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        raise RuntimeError("the environment was used")


def test_learn_warns_before_the_environment_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    model = CRCSAC("CnnPolicy", Untouched(), **SETTINGS)
    free(monkeypatch, 1e-6)
    with pytest.raises(RuntimeError, match="was used"), pytest.warns(UserWarning, match="would fit"):
        model.learn(14)


def test_learn_warns_once(monkeypatch: pytest.MonkeyPatch) -> None:
    model = CRCSAC("CnnPolicy", StackEnv(), **SETTINGS)
    free(monkeypatch, 1e-6)
    with pytest.warns(UserWarning, match="would fit") as caught:
        model.learn(5)
    model.learn(5)
    assert len(caught) == 1
