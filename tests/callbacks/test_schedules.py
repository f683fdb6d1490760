"""ObjectiveScheduleCallback and NStepScheduleCallback: what changes during a training, and what holds after it."""

from typing import Any

import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback

from sb3_crc import FrameReplayBuffer
from sb3_crc.callbacks import NStepScheduleCallback, ObjectiveScheduleCallback
from tests.callbacks.stock_models import stock
from tests.conftest import NoiseEnv, make_model


def test_scheduled_weights_reach_the_loss() -> None:
    model = make_model()
    callback = ObjectiveScheduleCallback(
        {"contrastive": "lin_2", "reconstruction": lambda progress: 1 - progress, "consistency": 0}
    )
    for total in (10, 40):
        model.learn(total, callback=callback, reset_num_timesteps=False)
        logged = model.logger.name_to_value
        assert logged["representation/contrastive_weight"] == pytest.approx(0)  # the end of training
        assert logged["representation/reconstruction_weight"] == 1
        assert logged["representation/loss"] == pytest.approx(logged["representation/reconstruction"], rel=1e-4)


def test_after_training_the_models_own_values_hold() -> None:
    model = make_model()
    own_rate, own_weights = model._lr_schedules["encoder_learning_rate"], model._objective_weights
    model.learn(5, callback=ObjectiveScheduleCallback({"contrastive": 3.0}, encoder_learning_rate=0.5))
    assert model._lr_schedules["encoder_learning_rate"] is own_rate
    assert model._objective_weights == own_weights


def test_the_encoders_rate_is_scheduled() -> None:
    model = make_model()
    model.learning_starts = 0
    model.learn(10, callback=ObjectiveScheduleCallback(encoder_learning_rate=lambda progress: 0.5 * progress + 0.25))
    assert model.policy.encoder_optimizer is not None
    assert model.policy.encoder_optimizer.param_groups[0]["lr"] == 0.25
    assert model.actor.optimizer.param_groups[0]["lr"] == 1e-3
    assert model.logger.name_to_value["train/encoder_learning_rate"] == 0.25


def test_objective_schedule_refusals() -> None:
    with pytest.raises(ValueError, match="nothing to schedule"):
        ObjectiveScheduleCallback()
    with pytest.raises(ValueError, match="'contrastive': the value must be finite and >= 0, got -0.5 at progress 0.5"):
        ObjectiveScheduleCallback({"contrastive": lambda progress: progress - 1 if progress < 1 else 1})
    with pytest.raises(
        ValueError, match="no objective 'kontrastive' to schedule; the model has: contrastive, reconstruction, cons"
    ):
        make_model().learn(1, callback=ObjectiveScheduleCallback({"kontrastive": 1.0}))
    with pytest.raises(ValueError, match="the model has objectives={}"):
        make_model(objectives={}).learn(1, callback=ObjectiveScheduleCallback(encoder_learning_rate=1e-3))
    with pytest.raises(ValueError, match="ObjectiveScheduleCallback is for CRCSAC, got SAC"):
        stock().learn(1, callback=ObjectiveScheduleCallback({"contrastive": 1.0}))


def test_returns_get_shorter_as_training_proceeds(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(n_steps=3, learning_starts=8, batch_size=4, gamma=0.5)
    seen = []
    sample = model.replay_buffer.sample_frames

    def spied(*args: Any, **kwargs: Any) -> Any:
        batch = sample(*args, **kwargs)
        seen.append((model.num_timesteps, 1.0 if batch.discounts is None else float(batch.discounts.min())))
        return batch

    monkeypatch.setattr(model.replay_buffer, "sample_frames", spied)
    model.learn(40, callback=NStepScheduleCallback({0.75: 1, 0.5: 2}))
    expected = [(3, 0.125) if step < 20 else (2, 0.25) if step < 30 else (1, 1.0) for step, _ in seen]
    assert [discount for _, discount in seen] == [discount for _, discount in expected]
    assert {number for number, _ in expected} == {1, 2, 3}
    assert model.replay_buffer.n_steps == 3  # its own again
    assert model.logger.name_to_value["train/n_steps"] == 1


def test_n_step_schedule_refusals() -> None:
    for steps, message in (
        ({}, "nothing to schedule"),
        ({1.0: 2}, "1.0 is no share of the training, from 0 to below 1"),
        ({-0.1: 2}, "-0.1 is no share"),
        ({0.5: 0}, "0 must be a whole number, at least 1"),
        ({0.5: 1.5}, "1.5 must be a whole number"),
    ):
        with pytest.raises(ValueError, match=message):
            NStepScheduleCallback(steps)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="needs a FrameReplayBuffer, the model has ReplayBuffer"):
        stock().learn(1, callback=NStepScheduleCallback({0.5: 1}))


class Interrupt(BaseCallback):
    def _on_step(self) -> bool:
        if self.n_calls == 30:
            raise KeyboardInterrupt
        return True


def test_after_an_interruption_too_the_models_own_values_hold() -> None:
    model = make_model(n_steps=3, learning_starts=8, batch_size=4)
    own_rate, own_weights = model._lr_schedules["encoder_learning_rate"], model._objective_weights
    schedules = [
        ObjectiveScheduleCallback({"contrastive": 3.0}, encoder_learning_rate=0.5),
        NStepScheduleCallback({0.5: 1}),
    ]
    with pytest.raises(KeyboardInterrupt):
        model.learn(40, callback=[*schedules, Interrupt()])
    assert model.logger.name_to_value["train/n_steps"] == 1
    assert model.replay_buffer.n_steps == 3
    assert model._lr_schedules["encoder_learning_rate"] is own_rate and model._objective_weights == own_weights
    model.learn(10, reset_num_timesteps=False)
    assert model._objective_weights == own_weights
    assert model.policy.encoder_optimizer.param_groups[0]["lr"] == 1e-3  # type: ignore[union-attr]


def test_the_callback_of_an_interrupted_stock_algorithm_knows_the_buffers_own_number() -> None:
    own = {"replay_buffer_class": FrameReplayBuffer, "replay_buffer_kwargs": {"n_steps": 3, "frame_channels": None}}
    model = SAC("CnnPolicy", NoiseEnv(), buffer_size=60, learning_starts=50, **own)  # type: ignore[arg-type]
    callback = NStepScheduleCallback({0.5: 1})
    with pytest.raises(KeyboardInterrupt):
        model.learn(40, callback=[callback, Interrupt()])
    model.learn(40, callback=callback)
    assert model.replay_buffer.n_steps == 3  # type: ignore[union-attr]
