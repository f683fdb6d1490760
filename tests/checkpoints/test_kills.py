"""SIGKILL at random moments."""

import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

SCRIPT = """
import sys, hashlib
from pathlib import Path
import torch as th
from stable_baselines3.common.callbacks import EvalCallback
from tests.checkpoints.runs import SETTINGS, cartpole
from sb3_crc import CRCSAC
from sb3_crc.checkpoints.callback import TrainingCheckpoint

th.set_num_threads(1)
model = CRCSAC("CnnPolicy", cartpole(0), seed=0, **SETTINGS)
evaluation = EvalCallback(cartpole(100), n_eval_episodes=1, eval_freq=50, verbose=0)
model.learn(300, callback=[evaluation, TrainingCheckpoint(sys.argv[1], every=20)])
digest = hashlib.sha256()
for name, value in model.policy.state_dict().items():
    digest.update(value.numpy().tobytes())
print(digest.hexdigest(), evaluation.evaluations_results, evaluation.evaluations_timesteps)
"""


@pytest.mark.slow
def test_kills_at_random_moments(tmp_path: Path) -> None:
    """SIGKILL, which nothing can catch, wherever it falls: also while a checkpoint is being written."""

    def start(folder: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", SCRIPT, str(tmp_path / folder)]
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2])

    begin = time.monotonic()
    whole, _ = start("whole").communicate()
    duration = time.monotonic() - begin
    random = np.random.default_rng()
    kills = 0
    for _ in range(30):
        process = start("killed")
        try:
            result, _ = process.communicate(timeout=float(random.uniform(0.3, 0.8)) * duration)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.communicate()
            kills += 1
            continue
        if kills:
            break
        shutil.rmtree(tmp_path / "killed")  # the whole run was slower, with other work beside it: earlier, then
        duration /= 2
    print(f"{kills} kills, {duration:.0f} s for the whole run")
    assert kills > 0 and whole
    assert result == whole
