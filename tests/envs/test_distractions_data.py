"""Distractions: clips and tables of colours that users bring, what they are called, and what is none."""

import io
import json
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_crc import make_dmc
from sb3_crc.envs.distractions import clips as clips_module
from sb3_crc.envs.distractions import labels
from sb3_crc.envs.distractions.clips import PROCEDURAL_FRAMES, ProceduralClip, StoredClip, bilinear, find_clips
from sb3_crc.envs.distractions.colours import DEFAULT, generated_table, read_table
from sb3_crc.envs.distractions.labels import what_they_are

SMALL: dict[str, Any] = {"image_size": 36, "frame_stack": 2, "render_quality": "fast", "action_repeat": 40}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Resized clips of tests stay among the tests."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("SB3_CRC_CACHE", str(folder))
    return folder


@pytest.fixture
def clips(tmp_path: Path) -> Path:
    """Three clips of 4 frames: each frame of one grey level, 10 x clip + frame."""
    folder = tmp_path / "clips"
    folder.mkdir()
    for clip in range(3):
        levels = (10 * clip + np.arange(4, dtype=np.uint8))[:, None, None, None]
        np.savez(folder / f"video{clip}.npz", np.broadcast_to(levels, (4, 20, 30, 3)))
    return folder


def shown(observation: np.ndarray) -> int:
    """The grey level at the top of the newest frame, where the sky is."""
    assert len(np.unique(observation[-3:, 0, 0])) == 1
    return int(observation[-1, 0, 0])


def cartpole(mode: str, data: Path | None, **kwargs: Any) -> Any:
    return make_dmc("cartpole-swingup", distraction=mode, distraction_data=data, **{**SMALL, "seed": 0, **kwargs})


def label(mode: str, data: Path | None, **kwargs: Any) -> str:
    return str(cartpole(mode, data, **kwargs).get_wrapper_attr("distraction_label"))


# -- What is shown -----------------------------------------------------------------------------------------------------


def test_episodes_show_clips_in_turn_and_decisions_their_frames(clips: Path) -> None:
    env = cartpole("video_easy", clips)
    action = np.zeros(1, np.float32)
    for clip in (1, 2, 0, 1):
        assert shown(env.reset()[0]) == 10 * clip
        levels = [shown(env.step(action)[0]) - 10 * clip for _ in range(6)]
        assert levels == [1, 2, 3, 0, 1, 2]
    assert shown(env.reset(seed=0)[0]) == 10  # as good as new


def test_each_frame_of_a_stack_has_the_background_of_its_time(clips: Path) -> None:
    env = cartpole("video_hard", clips, observation="dict", frame_stack=3)
    observation, _ = env.reset()
    assert observation["pixels"][::3, 0, 0].tolist() == [10, 10, 10]
    for _ in range(3):
        observation, *_ = env.step(np.zeros(1, np.float32))
    assert observation["pixels"][::3, 0, 0].tolist() == [11, 12, 13]


def test_the_large_picture_shows_the_clip_too(clips: Path) -> None:
    env = cartpole("video_hard", clips)
    env.reset()
    env.step(np.zeros(1, np.float32))
    large = env.render()
    assert large.shape == (480, 480, 3)
    assert (large == 11).all(axis=2).mean() > 0.9


def test_a_folder_of_the_modes_name_comes_first(clips: Path, tmp_path: Path) -> None:
    for folder, level in (("video_hard", 90), ("dcs_easy", 91)):
        (tmp_path / folder).mkdir()
        np.save(tmp_path / folder / "own.npy", np.full((2, 8, 8, 3), level, np.uint8))
    np.save(tmp_path / "other.npy", np.zeros((2, 8, 8, 3), np.uint8))
    assert shown(cartpole("video_hard", tmp_path).reset()[0]) == 90
    assert "1 clip of" in label("dcs_easy_static", tmp_path)
    assert shown(cartpole("video_easy", tmp_path).reset()[0]) == 0


