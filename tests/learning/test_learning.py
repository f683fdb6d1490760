"""It learns: to see where a critic needs it, and to overfit what it is shown."""

from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch.nn import functional as F

from sb3_crc import CRCSAC, PRESETS
from sb3_crc.views import Views
from tests.conftest import make_model
from tests.learning.blob import BlobEnv

BLOB: dict[str, Any] = {
    "augmentation": "random_shift",
    "augmentation_kwargs": {"pad": 1},
    "gamma": 0.0,
    "ent_coef": 0.01,
    "encoder_learning_rate": 3e-4,
    "batch_size": 64,
    "buffer_size": 2_000,
    "learning_starts": 1_000,
    "policy_delay": 1,
    "target_update_interval": 1,
    "policy_kwargs": {
        "net_arch": [64, 64],
        "features_extractor_kwargs": {"channels": [16, 16, 16], "strides": [2, 1, 1], "features_dim": 32},
    },
    "seed": 0,
    "device": "cpu",
}


class FrozenEncoder(CRCSAC):
    """The same agent, but its encoder stays as it was initialised."""

    def _update_critic_and_encoder(self, views: Views) -> dict[str, th.Tensor]:
        encoder = list(self.critic.features_extractor.parameters())
        before = [parameter.detach().clone() for parameter in encoder]
        metrics = super()._update_critic_and_encoder(views)
        with th.no_grad():
            for parameter, old in zip(encoder, before, strict=True):
                parameter.copy_(old)
        return metrics


def blob_score(algorithm: type[CRCSAC], preset: str) -> float:
    model = algorithm("CnnPolicy", BlobEnv(), **BLOB, objectives=PRESETS[preset]["objectives"])
    model.learn(1_800)
    score, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=200)
    return score


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["crc", "curl", "rad"])
def test_an_agent_that_trains_its_encoder_finds_the_blob(preset: str) -> None:
    assert blob_score(CRCSAC, preset) >= 0.9


@pytest.mark.slow
def test_an_agent_with_a_random_encoder_does_not() -> None:
    assert blob_score(FrozenEncoder, "rad") <= 0.75


def pictures(count: int) -> th.Tensor:
    """Smooth, all different, so that a small decoder can paint them: uint8 ``(count, 9, 40, 40)``."""
    coarse = th.rand(count, 3, 3, 3, generator=th.Generator().manual_seed(0)).repeat(1, 3, 1, 1)
    return (255 * F.interpolate(coarse, (40, 40), mode="bilinear")).to(th.uint8)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:consistency is the only objective")
@pytest.mark.parametrize(
    ("name", "share"),
    # of its value at the start that is left after 500 updates
    [("contrastive", 0.05), ("reconstruction", 0.25), ("consistency", 0.01)],
)
def test_each_loss_alone_overfits_one_batch(name: str, share: float) -> None:
    policy_kwargs = {
        "net_arch": [32],
        "features_extractor_kwargs": {"channels": [16, 16], "strides": [2, 2], "features_dim": 50, "image_size": 40},
    }
    settings: dict[str, Any] = {"objectives": {name: 1.0}, "encoder_learning_rate": 3e-3, "policy_kwargs": policy_kwargs}
    model = make_model(augmentation="center_crop", learning_starts=64, **settings)
    model.learn(24, reset_num_timesteps=False)  # 64 transitions are stored
    model.critic.optimizer.step = lambda: None  # this loss alone
    batch = model.replay_buffer.sample(64)
    images = pictures(64)
    batch = ReplayBufferSamples(images, batch.actions, images, batch.dones, batch.rewards)
    model.replay_buffer.sample_frames = lambda batch_size, env=None: batch
    losses = []
    for _ in range(500):
        model.train(gradient_steps=1, batch_size=64)
        losses.append(model.logger.name_to_value[f"representation/{name}"])
    start = float(np.var((images / 255).numpy())) if name == "reconstruction" else losses[0]
    assert losses[-1] < share * start
