"""A FrameReplayBuffer on disk: segments of frames, which are written once, and a small index that names them.

A folder holds ``frames-<number of the first>-<unique>.npy``, each up to ``SEGMENT`` frames, and ``index.npz`` with everything
else. Saving to the same folder again writes only the frames that are new since, then replaces the index, then deletes the
segments that it no longer names: at any moment there is a whole buffer in the folder. Nothing is pickled.
"""

import io
import json
import os
import shutil
import uuid
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import load_from_pkl

from sb3_crc.atomic import atomic_write, sync
from sb3_crc.buffers.replay import FrameReplayBuffer

#: Version of the layout
FORMAT = 1
#: Frames in a full segment
SEGMENT = 1024
#: Share of a full segment below which the last one is written anew with what follows it: frequent saves would leave ever more
#: small files otherwise, and rare ones would write frames twice
SHORT = 1 / 4
INDEX = "index.npz"


@dataclass(frozen=True)
class Segment:
    """
    A file of consecutive frames, which never changes.

    :param name: of the file
    :param first: number of its first frame
    :param end: one more than the number of its last frame
    """

    name: str
    first: int
    end: int


def save_buffer_file(buffer: FrameReplayBuffer, path: str | Path | io.BufferedIOBase) -> None:
    """
    Save the transitions and the frames that they use.

    :param buffer: what to save
    :param path: a folder, which is made, added to, or takes the place of a file, with ``.pkl`` at its end if it has no ending
        (SB3's rule); or a stream, which gets the same as a zip
    """
    if isinstance(path, io.BufferedIOBase):
        with zipfile.ZipFile(path, "w") as archive:
            _write(buffer, _Archive(archive), ())
        return
    target = Path(path)
    target = target if target.suffix else _with_ending(target)
    if target.is_file():  # SB3's pickle makes way only for a whole buffer
        _fill(buffer, _beside(target, "new"))
        os.replace(target, _beside(target, "old"))  # where loading finds it until the folder stands in its place
        os.replace(_beside(target, "new"), target)
        sync(target.parent)
    else:
        _fill(buffer, target)
    _beside(target, "old").unlink(missing_ok=True)
    shutil.rmtree(_beside(target, "new"), ignore_errors=True)  # of an earlier save that was stopped


def load_buffer_file(buffer: FrameReplayBuffer, path: str | Path | io.BufferedIOBase) -> None:
    """
    Fill a buffer with a saved one, whose size it takes over; ``n_steps`` and ``gamma`` stay its own.

    :param buffer: of the same spaces and number of environments
    :param path: folder or stream of :func:`save_buffer_file`, or SB3's pickle of a replay buffer
    :raises FileNotFoundError: if there is none
    :raises ValueError: if it is damaged, of a later format, or does not fit ``buffer``, which then stays as it was
    """
    source = path if isinstance(path, io.BufferedIOBase) else _find(Path(path))
    with _one_error("the stream" if isinstance(source, io.BufferedIOBase) else str(source)):
        if isinstance(source, Path) and source.is_dir():
            _read(buffer, _Folder(source), _read_index(_Folder(source)))
        elif zipfile.is_zipfile(source):
            with zipfile.ZipFile(source) as archive:
                _read(buffer, _Archive(archive), _read_index(_Archive(archive)))
        else:
            if isinstance(source, io.BufferedIOBase):
                source.seek(0)
            _read_pickle(buffer, source)


def _find(path: Path) -> Path:
    targets = path, _with_ending(path)
    for source in (*targets, *(_beside(target, "old") for target in targets)):
        if source.is_file() or (source / INDEX).is_file():
            return source
    raise FileNotFoundError(f"there is no replay buffer {path}")


@contextmanager
def _one_error(name: str) -> Iterator[None]:
    """Damaged bytes make pickle, zipfile and numpy raise nearly anything."""
    try:
        yield
    except Exception as error:
        raise ValueError(f"the replay buffer in {name} cannot be loaded: {error}") from error


def _with_ending(path: Path) -> Path:
    return path.with_name(f"{path.name}.pkl")


def _beside(target: Path, word: str) -> Path:
    return target.with_name(f".{target.name}.{word}")