def test_mp4(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "clip.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for level in (40, 90, 140, 190):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), level, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    clip = StoredClip(tmp_path / "clip.mp4", 20)
    assert [int(clip.frame(index).mean().round()) for index in range(len(clip))] == pytest.approx([40, 90, 140, 190], abs=3)
    observation, _ = cartpole("video_easy", tmp_path).reset()
    assert np.abs(observation[-3:, 0, 0].astype(int) - 40).max() <= 3


def test_procedural_clips_move_and_close() -> None:
    first, second = ProceduralClip(1, 24), ProceduralClip(2, 24)
    assert np.array_equal(first.frame(7), ProceduralClip(1, 24).frame(7))
    assert not np.array_equal(first.frame(7), second.frame(7))
    assert not np.array_equal(first.frame(7), first.frame(8))
    assert first.frame(0).std() > 10
    end, start = first.frame(PROCEDURAL_FRAMES).astype(int), first.frame(0).astype(int)
    assert np.abs(end - start).max() <= 1


def test_natural_order(tmp_path: Path) -> None:
    for name in ("video10.npy", "video2.npy", "video1.npy", "notes.txt", ".video0.npy"):
        (tmp_path / name).touch()
    assert [path.stem for path in find_clips(tmp_path)] == ["video1", "video2", "video10"]


# -- Kept on disk ------------------------------------------------------------------------------------------------------


def test_a_clip_is_decoded_once(clips: Path, cache: Path) -> None:
    cartpole("video_easy", clips)
    kept = sorted(cache.iterdir())
    times = [path.stat().st_mtime_ns for path in kept]
    assert len(kept) == 3
    cartpole("video_hard", clips).reset()
    assert [path.stat().st_mtime_ns for path in sorted(cache.iterdir())] == times
    np.savez(clips / "video1.npz", np.full((9, 20, 30, 3), 77, np.uint8))  # another clip of the same name
    assert shown(cartpole("video_easy", clips).reset()[0]) == 77


@pytest.mark.parametrize("frames", [2, 9, 10, 1234])
def test_what_is_kept_are_the_resized_frames(tmp_path: Path, cache: Path, frames: int) -> None:
    pixels = np.random.default_rng(frames).integers(0, 256, (frames, 5, 7, 3), dtype=np.uint8)
    np.save(tmp_path / "clip.npy", pixels)
    clip = StoredClip(tmp_path / "clip.npy", 6)
    (kept,) = cache.iterdir()
    stored = np.load(kept)
    assert stored.shape == (frames, 6, 6, 3) and len(clip) == frames
    assert all(np.array_equal(bilinear(frame, 6), resized) for frame, resized in zip(pixels, stored, strict=True))
    assert np.array_equal(clip.frame(frames - 1), stored[-1])
    assert isinstance(clip._frames.base, np.memmap)  # read as it is shown


@pytest.mark.parametrize("damage", [b"", b"\x93NUMPY", None])
def test_what_was_kept_and_is_damaged_is_made_anew(clips: Path, cache: Path, damage: bytes | None) -> None:
    before = StoredClip(clips / "video1.npz", 20).frame(3).copy()
    (kept,) = cache.iterdir()
    kept.write_bytes(kept.read_bytes()[:-100] if damage is None else damage)
    assert np.array_equal(StoredClip(clips / "video1.npz", 20).frame(3), before)


def test_nothing_is_kept_of_a_clip_that_is_none(tmp_path: Path, cache: Path) -> None:
    np.save(tmp_path / "short.npy", np.zeros((1, 8, 8, 3), np.uint8))
    with pytest.raises(ValueError):
        StoredClip(tmp_path / "short.npy", 6)
    assert not list(cache.iterdir())


# -- What it is called -------------------------------------------------------------------------------------------------


def test_what_is_generated_says_so() -> None:
    assert label("color_easy", None) == "color_easy (generated)"
    assert label("video_hard", None) == "video_hard (procedural)"
    assert label("video_hard", None, distraction_mask="segmentation") == "video_hard (procedural, segmentation)"
    assert label("dcs_hard_static", None) == "dcs_hard (procedural, static)"


def test_only_the_benchmarks_clips_are_called_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [tmp_path / f"video{number}.mp4" for number in range(10)]
    for path in paths:
        path.write_bytes(path.name.encode())
    assert "10 clips of one's own" in what_they_are(paths, "video_easy")  # the names are right, what they hold is not
    true = {path.stem: labels.hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}  # type: ignore[attr-defined]
    monkeypatch.setattr(labels, "ORIGINALS", {name: true[name] for name in labels.ORIGINALS})
    assert what_they_are(paths[:3], "video_easy") == "3 of DMControl-GB's 10 clips: 0, 1, 2"
    assert what_they_are(paths, "video_easy").startswith("10 of DMControl-GB's 10 clips; 4 by name only, ")
    assert what_they_are(paths[3:7], "video_easy").startswith("4 of DMControl-GB's 10 clips: 3, 4, 5, 6; 3 by name only, ")
    assert "of one's own" in what_they_are(paths[:3], "video_hard")
    paths[3].rename(tmp_path / "video3.npy")
    assert "1 clip of one's own" in what_they_are([tmp_path / "video3.npy"], "video_easy")
    paths[1].write_bytes(b"another")
    assert "3 clips of one's own" in what_they_are(paths[:3], "video_easy")


def test_other_data_have_another_label(clips: Path, tmp_path: Path) -> None:
    """Results are kept by label, and a state of other data is refused."""
    first = label("video_hard", clips)
    assert first == label("video_hard", clips) and "3 clips of one's own, " in first
    np.savez(clips / "video1.npz", np.full((4, 20, 30, 3), 77, np.uint8))  # as large as before
    assert label("video_hard", clips) != first
    for name, seed in (("a", 0), ("b", 1)):
        (tmp_path / name).mkdir()
        table = {key: np.random.default_rng(seed).uniform(size=(5, 3)) for key in DEFAULT}
        np.savez(tmp_path / name / "own.npz", **table)  # type: ignore[arg-type]
    own = [label("color_hard", tmp_path / name / "own.npz") for name in "ab"]
    assert own[0].startswith("color_hard (table own.npz, ") and own[0] != own[1]


@pytest.mark.parametrize("mode", ["video_easy", "dcs_hard"])
def test_a_state_of_other_clips_is_refused(clips: Path, mode: str) -> None:
    env = cartpole(mode, clips)
    env.reset()
    state = env.get_state()
    cartpole(mode, clips).set_state(state)
    (clips / "video2.npz").unlink()
    with pytest.raises(ValueError, match=r"3 clips of one's own.*it must be .*2 clips of one's own"):
        cartpole(mode, clips).set_state(state)


def test_tables_in_all_formats_are_one(tmp_path: Path) -> None:
    table = generated_table("color_hard")
    np.savez(tmp_path / "color_hard.npz", **table)  # type: ignore[arg-type]
    entries = [{name: values[entry].tolist() for name, values in table.items()} for entry in range(100)]
    (tmp_path / "list.json").write_text(json.dumps(entries))
    (tmp_path / "lists.json").write_text(json.dumps({name: values.tolist() for name, values in table.items()}))
    own, *others = (
        cartpole("color_hard", data, seed=4).reset()[0]
        for data in (None, tmp_path, tmp_path / "list.json", tmp_path / "lists.json")
    )
    assert all(np.array_equal(own, other) for other in others)


# -- What is none ------------------------------------------------------------------------------------------------------


def test_data_that_are_missing(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for mode in ("video_easy", "color_easy", "dcs_easy"):
        with pytest.raises(FileNotFoundError, match="nowhere"):
            cartpole(mode, tmp_path / "nowhere")
    for mode in ("video_easy", "dcs_easy"):
        with pytest.raises(ValueError, match=r"no clip in .*empty: a clip ends in \.mp4"):
            cartpole(mode, tmp_path / "empty")
        with pytest.raises(ValueError, match="is no folder of clips"):
            cartpole(mode, Path(__file__))
    with pytest.raises(FileNotFoundError, match=r"color_easy\.npz or .*color_easy\.json"):
        cartpole("color_easy", tmp_path / "empty")


def archive(**arrays: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


NOISE = archive(frames=np.random.default_rng(0).integers(0, 256, (5, 20, 20, 3), dtype=np.uint8))


def damaged(content: bytes, offset: int, value: int) -> bytes:
    """:return: an archive of one file, with another byte at an offset of its local header, and at that of the central one"""
    changed = bytearray(content)
    changed[offset] = changed[content.rfind(b"PK\1\2") + offset + 2] = value
    return bytes(changed)


METHOD, ENCRYPTED = damaged(NOISE, 8, 99), damaged(NOISE, 6, 1)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("broken.mp4", b"no video", r"broken\.mp4 cannot be read as a video"),
        ("broken.npz", b"no archive", r"broken\.npz is no clip"),
        ("half.npz", NOISE[: len(NOISE) // 2], r"half\.npz is no clip"),
        ("bits.npz", NOISE[:300] + bytes(40) + NOISE[340:], r"bits\.npz is no clip"),
        ("method.npz", METHOD, r"method\.npz is no clip"),
        ("encrypted.npz", ENCRYPTED, r"encrypted\.npz is no clip"),
        ("two.npz", archive(a=np.zeros((5, 8, 8, 3), np.uint8), b=np.zeros(2)), r"two\.npz is no clip.*2 arrays: a, b"),
        ("none.npy", b"", r"none\.npy is no clip"),
        ("short.npy", np.zeros((1, 8, 8, 3), np.uint8), r"short\.npy is too short: 1 frames"),
        ("empty.npy", np.zeros((0, 8, 8, 3), np.uint8), r"empty\.npy is too short: 0 frames"),
        ("long.npy", np.zeros((10_001, 1, 1, 3), np.uint8), r"long\.npy is too long: more than 10000 frames; cut it"),
        ("grey.npy", np.zeros((5, 8, 8), np.uint8), r"grey\.npy holds uint8 \(5, 8, 8\)"),
        ("first.npy", np.zeros((5, 3, 8, 8), np.uint8), r"first\.npy holds uint8 \(5, 3, 8, 8\)"),
        ("floats.npy", np.zeros((5, 8, 8, 3)), r"floats\.npy holds float64"),
        ("objects.npy", np.array([None]), r"objects\.npy is no clip"),
    ],
)
def test_clips_that_are_none(tmp_path: Path, name: str, content: Any, message: str) -> None:
    if name.endswith("mp4"):
        pytest.importorskip("av")
    if isinstance(content, bytes):
        (tmp_path / name).write_bytes(content)
    else:
        np.save(tmp_path / name, content)
    with pytest.raises(ValueError, match=message):
        StoredClip(tmp_path / name, 6)


def bomb(path: Path, gigabytes: int) -> None:
    """An npz of a few megabytes that would be as many gigabytes."""
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("frames.npy", "w", force_zip64=True) as file,
    ):
        shape = (gigabytes * 1000, 1000, 333, 3)
        np.lib.format.write_array_header_1_0(file, {"descr": "|u1", "fortran_order": False, "shape": shape})
        for _ in range(gigabytes):
            for _ in range(64):
                file.write(bytes(1 << 24))


@pytest.mark.parametrize("name", ["wide.npy", "wide.mp4", "bomb.npz"])
def test_clips_that_are_too_large_are_not_decoded(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clips_module, "MOST_PIXELS", 32 * 20)
    monkeypatch.setattr(clips_module, "MOST_BYTES", 1 << 29)
    path = tmp_path / name
    if name == "bomb.npz":
        bomb(path, 1)
        assert path.stat().st_size < 1 << 21
        message = r"bomb\.npz is no clip.*unpacked it would have \d+ bytes; at most 536870912 are read"
    else:
        message = rf"{name}: its frames have 64 x 32 pixels; at most 640 of them are decoded"
        frames = np.zeros((3, 32, 64, 3), np.uint8)
        if name.endswith("npy"):
            np.save(path, frames)
        else:
            av = pytest.importorskip("av")
            with av.open(str(path), "w") as container:
                stream = container.add_stream("mpeg4", rate=10)
                stream.width, stream.height, stream.pix_fmt = 64, 32, "yuv420p"
                for frame in frames:
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(frame)))
                container.mux(stream.encode())
    with pytest.raises(ValueError, match=message):
        StoredClip(path, 6)


