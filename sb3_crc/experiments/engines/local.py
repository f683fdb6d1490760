"""Runs in processes of this machine, several at once, each taken up where it stopped."""

import os
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sb3_crc.experiments.engines.execution import InUse, Report, RunProcess, finished, plan, stop_all
from sb3_crc.experiments.specs import RunSpec


class Stopped(KeyboardInterrupt):
    """A signal ended the comparison; every run has saved a checkpoint or will begin anew. ``signum`` says which."""

    def __init__(self, signum: int):
        super().__init__(f"stopped by signal {signum}")
        self.signum = signum


def run_locally(
    specs: Sequence[RunSpec],
    root: Path,
    *,
    jobs: int = 1,
    checkpoint_every: int = 1_000,
    report: Report = lambda *_: None,
    renderers: int | None = None,
) -> list[RunSpec]:
    """
    Train and evaluate what is not finished yet. A run that fails leaves ``failure.json`` and does not stop the others; one
    that another command is working on is skipped, and counts as failed here.

    :param specs: of the comparison; the same call again goes on where this one stopped
    :param root: folder of its runs
    :param jobs: how many at once; each has its share of the cores
    :param checkpoint_every: agent steps between two checkpoints of a run
    :param report: is told what happens
    :param renderers: how many may draw on the GPU at the same time, if each is to be watched; the others draw with OSMesa,
        and so does one whose first frame does not come. None: each chooses for itself
    :return: the runs that failed
    :raises Stopped: on SIGINT or SIGTERM, once every run has saved
    """
    waiting = plan(specs, root)
    running: list[RunProcess] = []
    failed: list[RunSpec] = []
    with caught_signals() as caught:
        try:
            while (waiting or running) and not caught:
                while waiting and len(running) < jobs:
                    backends: list[str] = []
                    if renderers is not None:
                        on_gpu = sum(run.backends[0] == "egl" for run in running)
                        backends = ["egl", "osmesa"] if on_gpu < renderers else ["osmesa"]
                    own: dict[str, Any] = {"threads": threads_each(jobs), "report": report, "backends": backends}
                    run = RunProcess(waiting.pop(0), root, checkpoint_every=checkpoint_every, **own)
                    try:
                        run.start()
                    except InUse as error:
                        report(run.spec, "skipped", str(error))
                        failed.append(run.spec)
                        continue
                    running.append(run)
                time.sleep(0.1)
                for run in [run for run in running if not run.poll()]:
                    running.remove(run)
                    if not finished(run.folder):
                        failed.append(run.spec)
        finally:
            stop_all(running)
    if caught:
        raise Stopped(caught[0])
    return failed


def usable_cores() -> int:
    """:return: cores that this process may use"""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads_each(jobs: int) -> int:
    """:param jobs: runs at once; :return: threads of each: its share of the cores, or what OMP_NUM_THREADS says"""
    try:
        return max(1, int(os.environ["OMP_NUM_THREADS"]))
    except (KeyError, ValueError):
        return max(1, usable_cores() // jobs)


@contextmanager
def caught_signals() -> Iterator[list[int]]:
    """:return: a list in which the first signal that asks for the end will stand; the second one interrupts as ever"""
    caught: list[int] = []

    def handle(signum: int, frame: Any) -> None:
        if caught:
            raise KeyboardInterrupt
        caught.append(signum)

    before = {signum: signal.signal(signum, handle) for signum in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield caught
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)
