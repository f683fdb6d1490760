"""Each argument of policy and encoder that no other test looks at: ignoring it would fail here."""

from typing import Any

import pytest
import torch as th
from torch import nn

from sb3_crc import CRCSAC, PixelEncoder
from tests.conftest import NoiseEnv, make_model
from tests.test_encoder import image_space


def build(**policy_kwargs: Any) -> CRCSAC:
    encoder = {"channels": [8, 8], "strides": [2, 2], "features_dim": 16}
    kwargs = {"net_arch": [32, 24], "features_extractor_kwargs": encoder, **policy_kwargs}
    return CRCSAC("CnnPolicy", NoiseEnv(), buffer_size=50, policy_kwargs=kwargs, seed=0, device="cpu")


def types(module: nn.Module) -> list[str]:
    return [type(layer).__name__ for layer in module]


def test_net_arch_and_activation() -> None:
    policy = build(net_arch={"pi": [12], "qf": [20, 10]}, activation_fn=nn.ELU).policy
    assert [layer.out_features for layer in policy.actor.latent_pi if isinstance(layer, nn.Linear)] == [12]
    assert [layer.out_features for layer in policy.critic.q_networks[0] if isinstance(layer, nn.Linear)] == [20, 10, 1]
    assert types(policy.actor.latent_pi) == ["Linear", "ELU"]


def test_layer_norm_in_actor_and_q_heads() -> None:
    with_norm, without = build(layer_norm=True).policy, build().policy
    assert types(with_norm.critic.q_networks[1]) == ["Linear", "LayerNorm", "ReLU"] * 2 + ["Linear"]
    assert types(with_norm.actor.latent_pi) == ["Linear", "LayerNorm", "ReLU"] * 2
    assert "LayerNorm" not in types(without.critic.q_networks[0]) + types(without.actor.latent_pi)


def test_number_of_critics() -> None:
    model = build(n_critics=3)
    images = th.zeros(4, 9, 40, 40, dtype=th.uint8)
    assert len(model.critic(images, th.zeros(4, 2))) == 3
    assert model.critic.q_values(model.critic.features_extractor(images), th.zeros(4, 2)).shape == (4, 3)


@pytest.mark.parametrize("bounds", [(-10, 2), (-5.0, -1.0)])
def test_log_std_is_squashed_into_its_bounds(bounds: tuple[float, float]) -> None:
    actor = build(log_std_bounds=bounds).actor
    images = th.randint(0, 256, (4, 9, 40, 40), dtype=th.uint8)
    middle = sum(bounds) / 2
    with th.no_grad():
        actor.log_std.weight.zero_()
        for bias, expected in ((-50.0, bounds[0]), (0.0, middle), (50.0, bounds[1])):
            actor.log_std.bias.fill_(bias)
            assert th.allclose(actor.get_action_dist_params(images)[1], th.tensor(expected, dtype=th.float32))


@pytest.mark.parametrize("bounds", [(2, -10), (0, 0), (float("-inf"), 2), (-10, float("nan"))])
def test_bounds_of_the_log_std_that_bound_nothing_are_refused(bounds: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="log_std_bounds=.*first below the second"):
        build(log_std_bounds=bounds)


def test_optimizer_class_and_arguments_reach_every_optimizer() -> None:
    model = build(optimizer_class=th.optim.AdamW, optimizer_kwargs={"weight_decay": 0.07})
    for optimizer in (model.actor.optimizer, model.critic.optimizer, model.policy.encoder_optimizer):
        assert isinstance(optimizer, th.optim.AdamW)
        assert all(group["weight_decay"] == 0.07 for group in optimizer.param_groups)


def test_actor_features_choose_what_the_actor_sees() -> None:
    conv, latent = build(actor_features="conv").actor, build(actor_features="latent").actor
    assert conv.projection[0].in_features == conv.features_extractor.convolution_dim
    assert conv.projection[0].out_features == 16
    assert isinstance(latent.projection, nn.Identity)
    assert latent.latent_pi[0].in_features == 16


def test_latent_activation_holds_for_encoder_key_encoder_and_actor() -> None:
    policy = build(features_extractor_kwargs={"channels": [8], "strides": [2], "latent_activation": "tanh"}).policy
    for projection in (policy.critic.features_extractor.projection, policy.key_encoder.projection, policy.actor.projection):
        assert types(projection) == ["Linear", "LayerNorm", "Tanh"]


def test_channels_strides_kernels_and_latent() -> None:
    encoder = PixelEncoder(image_space(3, 40), 7, channels=(5, 6), strides=(3, 1), kernel_size=5)
    convolutions = [layer for layer in encoder.convolutions if isinstance(layer, nn.Conv2d)]
    assert [(c.out_channels, c.stride[0], c.kernel_size[0]) for c in convolutions] == [(5, 3, 5), (6, 1, 5)]
    assert encoder(th.zeros(1, 3, 40, 40)).shape == (1, 7)


def test_image_size_of_crops_is_84_percent_and_of_shifts_the_frame() -> None:
    assert make_model().policy.key_encoder.input_shape == (9, 34, 34)
    assert make_model(augmentation="random_shift").policy.key_encoder.input_shape == (9, 40, 40)
    assert make_model(augmentation="random_shift", image_size=(36, 38)).policy.key_encoder.input_shape == (9, 36, 38)


def test_augmentation_kwargs_reach_the_augmentation() -> None:
    model = make_model(augmentation="random_shift", augmentation_kwargs={"pad": 0})
    batch = model.replay_buffer.sample(8)
    assert th.equal(model._augment(batch.observations), batch.observations)
    moved = make_model(augmentation="random_shift", augmentation_kwargs={"pad": 3})
    assert not th.equal(moved._augment(batch.observations), batch.observations)


def test_gamma_reaches_the_targets() -> None:
    views = make_model(gamma=0.8)._sample_views(16)
    assert th.equal(views.discounts, th.full((16, 1), 0.8))  # time limits do not terminate
