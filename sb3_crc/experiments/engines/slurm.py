"""Runs as an array job of a Slurm cluster, by submitit. The folder of the comparison must be shared by the nodes.

A job that is preempted or comes to its time limit lets its training save a checkpoint and is queued again. The command waits
for its jobs, but they do not need it: the same command finds them again.
"""

import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from sb3_crc.experiments.engines.execution import PATIENCE, Report, RunProcess, finished, plan, prepare, stop_all
from sb3_crc.experiments.engines.local import Stopped, caught_signals
from sb3_crc.experiments.runs import read_json, write_json
from sb3_crc.experiments.specs import RunSpec

#: In a run's folder: the job that was submitted for it; in the comparison's folder: submitit's own files
JOB, FILES = "slurm.json", "slurm"
#: States in which a job will still do something, or is doing it
ALIVE = {"PENDING", "RUNNING", "CONFIGURING", "COMPLETING", "REQUEUED", "SUSPENDED"}
#: How often a job may come to its time limit
TIMEOUTS = 100


@dataclass(frozen=True)
class SlurmOptions:
    """
    :param cpus: of each run, which are its threads too
    :param gpus: of each run
    :param memory: bytes of each run; None: what the cluster gives
    :param minutes: after which a job has to make room, and is queued again
    :param at_once: runs at the same time; None: as many as the cluster lets
    :param retries: how often a run may die without a word before it counts as failed
    :param parameters: of submitit's SlurmExecutor: partition, account, constraint, ...
    :param cluster: submitit's name of what executes; ``local`` is this machine, for trying it out
    """

    cpus: int = 1
    gpus: int = 0
    memory: int | None = None
    minutes: int = 24 * 60
    at_once: int | None = None
    retries: int = 5
    parameters: Mapping[str, Any] = field(default_factory=dict)
    cluster: str = "slurm"


class SlurmRun:
    """
    What a job executes: one run, to its end.

    :param spec: of the run
    :param root: folder of the comparison
    :param threads: of torch
    :param checkpoint_every: agent steps between two checkpoints
    """

    def __init__(self, spec: RunSpec, root: Path, threads: int, checkpoint_every: int):
        self.spec, self.root, self.threads, self.checkpoint_every = spec, root, threads, checkpoint_every
        self._running: RunProcess | None = None

    def __call__(self) -> list[tuple[str, str]]:
        """:return: what happened: events and remarks"""
        events: list[tuple[str, str]] = []
        prepare(self.spec, self.root)
        run = RunProcess(
            self.spec,
            self.root,
            checkpoint_every=self.checkpoint_every,
            threads=self.threads,
            report=lambda _, event, remark: events.append((event, remark)),
        )
        run.start()
        self._running = run
        while run.poll():
            time.sleep(0.2)
        return events

    def checkpoint(self) -> Any:
        """:return: submitit is to queue this again; called before the job has to make room"""
        from submitit.helpers import DelayedSubmission

        if self._running is not None:
            stop_all([self._running])
        return DelayedSubmission(SlurmRun(self.spec, self.root, self.threads, self.checkpoint_every))


