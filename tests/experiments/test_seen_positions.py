"""Cartpole's state as a stack of pictures could show it."""

import numpy as np
import pytest

from sb3_crc import make_dmc
from sb3_crc.experiments.ladder import seen_state_sac
from sb3_crc.experiments.seen_positions import VISIBLE, SeenPositions


def cartpole(**kwargs: float) -> SeenPositions:
    return SeenPositions(make_dmc("cartpole-swingup", observation="state", seed=0), **{"error": 0.0, **kwargs})


def test_without_error_positions_and_their_differences_are_exact() -> None:
    env = cartpole()
    previous = env.env.reset(seed=1)[0][:3]
    first, _ = env.reset(seed=1)
    np.testing.assert_allclose(first, [*previous, 1, *np.zeros(8)], atol=1e-6)  # a reset repeats the first frame
    action = np.array([0.3], np.float32)
    second, *_ = env.step(action)
    np.testing.assert_allclose(second[8:11], 4 * (second[:3] - first[:3]), atol=1e-5)
    assert np.abs(second[8:11]).max() > 0
    third, *_ = env.step(action)
    np.testing.assert_allclose(third[4:8], second[8:], atol=1e-6)
    again, _ = env.reset(seed=1)
    np.testing.assert_array_equal(again, first)


def test_out_of_the_picture_there_is_no_pole() -> None:
    env = cartpole()
    seen = env.observation(np.array([VISIBLE + 0.1, 0.6, 0.8, 5.0, 5.0]))
    np.testing.assert_allclose(seen[:4], [VISIBLE, 0, 0, 0])
    seen = env.observation(np.array([VISIBLE - 0.1, 0.6, 0.8, 5.0, 5.0]))
    np.testing.assert_allclose(seen[:4], [VISIBLE - 0.1, 0.6, 0.8, 1], atol=1e-6)


def test_the_error_has_the_size_that_was_asked_for() -> None:
    env = cartpole(error=0.05, frames=1)
    draws = np.stack([env.observation(np.array([0.2, 1.0, 0.0, 0.0, 0.0])) for _ in range(2_000)])
    assert draws.shape == (2_000, 4)
    np.testing.assert_allclose(draws[:, 0].std(), 0.05, rtol=0.1)
    np.testing.assert_allclose(np.arctan2(draws[:, 2], draws[:, 1]).std(), 0.05, rtol=0.1)


@pytest.mark.parametrize("settings", [{"error": -0.1}, {"error": float("nan")}, {"frames": 0}])
def test_what_cannot_be_is_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(settings))}={next(iter(settings.values()))} .*>="):
        cartpole(**settings)


def test_other_tasks_are_refused() -> None:
    with pytest.raises(ValueError, match="only cartpole's"):
        SeenPositions(make_dmc("walker-walk", observation="state"), error=0.0)


def test_sac_learns_from_it_and_reports_its_curve() -> None:
    measured = seen_state_sac("cartpole-swingup", error=0.01, n_steps=2, agent_steps=520, evaluations=2, episodes=2)
    assert [point["environment_steps"] for point in measured["curve"]] == [2080, 4160]
    assert measured["settings"]["error"] == 0.01 and measured["settings"]["n_steps"] == 2
