"""The files of docs/extending.md: each trains, and does what it says."""

import importlib
from collections.abc import Iterator
from types import ModuleType
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_checker import check_env

from sb3_crc import CRCSAC
from sb3_crc.augmentations import AUGMENTATIONS, bind_augmentation
from tests.conftest import make_model
from tests.docs.fences import ROOT

#: Decisions of each, of which the last few are followed by updates
BUDGET = ["--agent-steps", "103"]


@pytest.fixture
def module(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The example that the test names; what it registers is gone after the test."""
    monkeypatch.syspath_prepend(ROOT / "examples" / "extending")
    with mock.patch.dict(AUGMENTATIONS):
        yield importlib.import_module(request.param)


def trained(module: ModuleType) -> CRCSAC:
    model: CRCSAC = module.main(BUDGET)
    assert model.num_timesteps == 103 and model._n_updates >= 2
    return model


@pytest.mark.parametrize("module", ["own_objective"], indirect=True)
def test_the_objective_trains_the_encoder_and_is_logged(module: ModuleType) -> None:
    model = trained(module)
    assert model.policy.objectives["InverseDynamics"].predictor[0].out_features == 64
    assert "representation/InverseDynamics_explained" in model.logger.name_to_value

    alone = make_model(objectives={"own_objective.InverseDynamics": 1.0}, qf_learning_rate=0.0)
    before = [weight.clone() for weight in alone.critic.features_extractor.parameters()]
    head = alone.policy.objectives["InverseDynamics"].predictor[0].weight.clone()
    alone.train(gradient_steps=1, batch_size=16)
    moved = [not th.equal(*pair) for pair in zip(before, alone.critic.features_extractor.parameters(), strict=True)]
    assert any(moved) and not th.equal(head, alone.policy.objectives["InverseDynamics"].predictor[0].weight)


@pytest.mark.parametrize("module", ["own_augmentation"], indirect=True)
def test_the_augmentation_hides_one_square(module: ModuleType) -> None:
    AUGMENTATIONS["random_cutout"] = module.random_cutout
    images = th.full((64, 6, 20, 24), 7, dtype=th.uint8)
    cut = bind_augmentation("random_cutout", {"side": 5}, (6, 20, 24))(images)
    assert cut.dtype == th.uint8 and cut.shape == images.shape
    assert ((cut == 128).sum(dim=(1, 2, 3)) == 6 * 25).all() and (cut[:, 0] == cut[:, 5]).all()
    assert len(cut.unique(dim=0)) > 40  # places differ
    many = module.random_cutout(th.zeros(200, 1, 6, 6, dtype=th.uint8), side=5)
    assert many[:, 0, 0, 0].any() and many[:, 0, -1, -1].any()  # ends included
    trained(module)


@pytest.mark.parametrize("module", ["own_encoder"], indirect=True)
def test_the_encoder_finds_where_something_is(module: ModuleType) -> None:
    model = trained(module)
    assert type(model.policy.key_encoder) is module.KeypointEncoder
    assert model.actor.projection[0].in_features == 2 * 32 and model.critic.features_extractor.features_dim == 32

    encoder = module.KeypointEncoder(gym.spaces.Box(0, 255, (3, 24, 24), np.uint8), channels=[1], strides=[1])
    layer = encoder.convolutions[0]
    layer.weight.data.zero_()
    layer.weight.data[0, 0, 1, 1] = 1_000  # sees where the first channel is bright
    picture = th.zeros(1, 3, 24, 24, dtype=th.uint8)
    picture[0, 0, 1, 22] = 255
    place = encoder.convolve(picture)  # up on the right: row -1, column 1
    assert th.allclose(place, th.tensor([[-1.0, 1.0]]), atol=1e-3)


@pytest.mark.parametrize("module", ["own_environment"], indirect=True)
def test_the_environment_is_one(module: ModuleType) -> None:
    env = module.CentreTheDisc(render_mode="rgb_array")
    check_env(env)
    env.reset(seed=0)
    state = env.get_state()
    steps = [env.step(np.array([0.5, -0.5], np.float32))[:2] for _ in range(2)]
    again = module.CentreTheDisc()
    again.reset(seed=1)
    again.set_state(state)
    for picture, reward in steps:
        found = again.step(np.array([0.5, -0.5], np.float32))
        assert np.array_equal(found[0], picture) and found[1] == reward
    assert gym.make("own/CentreTheDisc-v0").spec.max_episode_steps == 50

    model = trained(module)
    assert model.replay_buffer.frame_channels == 3
