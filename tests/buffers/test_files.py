"""A buffer on disk: what is written, where it is found again, and that SB3's pickles are read."""

import io
import pickle
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import save_to_pkl

from sb3_crc.buffers import FrameReplayBuffer, files
from sb3_crc.buffers.files import load_buffer_file, save_buffer_file
from tests.buffers.worlds import DictWorld, World, assert_equal_buffers, files_of, fill


@pytest.fixture(autouse=True)
def _small_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "SEGMENT", 8)


def filled(world: World, rows: int, steps: int, n_steps: int = 1) -> tuple[FrameReplayBuffer, ReplayBuffer]:
    buffer, twin = world.buffer(rows, n_steps=n_steps), world.twin(rows, n_steps)
    fill(world.episodes(steps), buffer, twin)
    return buffer, twin


def segments(folder: Path) -> dict[str, tuple[int, int]]:
    return {name: file for name, file in files_of(folder).items() if name.startswith("frames-")}


# -- What is written ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("world_class", [World, DictWorld])
def test_nothing_is_pickled(world_class: type[World], tmp_path: Path) -> None:
    world = world_class(2)
    buffer, _ = filled(world, 20, 30)
    save_buffer_file(buffer, tmp_path / "buffer")
    folder = tmp_path / "buffer.pkl"
    assert len(segments(folder)) > 3 and {file.name for file in folder.iterdir()} == {"index.npz", *segments(folder)}
    for file in folder.iterdir():
        contents = np.load(file, allow_pickle=False)
        for array in [contents[key] for key in contents.files] if file.suffix == ".npz" else [contents]:
            assert array.dtype.kind in "uifbU"
        assert file.read_bytes()[:1] != pickle.dumps(0)[:1]
    stream = io.BytesIO()
    save_buffer_file(buffer, stream)
    with zipfile.ZipFile(stream) as archive:
        assert len(archive.namelist()) == len(list(folder.iterdir()))


@pytest.mark.parametrize(("rows", "steps"), [(1000, 30), (40, 200)])
def test_only_used_frames_are_on_disk(rows: int, steps: int, tmp_path: Path) -> None:
    world = World(k=3, c=3, size=(20, 20))
    buffer, _ = filled(world, rows, steps)
    save_buffer_file(buffer, tmp_path / "buffer")
    size = sum(file.stat().st_size for file in (tmp_path / "buffer.pkl").iterdir())
    frames, transitions = len(buffer.store) + files.SEGMENT, buffer.size()
    assert len(buffer.store) <= transitions * 1.6
    assert size < frames * (1200 + 20) + transitions * 80 + 6_000
    save_buffer_file(buffer, stream := io.BytesIO())
    assert len(stream.getvalue()) < frames * (1200 + 60) + transitions * 80 + 6_000


def test_saving_again_writes_what_is_new(tmp_path: Path) -> None:
    world = World(2)
    buffer, twin = filled(world, 200, 60)
    folder = tmp_path / "buffer.pkl"
    save_buffer_file(buffer, folder)
    old = segments(folder)
    assert len(old) > 12
    fill(world.episodes(9), buffer, twin)
    frames = len(buffer.store)
    save_buffer_file(buffer, folder)
    kept = {name: file for name, file in segments(folder).items() if name in old}
    assert kept.items() <= old.items() and len(kept) >= len(old) - 1  # neither moved nor written to
    written = sum(len(np.load(folder / name)) for name in segments(folder).keys() - old.keys())
    assert 18 <= written <= 18 + 18 // 5 * 3 + files.SEGMENT < frames / 3
    loaded = world.buffer(200)
    load_buffer_file(loaded, folder)
    assert_equal_buffers(loaded, twin)


def test_saving_again_without_news_leaves_whole_segments_alone(tmp_path: Path) -> None:
    buffer, _ = filled(World(), 50, 40)
    folder = tmp_path / "buffer.pkl"
    save_buffer_file(buffer, folder)
    old = segments(folder)
    save_buffer_file(buffer, folder)
    assert len(old.items() - segments(folder).items()) <= 1
    assert len(segments(folder)) == len(old)


def test_segments_whose_frames_are_all_dropped_vanish(tmp_path: Path) -> None:
    world = World()
    buffer, twin = filled(world, 10, 10)
    folder = tmp_path / "buffer.pkl"
    for _ in range(12):
        fill(world.episodes(7), buffer, twin)
        save_buffer_file(buffer, folder)
        assert len(segments(folder)) <= len(buffer.store) / (files.SHORT * files.SEGMENT) + 2
        loaded = world.buffer(10)
        load_buffer_file(loaded, folder)
        assert_equal_buffers(loaded, twin)