def run_on_slurm(
    specs: Sequence[RunSpec],
    root: Path,
    options: SlurmOptions,
    *,
    checkpoint_every: int = 1_000,
    report: Report = lambda *_: None,
) -> list[RunSpec]:
    """
    As :func:`~sb3_crc.experiments.engines.local.run_locally`, by Slurm.

    :param specs: of the comparison
    :param root: folder of its runs
    :param options: of the jobs
    :param checkpoint_every: agent steps between two checkpoints of a run
    :param report: is told what happens
    :return: the runs that failed
    :raises ValueError: if there is no Slurm here, or it does not take the options
    :raises Stopped: on SIGINT or SIGTERM; the jobs go on
    """
    root = root.absolute()
    executor = _executor(root, options)
    waiting = {spec.name: spec for spec in plan(specs, root)}
    jobs = {name: job for name in waiting if (job := _submitted(root / name, root / FILES)) is not None}
    for name, job in jobs.items():
        report(waiting[name], "found", f"in the queue as job {job.job_id}")
    attempts = dict.fromkeys(waiting, 1)

    submit = partial(
        _submit, root=root, executor=executor, threads=options.cpus, checkpoint_every=checkpoint_every, report=report
    )
    jobs |= submit([spec for name, spec in waiting.items() if name not in jobs])
    failed: list[RunSpec] = []
    with caught_signals() as caught:
        while jobs and not caught:
            time.sleep(0.5)
            for name, job in [(name, job) for name, job in jobs.items() if job.done()]:
                del jobs[name]
                spec, lost = waiting[name], not _has_result(job)
                if lost and not finished(root / name) and attempts[name] <= options.retries:
                    attempts[name] += 1
                    jobs |= submit([spec])
                elif not _collect(spec, root, job, report):
                    failed.append(spec)
    if caught:
        raise Stopped(caught[0])
    return failed


def _executor(root: Path, options: SlurmOptions) -> Any:
    try:
        import submitit
    except ImportError:
        raise ValueError("--engine slurm needs the extra 'cluster': pip install 'sb3-crc[cluster]'") from None
    if options.cluster == "slurm" and shutil.which("sbatch") is None:
        raise ValueError("there is no Slurm on this machine: sbatch is not in PATH")
    own = {f"slurm_{name}": value for name, value in options.parameters.items()}
    try:
        executor = submitit.AutoExecutor(root / FILES, cluster=options.cluster, slurm_max_num_timeout=TIMEOUTS)
        executor.update_parameters(
            name="sb3-crc",
            timeout_min=options.minutes,
            cpus_per_task=options.cpus,
            gpus_per_node=options.gpus or None,
            mem_gb=None if options.memory is None else options.memory / 2**30,
            slurm_array_parallelism=options.at_once,
            slurm_signal_delay_s=round(2 * PATIENCE),
            **own,
        )
    except (NameError, ValueError, RuntimeError, AssertionError) as error:
        raise ValueError(f"submitit does not take this: {str(error).splitlines()[0]}") from None
    return executor


def _submit(
    specs: Sequence[RunSpec], root: Path, executor: Any, threads: int, checkpoint_every: int, report: Report
) -> dict[str, Any]:
    """:return: name of each run -> its job; all are one array"""
    jobs: dict[str, Any] = {}
    if not specs:
        return jobs
    with executor.batch():
        for spec in specs:
            jobs[spec.name] = executor.submit(SlurmRun(spec, root, threads, checkpoint_every))
    for spec in specs:
        write_json({"job_id": jobs[spec.name].job_id, "cluster": executor.cluster}, root / spec.name / JOB)
        report(spec, "submitted", f"as job {jobs[spec.name].job_id}")
    return jobs


def _submitted(folder: Path, files: Path) -> Any:
    """:return: the job that an earlier command has submitted for a run and that is still in the queue; None: there is none"""
    if not (folder / JOB).exists():
        return None
    import submitit

    about = read_json(folder / JOB)
    if about["cluster"] != "slurm":
        return None
    job: Any = submitit.SlurmJob(folder=files, job_id=about["job_id"])
    return job if job.watcher.get_state(job.job_id, mode="force") in ALIVE else None


def _has_result(job: Any) -> bool:
    return bool(job.paths.result_pickle.exists())


def _collect(spec: RunSpec, root: Path, job: Any, report: Report) -> bool:
    """:return: whether the run has finished"""
    if not _has_result(job):
        if not finished(root / spec.name):
            report(spec, "failed", f"job {job.job_id} ended without a word, as those before it: {job.paths.stderr}")
    elif (error := job.exception()) is not None:
        report(spec, "failed", str(error).strip().splitlines()[-1])
    else:
        for event, remark in job.result():
            if event != "begun":  # long ago
                report(spec, event, remark)
    return finished(root / spec.name)
