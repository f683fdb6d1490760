"""FrameReplayBuffer beside SB3's replay buffer in both its modes, and beside the compressed one of sb3-extra-buffers.

All hold the same noise, which no compression makes smaller: what the compressed one needs for noise is the most it can need.
"""

import gc
import mmap
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from importlib.util import find_spec
from itertools import count, cycle, islice
from typing import Any, NamedTuple

import numpy as np
import psutil
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer

from benchmarks.interleave import Work, in_fresh_process, interleave, keep_memory
from benchmarks.networks import EPISODE, PAPER, NoiseFrames
from benchmarks.report import Target, judged, spread
from sb3_crc import FrameReplayBuffer
from sb3_crc.augmentations import random_crop
from sb3_crc.buffers.store import SLACK
from sb3_crc.memory import available_memory

SIZES = (1_000, 10_000, 100_000)
OURS, OPTIMIZED, STOCK = "FrameReplayBuffer", "SB3 optimize_memory_usage", "SB3"
#: What its README recommends for images: "for noisy input (mostly RGB), zstd", and of its levels, "personally zstd-3"
COMPRESSED = "sb3-extra-buffers zstd-3"
#: Buffer -> frames that it stores for each transition
FRAMES = {OURS: 1 + SLACK, OPTIMIZED: 3, STOCK: 6, COMPRESSED: 6}
FRAME_COPY = "frame copy"
FRAME_SHAPE = (NoiseFrames.frame_channels, PAPER.frame_size, PAPER.frame_size)
FRAME_BYTES = int(np.prod(FRAME_SHAPE))

#: Bytes that stay free, and those of a process that holds no buffer yet
SPARE, PROCESS = 2e9, 3e8
#: Transitions that are added before the ring counts as full, as a share of its size: ours has a few more places than those
FILL = 1.05
#: Additions that are timed together: so few that seldom another program comes between them, and so many that each time the
#: kernel clears one of the 2 MB pages that SB3's arrays get
BURST = 25

#: After a buffer's name: that of the smallest size, timed beside it
SMALLEST = ", smallest"
TARGETS = [Target("add - copy us", 60), Target("growing add - copy us", 60), Target("sample ms", 8), Target("/ smallest", 1.5)]
#: Transitions -> what is to be reached besides
TARGETS_AT = {100_000: [Target("resident MB", 3_200)]}

Transition = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]


class Growth(NamedTuple):
    """
    What an empty buffer costs until it is full.

    :param resident: memory that the full buffer has taken, in bytes
    :param add: seconds that an addition takes while memory is touched for the first time
    :param copy: seconds that a copy of one frame to such memory takes
    """

    resident: int
    add: float
    copy: float


class Figures(NamedTuple):
    """
    What is measured with buffers of one size.

    :param size: in transitions
    :param growth: of those buffers that memory can hold
    :param sample: seconds of each round
    :param add: seconds of an addition to a full buffer, and of a copy of one frame into a ring of ``size`` frames
    """

    size: int
    growth: dict[str, Growth]
    sample: dict[str, list[float]]
    add: dict[str, float]


def measure(
    sizes: Sequence[int] = SIZES,
    *,
    repeats: int,
    batch_size: int = 128,
    peers: Sequence[str] = tuple(FRAMES),
    tell: Callable[[str], object] = lambda what: None,
) -> list[dict[str, Any]]:
    """
    :param sizes: of the buffers, in transitions
    :param repeats: rounds, in each of which every buffer is timed once
    :param batch_size: transitions that are sampled at once
    :param peers: of :data:`FRAMES`
    :param tell: told what is measured now
    :return: a row per size and peer; of a buffer that free memory cannot hold the computed size, without times
    """
    rows = []
    for size in sizes:
        figures = measure_size(size, min(sizes), repeats, batch_size, [name for name in peers if installed(name)], tell)
        rows += [_row(name, figures) for name in peers]
    return rows