@pytest.mark.parametrize("new", [1, 2, 5, 8, 20])
def test_frequent_saves_leave_few_files_and_rare_ones_write_each_frame_once(new: int, tmp_path: Path) -> None:
    world = World()
    buffer, _ = filled(world, 500, 0)
    folder, written = tmp_path / "buffer.pkl", 0
    save_buffer_file(buffer, folder)
    for _ in range(200 // new):
        old = segments(folder)
        for _ in range(new):
            buffer.store.append(np.zeros(buffer.store.shape, buffer.store.dtype))
        save_buffer_file(buffer, folder)
        written += sum(len(np.load(folder / name)) for name in segments(folder).keys() - old.keys())
    frames = len(buffer.store)
    assert frames == 200
    assert len(segments(folder)) <= frames / min(new, files.SHORT * files.SEGMENT) + 1
    assert written == frames * (1 if new >= files.SHORT * files.SEGMENT else 1.5)


@pytest.mark.parametrize("forget", [False, True])
def test_a_buffer_that_was_reset_does_not_use_its_old_files(forget: bool, tmp_path: Path) -> None:
    """Its frames have the old numbers again."""
    world = World()
    buffer, twin = filled(world, 30, 20)
    folder = tmp_path / "buffer.pkl"
    save_buffer_file(buffer, folder)
    buffer.reset()
    twin.reset()
    fill(world.episodes(25 * (not forget)), buffer, twin)
    save_buffer_file(buffer, folder)
    loaded = world.buffer(3)
    load_buffer_file(loaded, folder)
    assert_equal_buffers(loaded, twin)
    assert bool(segments(folder)) != forget


def test_two_buffers_that_save_to_one_folder_do_not_mix(tmp_path: Path) -> None:
    world, path = World(2), tmp_path / "buffer"
    buffer, twin = filled(world, 20, 10)
    save_buffer_file(buffer, path)
    pairs = []
    for seed in (1, 2):
        copy = world.buffer(20)
        load_buffer_file(copy, path)
        other = World(2, seed=seed)
        pairs.append((copy, pickle.loads(pickle.dumps(twin)), other))
    for turn in (0, 1, 1, 0, 0, 1, 0):
        copy, its_twin, other = pairs[turn]
        fill(other.episodes(4 + turn), copy, its_twin)
        save_buffer_file(copy, path)
        loaded = world.buffer(20)
        load_buffer_file(loaded, path)
        assert_equal_buffers(loaded, its_twin)


def test_saving_to_two_places_in_turn(tmp_path: Path) -> None:
    world = World()
    buffer, twin = filled(world, 30, 5)
    for turn in range(6):
        fill(world.episodes(6), buffer, twin)
        path = tmp_path / f"{turn % 2}.pkl"
        save_buffer_file(buffer, path)
        shutil.copytree(path, tmp_path / f"copy{turn}")
        loaded = world.buffer(1)
        load_buffer_file(loaded, tmp_path / f"copy{turn}")
        assert_equal_buffers(loaded, twin)


# -- Where it is found -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("as_type", [str, Path])
@pytest.mark.parametrize(
    ("given", "written", "found_as"),
    [
        ("buffer", "buffer.pkl", ["buffer", "buffer.pkl"]),
        ("buffer.pkl", "buffer.pkl", ["buffer", "buffer.pkl"]),
        ("buffer.frames", "buffer.frames", ["buffer.frames"]),
        ("new/folder/buffer", "new/folder/buffer.pkl", ["new/folder/buffer"]),
    ],
)
def test_paths_follow_sb3s_rule(
    given: str, written: str, found_as: list[str], as_type: Callable[[Path], Any], tmp_path: Path
) -> None:
    world = World()
    buffer, twin = filled(world, 9, 12)
    save_buffer_file(buffer, as_type(tmp_path / given))
    assert (tmp_path / written / "index.npz").is_file()
    for name in found_as:
        loaded = world.buffer(9)
        load_buffer_file(loaded, as_type(tmp_path / name))
        assert_equal_buffers(loaded, twin)


def test_a_folder_of_that_name_without_a_buffer_is_passed_over(tmp_path: Path) -> None:
    world = World()
    buffer, twin = filled(world, 9, 12)
    (tmp_path / "buffer").mkdir()
    with pytest.raises(FileNotFoundError, match="no replay buffer"):
        load_buffer_file(buffer, tmp_path / "buffer")
    save_buffer_file(buffer, tmp_path / "buffer")
    loaded = world.buffer(9)
    load_buffer_file(loaded, tmp_path / "buffer")
    assert_equal_buffers(loaded, twin)


def test_nothing_there(tmp_path: Path) -> None:
    buffer, twin = filled(World(), 9, 5)
    for path in (tmp_path / "none", tmp_path / "none.pkl", tmp_path / "no" / "folder"):
        with pytest.raises(FileNotFoundError, match="none|folder"):
            load_buffer_file(buffer, path)
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("data", b"")
    with pytest.raises(ValueError, match=r"other\.zip cannot be loaded: .*index\.npz"):
        load_buffer_file(buffer, tmp_path / "other.zip")
    assert_equal_buffers(buffer, twin)


def test_what_a_stream_got_can_be_loaded_from_a_file(tmp_path: Path) -> None:
    world = World(2)
    buffer, twin = filled(world, 9, 12)
    with (tmp_path / "buffer.zip").open("wb") as file:
        save_buffer_file(buffer, file)
    loaded = world.buffer(2)
    load_buffer_file(loaded, tmp_path / "buffer.zip")
    assert_equal_buffers(loaded, twin)
    with (tmp_path / "buffer.zip").open("rb") as file:
        load_buffer_file(loaded, file)
    assert_equal_buffers(loaded, twin)


def test_size_and_frame_channels_are_the_files_and_n_steps_the_buffers_own(tmp_path: Path) -> None:
    world = World(2)
    buffer, _ = filled(world, 9, 12)
    save_buffer_file(buffer, tmp_path / "buffer")
    loaded = world.buffer(5, n_steps=3, gamma=0.5, frame_channels=None)
    load_buffer_file(loaded, tmp_path / "buffer")
    assert (loaded.buffer_size, loaded.frame_channels, loaded.n_steps, loaded.gamma) == (9, 1, 3, 0.5)


def test_after_loading_the_episode_goes_on(tmp_path: Path) -> None:
    """Neither its frames nor its n-step sums begin anew; one environment had been interrupted."""
    world = World(2)
    buffer, twin = filled(world, 20, 12, 3)
    buffer._interrupt(1)
    twin.timeouts[twin.pos - 1, 1] = 1 - twin.dones[twin.pos - 1, 1]
    save_buffer_file(buffer, tmp_path / "buffer")
    loaded = world.buffer(20, n_steps=3)
    load_buffer_file(loaded, tmp_path / "buffer")
    frames = len(loaded.store)
    fill([world.step()], loaded, twin)
    assert_equal_buffers(loaded, twin)
    assert frames + 1 + 2 <= len(loaded.store) <= frames + 1 + 4  # one of the first, a whole stack of the second
    assert not loaded.interrupted[:, 0].any()


# -- SB3's pickles -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [0, 1, 5, 9, 10, 13, 20, 27])
@pytest.mark.parametrize(("world_class", "n_steps"), [(World, 1), (World, 3), (DictWorld, 1)])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_sb3s_pickles(n_envs: int, world_class: type[World], n_steps: int, steps: int, tmp_path: Path) -> None:
    world = world_class(n_envs)
    _, twin = filled(world, 10, steps)
    twin = filled(world_class(n_envs), 10, steps, n_steps)[1]
    save_to_pkl(tmp_path / "buffer", twin)
    buffer = world.buffer(4, n_steps=n_steps)
    load_buffer_file(buffer, tmp_path / "buffer")
    assert buffer.buffer_size == 10
    assert_equal_buffers(buffer, twin)
    with (tmp_path / "buffer.pkl").open("rb") as file:
        load_buffer_file(buffer, file)
    for transition in world.episodes(13, 4):
        fill([transition], buffer, twin)
        if n_steps == 1:
            assert_equal_buffers(buffer, twin)
    save_buffer_file(buffer, tmp_path / "buffer")  # in place of the pickle
    loaded = world.buffer(10, n_steps=n_steps)
    load_buffer_file(loaded, tmp_path / "buffer")
    assert_equal_buffers(loaded, buffer)
    assert [path.name for path in tmp_path.iterdir()] == ["buffer.pkl"]


def test_pickles_from_before_sb3_2_1(tmp_path: Path) -> None:
    """They have no timeouts."""
    world = World()
    _, twin = filled(world, 10, 13)
    twin.timeouts[:] = 0
    with pytest.MonkeyPatch.context() as patch:
        patch.delattr(twin, "timeouts")
        patch.delattr(twin, "handle_timeout_termination")
        save_to_pkl(tmp_path / "buffer", twin)
    buffer = world.buffer(10)
    load_buffer_file(buffer, tmp_path / "buffer")
    assert_equal_buffers(buffer, twin)


@pytest.mark.parametrize("world_class", [World, DictWorld])
def test_its_own_pickles(world_class: type[World], tmp_path: Path) -> None:
    """What stable_baselines3.SAC writes of it."""
    world = world_class(2)
    buffer, twin = filled(world, 10, 13)
    save_to_pkl(tmp_path / "buffer", buffer)
    loaded = world.buffer(3, n_steps=1, gamma=0.5)
    load_buffer_file(loaded, tmp_path / "buffer")
    fill(world.episodes(3), loaded, twin)
    assert_equal_buffers(loaded, twin)
    assert loaded.gamma == 0.5 and loaded._frame_device is None  # as its own: frames follow ``device``
