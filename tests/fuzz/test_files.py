"""Files with flipped bits and cut ends: they are read, or one clear error says why not, and nothing that was whole is lost."""

import json
import shutil
import tempfile
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from sb3_crc import CRCSAC, FrameReplayBuffer
from sb3_crc.checkpoints.callback import TrainingCheckpoint
from sb3_crc.checkpoints.store import CheckpointError, CheckpointStore
from sb3_crc.export import PolicyFileError, export_policy, load_policy
from tests.conftest import make_model
from tests.fuzz.documented import quietly
from tests.fuzz.tiers import tiers

DAMAGE = st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 7)), max_size=3)


def damaged(content: bytes, flips: list[tuple[float, int]], kept: float) -> bytes:
    changed = bytearray(content)
    for where, bit in flips:
        changed[int(where * len(changed))] ^= 1 << bit
    return bytes(changed[: round(kept * len(changed))])


@lru_cache
def saved() -> dict[str, Any]:
    """A policy, a model, and a folder of checkpoints, all of a tiny training."""
    folder = Path(tempfile.mkdtemp())
    model = make_model()
    model.save(folder / "model.zip")
    export_policy(model, folder / "policy.sb3crc")
    checkpoint = TrainingCheckpoint(folder / "checkpoints", every=8)
    model.learn(24, callback=checkpoint)
    return {"folder": folder, "observation": np.zeros((9, 40, 40), np.uint8)}


KEPT = st.just(1.0) | st.floats(0, 1)


def check_policies(flips: list[tuple[float, int]], kept: float) -> None:
    """A damaged policy is refused, or acts with finite numbers."""
    about = saved()
    path = about["folder"] / "damaged.sb3crc"
    path.write_bytes(damaged((about["folder"] / "policy.sb3crc").read_bytes(), flips, kept))
    try:
        policy = load_policy(path, "cpu")
    except PolicyFileError:
        return
    assert np.isfinite(policy.predict(about["observation"], deterministic=True)[0]).all()


test_policies, test_policies_long = tiers(2_000, flips=DAMAGE, kept=KEPT)(check_policies)


def check_models(flips: list[tuple[float, int]], kept: float) -> None:
    """A damaged model is refused, or was damaged where it does not matter: every member of the zip has a checksum."""
    about = saved()
    path = about["folder"] / "damaged.zip"
    path.write_bytes(damaged((about["folder"] / "model.zip").read_bytes(), flips, kept))
    with quietly():
        try:
            model = CRCSAC.load(path, device="cpu", safe=True)
        except ValueError:
            return
    assert np.isfinite(model.predict(about["observation"], deterministic=True)[0]).all()


test_models, test_models_long = tiers(1_000, flips=DAMAGE, kept=KEPT)(check_models)


def check_checkpoints(flips: list[tuple[float, int]], kept: float, file: float, older_too: bool) -> None:
    """Damage of the newest checkpoint leads to the one before; damage of all of them is said."""
    about = saved()
    folder = about["folder"] / "damaged"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(about["folder"] / "checkpoints", folder)
    newest, older = CheckpointStore(folder).names()
    changed = False
    for name in (newest, older) if older_too else (newest,):
        files = sorted((folder / name).iterdir())
        path = files[int(file * len(files))]
        before = path.read_bytes()
        path.write_bytes(damaged(before, flips, kept))
        changed |= path.read_bytes() != before
    with quietly():
        try:
            found = CheckpointStore(folder).newest()
        except CheckpointError:
            assert older_too or "format" in str(found_format(folder / newest))
            return
    assert found is not None and (found.path.name == newest or changed)


def found_format(folder: Path) -> str:
    with suppress(ValueError, OSError):
        return "format" if json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["format"] > 1 else ""
    return ""


test_checkpoints, test_checkpoints_long = tiers(
    2_000, flips=DAMAGE, kept=KEPT, file=st.floats(0, 1, exclude_max=True), older_too=st.booleans()
)(check_checkpoints)


def check_buffers(flips: list[tuple[float, int]], kept: float) -> None:
    """A damaged archive of a replay buffer is refused, and the buffer then stays as it was; or it was not damaged."""
    about = saved()
    model = make_model()
    path = about["folder"] / "buffer.zip"
    if not path.exists():
        with path.open("wb") as file:
            model.save_replay_buffer(file)
    changed = about["folder"] / "damaged-buffer.zip"
    changed.write_bytes(damaged(path.read_bytes(), flips, kept))
    buffer = model.replay_buffer
    assert isinstance(buffer, FrameReplayBuffer)
    before = buffer.size(), buffer.observations.copy()
    with changed.open("rb") as file:
        try:
            model.load_replay_buffer(file)
        except (ValueError, FileNotFoundError):
            assert buffer.size() == before[0] and np.array_equal(buffer.observations, before[1])


test_buffers, test_buffers_long = tiers(500, flips=DAMAGE, kept=KEPT)(check_buffers)


def test_undamaged_files_are_read() -> None:
    """Else the checks above would show nothing."""
    folder = saved()["folder"]
    load_policy(folder / "policy.sb3crc", "cpu")
    CRCSAC.load(folder / "model.zip", device="cpu", safe=True)
    assert len(CheckpointStore(folder / "checkpoints").names()) == 2
    assert CheckpointStore(folder / "checkpoints").newest() is not None
    check_buffers([], 1.0)
    with (folder / "buffer.zip").open("rb") as file:
        make_model().load_replay_buffer(file)
