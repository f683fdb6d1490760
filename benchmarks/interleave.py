"""Time several programs against one another: each in a process of its own, in turn, so that all share its moods."""

import ctypes
import gc
import multiprocessing
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from multiprocessing.connection import Connection
from typing import Any

from sb3_crc.memory import memory_kept

Work = Callable[[], object]


def interleave(
    programs: Mapping[str, Callable[[], Work]],
    *,
    repeats: int,
    calls: int = 1,
    threads: int | None = None,
    on_round: Callable[[int], object] = lambda done: None,
) -> dict[str, list[float]]:
    """
    Let each program work once, then each a second time, and so on; a process that is not at work sleeps.

    :param programs: name -> picklable function that sets up and returns the work to be timed
    :param repeats: rounds
    :param calls: of the work, per turn and timing
    :param threads: of torch; None: torch's choice
    :param on_round: told how many rounds are done
    :return: name -> seconds per call, of each round
    """
    context = multiprocessing.get_context("spawn")
    workers, pipes = [], {}
    try:
        for name, set_up in programs.items():
            pipes[name], other_end = context.Pipe()
            workers.append(context.Process(target=_serve, args=(other_end, set_up, calls, threads), daemon=True))
            workers[-1].start()
            other_end.close()
            _answer(pipes[name], name)  # ready; the next one is set up alone
        seconds: dict[str, list[float]] = {name: [] for name in programs}
        for done in range(1, repeats + 1):
            for name, pipe in pipes.items():
                pipe.send("work")
                seconds[name].append(_answer(pipe, name))
            on_round(done)
        return seconds
    finally:
        for pipe in pipes.values():
            pipe.close()  # which ends the process
        for worker in workers:
            worker.join(10)
            worker.kill()


def in_fresh_process(measure: Callable[[], Any]) -> Any:
    """:param measure: picklable; :return: what it returns, in a process that has done nothing before"""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(measure)


def keep_memory() -> None:
    """Set the allocator for the rest of this process as :meth:`~sb3_crc.CRCSAC.learn` sets it."""
    _whole_process.enter_context(memory_kept())


_whole_process = ExitStack()


def _answer(pipe: Connection, name: str) -> float:
    try:
        return float(pipe.recv())
    except EOFError:
        raise RuntimeError(f"{name}: its process has ended, see above") from None


def _serve(pipe: Connection, set_up: Callable[[], Work], calls: int, threads: int | None) -> None:
    import torch as th

    if threads is not None:
        th.set_num_threads(threads)
    work = set_up()
    pipe.send(0.0)
    while True:
        try:
            pipe.recv()
        except EOFError:
            return
        work()  # brings code and memory back
        start = time.perf_counter()
        for _ in range(calls):
            work()
        seconds = (time.perf_counter() - start) / calls
        gc.collect()
        if sys.platform == "linux":
            ctypes.CDLL(None).malloc_trim(0)  # the others need the memory
        pipe.send(seconds)
