"""Trainings that are killed again and again, from without and from within their writer, and that find damaged files."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.torture.training import EVERY, STEPS, WRITER

pytestmark = pytest.mark.long

TASKS = ("cartpole-swingup", "reacher-easy", "finger-spin")
KILLS = 9  # of each of six trainings, 54 in all; each comes within 60 steps, so that none comes too late
ROOT = Path(__file__).parents[2]


class Run:
    """One start of the training."""

    def __init__(self, folder: Path, task: str, n_envs: int, *flags: str):
        command = [sys.executable, "-m", "tests.torture.training", str(folder), task, str(n_envs), *flags]
        self.errors = (folder.parent / f"{folder.name}.log").open("a")
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=self.errors, text=True, cwd=ROOT)
        self.first_step = 0

    def result(self, kill_after: int | None = None, delay: float = 0.0) -> dict[str, Any] | None:
        """
        :param kill_after: so many steps of this start; None: let it go on
        :param delay: and so many seconds
        :return: what the training has come to; None: it did not end
        """
        assert self.process.stdout is not None
        last, steps = "", 0
        for line in self.process.stdout:
            last, steps = line, steps + 1
            self.first_step = self.first_step or int(line if line.strip().isdigit() else STEPS)
            if steps == kill_after:
                time.sleep(delay)
                self.process.send_signal(signal.SIGKILL)
        status = self.process.wait()
        self.errors.close()
        return json.loads(last) if status == 0 else None


def damage_newest(folder: Path, random: np.random.Generator) -> bool:
    """Change a byte of a file of the newest checkpoint, or cut the file. :return: whether there is another checkpoint."""
    checkpoints = sorted(path for path in (folder / "checkpoints").iterdir() if path.name.isdigit())
    if len(checkpoints) < 2:
        return False
    path = random.choice(sorted(checkpoints[-1].iterdir()))
    content = bytearray(path.read_bytes())
    if random.random() < 0.5:
        content[random.integers(len(content))] ^= 255
    else:
        del content[random.integers(len(content)) :]
    path.write_bytes(content)
    return True


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("task", TASKS)
def test_it_ends_as_if_nothing_had_happened(task: str, n_envs: int, tmp_path: Path) -> None:
    """Kills at random moments, a writer that dies in any of its calls, a full disk, damaged files; the ring wraps around."""
    seed = int(np.random.SeedSequence().generate_state(1)[0])
    random = np.random.default_rng(seed)
    whole = Run(tmp_path / "whole", task, n_envs).result()
    assert whole is not None

    folder, log, damaged = tmp_path / "killed", [], 0
    for number in range(KILLS):
        if number % 2:
            after, delay = int(random.integers(1, 2 * EVERY // n_envs)), float(random.uniform(0, 0.1))
            run = Run(folder, task, n_envs)
            result = run.result(after, delay)
            log.append(f"from {run.first_step}: killed {after} steps and {delay:.3f} s later")
        else:
            what, death = str(random.choice(list(WRITER))), str(random.choice(["before", "after", "full"]))
            call = int(random.integers(1, 4))
            run = Run(folder, task, n_envs, "--fail", what, str(call), death)
            result = run.result(2 * EVERY // n_envs if death == "full" else None)  # a full disk alone ends nothing
            log.append(f"from {run.first_step}: {what}, call {call}, {death}")
        assert result is None, "the training ended before it was killed"
        if number % 3 == 2 and damage_newest(folder, random):
            damaged += 1
            log.append("the newest checkpoint was damaged")
    last = Run(folder, task, n_envs)
    result = last.result()
    print(f"{task}, {n_envs} environments, seed {seed}: {KILLS} kills, {damaged} checkpoints damaged;", "; ".join(log))
    assert last.first_step > 1, "no checkpoint was used"
    assert result == whole
