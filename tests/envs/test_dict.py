"""make_dmc(observation="dict"): the stack of pictures beside the task's own observations."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from packaging.version import Version
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from sb3_crc.envs.dmc import make_dmc
from sb3_crc.envs.tasks import PAPER_TASKS

SMALL: dict[str, Any] = {"image_size": 36, "render_quality": "fast", "observation": "dict"}


def test_pictures_and_states_are_those_of_the_other_modes() -> None:
    both = make_dmc("walker-walk", seed=0, **SMALL)
    pixels = make_dmc("walker-walk", seed=0, **{**SMALL, "observation": "pixels"})
    states = make_dmc("walker-walk", seed=0, **{**SMALL, "observation": "state"})
    assert both.observation_space == gym.spaces.Dict(
        {
            "height": gym.spaces.Box(-np.inf, np.inf, (1,), np.float32),  # a number in dm_control
            "orientations": gym.spaces.Box(-np.inf, np.inf, (14,), np.float32),
            "pixels": gym.spaces.Box(0, 255, (9, 36, 36), np.uint8),
            "velocity": gym.spaces.Box(-np.inf, np.inf, (9,), np.float32),
        }
    )
    assert both.get_wrapper_attr("frame_channels") == 3 and both.get_wrapper_attr("action_repeat") == 2
    observations = [env.reset()[0] for env in (both, pixels, states)]
    action = np.full(6, 0.5, np.float32)
    for _ in range(5):
        seen, picture, state = observations
        assert both.observation_space.contains(seen) and seen["pixels"].flags.c_contiguous
        np.testing.assert_array_equal(seen["pixels"], picture)
        np.testing.assert_array_equal(np.concatenate([seen[k] for k in ("height", "orientations", "velocity")]), state)
        steps = [env.step(action) for env in (both, pixels, states)]
        assert steps[0][1:] == steps[1][1:] == steps[2][1:]
        observations = [step[0] for step in steps]
    for env in (both, pixels):
        env.close()


def test_observations_handed_out_never_change() -> None:
    env = make_dmc("finger-spin", seed=0, **SMALL)
    observations = [env.reset()[0]]
    copies = [{name: value.copy() for name, value in observations[0].items()}]
    for _ in range(4):
        observations.append(env.step(np.ones(2, np.float32))[0])
        copies.append({name: value.copy() for name, value in observations[-1].items()})
    for observation, copy in zip(observations, copies, strict=True):
        for name, value in copy.items():
            np.testing.assert_array_equal(observation[name], value)
    assert not any(np.shares_memory(a[name], b[name]) for a, b in pairwise(observations) for name in a)
    env.close()


def test_the_ids_take_it() -> None:
    env = gym.make("dmc_pixels/reacher-easy-v0", **SMALL)
    observation, _ = env.reset(seed=0)
    assert sorted(observation) == ["pixels", "position", "to_target", "velocity"]
    assert observation["pixels"].shape == (9, 36, 36)
    env.close()


def test_an_observation_called_pixels_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    from dm_control.suite.cartpole import Balance

    monkeypatch.setattr(Balance, "get_observation", lambda task, physics: {"pixels": physics.velocity()})
    older = Version(gym.__version__) < Version("1.4")  # its assertion says nothing
    with pytest.raises(AssertionError if older else ValueError, match="" if older else "'pixels' already exists"):
        make_dmc("cartpole-swingup", **SMALL)


FAST = ("cartpole-swingup", "quadruped-walk")  # without and with rescaled actions


@pytest.mark.parametrize(
    "task", [task if task in FAST else pytest.param(task, marks=pytest.mark.slow) for task in PAPER_TASKS]
)
def test_check_env(task: str, recwarn: pytest.WarningsRecorder) -> None:
    env = make_dmc(task, **SMALL)
    gymnasium_check_env(env, skip_render_check=True)
    sb3_check_env(env)
    env.close()
    # Gymnasium would rather be given the innermost environment, and states have no bounds.
    foreign = ("is different from the unwrapped version", "value is -infinity", "value is infinity")
    assert [str(w.message) for w in recwarn if not any(text in str(w.message) for text in foreign)] == []
