"""Saving that is stopped anywhere leaves the old buffer or the new one; files that are damaged or of others are refused."""

import io
import json
import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import save_to_pkl

from sb3_crc.buffers import FrameReplayBuffer, files
from sb3_crc.buffers.files import load_buffer_file, save_buffer_file
from tests.buffers.test_replay import saved
from tests.buffers.worlds import ACTIONS, DictWorld, World, assert_equal_buffers, fill


class PowerCut(BaseException):
    """Nothing handles it, and nothing reaches the disk after it."""


@contextmanager
def power_cut_after(steps: int) -> Iterator[list[str]]:
    """:return: the steps that were made on the disk"""
    made: list[str] = []

    def cut(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def step(*args: Any, **kwargs: Any) -> Any:
            if len(made) == steps:
                if name in ("write_array", "savez"):
                    args[0].write(b"\x93NUMPY and no more")
                raise PowerCut
            made.append(name)
            return function(*args, **kwargs)

        return step

    with pytest.MonkeyPatch.context() as patch:
        for module, name in (
            *((os, name) for name in ("replace", "fsync", "unlink", "rmdir", "mkdir")),
            (np.lib.format, "write_array"),
            (np, "savez"),
        ):
            patch.setattr(module, name, cut(name, getattr(module, name)))
        yield made


@pytest.fixture(autouse=True)
def _small_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "SEGMENT", 8)


@pytest.fixture
def history() -> tuple[bytes, ReplayBuffer, bytes, ReplayBuffer]:
    """A buffer and SB3's beside it, now and later, when old frames were dropped and new ones came; buffers as pickles."""
    world = World()
    buffer, twin = world.buffer(12), world.twin(12)
    fill(world.episodes(20), buffer, twin)
    before = pickle.dumps(buffer), pickle.loads(pickle.dumps(twin))
    fill(world.episodes(9), buffer, twin)
    return *before, pickle.dumps(buffer), twin


@pytest.mark.parametrize("there", ["nothing", "a folder", "a pickle"])
def test_a_power_cut_anywhere(there: str, history: tuple[bytes, ReplayBuffer, bytes, ReplayBuffer], tmp_path: Path) -> None:
    old, old_twin, new, new_twin = history
    path, outcomes, steps = tmp_path / "buffer", set(), 0
    while True:
        shutil.rmtree(tmp_path)
        tmp_path.mkdir()
        buffer, after = pickle.loads(old), pickle.loads(new)
        if there == "a folder":
            save_buffer_file(buffer, path)
            after.segments = buffer.segments
        elif there == "a pickle":
            save_to_pkl(path, old_twin)
        with power_cut_after(steps) as made:
            try:
                save_buffer_file(after, path)
            except PowerCut:
                finished = False
            else:
                finished = True

        loaded = pickle.loads(old)
        loaded.reset()
        try:
            load_buffer_file(loaded, path)
        except FileNotFoundError:
            outcome = "nothing"
        else:
            outcome = "old" if loaded.rewards.tolist() == old_twin.rewards.tolist() else "new"
            assert_equal_buffers(loaded, old_twin if outcome == "old" else new_twin)
        outcomes.add(outcome)
        if finished:
            break

        # The next save, of this process or of another, clears up
        another = pickle.loads(new)
        save_buffer_file(after if steps % 2 else another, path)
        load_buffer_file(loaded, path)
        assert_equal_buffers(loaded, new_twin)
        assert [file.name for file in tmp_path.iterdir()] == ["buffer.pkl"]
        named = {segment.name for segment in loaded.segments}
        assert {file.name for file in path.with_suffix(".pkl").iterdir()} == {"index.npz", *named}
        steps += 1
    assert outcomes == {"nothing" if there == "nothing" else "old", "new"}
    assert {"write_array", "savez", "replace", "fsync"} <= set(made) and steps > 8


