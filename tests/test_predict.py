"""Actions for one observation or many, within the action space."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from tests.conftest import NoiseEnv, make_model


def test_prediction_of_batches_and_of_single_observations(observations: np.ndarray) -> None:
    model = make_model()
    batch, _ = model.predict(observations, deterministic=True)
    assert batch.shape == (5, 2) and len(np.unique(batch, axis=0)) == 5
    assert np.array_equal(batch, model.predict(observations, deterministic=True)[0])
    for observation, action in zip(observations, batch, strict=True):
        single, _ = model.predict(observation, deterministic=True)
        assert single.shape == (2,)
        assert np.allclose(single, action, atol=1e-6)
        last, _ = model.predict(observation.transpose(1, 2, 0), deterministic=True)
        assert np.array_equal(last, single)  # SB3 transposes channel-last images
    assert not np.allclose(batch, model.predict(observations)[0], atol=1e-3)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int64])
def test_images_are_taken_by_their_space_whatever_their_type(observations: np.ndarray, dtype: Any) -> None:
    """As by SB3: environments need not keep to their space's type."""
    model = make_model()
    others = observations.astype(dtype)
    assert np.array_equal(model.predict(others, deterministic=True)[0], model.predict(observations, deterministic=True)[0])
    actions = th.zeros(len(observations), 2)
    one, other = (model.critic(model.policy.obs_to_tensor(images)[0], actions) for images in (observations, others))
    assert all(map(th.equal, one, other))


def test_actions_are_scaled_to_the_action_space(observations: np.ndarray) -> None:
    class Wide(NoiseEnv):
        def __init__(self) -> None:
            super().__init__()
            self.action_space = gym.spaces.Box(np.array([-3, 2], np.float32), np.array([1, 7], np.float32))

    model = make_model(Wide())
    actions, _ = model.predict(np.repeat(observations, 20, axis=0))
    assert all(model.action_space.contains(action) for action in actions)
    assert actions[:, 1].min() > 2 and actions[:, 0].min() < -1