class _Folder:
    def __init__(self, path: Path):
        self.path = path

    def has(self, name: str) -> bool:
        return (self.path / name).exists()

    @contextmanager
    def writing(self, name: str) -> Iterator[IO[bytes]]:
        self.path.mkdir(parents=True, exist_ok=True)
        with atomic_write(self.path / name) as unfinished, unfinished.open("wb") as file:
            yield file

    @contextmanager
    def reading(self, name: str) -> Iterator[IO[bytes]]:
        with (self.path / name).open("rb") as file:
            yield file

    def keep(self, names: set[str]) -> None:
        """Delete the segments that are not among the ``names``, and what was not written to its end."""
        for file in self.path.iterdir():
            if file.name.lstrip(".").startswith(("frames-", f"{INDEX}.")) and file.name not in names:
                file.unlink()
        sync(self.path)


class _Archive:
    def __init__(self, archive: zipfile.ZipFile):
        self.archive = archive

    def has(self, name: str) -> bool:
        return name in self.archive.namelist()

    @contextmanager
    def writing(self, name: str) -> Iterator[IO[bytes]]:
        with self.archive.open(name, "w", force_zip64=True) as file:
            yield file

    @contextmanager
    def reading(self, name: str) -> Iterator[IO[bytes]]:
        with self.archive.open(name) as file:
            yield file


@dataclass(frozen=True)
class Contents:
    """
    What of a buffer is to be written; it shares no memory with the buffer.

    :param segments: all that the buffer needs
    :param frames: name -> frames of the segments that are not in the folder yet
    :param arrays: the index
    """

    segments: tuple[Segment, ...]
    frames: dict[str, np.ndarray]
    arrays: dict[str, np.ndarray]


def contents(buffer: FrameReplayBuffer, folder: Path, written: tuple[Segment, ...]) -> Contents:
    """
    :param buffer: what is to be saved
    :param folder: where segments lie
    :param written: the segments that were written for this buffer before
    :return: what a save has to write
    """
    segments, new = _segments(buffer, _Folder(folder), written)
    frames = {segment.name: buffer.store.read(segment.first, segment.end) for segment in new}
    return Contents(tuple(segments), frames, {name: values.copy() for name, values in _index(buffer, segments).items()})


def read_contents(buffer: FrameReplayBuffer, folder: Path, index: Path) -> None:
    """
    Fill a buffer.

    :param buffer: of the same spaces and number of environments
    :param folder: where segments lie
    :param index: the file with :attr:`Contents.arrays`
    :raises ValueError: if it does not fit ``buffer``, which then stays as it was
    """
    with np.load(index, allow_pickle=False) as file:
        _read(buffer, _Folder(folder), {key: file[key] for key in file.files})


def _fill(buffer: FrameReplayBuffer, target: Path) -> None:
    folder = _Folder(target)
    buffer.segments = _write(buffer, folder, buffer.segments)
    folder.keep({segment.name for segment in buffer.segments})


def _write(buffer: FrameReplayBuffer, container: _Folder | _Archive, written: tuple[Segment, ...]) -> tuple[Segment, ...]:
    segments, new = _segments(buffer, container, written)
    for segment in new:
        with container.writing(segment.name) as file:
            np.lib.format.write_array(file, buffer.store.read(segment.first, segment.end), allow_pickle=False)
    with container.writing(INDEX) as file:
        np.savez(file, **_index(buffer, segments))  # type: ignore[arg-type]
    return tuple(segments)


def _segments(
    buffer: FrameReplayBuffer, container: _Folder | _Archive, written: tuple[Segment, ...]
) -> tuple[list[Segment], list[Segment]]:
    """:return: all segments, and those of them that are to be written"""
    store = buffer.store
    good = _still_good(container, written, store.first)
    new = []
    for start in range(good[-1].end if good else store.first, store.end, SEGMENT):
        end = min(start + SEGMENT, store.end)
        new.append(Segment(f"frames-{start:012d}-{uuid.uuid4().hex[:12]}.npy", start, end))
    return good + new, new


def _index(buffer: FrameReplayBuffer, segments: list[Segment]) -> dict[str, np.ndarray]:
    store, size = buffer.store, buffer.size()
    header = {
        "format": FORMAT,
        **_description(buffer),
        "frame_channels": buffer.frame_channels,
        "buffer_size": buffer.buffer_size,
        "pos": buffer.pos,
        "full": buffer.full,
        "first_frame": store.first,
        "end_frame": store.end,
        "latest": [[int(number) for number in latest.numbers] for latest in buffer.latest],
        "segments": [asdict(segment) for segment in segments],
    }
    arrays = {name: values[:size] for name, values in buffer.arrays().items()}
    return {"header": np.array(json.dumps(header)), **arrays}


