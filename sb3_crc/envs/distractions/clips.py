"""Moving backgrounds: clips from files, resized once and kept on disk, or procedural ones.

F frames, S side of the square picture in pixels.
"""

from __future__ import annotations

import hashlib
import os
import re
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from sb3_crc.atomic import atomic_write

SUFFIXES = (".mp4", ".npz", ".npy")
#: Frames of one clip: at 100 x 100 pixels the longest take 300 MB on disk
SHORTEST, LONGEST = 2, 10_000
#: Pixels of one frame, and bytes of a whole npz, at most: more is refused before it is decoded
MOST_PIXELS, MOST_BYTES = 1 << 24, 1 << 32
#: What NumPy raises for a damaged npy or npz: the last is zipfile's, of a compression or encryption that it does not know
UNREADABLE = (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError)
#: Of the files that resized clips are kept in
FORMAT = 1
PROCEDURAL_FRAMES = 600


class Clip(Protocol):
    """A background of one episode."""

    def __len__(self) -> int: ...

    def frame(self, index: int) -> np.ndarray:
        """:param index: of F; :return: uint8 ``(S, S, 3)``"""
        ...


class ProceduralClip:
    """
    Coloured waves that drift, always the same for the same number and size.

    :param number: which
    :param side: S
    """

    def __init__(self, number: int, side: int) -> None:
        rng = np.random.RandomState(number)
        along = (np.arange(side, dtype=np.float32) + 0.5) / side
        self._waves = []
        for _ in range(4):
            frequency = rng.uniform(-3, 3, 2).astype(np.float32)
            turns = rng.randint(1, 6)  # whole ones, so that the clip's end meets its beginning
            colour = rng.uniform(-1, 1, 3).astype(np.float32)
            phases = 2 * np.pi * (along[:, None] * frequency[0] + along * frequency[1])
            self._waves.append((phases + rng.uniform(0, 2 * np.pi), 2 * np.pi * turns / PROCEDURAL_FRAMES, colour))
        self._base = rng.uniform(64, 192, 3).astype(np.float32)

    def __len__(self) -> int:
        return PROCEDURAL_FRAMES

    def frame(self, index: int) -> np.ndarray:
        """:param index: of F; :return: uint8 ``(S, S, 3)``"""
        waves = (np.sin(phases + speed * index)[..., None] * (48 * colour) for phases, speed, colour in self._waves)
        picture = self._base + sum(waves)
        return np.asarray(np.clip(picture, 0, 255), np.uint8)


class StoredClip:
    """
    A clip of a file, at one size, read from disk as its frames are shown.

    :param path: mp4, or npz or npy with one array uint8 ``(F, height, width, 3)``
    :param side: S
    :raises FileNotFoundError: if there is no such file
    :raises ImportError: for an mp4 without the package ``av`` (extra ``video``)
    :raises ValueError: naming the file, if it is no clip, or is too short or too long
    """

    def __init__(self, path: Path, side: int) -> None:
        self._frames = _resized(path, side)

    def __len__(self) -> int:
        return len(self._frames)

    def frame(self, index: int) -> np.ndarray:
        """:param index: of F; :return: uint8 ``(S, S, 3)``"""
        return np.asarray(self._frames[index])


def clips_of(data: Path, mode: str) -> list[Path]:
    """:param data: a folder of clips, or one that has a folder of the mode's name; :return: as :func:`find_clips`"""
    return find_clips(data / mode if (data / mode).is_dir() else data)


def find_clips(folder: Path) -> list[Path]:
    """
    :param folder: of clips
    :return: its clips, video2 before video10
    :raises FileNotFoundError: if it does not exist
    :raises ValueError: if it is no folder, or there is no clip in it
    """
    if not folder.exists():
        raise FileNotFoundError(f"there is no folder {folder} of clips")
    if not folder.is_dir():
        raise ValueError(f"{folder} is no folder of clips")
    found = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")]
    if not found:
        raise ValueError(f"no clip in {folder}: a clip ends in {', '.join(SUFFIXES)}")
    return sorted(found, key=lambda path: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)])