def measure_size(
    size: int, smallest: int, repeats: int, batch_size: int, peers: Sequence[str], tell: Callable[[str], object]
) -> Figures:
    """:return: what is measured with buffers of ``size`` transitions, and of the ``smallest`` beside them"""
    growth = {}
    for name in peers:
        if computed(name, size) + PROCESS <= available_memory() - SPARE:
            tell(f"{size} transitions: filling {name}")
            growth[name] = in_fresh_process(partial(grow, name, size))
    timed = _at_once(list(growth), size, smallest)
    on_round = lambda what: lambda done: tell(f"{size} transitions: {what}, {done} of {repeats}")  # noqa: E731

    samplers: dict[str, Callable[[], Work]] = {name: partial(sampling, name, size, batch_size) for name in timed}
    if size > smallest:
        samplers |= {f"{name}{SMALLEST}": partial(sampling, name, smallest, batch_size) for name in timed}
    sample = interleave(samplers, repeats=repeats, on_round=on_round("sampling"))
    adders: dict[str, Callable[[], Work]] = {name: partial(adding, name, size) for name in timed}
    adders[FRAME_COPY] = partial(copying, size)
    add = interleave(adders, repeats=repeats, on_round=on_round("adding"))
    return Figures(size, growth, sample, {name: statistics.median(seconds) / BURST for name, seconds in add.items()})


def _row(name: str, figures: Figures) -> dict[str, Any]:
    size, growth, sample, add = figures
    row: dict[str, Any] = {"transitions": size, "buffer": name}
    if not installed(name):
        return {**row, "note": "not installed"}
    resident, stock = (growth[buffer].resident if buffer in growth else computed(buffer, size) for buffer in (name, STOCK))
    row |= {"resident MB": resident / 1e6, "/ SB3": resident / stock}
    if name in add:
        row |= _additions("", add[name], add[FRAME_COPY])
    if name in growth:
        row |= _additions("growing ", growth[name].add, growth[name].copy)
    if name in sample:
        row |= {f"sample {column}": value for column, value in spread(sample[name]).items()}
    if f"{name}{SMALLEST}" in sample:
        pairs = zip(sample[name], sample[f"{name}{SMALLEST}"], strict=True)
        row["/ smallest"] = statistics.median(mine / small for mine, small in pairs)
    if name not in growth:
        row["note"] = "computed: does not fit"
    elif name not in add:
        row["note"] = "does not fit beside the others"
    elif name == COMPRESSED:
        row["note"] = "noise does not compress"
    targets = [*TARGETS, *TARGETS_AT.get(size, [])] if name == OURS else []
    return judged(row, [target for target in targets if target.figure in row])


def _additions(when: str, add: float, copy: float) -> dict[str, float]:
    return {f"{when}add us": 1e6 * add, f"{when}frame copy us": 1e6 * copy, f"{when}add - copy us": 1e6 * (add - copy)}


def installed(name: str) -> bool:
    """:return: whether the packages of this buffer are there: ``pip install "sb3-extra-buffers[zstd]"``"""
    return name != COMPRESSED or all(find_spec(package) for package in ("sb3_extra_buffers", "zstd"))


def computed(name: str, size: int) -> int:
    """:return: bytes of the frames in a full buffer of ``size`` transitions"""
    return round(FRAMES[name] * size * FRAME_BYTES)


def _at_once(names: Sequence[str], size: int, smallest: int) -> list[str]:
    """:return: buffers that fit into memory together, each with its smallest version, beside a ring of frames"""
    chosen, room = [], available_memory() - SPARE - PROCESS - size * FRAME_BYTES
    for name in sorted(names, key=lambda name: computed(name, size)):
        room -= computed(name, size) + computed(name, smallest) + 2 * PROCESS
        if room >= 0:
            chosen.append(name)
    return chosen


def make(name: str, size: int) -> ReplayBuffer:
    """:return: an empty buffer, for ``size`` transitions of :class:`~benchmarks.networks.NoiseFrames`"""
    world = NoiseFrames(PAPER.frame_size)
    spaces = world.observation_space, world.action_space
    if name == OURS:
        return FrameReplayBuffer(size, *spaces, "cpu", frame_channels=world.frame_channels)
    if name == OPTIMIZED:
        return ReplayBuffer(size, *spaces, "cpu", optimize_memory_usage=True, handle_timeout_termination=False)
    if name == STOCK:
        return ReplayBuffer(size, *spaces, "cpu")
    from sb3_extra_buffers.compressed import CompressedReplayBuffer, find_buffer_dtypes

    method = COMPRESSED.split()[-1]
    dtypes = find_buffer_dtypes(world.observation_space.shape, np.uint8, method)
    buffer: ReplayBuffer = CompressedReplayBuffer(size, *spaces, "cpu", dtypes=dtypes, compression_method=method)
    return buffer


