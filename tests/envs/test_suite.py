"""All 51 tasks of the suite load, reset, step and draw."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_crc.envs.dmc import make_dmc
from sb3_crc.envs.tasks import default_action_repeat, task_names


@pytest.mark.slow
@pytest.mark.parametrize("task", task_names())
def test_task_works(task: str) -> None:
    env = make_dmc(task, seed=0, image_size=64, render_quality="fast")
    observation, info = env.reset(seed=1)
    assert observation in env.observation_space and info["env_steps"] == 0
    observations = [observation]
    for decision in range(1, 11):
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert observation in env.observation_space
        assert np.isfinite(reward) and not terminated and not truncated
        assert info["env_steps"] == decision * default_action_repeat(task)
        observations.append(observation)
    first, last = observations[0][-3:], observations[-1][-3:]  # the newest frame is last
    assert last.std() > 5, "an empty picture"
    assert np.any(first != last), "nothing that moves is in the picture"
    assert np.any(env.reset()[0][-3:] != first)

    picture = env.render()
    assert picture.shape == (480, 480, 3) and picture.dtype == np.uint8 and picture.std() > 5
    env.close()
