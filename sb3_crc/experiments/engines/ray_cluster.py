"""Runs as tasks of a Ray cluster. A run whose worker or node dies begins again elsewhere, from its last checkpoint.

Where the nodes share the folder of the comparison, runs work in it. Where they do not, a run works in a temporary folder of
its node, and an actor on the machine of the command keeps what it has written: :mod:`~sb3_crc.experiments.engines.keeping`.
"""

import logging
import os
import socket
import time
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_crc.experiments.engines.execution import Report, RunProcess, finished, plan, prepare
from sb3_crc.experiments.engines.keeping import EVERY, Keeper, working_copy
from sb3_crc.experiments.engines.local import Stopped, caught_signals
from sb3_crc.experiments.specs import RunSpec

#: Of the comparison's folder, by which a node recognises it
MARK = ".ray-{}"
#: Seconds in which an address must answer
PATIENCE = 5.0


class Killed(Exception):
    """A training was killed from outside: it is worth another attempt."""


@dataclass(frozen=True)
class RayOptions:
    """
    :param address: of a cluster, ``host:port`` or ``auto``, to which this machine belongs; None: Ray starts one here
    :param cpus: of each run, which are its threads too
    :param gpus: of each run; a fraction shares one
    :param memory: bytes that a run is given, so that not too many share a node; None: Ray does not count it
    :param retries: how often a run may die with its worker or node before it counts as failed
    :param shared: whether the nodes see the comparison's folder; None: each looks for itself
    :param keep_every: where they do not: seconds between two looks at what a run has written
    """

    address: str | None = None
    cpus: int = 1
    gpus: float = 0.0
    memory: int | None = None
    retries: int = 5
    shared: bool | None = None
    keep_every: float = EVERY


def run_on_ray(
    specs: Sequence[RunSpec],
    root: Path,
    options: RayOptions,
    *,
    checkpoint_every: int = 1_000,
    report: Report = lambda *_: None,
) -> list[RunSpec]:
    """
    As :func:`~sb3_crc.experiments.engines.local.run_locally`, on a cluster, as many at once as its nodes have room for.

    :param specs: of the comparison
    :param root: folder of its runs
    :param options: of the cluster
    :param checkpoint_every: agent steps between two checkpoints of a run
    :param report: is told what happens
    :return: the runs that failed
    :raises ValueError: if nothing answers at the address
    :raises Stopped: on SIGINT or SIGTERM; runs that were under way have their last checkpoint
    """
    root = root.absolute()
    waiting = plan(specs, root)
    if not waiting:
        return []
    connect(options.address)
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    mark = root / MARK.format(uuid.uuid4().hex)
    failed: list[RunSpec] = []
    try:
        mark.touch()
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
        keeper = ray.remote(num_cpus=0, scheduling_strategy=here)(Keeper).remote(str(root))
        task = ray.remote(_run_on_node).options(
            num_cpus=options.cpus,
            num_gpus=options.gpus,
            memory=options.memory,
            max_retries=options.retries,
            retry_exceptions=[Killed],
        )
        job = {"mark": str(mark), "shared": options.shared, "keeper": keeper, "keep_every": options.keep_every}
        job |= {"threads": options.cpus, "checkpoint_every": checkpoint_every, "workplace": os.getcwd()}
        with caught_signals() as caught:
            pending = {task.remote(spec, **job): spec for spec in waiting}
            for spec in waiting:
                report(spec, "submitted", "")
            while pending and not caught:
                for reference in ray.wait(list(pending), timeout=0.5)[0]:
                    spec = pending.pop(reference)
                    if not _collect(spec, reference, report):
                        failed.append(spec)
        if caught:
            raise Stopped(caught[0])
    finally:
        mark.unlink(missing_ok=True)
        ray.shutdown()
    return failed


def connect(address: str | None) -> None:
    """
    :param address: see :class:`RayOptions`
    :raises ValueError: if Ray is not installed, or nothing answers at the address
    """
    try:
        import ray
    except ImportError:
        raise ValueError("--engine ray needs the extra 'cluster': pip install 'sb3-crc[cluster]'") from None
    if address not in (None, "auto", "local"):
        assert address is not None
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit():
            raise ValueError(f"--address {address!r} is no address of a Ray cluster: host:port, or auto")
        try:
            socket.create_connection((host, int(port)), timeout=PATIENCE).close()
        except OSError as error:
            raise ValueError(f"no Ray cluster answers at {address}: {error}") from None
    try:
        ray.init(
            address=address, log_to_driver=False, include_dashboard=None if address else False, logging_level=logging.ERROR
        )
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise ValueError(f"no Ray cluster at {address}: {error}") from None


def _collect(spec: RunSpec, reference: Any, report: Report) -> bool:
    """:return: whether the run has finished"""
    import ray

    try:
        events = ray.get(reference)
    except (ray.exceptions.RayError, Killed) as error:
        report(spec, "failed", str(error).strip().splitlines()[-1])
        return False
    for event, remark in events:
        if event != "begun":  # long ago
            report(spec, event, remark)
    return bool(events) and events[-1][0] == "finished"


def _run_on_node(
    spec: RunSpec,
    *,
    mark: str,
    shared: bool | None,
    keeper: Any,
    keep_every: float,
    threads: int,
    checkpoint_every: int,
    workplace: str,
) -> list[tuple[str, str]]:
    """:return: what happened to a run: events and remarks; executed by a worker"""
    if os.path.isdir(workplace):
        os.chdir(workplace)  # from which Python imports the user's own modules
    root = Path(mark).parent
    if Path(mark).exists() if shared is None else shared:
        return _run_in(root, spec, threads, checkpoint_every)
    with working_copy(spec.name, keeper, every=keep_every) as own_root:
        return _run_in(own_root, spec, threads, checkpoint_every)


def _run_in(root: Path, spec: RunSpec, threads: int, checkpoint_every: int) -> list[tuple[str, str]]:
    events: list[tuple[str, str]] = []
    prepare(spec, root)
    if finished(root / spec.name):  # before its worker died
        return [("finished", "")]

    def note(_: RunSpec, event: str, remark: str) -> None:
        events.append((event, remark))

    run = RunProcess(spec, root, checkpoint_every=checkpoint_every, threads=threads, report=note)
    run.start()
    while run.poll():
        time.sleep(0.2)
    if run.exit_code is not None and run.exit_code < 0:
        raise Killed(f"{run.folder}: killed by signal {-run.exit_code}")
    return events