def _still_good(container: _Folder | _Archive, written: tuple[Segment, ...], first: int) -> list[Segment]:
    """:return: the written segments that need not be written again"""
    segments = [segment for segment in written if segment.end > first]
    starts_early = bool(segments) and segments[0].first <= first
    if not starts_early or not all(container.has(segment.name) for segment in segments):
        return []
    if segments[-1].end - segments[-1].first < SHORT * SEGMENT:
        segments.pop()
    return segments


def _description(buffer: FrameReplayBuffer) -> dict[str, Any]:
    """What must agree between a file and the buffer that it is loaded into."""
    channels, *size = buffer.store.shape
    return {
        "observations": [buffer.stack_size * channels, *size],
        "dtype": buffer.store.dtype.str,
        "vectors": {key: list(shape) for key, shape in buffer.vector_shapes().items()},
        "action_dim": buffer.action_dim,
        "n_envs": buffer.n_envs,
    }


def _read_index(container: _Folder | _Archive) -> dict[str, np.ndarray]:
    with container.reading(INDEX) as file, np.load(file, allow_pickle=False) as index:
        return {key: index[key] for key in index.files}


def _read(buffer: FrameReplayBuffer, container: _Folder | _Archive, arrays: dict[str, np.ndarray]) -> None:
    header = json.loads(str(arrays.pop("header")))
    if header["format"] > FORMAT:
        raise ValueError(f"its format is {header['format']}, this version of sb3_crc reads up to {FORMAT}")
    for key, own in _description(buffer).items():
        if header[key] != own:
            raise ValueError(f"{key} is {header[key]} there and {own} here")
    loaded = buffer.empty_copy(header["buffer_size"] * header["n_envs"], header["frame_channels"])
    loaded.store.first = loaded.store.end = header["first_frame"]
    segments = tuple(Segment(**segment) for segment in header["segments"])
    for segment in segments:
        with container.reading(segment.name) as file:
            frames = np.lib.format.read_array(file, allow_pickle=False)
        expected = segment.end - segment.first, *loaded.store.shape
        if frames.shape != expected:
            raise ValueError(f"{segment.name} has frames {frames.shape} instead of {expected}")
        loaded.store.extend(frames[max(0, header["first_frame"] - segment.first) :])
    if loaded.store.end != header["end_frame"]:
        raise ValueError(f"there are frames up to {loaded.store.end} instead of {header['end_frame']}")
    loaded.restore(arrays, header["pos"], full=header["full"], latest=header["latest"])
    loaded.segments = segments if isinstance(container, _Folder) else ()
    vars(buffer).update(vars(loaded))


def _read_pickle(buffer: FrameReplayBuffer, source: Path | io.BufferedIOBase) -> None:
    """Store the transitions of SB3's ReplayBuffer one by one, in the rows that they have there."""
    other = load_from_pkl(source)
    if not isinstance(other, ReplayBuffer) or other.optimize_memory_usage:
        raise ValueError(f"it is a {type(other).__name__}, not a replay buffer with both obs and next_obs")
    for name in ("observation_space", "action_space", "n_envs"):
        if getattr(other, name) != getattr(buffer, name):
            raise ValueError(f"{name} is {getattr(other, name)} there and {getattr(buffer, name)} here")
    if isinstance(other, FrameReplayBuffer):
        loaded = other
        loaded.n_steps, loaded.gamma = buffer.n_steps, buffer.gamma
        loaded.device, loaded.frame_device = buffer.device, buffer._frame_device
    else:
        loaded = buffer.empty_copy(other.buffer_size * other.n_envs, buffer.frame_channels)
        oldest = other.pos if other.full else 0
        loaded.pos = oldest
        timeouts = getattr(other, "timeouts", np.zeros_like(other.dones))  # which SB3 has had since 2.1
        for row in ((np.arange(other.size()) + oldest) % other.buffer_size).tolist():
            obs, next_obs = (_row(part, row) for part in (other.observations, other.next_observations))
            infos = [{"TimeLimit.truncated": bool(timeout)} for timeout in timeouts[row]]
            loaded.add(obs, next_obs, other.actions[row], other.rewards[row], other.dones[row], infos)
    vars(buffer).update(vars(loaded))


def _row(observations: Any, row: int) -> Any:
    if isinstance(observations, Mapping):
        return {key: values[row] for key, values in observations.items()}
    return observations[row]
