"""The instruments against numbers known by construction."""

import math
import sys
import warnings
from typing import Any

import pytest
import torch as th

from sb3_crc import base_sac
from sb3_crc.finite import LossHistory
from sb3_crc.instruments import CollapseAlarm, Speedometer, latent_health, update_ratio
from tests.conftest import make_model


def test_effective_rank_counts_the_directions_in_use() -> None:
    basis = th.linalg.qr(th.randn(20, 20))[0]
    for rank in (1, 3, 7):
        signs = th.cat([th.eye(rank), -th.eye(rank)])  # centred, equally spread over `rank` directions
        health = latent_health(signs @ basis[:rank], th.ones(2 * rank, 4))
        assert health["representation/effective_rank"].item() == pytest.approx(rank, rel=1e-4)


def test_latent_std_and_dead_relus() -> None:
    latents = th.tensor([[1.0, 5.0], [-1.0, 5.0]])
    features = th.tensor([[0.0, 0.0, 2.0, 0.0], [0.0, 1.0, 3.0, 0.0]])
    health = latent_health(latents, features)
    assert health["representation/latent_std"].item() == pytest.approx(math.sqrt(2) / 2)
    assert health["representation/dead_relus"].item() == 0.5


def test_update_ratio() -> None:
    assert update_ratio([th.tensor([3.0]), th.tensor([4.0])], [th.tensor([3.0]), th.tensor([4.5])]).item() == pytest.approx(
        0.1
    )


def test_the_alarm_rings_once_after_a_thousand_collapsed_updates_in_a_row() -> None:
    alarm = CollapseAlarm()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for std in [0.01] * 9 + [0.5] + [0.01] * 9:
            alarm.check(std, 100)
    with pytest.warns(UserWarning, match="collapsed.*1000 updates"):
        alarm.check(0.01, 100)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alarm.check(0.01, 100)


def test_speedometer_rates(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 1.0, 5.0])
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    meter = Speedometer()
    assert meter.read({"updates": 10}) == {}
    assert meter.read({"updates": 30, "agent_steps": 5}) == {"updates": 5.0}


def test_a_run_logs_its_health(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base_sac, "HEALTH_INTERVAL", 2)
    model = make_model()
    model.train(gradient_steps=2, batch_size=16)
    logged = model.logger.name_to_value
    assert logged["representation/latent_std"] > 0
    assert 1 < logged["representation/effective_rank"] <= 16
    assert 0 <= logged["representation/dead_relus"] < 1
    assert 0 < logged["train/encoder_update_ratio"] < 1
    assert 0 < logged["train/q_heads_update_ratio"] < 1
    assert 0 <= logged["representation/contrastive_accuracy"] <= 1
    information = math.log(16) - logged["representation/contrastive"]
    assert logged["representation/contrastive_information"] == pytest.approx(information, abs=1e-5)
    model.dump_logs()
    model.train(gradient_steps=2, batch_size=16)
    model.dump_logs()


def test_one_transfer_from_the_device_per_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever makes Python wait for a tensor's value; Adam reads its step counters, which lie on the host on any device."""
    model = make_model()
    transfers: list[str] = []

    def spy(name: str) -> None:
        original = getattr(th.Tensor, name)

        def read(self: th.Tensor, *args: Any, **kwargs: Any) -> Any:
            caller = sys._getframe(1).f_code.co_filename
            if not caller.endswith("torch/optim/optimizer.py"):
                transfers.append(f"{name} in {caller}")
            return original(self, *args, **kwargs)

        monkeypatch.setattr(th.Tensor, name, read)

    batch = model.replay_buffer.sample(16)  # whose rows are drawn, and its crops, on the host
    monkeypatch.setattr(model.replay_buffer, "sample_frames", lambda *args, **kwargs: batch)
    monkeypatch.setattr(model, "_augment", lambda images: images[:, :, 3:37, 3:37])
    for name in ("item", "tolist", "numpy", "cpu", "__bool__", "__float__", "__int__"):
        spy(name)
    model.train(gradient_steps=4, batch_size=16)
    assert len(transfers) == 1, transfers
    assert transfers[0].startswith("tolist")
    assert transfers[0].endswith("finite.py")


def test_metrics_keep_no_graphs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A graph keeps its batch alive: 500 initial updates once took 14 GB."""
    kept: list[th.Tensor] = []
    means = LossHistory.means

    def spy(history: LossHistory) -> dict[str, float]:
        kept.extend(value for metrics in history.updates for value in metrics.values())
        return means(history)

    monkeypatch.setattr(LossHistory, "means", spy)
    make_model().train(gradient_steps=4, batch_size=16)
    assert len(kept) > 20
    assert all(value.grad_fn is None for value in kept)
