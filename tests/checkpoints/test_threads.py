"""Updates are as fast after a checkpoint as before."""

import resource
import threading
import time
from pathlib import Path

import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_crc import CRCSAC
from sb3_crc.checkpoints.callback import THREAD, TrainingCheckpoint
from tests.conftest import NoiseEnv


class Watch(BaseCallback):
    """Once the first checkpoint is written: which threads there are, and how often threads went to sleep in 20 updates."""

    def __init__(self, checkpoint: TrainingCheckpoint):
        super().__init__()
        self.checkpoint = checkpoint
        self.threads: list[str] = []
        self.before = self.after = -1

    def sleeps(self) -> int:
        began = resource.getrusage(resource.RUSAGE_SELF).ru_nvcsw
        self.model.train(gradient_steps=20, batch_size=self.model.batch_size)  # type: ignore[attr-defined]
        return resource.getrusage(resource.RUSAGE_SELF).ru_nvcsw - began

    def _on_step(self) -> bool:
        if self.num_timesteps == 70:
            self.before = self.sleeps()
        if self.num_timesteps == 90:
            writing = self.checkpoint._writing
            assert writing is not None
            writing.result()
            deadline = time.monotonic() + 10
            while self.writers() and time.monotonic() < deadline:
                time.sleep(0.01)
            self.threads = self.writers()
            self.after = self.sleeps()
        return True

    def writers(self) -> list[str]:
        return [thread.name for thread in threading.enumerate() if thread.name.startswith(THREAD)]


def watched(folder: Path) -> Watch:
    kwargs = {
        "net_arch": [256, 256],
        "features_extractor_kwargs": {"channels": [16, 16], "strides": [2, 2], "features_dim": 64},
    }
    model = CRCSAC(
        "CnnPolicy", NoiseEnv(size=64), seed=0, buffer_size=200, batch_size=64, learning_starts=65, policy_kwargs=kwargs
    )
    checkpoint = TrainingCheckpoint(folder, every=80)
    watch = Watch(checkpoint)
    model.learn(92, callback=[checkpoint, watch])
    return watch


def test_the_thread_that_writes_ends_with_its_work(tmp_path: Path) -> None:
    watch = watched(tmp_path)
    assert watch.after >= 0 and not watch.threads


@pytest.mark.slow
@pytest.mark.alone
def test_threads_of_updates_stay_awake(tmp_path: Path) -> None:
    """With OpenMP threads of two threads of Python each would sleep after each operation, some hundred times in an update."""
    th.set_num_threads(2)
    watch = watched(tmp_path)
    assert watch.after <= 10 * max(watch.before, 20)
