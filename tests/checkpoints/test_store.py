"""Checkpoints on disk: which stay, and what a damaged one leads to."""

import errno
import json
from pathlib import Path
from typing import Any

import pytest

from sb3_crc import CRCSAC
from sb3_crc.checkpoints import store as store_module
from sb3_crc.checkpoints.store import MANIFEST, CheckpointError, CheckpointStore
from tests.checkpoints.runs import assert_equal, train


def test_only_the_newest_stay_and_segments_that_they_need(tmp_path: Path) -> None:
    train(tmp_path, keep=2)
    store = CheckpointStore(tmp_path)
    assert store.names() == ["000000000060", "000000000050"]
    needed = {name for checkpoint in store.names() for name in store._needed(checkpoint)}
    assert {path.name for path in store.segments.iterdir()} == needed
    assert not list(tmp_path.glob(".unfinished*"))


def test_colleagues_may_read_it(tmp_path: Path) -> None:
    (mine := tmp_path / "mine").touch()
    train(tmp_path / "run", stop=25)
    files = [path for path in (tmp_path / "run").rglob("*") if path.is_file()]
    assert {path.name for path in files} > {"arrays.safetensors", "structure.json", MANIFEST}
    assert {path.stat().st_mode for path in files} == {mine.stat().st_mode}


def damage(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))


@pytest.mark.parametrize("file", ["arrays.safetensors", "structure.json", "replay.npz", MANIFEST, "segment"])
def test_a_damaged_checkpoint_is_reported_and_the_one_before_used(file: str, tmp_path: Path, whole: CRCSAC) -> None:
    train(tmp_path, stop=45)
    store = CheckpointStore(tmp_path)
    newest, before = store.names()
    assert (newest, before) == ("000000000040", "000000000030")
    if file == "segment":  # one that only the newest needs
        (name,) = set(store._needed(newest)) - set(store._needed(before))
        damage(store.segments / name)
    elif file == MANIFEST:
        (tmp_path / newest / MANIFEST).write_text("{")
    else:
        damage(tmp_path / newest / file)
    with pytest.warns(UserWarning, match="000000000040 is damaged"):
        model = train(tmp_path, seed=5)
    assert_equal(model, whole)


def test_a_damaged_older_one_stops_no_training(whole: CRCSAC, tmp_path: Path) -> None:
    """Its manifest is looked into when others are deleted."""
    train(tmp_path, stop=45, keep=3)
    manifest = tmp_path / "000000000030" / MANIFEST
    manifest.write_text(manifest.read_text().replace('"segments"', '"segmentz"'))
    assert_equal(train(tmp_path, seed=1, keep=3), whole)


def test_where_all_are_damaged_nothing_is_lost_silently(tmp_path: Path) -> None:
    train(tmp_path, stop=45)
    for name in CheckpointStore(tmp_path).names():
        (tmp_path / name / "structure.json").unlink()
    with (
        pytest.warns(UserWarning, match="is damaged"),
        pytest.raises(CheckpointError, match="all checkpoints in .* are damaged"),
    ):
        train(tmp_path)


def test_a_later_format_is_refused(tmp_path: Path) -> None:
    train(tmp_path, stop=45)
    manifest = tmp_path / "000000000040" / MANIFEST
    manifest.write_text(json.dumps({**json.loads(manifest.read_text()), "format": 99}))
    with pytest.raises(CheckpointError, match="has format 99, this version of sb3_crc reads up to 1"):
        train(tmp_path)


def test_a_damaged_one_takes_no_place_of_those_that_follow(whole: CRCSAC, tmp_path: Path) -> None:
    train(tmp_path, stop=45)
    damage(tmp_path / "000000000040" / "structure.json")
    with pytest.warns(UserWarning, match="000000000040 is damaged"):
        train(tmp_path, seed=1, stop=35, every=3, keep=1)
    assert CheckpointStore(tmp_path).names() == ["000000000033"]
    assert_equal(train(tmp_path, seed=2), whole)


def test_frames_of_a_checkpoint_that_could_not_be_written_are_taken_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise each attempt would fill the disk further, with the same frames under other names."""
    written = store_module.write_tree

    def full(tree: Any, folder: Path) -> None:
        if monkeypatched:
            raise OSError(errno.ENOSPC, "No space left on device")
        written(tree, folder)

    monkeypatched = False
    monkeypatch.setattr(store_module, "write_tree", full)
    train(tmp_path, stop=15)
    store = CheckpointStore(tmp_path)
    needed = {path.name for path in store.segments.iterdir()}
    monkeypatched = True
    with pytest.warns(UserWarning, match="could not be written"):
        train(tmp_path)
    assert {path.name for path in store.segments.iterdir()} == needed
    monkeypatched = False
    assert store.newest().path.name == "000000000010"  # type: ignore[union-attr]
