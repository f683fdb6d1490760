"""Policies that have learned nothing."""

import numpy as np
import pytest

from sb3_crc import make_dmc
from sb3_crc.experiments import baselines
from sb3_crc.experiments.baselines import measure_baselines, measure_landmarks


def test_landmarks_are_repeatable_and_know_nothing() -> None:
    found = measure_landmarks(["cartpole-swingup"], episodes=1)
    again = measure_landmarks(["cartpole-swingup"], episodes=1)
    assert found["returns"] == again["returns"]
    assert 0 < found["returns"]["cartpole-swingup"]["random"][0] < 300
    assert found["returns"]["cartpole-swingup"]["zero"][0] < 50  # it hangs down


def test_baselines_are_returns_of_the_same_episodes() -> None:
    landmarks = measure_landmarks(["cartpole-swingup"], episodes=2, seed=3)["returns"]["cartpole-swingup"]
    for name, found in measure_baselines("cartpole-swingup", episodes=2, seed=3).items():
        assert found["returns"] == pytest.approx(landmarks[name], abs=1e-3)
        assert found["mean"] == pytest.approx(np.mean(found["returns"]))
        assert found["std"] == pytest.approx(abs(np.subtract(*found["returns"])) / np.sqrt(2))


def test_actions_without_bounds_have_a_zero_too() -> None:
    action = baselines.POLICIES["zero"](make_dmc("lqr-lqr_2_1", observation="state"))
    assert action.tolist() == [0.0]


def test_an_unknown_task_is_refused_before_any_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "make_dmc", lambda *_, **__: pytest.fail("measured"))
    with pytest.raises(ValueError, match="Did you mean 'walker-walk'"):
        measure_landmarks(["cartpole-swingup", "walker-wlk"])