def test_a_full_disk_leaves_the_old_buffer(
    history: tuple[bytes, ReplayBuffer, bytes, ReplayBuffer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here Python goes on, and clears up what it began."""
    old, old_twin, new, new_twin = history
    buffer = pickle.loads(old)
    save_buffer_file(buffer, tmp_path / "buffer")
    before = {file.name for file in (tmp_path / "buffer.pkl").iterdir()}
    after = pickle.loads(new)
    after.segments = buffer.segments

    def full(*args: Any, **kwargs: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", full)
        with pytest.raises(OSError, match="No space"):
            save_buffer_file(after, tmp_path / "buffer")
    load_buffer_file(buffer, tmp_path / "buffer")
    assert_equal_buffers(buffer, old_twin)
    assert before <= {file.name for file in (tmp_path / "buffer.pkl").iterdir()}
    save_buffer_file(after, tmp_path / "buffer")
    load_buffer_file(buffer, tmp_path / "buffer")
    assert_equal_buffers(buffer, new_twin)


# -- Damage ------------------------------------------------------------------------------------------------------------


class Saved:
    """A buffer in a folder, and one that is to stay as it is when the other cannot be loaded."""

    def __init__(self, folder: Path, world: World | None = None):
        self.world = world or World(2)
        buffer = self.world.buffer(12)
        fill(self.world.episodes(20), buffer)
        self.folder = folder / "buffer.pkl"
        save_buffer_file(buffer, self.folder)
        self.own = self.world.buffer(5)
        fill(self.world.episodes(3), self.own)

    def segment(self) -> Path:
        return sorted(self.folder.glob("frames-*"))[1]

    def edit(self, arrays: dict[str, np.ndarray] | None = None, drop: str = "", **header: Any) -> None:
        with np.load(self.folder / "index.npz") as index:
            contents = {key: index[key] for key in index.files}
        contents["header"] = np.array(json.dumps(json.loads(str(contents["header"])) | header))
        contents |= arrays or {}
        contents.pop(drop, None)
        np.savez(self.folder / "index.npz", **contents)

    def refused(self, message: str, buffer: FrameReplayBuffer | None = None, source: Any = None) -> None:
        buffer = buffer or self.own
        before = saved(buffer), buffer.buffer_size, buffer.segments
        with pytest.raises(ValueError, match=message):
            load_buffer_file(buffer, source or self.folder)
        assert (saved(buffer), buffer.buffer_size, buffer.segments) == before


DAMAGES: dict[str, tuple[Callable[[Saved], Any], str]] = {
    "segment missing": (lambda s: s.segment().unlink(), "buffer.pkl cannot be loaded: .*frames-"),
    "segment cut": (lambda s: os.truncate(s.segment(), s.segment().stat().st_size - 1), "buffer.pkl cannot be loaded"),
    "segment empty": (lambda s: os.truncate(s.segment(), 0), "buffer.pkl cannot be loaded"),
    "segment of fewer frames": (lambda s: np.save(s.segment(), np.zeros((3, 1, 2, 3), np.uint8)), r"frames-.*\(3, 1, 2, 3\)"),
    "segment of other frames": (
        lambda s: np.save(s.segment(), np.zeros((8, 1, 1, 3), np.uint8)),
        r"of \(8, 1, 2, 3\)",
    ),
    "segment of objects": (lambda s: np.save(s.segment(), np.array([{}] * 8), allow_pickle=True), "allow_pickle"),
    "index empty": (lambda s: os.truncate(s.folder / "index.npz", 0), "buffer.pkl cannot be loaded"),
    "index not one": (lambda s: (s.folder / "index.npz").write_text("hello"), "buffer.pkl cannot be loaded"),
    "index an array": (lambda s: np.save((s.folder / "index.npz").open("wb"), np.zeros(3)), "buffer.pkl cannot be loaded"),
    "newer format": (lambda s: s.edit(format=files.FORMAT + 1), r"format is 2, .* reads up to 1"),
    "no header": (lambda s: s.edit(drop="header"), "header"),
    "header no JSON": (lambda s: s.edit({"header": np.array("{")}), "buffer.pkl cannot be loaded"),
    "header a list": (lambda s: s.edit({"header": np.array("[]")}), "buffer.pkl cannot be loaded"),
    "array missing": (lambda s: s.edit(drop="actions"), "actions"),
    "array short": (lambda s: s.edit({"rewards": np.zeros((1, 2), np.float32)}), r"rewards is float32 \(1, 2\) there"),
    "array of another type": (lambda s: s.edit({"dones": np.zeros((12, 2))}), "dones is float64 .* float32"),
    "frames missing at the end": (lambda s: s.edit(segments=[]), "frames up to .* instead of"),
}


@pytest.mark.parametrize("what", DAMAGES)
def test_damaged_files_are_refused(what: str, tmp_path: Path) -> None:
    damage, message = DAMAGES[what]
    files_there = Saved(tmp_path)
    damage(files_there)
    files_there.refused(message)


def test_wherever_an_index_is_damaged_it_is_refused_or_harmless(tmp_path: Path) -> None:
    """Cut off at any place, or with a byte changed."""
    there = Saved(tmp_path)
    index, buffer = there.folder / "index.npz", there.world.buffer(3)
    load_buffer_file(buffer, there.folder)
    good, whole = index.read_bytes(), saved(buffer)
    rng = np.random.default_rng(0)
    damaged = [good[: rng.integers(len(good))] for _ in range(30)]
    # Names, sizes and offsets lie behind each other at the end
    for place in [*rng.integers(len(good), size=30), *(len(good) - rng.integers(900, size=70))]:
        changed = bytearray(good)
        changed[place] ^= 1 << rng.integers(8)
        damaged.append(bytes(changed))
    refused = 0
    for contents in damaged:
        index.write_bytes(contents)
        try:
            load_buffer_file(buffer, there.folder)
        except ValueError as error:
            refused += "buffer.pkl cannot be loaded" in str(error)
        assert saved(buffer) == whole
    assert refused > 60


def test_wherever_a_stream_is_damaged_it_is_refused_or_harmless(tmp_path: Path) -> None:
    there = Saved(tmp_path)
    buffer = there.world.buffer(3)
    load_buffer_file(buffer, there.folder)
    save_buffer_file(buffer, stream := io.BytesIO())
    good, whole = stream.getvalue(), saved(buffer)
    rng = np.random.default_rng(0)
    for place in rng.integers(len(good), size=60):
        changed = bytearray(good)
        changed[place] ^= 1 << rng.integers(8)
        for contents in (bytes(changed), good[:place]):
            with suppress(ValueError):
                load_buffer_file(buffer, io.BytesIO(contents))
            assert saved(buffer) == whole


# -- Buffers of others -------------------------------------------------------------------------------------------------


def other(world: World, **changes: Any) -> FrameReplayBuffer:
    arguments: dict[str, Any] = {"observation_space": world.space, "action_space": ACTIONS, "n_envs": 2, "frame_channels": 1}
    return FrameReplayBuffer(24, device="cpu", **{**arguments, **changes})


OTHERS: dict[str, tuple[dict[str, Any], str]] = {
    "larger images": (
        {"observation_space": spaces.Box(0, 255, (3, 2, 4), np.uint8)},
        r"observations is \[3, 2, 3\] there",
    ),
    "longer stacks": (
        {"observation_space": spaces.Box(0, 255, (4, 2, 3), np.uint8)},
        r"observations is \[3, 2, 3\] there",
    ),
    "floats": ({"observation_space": spaces.Box(0, 255, (3, 2, 3), np.float32)}, r"dtype is \|u1 there and <f4 here"),
    "more action": ({"action_space": spaces.Box(-1, 1, (3,))}, "action_dim is 2 there and 3 here"),
    "other actions": ({"action_space": spaces.MultiDiscrete([3, 3])}, "actions is float32 .* int64"),
    "more environments": ({"n_envs": 3}, "n_envs is 2 there and 3 here"),
}


@pytest.mark.parametrize("what", OTHERS)
def test_what_does_not_fit_is_refused(what: str, tmp_path: Path) -> None:
    changes, message = OTHERS[what]
    there = Saved(tmp_path)
    there.refused(message, other(there.world, **changes))


def test_other_vectors_are_refused(tmp_path: Path) -> None:
    there = Saved(tmp_path, DictWorld(2))
    for state, message in ((spaces.Box(-1, 1, (4,)), "vectors is .*'state': \\[3\\].* there"), (None, "vectors is")):
        world = DictWorld(2)
        entries = {**world.dict_space.spaces, "state": state}
        world.dict_space = spaces.Dict({key: space for key, space in entries.items() if space is not None})
        there.refused(message, world.buffer(5))
    world = DictWorld(2)
    world.dict_space = spaces.Dict({**world.dict_space.spaces, "height": spaces.Box(-1, 1, (1,), np.float32)})
    there.refused("vectors/height is float64 .* float32", world.buffer(5))


@pytest.mark.parametrize("stream", [False, True])
def test_pickles_that_do_not_fit_are_refused(stream: bool, tmp_path: Path) -> None:
    there = Saved(tmp_path)
    world, size = there.world, (24, there.world.space, ACTIONS, "cpu")
    optimized = ReplayBuffer(*size, 2, optimize_memory_usage=True, handle_timeout_termination=False)
    unstacked = World(2, k=1, c=3).twin(12)
    fill([t._replace() for t in World(2, k=1, c=3).episodes(4)], unstacked)
    pickles: list[tuple[Any, str]] = [
        (ReplayBuffer(*size, 1), "n_envs is 1 there and 2 here"),
        (ReplayBuffer(24, spaces.Box(0, 255, (4, 2, 3), np.uint8), ACTIONS, "cpu", 2), "observation_space is"),
        (ReplayBuffer(24, world.space, spaces.Box(-2, 2, (2,)), "cpu", 2), "action_space is"),
        (other(world, n_envs=1), "n_envs is 1 there and 2 here"),
        (optimized, "it is a ReplayBuffer, not a replay buffer with both"),
        (unstacked, "transition 0 of environment 0: .*frame_channels"),
        ({"not": "a buffer"}, "it is a dict"),
        (None, "it is a NoneType"),
    ]
    for content, message in pickles:
        path = tmp_path / "other.pkl"
        save_to_pkl(path, content)
        there.refused(message, source=io.BytesIO(path.read_bytes()) if stream else path)


def test_wherever_a_pickle_is_cut_or_changed_it_is_refused_or_harmless(tmp_path: Path) -> None:
    world = World(2)
    twin = world.twin(3)
    fill(world.episodes(5), twin)
    good = pickle.dumps(twin, protocol=5)
    buffer, path = world.buffer(3), tmp_path / "buffer.pkl"
    for end in range(0, len(good) - 1, 23):
        path.write_bytes(good[:end])
        with pytest.raises(ValueError, match=r"buffer\.pkl cannot be loaded"):
            load_buffer_file(buffer, path)
    for nonsense in (b"hello", b"\x00" * 50, b"PK\x03\x04", b"(lp0\nS'", bytes(range(256))):
        path.write_bytes(nonsense)
        with pytest.raises(ValueError, match=r"buffer\.pkl cannot be loaded"):
            load_buffer_file(buffer, path)
    assert buffer.size() == 0
