"""AuxiliaryLossCallback: what it trains."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecTransposeImage

from sb3_crc import PixelEncoder
from sb3_crc.callbacks import AuxiliaryLossCallback
from sb3_crc.objectives import AuxiliaryObjective
from sb3_crc.views import Views
from tests.callbacks.stock_models import SIZE, BatchNormCNN, live_extractor, moved, noise_env, stock, weights
from tests.conftest import NoiseEnv


class BlobEnv(NoiseEnv):
    """A square of random shade at a random place, on dark noise."""

    def _frame(self) -> np.ndarray:
        frame = self.np_random.integers(0, 60, self.observation_space.shape, dtype=np.uint8)
        row, column = self.np_random.integers(4, SIZE - 10, 2)
        frame[:, row : row + 6, column : column + 6] = self.np_random.integers(100, 255, (3, 1, 1))
        return frame


class ChannelLast(gym.ObservationWrapper[np.ndarray, Any, np.ndarray]):
    def __init__(self, env: gym.Env[Any, Any]):
        super().__init__(env)
        self.observation_space = gym.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        return observation.transpose(1, 2, 0)


class ActionNorm(AuxiliaryObjective):
    """A user's objective, which reads actions and latents."""

    def forward(self, views: Views) -> th.Tensor:
        assert views.actions.shape[1] == self.action_dim
        return (views.anchor.latent.mean(dim=1) - views.actions.float().mean(dim=1)).square().mean()


@pytest.mark.parametrize("algorithm", ["sac", "sac-shared", "td3", "td3-shared", "tqc", "tqc-shared", "dqn"])
def test_the_auxiliary_loss_moves_the_extractor_and_nothing_else(algorithm: str) -> None:
    model = stock(algorithm)
    before = weights(model.policy)
    model.learn(16, callback=AuxiliaryLossCallback())
    changed = {name for name in moved(before, model.policy) if "target" not in name}  # targets follow, as they should

    own = "q_net.features_extractor" if algorithm == "dqn" else "critic.features_extractor"
    expected = {name for name in before if name.startswith(own)}
    if algorithm.endswith("shared"):
        expected |= {name for name in before if name.startswith("actor.features_extractor")}
    assert changed == expected


def test_without_the_callback_nothing_moves() -> None:
    model = stock()
    before = weights(model.policy)
    model.learn(16)
    assert not {name for name in moved(before, model.policy) if "target" not in name}  # targets move by rounding


def test_heads_see_the_trained_extractor_and_still_learn() -> None:
    model = stock(learning_rate=1e-3)
    before = weights(model.policy)
    model.learn(16, callback=AuxiliaryLossCallback())
    assert moved(before, model.policy) == set(before)


def test_it_starts_when_the_algorithm_does_and_a_batch_is_stored() -> None:
    for learning_starts, batch_size, updates in ((12, 8, 4), (4, 10, 7)):  # in 16 steps
        callback = AuxiliaryLossCallback(batch_size=batch_size)
        stock(learning_starts=learning_starts).learn(16, callback=callback)
        assert callback.learner is not None and callback.learner.n_updates == updates


def test_gradient_steps_count_per_rollout() -> None:
    callback = AuxiliaryLossCallback(gradient_steps=3)
    stock(train_freq=2).learn(16, callback=callback)
    assert callback.learner is not None and callback.learner.n_updates == 2 * 3


def test_all_three_losses_fall_on_frames_that_differ() -> None:
    model = stock(env=BlobEnv(size=SIZE, channels=3, length=5), policy_kwargs={"features_extractor_kwargs": {}}).learn(40)
    callback = AuxiliaryLossCallback(gradient_steps=25, batch_size=16)
    callback.init_callback(model)
    assert callback.learner is not None
    first, *_, last = [callback.learner.train() for _ in range(3)]
    for name in ("contrastive", "reconstruction", "consistency"):
        assert last[f"representation/{name}"] < 0.9 * first[f"representation/{name}"]


def test_the_key_encoder_follows_at_its_rate() -> None:
    model = stock().learn(16)
    for tau in (0.25, 1.0):
        callback = AuxiliaryLossCallback(encoder_tau=tau)
        callback.init_callback(model)
        learner = callback.learner
        assert learner is not None
        old = weights(learner.key_encoder)
        learner.train()
        live = live_extractor(model).state_dict()
        for name, tensor in learner.key_encoder.state_dict().items():
            th.testing.assert_close(tensor, tau * live[name] + (1 - tau) * old[name])


def test_augmentation_batch_size_and_learning_rate_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    from sb3_crc.augmentations import AUGMENTATIONS

    seen: list[tuple[int, ...]] = []

    def paint(images: th.Tensor, value: int) -> th.Tensor:
        seen.append(tuple(images.shape))
        return th.full_like(images, value)

    monkeypatch.setitem(AUGMENTATIONS, "paint", paint)
    callback = AuxiliaryLossCallback(
        {"reconstruction": 1.0}, learning_rate="lin_0.5", augmentation="paint", augmentation_kwargs={"value": 51}, batch_size=5
    )
    model = stock().learn(16)
    callback.init_callback(model)
    assert callback.learner is not None
    model._current_progress_remaining = 0.25
    metrics = callback.learner.train()
    assert seen[-1] == (5, 3, SIZE, SIZE)
    assert metrics["representation/reconstruction"] == pytest.approx(0.2**2, rel=1)  # a constant, painted by a new decoder
    assert callback.learner.optimizer.param_groups[0]["lr"] == 0.125


