"""One run as any engine executes it: ``train`` of the zoo, with checkpoints, then ``evaluate`` for the final policy's score.

Both are processes of their own, which end when the process that started them does, however that ends.
"""

import ctypes
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TextIO

import yaml
from filelock import FileLock, Timeout

from sb3_crc.envs.rendering import FIRST_FRAME, NO_FRAME
from sb3_crc.envs.tasks import environment_id
from sb3_crc.experiments.runs import CHECKPOINTS, DONE, FAILURE, FINAL, SPEC, read_json, write_json
from sb3_crc.experiments.specs import RunSpec

LOG, SETTINGS, LOCK, FLAGS = "log.txt", "settings.yml", "lock", "flags.json"
#: Seconds in which a training that was told to stop saves a checkpoint
PATIENCE = 60.0
#: Seconds in which a back end that was chosen for a run must draw
FIRST_FRAME_WITHIN = 60.0
#: prctl(2)
PR_SET_PDEATHSIG = 1

#: What happened to a run (begun, resumed, restarted, finished, failed, skipped; on a cluster submitted or found), and a remark
Report = Callable[[RunSpec, str, str], None]


def plan(specs: Sequence[RunSpec], root: Path) -> list[RunSpec]:
    """
    Write what each run is to be into its folder. What an interruption left half written there is written anew.

    :param specs: of the comparison
    :param root: folder of its runs
    :return: those that are not finished
    """
    for spec in specs:
        prepare(spec, root)
    return [spec for spec in specs if not finished(root / spec.name)]


def prepare(spec: RunSpec, root: Path) -> Path:
    """:param spec: of a run; :param root: folder of its comparison; :return: folder of the run, which says what it is to be"""
    folder = root / spec.name
    try:
        described = read_json(folder / SPEC) == asdict(spec) and (folder / SETTINGS).exists()
    except ValueError:
        described = False
    if not described:
        folder.mkdir(parents=True, exist_ok=True)
        settings = {environment_id(spec.task): {"n_timesteps": spec.agent_steps, **spec.settings}}
        (folder / SETTINGS).write_text(yaml.safe_dump(settings, sort_keys=False), encoding="utf-8")
        write_json(asdict(spec), folder / SPEC)
    return folder


def finished(folder: Path) -> bool:
    """:param folder: of one run of the comparison; :return: whether the score of its final policy is there"""
    return any(folder.glob(f"*/*/{FINAL}"))


class InUse(ValueError):
    """Another command is at work on this run."""