def episode() -> list[Transition]:
    """:return: arguments of :meth:`ReplayBuffer.add`, drawn beforehand"""
    world = NoiseFrames(PAPER.frame_size)
    action = np.zeros(1, np.float32)
    transitions = []
    obs, _ = world.reset()
    for _ in range(EPISODE):
        next_obs, reward, terminated, truncated, _ = world.step(action)
        infos = [{"TimeLimit.truncated": truncated}]
        done = np.array([terminated or truncated])
        transitions.append((obs[None], next_obs[None], action[None], np.array([reward], np.float32), done, infos))
        obs = next_obs
    return transitions


def add_all(buffer: ReplayBuffer, transitions: Iterable[Transition]) -> None:
    """Store one after the other."""
    for transition in transitions:
        buffer.add(*transition)


def filled(name: str, size: int) -> ReplayBuffer:
    """:return: a full buffer, all of whose memory has been written"""
    buffer = make(name, size)
    add_all(buffer, islice(cycle(episode()), round(FILL * size)))
    return buffer


def grow(name: str, size: int) -> Growth:
    """
    Fill a buffer, in a process that has done nothing before.

    :param name: of the buffer
    :param size: in transitions
    :return: medians over bursts
    """
    transitions = cycle(episode())
    add_all(make(name, 2), islice(transitions, EPISODE))  # code and its libraries are not the buffer's
    gc.collect()
    before = psutil.Process().memory_info().rss
    buffer = make(name, size)
    adds, copies = [], []
    for start in range(0, round(FILL * size), BURST):
        burst = list(islice(transitions, BURST))
        seconds = _seconds(partial(add_all, buffer, burst)) / BURST
        if start + BURST <= size:
            adds.append(seconds)
            copies.append(_copy_to_new_memory(burst))
    gc.collect()
    return Growth(psutil.Process().memory_info().rss - before, statistics.median(adds), statistics.median(copies))


def _copy_to_new_memory(transitions: Sequence[Transition]) -> float:
    """:return: seconds per frame"""
    memory = mmap.mmap(-1, len(transitions) * FRAME_BYTES)  # which, unlike malloc's, is new every time
    ring = np.frombuffer(memory, np.uint8).reshape(-1, *FRAME_SHAPE)
    return _seconds(partial(_copy_all, ring, transitions, 0)) / len(transitions)


def _copy_all(ring: np.ndarray, transitions: Iterable[Transition], start: int) -> None:
    for place, transition in enumerate(transitions, start):
        ring[place % len(ring)] = transition[1][0, -FRAME_SHAPE[0] :]


def _seconds(work: Work) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def sampling(name: str, size: int, batch_size: int) -> Work:
    """:return: a batch with crops of o_t and o_{t+1}, with the allocator as :meth:`CRCSAC.learn` sets it, for all buffers"""
    buffer = filled(name, size)
    sample = buffer.sample_frames if isinstance(buffer, FrameReplayBuffer) else buffer.sample
    keep_memory()

    def work() -> None:
        samples: Any = sample(batch_size)
        random_crop(samples.observations, PAPER.input_size)
        random_crop(samples.next_observations, PAPER.input_size)

    return work


def adding(name: str, size: int) -> Work:
    """:return: ``BURST`` transitions added to a full buffer"""
    buffer, transitions = filled(name, size), cycle(episode())
    return lambda: add_all(buffer, islice(transitions, BURST))


def copying(size: int) -> Work:
    """:return: the newest frames of ``BURST`` transitions copied into a ring of ``size`` frames, one after the other"""
    ring = th.zeros((size, *FRAME_SHAPE), dtype=th.uint8).fill_(1).numpy()  # in such memory as ours
    transitions, starts = cycle(episode()), count(0, BURST)
    return lambda: _copy_all(ring, islice(transitions, BURST), next(starts))
