"""How the time of an update grows with the batch and with the images. With the buffer's fill: :mod:`benchmarks.buffer`."""

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from benchmarks.interleave import Work, in_fresh_process, interleave, keep_memory
from benchmarks.networks import PAPER, Networks
from benchmarks.report import Target, judged, spread
from benchmarks.update import count

BATCH_SIZES = (64, 128, 256, 512)
INPUT_SIZES = (64, 84, 100)
#: The batch that the others are compared with, and at which the images vary
BATCH = 128
#: Pixels that frames are larger than the input that is cropped out of them
MARGIN = 16
POLICY_DELAY = 2
#: Time per sample of the largest batch, and per needed operation of any input, against those of the reference
LARGEST_BATCH, ANY_INPUT = 1.0, 1.3


def measure(
    *,
    repeats: int,
    networks: Networks = PAPER,
    batch_sizes: Sequence[int] = BATCH_SIZES,
    input_sizes: Sequence[int] = INPUT_SIZES,
    on_round: Callable[[int], object] = lambda done: None,
) -> list[dict[str, Any]]:
    """
    :param repeats: rounds, in each of which every setting is timed once
    :param networks: whose input varies; its own is what the other inputs are compared with
    :param batch_sizes: B
    :param input_sizes: sides of the images that the encoder sees, in pixels
    :param on_round: told how many rounds are done
    :return: a row per batch size, with its time per sample, and one per input size, with its time per needed operation
    """
    reference = networks.input_size, BATCH
    batches = [(networks.input_size, batch_size) for batch_size in batch_sizes]
    inputs = [(size, BATCH) for size in input_sizes]
    programs: dict[str, Callable[[], Work]] = {
        _name(*setting): partial(update, networks, *setting) for setting in [reference, *batches, *inputs]
    }
    timed = interleave(programs, repeats=repeats, on_round=on_round)
    seconds = {name: [value / POLICY_DELAY for value in values] for name, values in timed.items()}
    counted = {_name(*setting): programs[_name(*setting)] for setting in [reference, *inputs]}
    needed = in_fresh_process(partial(count_all, counted))

    rows = []
    for size, batch_size in batches:
        own = seconds[_name(size, batch_size)]
        row: dict[str, Any] = {"varied": "batch", "input": size, "batch": batch_size, **spread(own)}
        column = f"/ batch {BATCH}"
        row |= {"ms per sample": row["ms"] / batch_size, column: _ratio(own, seconds[_name(*reference)]) * BATCH / batch_size}
        rows.append(judged(row, [Target(column, LARGEST_BATCH)] if batch_size == max(batch_sizes) else []))
    for size, batch_size in inputs:
        name = _name(size, batch_size)
        row = {"varied": "input", "input": size, "batch": batch_size, **spread(seconds[name])}
        row |= {"needed GFLOP": needed[name] / 1e9, "ms per GFLOP": row["ms"] / (needed[name] / 1e9)}
        times, operations = _ratio(seconds[name], seconds[_name(*reference)]), needed[name] / needed[_name(*reference)]
        column = f"/ input {networks.input_size}"
        rows.append(judged({**row, column: times / operations}, [Target(column, ANY_INPUT)]))
    return rows


def update(networks: Networks, input_size: int, batch_size: int) -> Work:
    """
    :param networks: whose frames and input are replaced
    :param input_size: side of what the encoder sees, in pixels
    :param batch_size: B
    :return: ``POLICY_DELAY`` updates of CRCSAC, as within :meth:`learn`
    """
    resized = replace(networks, frame_size=input_size + MARGIN, input_size=input_size)
    model = resized.crc_sac("crc", batch_size, policy_delay=POLICY_DELAY, image_size=input_size)
    keep_memory()
    return lambda: model.train(POLICY_DELAY, batch_size)


def count_all(programs: Mapping[str, Callable[[], Work]]) -> dict[str, float]:
    """:return: operations of one update of each"""
    return {name: count(program) / POLICY_DELAY for name, program in programs.items()}


def _name(input_size: int, batch_size: int) -> str:
    return f"input {input_size}, batch {batch_size}"


def _ratio(seconds: Sequence[float], reference: Sequence[float]) -> float:
    return statistics.median(mine / theirs for mine, theirs in zip(seconds, reference, strict=True))
