"""A comparison from its plan to its scores: what it needs, which engine executes it, how far it is."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch as th

from sb3_crc.atomic import atomic_write
from sb3_crc.console import errors, on_a_screen, tell
from sb3_crc.envs.rendering import probe
from sb3_crc.experiments.engines.execution import finished
from sb3_crc.experiments.engines.local import run_locally, threads_each, usable_cores
from sb3_crc.experiments.needs import RENDERERS, Needs, check_disk, measure_needs, most_at_once, nearest_existing
from sb3_crc.experiments.plans import Plan
from sb3_crc.experiments.runs import find_runs
from sb3_crc.experiments.specs import RunSpec
from sb3_crc.experiments.watching import Progress, progress_table, read_progress
from sb3_crc.memory import GIGABYTE
from sb3_crc.settings import check_name

ENGINES = ("local", "ray", "slurm")
#: Options that only some engines have
OWN_OPTIONS = {
    "jobs": ("local", "slurm"),
    "address": ("ray",),
    "cpus": ("ray", "slurm"),
    "gpus": ("ray", "slurm"),
    "memory": ("ray", "slurm"),
    "slurm": ("slurm",),
    "pack": ("local",),
}


@dataclass(frozen=True)
class Campaign:
    """
    How a comparison is executed. None leaves a choice to the engine.

    :param engine: one of :data:`ENGINES`
    :param jobs: runs at once; None: as many as cores, memory and GPU allow
    :param address: of a Ray cluster; None: this machine
    :param cpus: cores of each run; None: one
    :param gpus: of each run; Ray shares one that is given in fractions
    :param memory: gigabytes of each run; None: what is measured
    :param slurm: parameters of submitit's SlurmExecutor, and ``cluster``
    :param checkpoint_every: agent steps between two checkpoints of a run
    :param pack: fill a GPU: as many runs as its memory and the cores allow, of which a few draw on it
        (:data:`~sb3_crc.experiments.needs.RENDERERS`) and the others with OSMesa
    :raises ValueError: for an unknown engine, an option that it does not have, or a value that cannot work
    """

    engine: str = "local"
    jobs: int | None = None
    address: str | None = None
    cpus: int | None = None
    gpus: float | None = None
    memory: float | None = None
    slurm: Mapping[str, Any] = field(default_factory=dict)
    checkpoint_every: int = 1_000
    pack: bool | None = None

    def __post_init__(self) -> None:
        check_name("--engine", self.engine, ENGINES)
        for name, engines in OWN_OPTIONS.items():
            if getattr(self, name) not in (None, {}) and self.engine not in engines:
                raise ValueError(f"--{name} is an option of --engine {' and '.join(engines)}; this is --engine {self.engine}")
        if self.engine == "slurm" and self.gpus is not None and self.gpus != round(self.gpus):
            raise ValueError(f"--gpus {self.gpus}: Slurm gives whole GPUs")
        if self.pack and not th.cuda.is_available():
            raise ValueError("--pack fills a GPU, and there is none that torch can use; `python -m sb3_crc doctor` shows more")
        if not isinstance(minutes := self.slurm.get("timeout_min", 1), int) or minutes < 1:
            raise ValueError(f"--slurm timeout_min={minutes} must be a whole number of minutes, at least 1")

    @property
    def measures(self) -> bool:
        """Whether what runs need is measured first: always on this machine, whose memory and disk they share."""
        return self.engine == "local" or self.memory is None


def parse_assignments(assignments: Sequence[str], flag: str) -> dict[str, Any]:
    """
    :param assignments: ``name=value``; numbers become numbers
    :param flag: where they come from
    :raises ValueError: for anything else, or a name that comes twice
    """
    found: dict[str, Any] = {}
    for one in assignments:
        name, equals, value = one.partition("=")
        if not equals or not name or not value:
            raise ValueError(f"{flag} {one!r} must be NAME=VALUE")
        if name in found:
            raise ValueError(f"{flag} {one!r}: {name} is there twice")
        found[name] = int(value) if value.isdigit() else value
    return found


def check_folder(root: Path) -> None:
    """
    :param root: where runs will be written; it need not exist
    :raises ValueError: if nothing can be written there
    """
    existing = nearest_existing(root)
    try:
        if not existing.is_dir():
            raise NotADirectoryError(f"{existing} is a file")
        with atomic_write(existing / ".sb3-crc-can-write") as unfinished:
            unfinished.touch()
        (existing / ".sb3-crc-can-write").unlink()
    except OSError as error:
        raise ValueError(f"nothing can be written to {root}: {error.strerror or error}") from None


def plan(specs: Sequence[RunSpec], root: Path, how: Campaign) -> Plan:
    """
    :param specs: of a comparison
    :param root: folder of its runs
    :param how: it would be executed
    :return: what is to be done. Nothing is started but the measurement of a few seconds of each kind of run
    """
    waiting = [spec for spec in specs if not finished(root / spec.name)]
    jobs, threads, needs, reasons = _resources(waiting, how)
    return Plan(specs, root, waiting, jobs, threads if how.engine == "local" else None, needs, reasons)


def execute(specs: Sequence[RunSpec], root: Path, how: Campaign) -> list[RunSpec]:
    """
    Work off a comparison; what is finished stays as it is.

    :param specs: of it
    :param root: folder of its runs
    :param how: it is executed
    :return: runs that failed
    :raises ValueError: if the folder, its disk or the engine will not do
    :raises Stopped: on SIGINT or SIGTERM
    """
    check_folder(root)
    waiting = [spec for spec in specs if not finished(root / spec.name)]
    jobs, _, needs, _ = _resources(waiting, how) if how.measures else (how.jobs or 1, 1, {}, {})
    check_disk(list(needs.values()), root)
    root.mkdir(parents=True, exist_ok=True)

    def report(spec: RunSpec, event: str, remark: str) -> None:
        done = sum(finished(root / one.name) for one in specs)
        tell(f"[{done}/{len(specs)}] {spec.name}: {event}{remark and f' {remark}'}")

    with _shown(root, specs):
        return _engine(how, jobs, needs)(specs, root, checkpoint_every=how.checkpoint_every, report=report)


def _engine(how: Campaign, jobs: int, needs: Mapping[str, Needs]) -> Callable[..., list[RunSpec]]:
    measured = max((one.memory for one in needs.values()), default=None)
    memory = measured if how.memory is None else round(how.memory * GIGABYTE)
    if how.engine == "ray":
        from sb3_crc.experiments.engines.ray_cluster import RayOptions, run_on_ray

        return partial(
            run_on_ray, options=RayOptions(address=how.address, cpus=how.cpus or 1, gpus=how.gpus or 0.0, memory=memory)
        )
    if how.engine == "slurm":
        from sb3_crc.experiments.engines.slurm import SlurmOptions, run_on_slurm

        parameters = dict(how.slurm)
        options = SlurmOptions(
            cluster=str(parameters.pop("cluster", "slurm")),
            minutes=parameters.pop("timeout_min", SlurmOptions.minutes),
            cpus=how.cpus or 1,
            gpus=round(how.gpus or 0),
            memory=memory,
            at_once=how.jobs,
            parameters=parameters,
        )
        return partial(run_on_slurm, options=options)
    return partial(run_locally, jobs=jobs, renderers=RENDERERS if how.pack else None)


def _resources(waiting: Sequence[RunSpec], how: Campaign) -> tuple[int, int, dict[str, Needs], dict[str, str]]:
    """:return: runs at once, threads of each, their needs, and why some cannot begin"""
    if not waiting:
        return how.jobs or 1, 1, {}, {}
    likely = how.jobs or min(len(waiting), usable_cores())
    threads = threads_each(likely) if how.engine == "local" else how.cpus or 1
    tell(f"measuring what runs need: a few seconds of each kind, with {threads} threads")
    needs, reasons = measure_needs(waiting, threads)
    drawing = None if how.pack and probe("osmesa").draws else RENDERERS
    jobs = how.jobs or min(len(waiting), most_at_once(list(needs.values()), renderers=drawing))
    return jobs, threads_each(jobs) if how.engine == "local" else threads, needs, reasons


@contextmanager
def _shown(root: Path, specs: Sequence[RunSpec]) -> Iterator[None]:
    """Within it a table of all runs, and of all together, stands in a terminal below what is said."""
    if not on_a_screen(errors):
        yield
        return
    from rich.live import Live

    last: list[Progress] = []

    def look() -> Any:
        with suppress(ValueError, FileNotFoundError):  # a file is just being written
            last[:] = [_progress(spec, root / spec.name) for spec in specs]
        return progress_table(last)

    with Live(get_renderable=look, console=errors, refresh_per_second=0.5):
        yield


def _progress(spec: RunSpec, folder: Path) -> Progress:
    begun = next(find_runs([folder]), None) if folder.is_dir() else None
    if begun is not None:
        return read_progress(begun)
    return Progress(f"{spec.method}, {spec.task}, seed {spec.seed}", "waiting", 0, spec.agent_steps, None, (), None, {})