class RunProcess:
    """
    The processes of one run, one after the other. Only one of these, on any machine that shares the folder, works on it.

    :param spec: what it is to be
    :param root: folder of the comparison
    :param checkpoint_every: agent steps between two checkpoints
    :param threads: of torch
    :param report: is told what happens
    :param backends: OpenGL back ends to try, one after the other, where no first frame comes; none: the process chooses
    """

    def __init__(
        self,
        spec: RunSpec,
        root: Path,
        *,
        checkpoint_every: int,
        threads: int,
        report: Report = lambda *_: None,
        backends: Sequence[str] = (),
    ):
        self.spec = spec
        self.backends = list(backends)
        self.folder = root / spec.name
        self.checkpoint_every = checkpoint_every
        self.report = report
        #: Exit code of the last process; negative: the signal that killed it
        self.exit_code: int | None = None
        self._log_begin = 0
        self._environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "MKL_NUM_THREADS": str(threads)}
        self._process: subprocess.Popen[bytes] | None = None
        self._log: TextIO | None = None
        self._trains = False
        self._lock = FileLock(self.folder / LOCK)

    def start(self) -> None:
        """
        Begin it, or go on with it where it stopped.

        :raises InUse: if another one works on it
        """
        try:
            self._lock.acquire(timeout=0)
        except Timeout:
            raise InUse(f"{self.folder} is in use by another command") from None
        try:
            self._begin()
        except BaseException:
            self._lock.release()
            raise

    def _begin(self) -> None:
        (self.folder / FAILURE).unlink(missing_ok=True)
        run = self._run_folder()
        zoo = [sys.executable, "-m", "sb3_crc.zoo", "train"]
        if run is not None and (run / CHECKPOINTS / DONE).exists() and any(_final_models(run)):
            self._launch(self._evaluation(run), trains=False)
            return
        if run is not None and any((run / CHECKPOINTS).glob("[0-9]*")) and (run / CHECKPOINTS / FLAGS).exists():
            _wait_until_left(run / CHECKPOINTS / LOCK)
            self.report(self.spec, "resumed", "")
            self._launch([*zoo, "--resume", str(run)], trains=True)
            return
        if run is not None:  # ended before its first checkpoint
            _wait_until_left(run / CHECKPOINTS / LOCK)
            shutil.rmtree(run)
        self.report(self.spec, "begun", "")
        self._launch([*zoo, *self._flags()], trains=True)

    def poll(self) -> bool:
        """:return: whether something is still to come; a training that has ended is followed by its evaluation"""
        assert self._process is not None
        self.exit_code = self._process.poll()
        if self.exit_code is None:
            return True
        self._close_log()
        if self.exit_code != 0 and self._no_frame_came():
            tried = self.backends.pop(0)
            self.report(self.spec, "restarted", f"no frame came from {tried}; now {self.backends[0]} draws")
            self._begin()
            return True
        run = self._run_folder()
        if self.exit_code == 0 and self._trains and run is not None:
            self._launch(self._evaluation(run), trains=False)
            return True
        if self.exit_code == 0 and run is not None and (run / FINAL).exists():
            returns = read_json(run / FINAL)["returns"]
            self.report(self.spec, "finished", f"{sum(returns) / len(returns):.1f}")
        else:
            self._fail()
        self._lock.release()
        return False

    def ask_to_stop(self) -> None:
        """Let a training save a checkpoint and end."""
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)

    def wait_until_stopped(self, deadline: float) -> None:
        """:param deadline: of time.monotonic(); what does not end by then is killed, and goes on from the checkpoint before"""
        if self._process is None:
            return
        try:
            self._process.wait(max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._close_log()
        self._lock.release()

    def _no_frame_came(self) -> bool:
        """:return: whether the process ended for that, and there is another back end"""
        with (self.folder / LOG).open("rb") as log:
            log.seek(self._log_begin)
            return len(self.backends) > 1 and NO_FRAME.encode() in log.read()

    def _run_folder(self) -> Path | None:
        return next(iter(sorted(self.folder.glob("*/*_1"))), None)

    def _flags(self) -> list[str]:
        spec = self.spec
        flags = ["--algo", spec.preset, "--env", environment_id(spec.task), "--conf-file", str(self.folder / SETTINGS)]
        flags += ["-n", str(spec.agent_steps), "--seed", str(spec.seed), "-f", str(self.folder), "--verbose", "0"]
        flags += ["--eval-freq", str(spec.eval_every // spec.action_repeat), "--eval-episodes", str(spec.eval_episodes)]
        return [*flags, "--vec-env", "subproc", "--checkpoint-every", str(self.checkpoint_every)]

    def _evaluation(self, run: Path) -> list[str]:
        return [sys.executable, "-m", "sb3_crc", "evaluate", str(run), "--episodes", str(self.spec.eval_episodes)]

    def _launch(self, command: list[str], *, trains: bool) -> None:
        self._log = (self.folder / LOG).open("a", encoding="utf-8")
        self._log_begin = self._log.seek(0, os.SEEK_END)
        if self.backends:
            self._environment |= {"MUJOCO_GL": self.backends[0], FIRST_FRAME: str(FIRST_FRAME_WITHIN)}
        # in a session of its own: Ctrl-C reaches it through this process alone, once
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=subprocess.STDOUT,
            env=self._environment,
            start_new_session=True,
            preexec_fn=_end_with_parent if sys.platform == "linux" else None,
        )
        self._trains = trains

    def _fail(self) -> None:
        lines = (self.folder / LOG).read_text(encoding="utf-8", errors="replace").strip().splitlines()
        assert self._process is not None
        command = [str(part) for part in self._process.args]  # type: ignore[union-attr]
        write_json({"exit_code": self.exit_code, "command": command, "last_lines": lines[-20:]}, self.folder / FAILURE)
        last = lines[-1] if lines else "no output"
        self.report(self.spec, "failed", f"exit code {self.exit_code}, {self.folder / LOG}: {last}")

    def _close_log(self) -> None:
        if self._log is not None:
            self._log.close()
            self._log = None


def stop_all(running: Sequence[RunProcess]) -> None:
    """Let every run save a checkpoint, all at the same time."""
    for run in running:
        run.ask_to_stop()
    deadline = time.monotonic() + PATIENCE
    for run in running:
        run.wait_until_stopped(deadline)


def _final_models(run: Path) -> Iterator[Path]:
    return (path for path in run.glob("*.zip") if path.name != "best_model.zip")


def _wait_until_left(lock: Path) -> None:
    """
    A training whose parent was killed may still be saving its last checkpoint.

    :raises InUse: if it does not end
    """
    if lock.exists():
        own = FileLock(lock)
        try:
            own.acquire(timeout=PATIENCE)
        except Timeout:
            raise InUse(f"{lock.parent.parent} is in use by a training that no command has started") from None
        own.release()


#: Loaded now, since between fork and exec no library may be
_LIBC: Any = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None


def _end_with_parent() -> None:
    """Between fork and exec: the kernel will tell this process to stop, with a checkpoint, if its parent ends first."""
    _LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