@pytest.mark.parametrize("n_envs", [1, 3])
def test_channel_last_frames_of_many_environments(n_envs: int) -> None:
    model = stock(env=DummyVecEnv([lambda: ChannelLast(noise_env())] * n_envs))
    assert isinstance(model.get_env(), VecTransposeImage)
    before = weights(live_extractor(model))
    model.learn(21, callback=AuxiliaryLossCallback())
    assert moved(before, live_extractor(model)) == set(before)


def test_train_mode_is_set_for_the_update_and_restored() -> None:
    model = stock(policy_kwargs={"features_extractor_class": BatchNormCNN}).learn(16)
    callback = AuxiliaryLossCallback()
    callback.init_callback(model)
    extractor = live_extractor(model)
    assert isinstance(extractor, BatchNormCNN) and callback.learner is not None
    for mode in (True, False):
        extractor.train(mode)
        extractor.modes.clear()
        unused = extractor.unused.weight.clone()
        callback.learner.train()
        assert extractor.modes == [True] and extractor.training is mode
        key = callback.learner.key_encoder
        assert key.modes[-1] is False and not key.training
        assert th.equal(key.cnn[1].running_mean, extractor.cnn[1].running_mean)
        assert th.equal(key.cnn[1].num_batches_tracked, extractor.cnn[1].num_batches_tracked)
        assert th.equal(unused, extractor.unused.weight)


@pytest.mark.parametrize(("normalize_images", "largest"), [(True, 1.0), (False, 255.0)])
def test_the_extractor_sees_the_policys_scale(normalize_images: bool, largest: float) -> None:
    policy_kwargs = {"features_extractor_class": BatchNormCNN, "normalize_images": normalize_images}
    model = stock(policy_kwargs=policy_kwargs).learn(16)
    callback = AuxiliaryLossCallback()
    callback.init_callback(model)
    extractor = live_extractor(model)
    assert isinstance(extractor, BatchNormCNN) and callback.learner is not None
    extractor.largest = 0.0
    callback.learner.train()
    assert extractor.largest == largest


def test_our_encoder_in_a_stock_algorithm_is_mirrored_and_may_be_cropped_to() -> None:
    encoder_kwargs = {"channels": [4, 6], "strides": [2, 2], "features_dim": 8, "image_size": 32}
    policy_kwargs = {"features_extractor_class": PixelEncoder, "features_extractor_kwargs": encoder_kwargs}
    model = stock(policy_kwargs=policy_kwargs)
    callback = AuxiliaryLossCallback(augmentation="random_crop", augmentation_kwargs={"size": 32})
    before = weights(live_extractor(model))
    model.learn(16, callback=callback)
    assert callback.learner is not None
    decoder = callback.learner.objectives["reconstruction"].decoder
    assert decoder.start_shape[0] == 6 and len(decoder.deconvolutions) == 2
    assert moved(before, live_extractor(model)) == set(before)


def test_objectives_settings_and_a_users_class() -> None:
    callback = AuxiliaryLossCallback(
        {f"{__name__}.ActionNorm": 0.5, "reconstruction": {"weight": 0.1, "channels": [8], "strides": [2]}}
    )
    model = stock("dqn")
    model.learn(16, callback=callback)
    assert callback.learner is not None
    assert set(callback.learner.objectives) == {"ActionNorm", "reconstruction"}
    assert len(callback.learner.objectives["reconstruction"].decoder.deconvolutions) == 1
    logged = model.logger.name_to_value
    assert logged["representation/loss"] == pytest.approx(
        0.5 * logged["representation/ActionNorm"] + 0.1 * logged["representation/reconstruction"], rel=1e-5
    )


def test_other_forms_of_the_objectives_work_on_any_extractor() -> None:
    forms = {
        "contrastive": {"weight": 1.0, "initialization": "uniform", "symmetric": False},
        "reconstruction": {"weight": 1.0, "bits": 5},
        "consistency": {"weight": 1.0, "predictor_side": "online", "predictor": "batch_norm", "normalize": True},
    }
    model = stock()
    before = weights(live_extractor(model))
    with pytest.warns(UserWarning, match="should sum to 1"):
        model.learn(16, callback=AuxiliaryLossCallback(forms))
    assert moved(before, live_extractor(model)) == set(before)


def test_it_logs_means_with_one_transfer(monkeypatch: pytest.MonkeyPatch) -> None:
    model = stock().learn(16)
    callback = AuxiliaryLossCallback(gradient_steps=3)
    callback.init_callback(model)
    assert callback.learner is not None
    calls: list[int] = []
    callback.learner._augment = lambda images: images  # type: ignore[method-assign]  # draws its offsets on the host
    monkeypatch.setattr(callback.learner.optimizer, "step", lambda: None)  # Adam counts its steps on the host
    for transfer in ("tolist", "item", "__float__", "__bool__"):
        monkeypatch.setattr(th.Tensor, transfer, _counted(getattr(th.Tensor, transfer), calls))
    metrics = callback.learner.train()
    assert len(calls) == 1
    assert {"representation/contrastive", "representation/loss", "representation/learning_rate"} <= set(metrics)


def _counted(function: Any, calls: list[int]) -> Any:
    def count(*args: Any, **kwargs: Any) -> Any:
        calls.append(1)
        return function(*args, **kwargs)

    return count


def test_a_loss_that_is_not_finite_stops_training() -> None:
    model = stock().learn(16)
    callback = AuxiliaryLossCallback()
    callback.init_callback(model)
    with th.no_grad():
        live_extractor(model).linear[0].bias.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match="representation/contrastive is nan after 1 auxiliary updates"):
        callback.on_rollout_end()