@pytest.mark.parametrize("mode", ["video_easy", "video_hard", "dcs_easy", "dcs_hard_static"])
def test_a_clip_that_is_none_is_found_out_at_once(clips: Path, mode: str) -> None:
    (clips / "video2.npz").write_bytes(b"no archive")  # not one of the first episode
    with pytest.raises(ValueError, match=r"video2\.npz is no clip"):
        cartpole(mode, clips)


def test_an_mp4_needs_a_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "clip.mp4").touch()
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ImportError, match=r"clip\.mp4 needs the package av: pip install 'sb3-crc\[video\]'"):
        cartpole("video_easy", tmp_path)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("table.json", b"no json", r"table\.json is no table of colours"),
        ("table.json", b"\xff\xfe", r"table\.json is no table of colours"),
        ("table.json", json.dumps([{"self_rgb": [0, 0, 0]}]).encode(), r"is no table of colours.*grid_rgb1"),
        ("table.json", json.dumps({name: [[0.5, 0.5]] for name in DEFAULT}).encode(), r"grid_rgb1 has shape \(1, 2\)"),
        ("table.json", json.dumps({name: [[0.5, 0.5, 1.5]] for name in DEFAULT}).encode(), r"outside \[0, 1\]"),
        ("table.json", b"[]", r"table\.json: grid_rgb1 has shape \(0,\)"),
        ("half.npz", NOISE[: len(NOISE) // 2], r"half\.npz is no table of colours"),
        ("bits.npz", NOISE[:300] + bytes(40) + NOISE[340:], r"bits\.npz is no table of colours"),
        ("none.npz", b"", r"none\.npz is no table of colours"),
        ("method.npz", METHOD, r"method\.npz is no table of colours"),
        ("encrypted.npz", ENCRYPTED, r"encrypted\.npz is no table of colours"),
        ("other.npz", NOISE, r"other\.npz is no table of colours.*grid_rgb1"),
        ("nan.npz", archive(**{name: np.full((2, 3), np.nan) for name in DEFAULT}), r"outside \[0, 1\]"),
    ],
)
def test_tables_that_are_none(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_table(tmp_path / name, "color_hard")


def test_a_table_that_is_none_is_found_out_at_once(tmp_path: Path) -> None:
    (tmp_path / "color_easy.npz").write_bytes(b"no archive")
    with pytest.raises(ValueError, match=r"color_easy\.npz is no table of colours"):
        cartpole("color_easy", tmp_path)
