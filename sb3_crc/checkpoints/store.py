"""Checkpoints on disk: each a folder that appears whole or not at all, with a checksum of every file.

::

    <folder>/replay/frames-*.npy      segments of frames, which never change; checkpoints share them
    <folder>/000000012000/            one checkpoint, named after the agent steps done
        manifest.json                 format, versions, checksums: of the files here and of the segments that it needs
        arrays.safetensors structure.json   everything but the replay buffer
        replay.npz                    the replay buffer without its frames
"""

import hashlib
import json
import os
import shutil
import uuid
import warnings
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch as th

from sb3_crc.atomic import atomic_write, sync
from sb3_crc.buffers.files import Contents
from sb3_crc.checkpoints.tree import Tree, read_tree, write_tree

#: Version of the layout
FORMAT = 1
MANIFEST, INDEX, SEGMENTS = "manifest.json", "replay.npz", "replay"
UNFINISHED = ".unfinished-"


class CheckpointError(ValueError):
    """A checkpoint cannot be used."""


@dataclass(frozen=True)
class Checkpoint:
    """
    A whole checkpoint, all of whose checksums are right.

    :param path: its folder
    :param state: see :func:`~sb3_crc.checkpoints.training.training_state`
    :param threads: of torch when it was written
    """

    path: Path
    state: Tree
    threads: int


class CheckpointStore:
    """
    The checkpoints of one run.

    :param folder: is made when the first one is saved
    :param keep: how many of the newest stay
    :raises ValueError: if none would
    """

    def __init__(self, folder: Path, keep: int = 2):
        if keep < 1:
            raise ValueError(f"keep={keep} must be at least 1")
        self.folder = folder
        self.keep = keep
        #: Checksums of the segments that this process has written or checked
        self._checksums: dict[str, str] = {}

    @property
    def segments(self) -> Path:
        """Where the frames lie."""
        return self.folder / SEGMENTS

    def names(self) -> list[str]:
        """:return: the folders of all checkpoints, newest first"""
        if not self.folder.is_dir():
            return []
        return sorted((path.name for path in self.folder.iterdir() if path.name.isdigit()), reverse=True)

    def save(self, steps: int, state: Tree, replay: Contents) -> Path:
        """
        Write a checkpoint, then delete those that are too many. Whatever stops this leaves the earlier ones as they were; on a
        disk that fails it takes its frames away again, whose place the next attempt needs.

        :param steps: agent steps done
        :param state: everything but the replay buffer
        :param replay: the replay buffer
        :return: its folder
        """
        try:
            return self._save(steps, state, replay)
        except OSError:
            for name in replay.frames:
                with suppress(OSError):
                    (self.segments / name).unlink(missing_ok=True)
            raise

    def _save(self, steps: int, state: Tree, replay: Contents) -> Path:
        self.segments.mkdir(parents=True, exist_ok=True)
        for name, frames in replay.frames.items():
            with atomic_write(self.segments / name) as unfinished, unfinished.open("wb") as file:
                np.lib.format.write_array(file, frames, allow_pickle=False)
            self._checksums[name] = checksum(self.segments / name)

        unfinished = self.folder / f"{UNFINISHED}{uuid.uuid4().hex[:12]}"
        unfinished.mkdir()
        write_tree(state, unfinished)
        with (unfinished / INDEX).open("wb") as file:
            np.savez(file, **replay.arrays)  # type: ignore[arg-type]
        names = [segment.name for segment in replay.segments]
        manifest = {
            "format": FORMAT,
            "versions": {package: version(package) for package in ("torch", "numpy", "stable-baselines3")},
            "threads": th.get_num_threads(),
            "files": {path.name: checksum(path) for path in unfinished.iterdir()},
            "segments": {name: self._checksum(name) for name in names},
        }
        (unfinished / MANIFEST).write_text(json.dumps(manifest, indent=1), encoding="utf-8")
        for path in unfinished.iterdir():
            sync(path)
        sync(unfinished)
        target = self.folder / f"{steps:012d}"
        if target.exists():  # of the same steps, by an earlier process
            os.replace(target, self.folder / f"{UNFINISHED}{uuid.uuid4().hex[:12]}")
        os.replace(unfinished, target)
        sync(self.folder)
        self._prune(target.name)
        return target

    def newest(self) -> Checkpoint | None:
        """
        Find the newest checkpoint that is undamaged; each damaged one is warned of.

        :return: None: there are no checkpoints
        :raises CheckpointError: if there are only damaged ones, or one of a later format
        """
        names = self.names()
        for name in names:
            try:
                return self._read(self.folder / name)
            except CheckpointError:
                raise
            except Exception as error:  # damaged bytes make JSON, safetensors and numpy raise nearly anything
                warnings.warn(f"the checkpoint {self.folder / name} is damaged ({error}): trying the one before", stacklevel=2)
        if names:
            raise CheckpointError(f"all checkpoints in {self.folder} are damaged: remove that folder to start anew")
        return None

    def remove_unfinished(self) -> None:
        """Make room on a disk after a checkpoint could not be written; what cannot be removed stays."""
        for path in [*self.folder.glob(f"{UNFINISHED}*")]:
            shutil.rmtree(path, ignore_errors=True)

    def _read(self, path: Path) -> Checkpoint:
        manifest = json.loads((path / MANIFEST).read_text(encoding="utf-8"))
        if manifest["format"] > FORMAT:
            raise CheckpointError(
                f"{path} has format {manifest['format']}, this version of sb3_crc reads up to {FORMAT}: install a newer one"
            )
        for name, expected in manifest["files"].items():
            _check(path / name, checksum(path / name), expected)
        for name, expected in manifest["segments"].items():
            _check(self.segments / name, self._checksum(name), expected)
        return Checkpoint(path, read_tree(path), manifest["threads"])

    def _checksum(self, segment: str) -> str:
        if segment not in self._checksums:
            self._checksums[segment] = checksum(self.segments / segment)
        return self._checksums[segment]

    def _prune(self, newest: str) -> None:
        names = self.names()
        kept = [name for name in names if name <= newest][: self.keep]  # training went on from before any later, damaged one
        needed = {segment for name in kept for segment in self._needed(name)}
        for name in set(names) - set(kept):
            shutil.rmtree(self.folder / name)
        self.remove_unfinished()
        for path in self.segments.iterdir():
            if path.name not in needed:
                path.unlink()

    def _needed(self, name: str) -> set[str]:
        """:return: segments of a checkpoint; a damaged one needs nothing any more"""
        try:
            return set(json.loads((self.folder / name / MANIFEST).read_text(encoding="utf-8"))["segments"])
        except (OSError, ValueError, KeyError, TypeError):
            return set()


def checksum(path: Path) -> str:
    """:return: SHA-256 of a file, in hexadecimal digits"""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()


def _check(path: Path, found: str, expected: str) -> None:
    if found != expected:
        raise ValueError(f"{path.name} has other bytes than were written")
