"""What saving a training costs: how long it stands still, how long the writing beside it takes, and the disk."""

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

from benchmarks.end_to_end import TASK
from benchmarks.interleave import in_fresh_process
from benchmarks.networks import Networks, NoiseFrames
from benchmarks.report import Target, judged, spread
from sb3_crc import FrameReplayBuffer, TrainingCheckpoint, make_dmc
from sb3_crc.checkpoints.store import CheckpointStore

EVERY = 1_000
TARGETS = [Target("longest stall ms", 100), Target("longest writing s", 1), Target("disk / frames", 1.1)]


@dataclass
class Costs:
    """
    What the checkpoints of one run took.

    :param stalls: seconds for which training stood still, of each checkpoint
    :param writing: seconds of the writing beside the training, of each checkpoint
    :param frames: bytes of the frames that the replay buffer holds at the end
    :param segments: bytes of the files of frames at the end
    :param state: bytes of everything else at the end
    """

    stalls: list[float] = field(default_factory=list)
    writing: list[float] = field(default_factory=list)
    frames: int = 0
    segments: int = 0
    state: int = 0


def measure(
    *,
    networks: Networks,
    decisions: int,
    buffer_size: int | None = None,
    every: int = EVERY,
) -> dict[str, Any]:
    """
    Collect random decisions of a real task without updates, with a checkpoint now and then.

    :param networks: of the model that is saved
    :param decisions: in all
    :param buffer_size: of the replay buffer; None: as many as ``decisions``, so that it holds them all
    :param every: decisions between two checkpoints
    :return: a row
    """
    costs: Costs = in_fresh_process(partial(collect, networks, decisions, buffer_size or decisions, every))
    row: dict[str, Any] = {"networks": networks.name, "decisions": decisions, "buffer": buffer_size or decisions}
    row |= {f"stall {name}": value for name, value in spread(costs.stalls).items()}
    row |= {"longest stall ms": 1e3 * max(costs.stalls), "longest writing s": max(costs.writing)}
    row |= {"frames MB": costs.frames / 1e6, "segments / frames": costs.segments / costs.frames, "rest MB": costs.state / 1e6}
    row["disk / frames"] = (costs.segments + costs.state) / costs.frames
    return judged(row, TARGETS)


def collect(networks: Networks, decisions: int, buffer_size: int, every: int) -> Costs:
    """:return: what a run in this process measured"""
    costs = Costs()
    model = networks.crc_sac("crc", batch_size=2)
    env = make_dmc(TASK, seed=0, image_size=networks.frame_size, render_quality="fast")
    model.set_env(env)
    model.learning_starts = 10 * decisions
    spaces = model.observation_space, model.action_space
    model.replay_buffer = FrameReplayBuffer(buffer_size, *spaces, "cpu", frame_channels=NoiseFrames.frame_channels)
    with tempfile.TemporaryDirectory() as folder:
        callback = TrainingCheckpoint(folder, every)
        with (
            patch.object(TrainingCheckpoint, "_save", timed(TrainingCheckpoint._save, costs.stalls)),
            patch.object(CheckpointStore, "save", timed(CheckpointStore.save, costs.writing)),
        ):
            model.learn(decisions, callback=callback)
        sizes = {path: path.stat().st_size for path in Path(folder).rglob("*") if path.is_file()}
        costs.segments = sum(size for path, size in sizes.items() if path.parent == callback.store.segments)
        costs.state = sum(sizes.values()) - costs.segments
    frames = model.replay_buffer.store
    costs.frames = int(len(frames) * frames.frame_bytes)
    env.close()
    return costs


def timed(function: Callable[..., Any], seconds: list[float]) -> Callable[..., Any]:
    """:return: ``function``, each of whose calls adds its duration to ``seconds``"""

    def timed_function(*args: Any) -> Any:
        start = time.perf_counter()
        try:
            return function(*args)
        finally:
            seconds.append(time.perf_counter() - start)

    return timed_function
