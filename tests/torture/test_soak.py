"""A training that goes on for very long keeps nothing that it does not need."""

import gc
import threading
from pathlib import Path
from typing import Any

import psutil
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_crc import CRCSAC
from sb3_crc.checkpoints.callback import TrainingCheckpoint
from sb3_crc.evaluation import QBiasEvalCallback
from tests.conftest import POLICY_KWARGS, NoiseEnv

DECISIONS, WARM_UP, LOOKS_EVERY = 200_000, 50_000, 10_000


class Look(BaseCallback):
    """Memory, handles and threads of this process, now and then."""

    def __init__(self) -> None:
        super().__init__()
        self.process = psutil.Process()
        self.seen: list[tuple[int, int, int, int]] = []

    def _on_step(self) -> bool:
        if self.num_timesteps % LOOKS_EVERY == 0:
            gc.collect()
            memory, handles = self.process.memory_info().rss, self.process.num_fds()
            self.seen.append((self.num_timesteps, memory, handles, threading.active_count()))
        return True


@pytest.mark.long
@pytest.mark.timeout(7_200)
def test_memory_handles_and_threads_stay(tmp_path: Path) -> None:
    def make() -> Any:
        return Monitor(NoiseEnv(size=24, length=50))

    model = CRCSAC(
        "CnnPolicy",
        DummyVecEnv([lambda: Monitor(NoiseEnv(size=24, length=50), str(tmp_path / "0.monitor.csv"))]),
        batch_size=16,
        buffer_size=5_000,
        learning_starts=100,
        train_freq=8,
        gradient_steps=1,
        policy_kwargs=POLICY_KWARGS,
        seed=0,
        device="cpu",
    )
    model.set_logger(configure(str(tmp_path), ["csv"]))
    evaluation = QBiasEvalCallback(DummyVecEnv([make]), log_path=str(tmp_path), n_eval_episodes=1, eval_freq=5_000, verbose=0)
    look = Look()
    checkpoint = TrainingCheckpoint(tmp_path / "checkpoints", every=2_000)
    model.learn(DECISIONS, callback=[evaluation, look, checkpoint])
    before = next(one for one in look.seen if one[0] >= WARM_UP)
    last = look.seen[-1]
    print(f"{DECISIONS} decisions, {model._n_updates} updates, {DECISIONS // 2_000} checkpoints:", look.seen)
    assert last[1] < 1.01 * before[1], f"memory has grown from {before[1] / 1e6:.1f} to {last[1] / 1e6:.1f} MB"
    assert last[2:] == before[2:], "handles or threads have grown"
