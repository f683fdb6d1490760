"""Runs of a comparison in processes of their own, several at once, each taken up where it stopped.

A run is two commands: ``train`` of the zoo, with checkpoints, and ``evaluate`` for the score of its final policy.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TextIO

import yaml

from sb3_crc.envs.tasks import environment_id
from sb3_crc.experiments.runs import FAILURE, FINAL, SPEC, read_json, write_json
from sb3_crc.experiments.specs import RunSpec

LOG, SETTINGS = "log.txt", "settings.yml"
CHECKPOINTS, FLAGS, DONE = "checkpoints", "flags.json", "DONE"
#: A training that was told to stop saves a checkpoint first
PATIENCE = 60.0

#: What happened to a run: begun, resumed, finished or failed, and a remark
Report = Callable[[RunSpec, str, str], None]


class Stopped(KeyboardInterrupt):
    """A signal ended the comparison; every run has saved a checkpoint or will begin anew. ``signum`` says which."""

    def __init__(self, signum: int):
        super().__init__(f"stopped by signal {signum}")
        self.signum = signum


@dataclass
class _Job:
    spec: RunSpec
    folder: Path
    process: subprocess.Popen[bytes]
    log: TextIO
    trains: bool


def plan(specs: Sequence[RunSpec], root: Path) -> list[RunSpec]:
    """
    Write what each run is to be into its folder.

    :param specs: of the comparison
    :param root: folder of its runs
    :return: those that are not finished
    """
    for spec in specs:
        folder = root / spec.name
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / SPEC).exists():
            settings = {environment_id(spec.task): {"n_timesteps": spec.agent_steps, **spec.settings}}
            (folder / SETTINGS).write_text(yaml.safe_dump(settings, sort_keys=False), encoding="utf-8")
            write_json(asdict(spec), folder / SPEC)
    return [spec for spec in specs if not finished(root / spec.name)]


def finished(folder: Path) -> bool:
    """:param folder: of one run of the comparison; :return: whether the score of its final policy is there"""
    return any(folder.glob(f"*/*/{FINAL}"))


def run_specs(
    specs: Sequence[RunSpec], root: Path, *, jobs: int = 1, checkpoint_every: int = 1_000, report: Report = lambda *_: None
) -> list[RunSpec]:
    """
    Train and evaluate what is not finished yet. A run that fails leaves ``failure.json`` and does not stop the others.

    :param specs: of the comparison; the same call again goes on where this one stopped
    :param root: folder of its runs
    :param jobs: how many at once; each has its share of the cores
    :param checkpoint_every: agent steps between two checkpoints of a run
    :param report: is told what happens
    :return: the runs that failed
    :raises Stopped: on SIGINT or SIGTERM, once every run has saved
    """
    waiting = plan(specs, root)
    running: list[_Job] = []
    failed: list[RunSpec] = []
    environment = {"OMP_NUM_THREADS": str(max(1, (os.cpu_count() or 1) // jobs)), **os.environ}
    with _signals() as caught:
        try:
            while (waiting or running) and not caught:
                while waiting and len(running) < jobs:
                    spec = waiting.pop(0)
                    running.append(_start(spec, root / spec.name, checkpoint_every, environment, report))
                time.sleep(0.1)
                for job in [job for job in running if job.process.poll() is not None]:
                    running.remove(job)
                    follower = _after(job, environment, report)
                    if follower is not None:
                        running.append(follower)
                    elif not finished(job.folder):
                        failed.append(job.spec)
        finally:
            _stop(running)
    if caught:
        raise Stopped(caught[0])
    return failed


def _start(spec: RunSpec, folder: Path, checkpoint_every: int, environment: dict[str, str], report: Report) -> _Job:
    (folder / FAILURE).unlink(missing_ok=True)
    run = next(iter(sorted(folder.glob("*/*_1"))), None)
    zoo = [sys.executable, "-m", "sb3_crc.zoo", "train"]
    if run is not None and (run / CHECKPOINTS / DONE).exists() and any(_final_models(run)):
        return _launch(spec, folder, _evaluation(run, spec), environment, trains=False)
    if run is not None and any((run / CHECKPOINTS).glob("[0-9]*")) and (run / CHECKPOINTS / FLAGS).exists():
        report(spec, "resumed", "")
        return _launch(spec, folder, [*zoo, "--resume", str(run)], environment, trains=True)
    if run is not None:  # ended before its first checkpoint
        shutil.rmtree(run)
    report(spec, "begun", "")
    flags = ["--algo", spec.preset, "--env", environment_id(spec.task), "--conf-file", str(folder / SETTINGS)]
    flags += ["-n", str(spec.agent_steps), "--seed", str(spec.seed), "-f", str(folder), "--verbose", "0"]
    flags += ["--eval-freq", str(spec.eval_every // spec.action_repeat), "--eval-episodes", str(spec.eval_episodes)]
    flags += ["--checkpoint-every", str(checkpoint_every)]
    return _launch(spec, folder, [*zoo, *flags], environment, trains=True)


def _after(job: _Job, environment: dict[str, str], report: Report) -> _Job | None:
    """:return: the evaluation that follows a training; None: the run is over"""
    job.log.close()
    status = job.process.returncode
    run = next(iter(sorted(job.folder.glob("*/*_1"))), None)
    if status == 0 and job.trains and run is not None:
        return _launch(job.spec, job.folder, _evaluation(run, job.spec), environment, trains=False)
    if status == 0 and run is not None and (run / FINAL).exists():
        returns = read_json(run / FINAL)["returns"]
        report(job.spec, "finished", f"{sum(returns) / len(returns):.1f}")
        return None
    lines = (job.folder / LOG).read_text(encoding="utf-8", errors="replace").strip().splitlines()
    failure = {"exit_code": status, "command": [str(part) for part in job.process.args], "last_lines": lines[-20:]}  # type: ignore[union-attr]
    write_json(failure, job.folder / FAILURE)
    report(job.spec, "failed", f"exit code {status}, {job.folder / LOG}: {lines[-1] if lines else 'no output'}")
    return None


def _evaluation(run: Path, spec: RunSpec) -> list[str]:
    return [sys.executable, "-m", "sb3_crc", "evaluate", str(run), "--episodes", str(spec.eval_episodes)]


def _final_models(run: Path) -> Iterator[Path]:
    return (path for path in run.glob("*.zip") if path.name != "best_model.zip")


def _launch(spec: RunSpec, folder: Path, command: list[str], environment: dict[str, str], *, trains: bool) -> _Job:
    log = (folder / LOG).open("a", encoding="utf-8")
    # in a session of its own: Ctrl-C reaches it through this process alone, once
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, env=environment, start_new_session=True
    )
    return _Job(spec, folder, process, log, trains)


def _stop(running: Sequence[_Job]) -> None:
    """Let every run save a checkpoint; whoever does not end then is killed, and goes on from the one before."""
    for job in running:
        if job.process.poll() is None:
            job.process.send_signal(signal.SIGTERM)
    deadline = time.monotonic() + PATIENCE
    for job in running:
        try:
            job.process.wait(max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            job.process.kill()
            job.process.wait()
        job.log.close()


@contextmanager
def _signals() -> Iterator[list[int]]:
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
