"""Whose clips they are: only DMControl-GB's own ten are called so."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

#: sha256 of DMControl-GB's clips of video_easy; of 3, 4, 5 and 7 it is not known
ORIGINALS = {
    "video0": "7cd810b22c9cea030b94a82e392cd5e7f301b084a2ccfe141a180c39d1ae3deb",
    "video1": "fc348d4f0edb587bf1357a06e6b1fa53599f0e12f2d537f49716b00986edde46",
    "video2": "10a9cbfbc9cad7b8f4750ebf9a3cf1b97c3006730b85a949995ab49eff48fab0",
    "video6": "64e9a29ebe6082c60af013ebdd6c3e9a390c9935b2c9a56650bdc685e881aefb",
    "video8": "240c950b82075254a5668f567c66358faac9c62d1bd4772adbd3596066237d0b",
    "video9": "c13470e0adca7b34b6961f8202bc0c7d0f1715f55dabfda448546143122cde11",
}
UNVERIFIED = ("video3", "video4", "video5", "video7")


def what_they_are(paths: Sequence[Path], mode: str) -> str:
    """
    :param paths: of clips
    :param mode: "video_easy", whose ten clips can be recognised, or another
    :return: for labels: which of the benchmark's own clips they are, or how many others and a checksum that tells them apart
    """
    if mode != "video_easy" or not all(path.suffix == ".mp4" and _is_original(path) for path in paths):
        return f"{len(paths)} {'clip' if len(paths) == 1 else 'clips'} of one's own, {_checksum(paths)}"
    missing = 10 - len(paths)
    which = f": {', '.join(path.stem.removeprefix('video') for path in paths)}" if missing else ""
    unverified = sum(path.stem in UNVERIFIED for path in paths)
    doubt = f"; {unverified} by name only, {_checksum(paths)}" if unverified else ""
    return f"{len(paths)} of DMControl-GB's 10 clips{which}{doubt}"


def _checksum(paths: Sequence[Path]) -> str:
    """Of names, sizes and beginnings: whole clips can be gigabytes."""
    digest = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            digest.update(f"{path.name} {path.stat().st_size} ".encode() + file.read(1 << 16))
    return digest.hexdigest()[:8]


def _is_original(path: Path) -> bool:
    if path.stem in UNVERIFIED:
        return True
    return path.stem in ORIGINALS and hashlib.sha256(path.read_bytes()).hexdigest() == ORIGINALS[path.stem]