def bilinear(picture: np.ndarray, side: int) -> np.ndarray:
    """
    The benchmark's resizing, torch's ``interpolate(mode="bilinear", align_corners=False)``: no antialiasing, the aspect ratio
    is not kept, fractions are cut off.

    :param picture: uint8 ``(height, width, 3)``
    :param side: S
    :return: uint8 ``(S, S, 3)``
    """
    if picture.shape[:2] == (side, side):
        return picture
    (top, bottom, down), (left, right, across) = (_weights(size, side) for size in picture.shape[:2])
    upper, lower = (picture[rows].astype(np.float32) / 255 for rows in (top, bottom))
    rows = upper * (1 - down)[:, None, None] + lower * down[:, None, None]
    resized = rows[:, left] * (1 - across)[:, None] + rows[:, right] * across[:, None]
    return np.asarray(resized * 255, np.uint8)


def _weights(size: int, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    place = np.maximum((np.arange(side, dtype=np.float32) + 0.5) * np.float32(size / side) - 0.5, 0)
    first = place.astype(np.int64)
    return first, np.minimum(first + 1, size - 1), place - first


def _resized(path: Path, side: int) -> np.ndarray:
    if not path.exists():
        raise FileNotFoundError(f"there is no clip {path}")
    about = path.stat()
    identity = f"{FORMAT} {path.resolve()} {about.st_size} {about.st_mtime_ns} {side}"
    kept = _cache() / f"{path.stem}-{side}-{hashlib.sha256(identity.encode()).hexdigest()[:16]}.npy"
    with suppress(OSError, ValueError, EOFError):  # there is none, or it is damaged
        return np.asarray(np.load(kept, mmap_mode="r"))
    kept.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(kept) as unfinished:
        _write(_decoded(path), side, unfinished, path)
    return np.asarray(np.load(kept, mmap_mode="r"))


def _write(frames: Iterator[np.ndarray], side: int, target: Path, path: Path) -> None:
    """Resize and write frame by frame: memory holds one of them, whatever the clip's length."""
    header = {"descr": "|u1", "fortran_order": False, "shape": (0, side, side, 3)}
    with target.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        start, number = file.tell(), 0
        for frame in frames:
            number += 1
            if number > LONGEST:
                raise ValueError(f"{path} is too long: more than {LONGEST} frames; cut it, for instance into several clips")
            file.write(bilinear(frame, side).tobytes())
        if number < SHORTEST:
            raise ValueError(f"{path} is too short: {number} frames; a clip has at least {SHORTEST}")
        file.seek(0)
        np.lib.format.write_array_header_1_0(file, {**header, "shape": (number, side, side, 3)})
        assert file.tell() == start  # NumPy leaves room for a longer first axis


def _cache() -> Path:
    own = os.environ.get("SB3_CRC_CACHE")
    shared = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(own) if own else shared / "sb3_crc" / "clips"


def _decoded(path: Path) -> Iterator[np.ndarray]:
    if path.suffix.lower() == ".mp4":
        yield from _decoded_video(path)
        return
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                unpacked = sum(member.file_size for member in archive.infolist())
            if unpacked > MOST_BYTES:
                raise ValueError(f"unpacked it would have {unpacked} bytes; at most {MOST_BYTES} are read")
        content: Any = np.load(path, mmap_mode="r")
        if isinstance(content, np.lib.npyio.NpzFile):
            with content:
                if len(content.files) != 1:
                    raise ValueError(f"it holds {len(content.files)} arrays: {', '.join(content.files)}")
                content = content[content.files[0]]
    except UNREADABLE as error:
        raise ValueError(f"{path} is no clip, one array of frames: {error}") from error
    if content.ndim != 4 or content.shape[3] != 3 or content.dtype != np.uint8 or 0 in content.shape[1:]:
        raise ValueError(f"{path} holds {content.dtype} {content.shape}; a clip is uint8 (frames, height, width, 3)")
    _check_size(path, content.shape[2], content.shape[1])
    yield from content


def _check_size(path: Path, width: int, height: int) -> None:
    if width * height > MOST_PIXELS:
        raise ValueError(f"{path}: its frames have {width} x {height} pixels; at most {MOST_PIXELS} of them are decoded")


def _decoded_video(path: Path) -> Iterator[np.ndarray]:
    try:
        import av
    except ImportError as error:
        raise ImportError(f"{path} needs the package av: pip install 'sb3-crc[video]'") from error

    try:
        with av.open(str(path)) as container:
            _check_size(path, container.streams.video[0].width, container.streams.video[0].height)
            for frame in container.decode(video=0):
                _check_size(path, frame.width, frame.height)  # which may change within a stream
                yield frame.to_ndarray(format="rgb24")
    except (av.FFmpegError, IndexError, OSError) as error:
        raise ValueError(f"{path} cannot be read as a video: {error}") from error
