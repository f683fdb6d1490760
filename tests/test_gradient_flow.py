"""Which step trains which weights: parameters are compared before and after."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_crc import CRCSAC
from sb3_crc.objectives import OBJECTIVES, AuxiliaryObjective
from sb3_crc.views import Views
from tests.conftest import POLICY_KWARGS, make_model


def parts(model: CRCSAC) -> dict[str, list[th.Tensor]]:
    """The weights by who is meant to train them."""
    policy = model.policy
    encoder = policy.critic.features_extractor
    modules: dict[str, list[nn.Module]] = {
        "convolutions": [encoder.convolutions],
        "projection": [encoder.projection],
        "q_heads": policy.critic.q_networks,
        "actor": policy.actor.own_modules(),
        "objectives": [policy.objectives],
        "key_encoder": [policy.key_encoder],
        "target_heads": policy.critic_target.q_networks,
    }
    return {name: [p.detach().clone() for m in group for p in m.parameters()] for name, group in modules.items()}


def moved(model: CRCSAC, change: Callable[[], object]) -> set[str]:
    before = parts(model)
    change()
    after = parts(model)
    return {name for name in before if not all(map(th.equal, before[name], after[name]))}


def freeze(*optimizers: th.optim.Optimizer | None) -> None:
    for optimizer in optimizers:
        if optimizer is not None:
            optimizer.step = lambda *args, **kwargs: None


def test_the_critic_loss_trains_encoder_and_q_heads_only() -> None:
    model = make_model()
    freeze(model.policy.encoder_optimizer)
    views = model._sample_views(16)
    assert moved(model, lambda: model._update_critic_and_encoder(views)) == {"convolutions", "projection", "q_heads"}


@pytest.mark.parametrize("name", OBJECTIVES)
@pytest.mark.filterwarnings("ignore:consistency is the only objective")
def test_each_objective_trains_encoder_and_its_own_weights_only(name: str) -> None:
    model = make_model(objectives={name: 1.0})
    freeze(model.critic.optimizer)
    views = model._sample_views(16)
    assert moved(model, lambda: model._update_critic_and_encoder(views)) == {"convolutions", "projection", "objectives"}


@pytest.mark.parametrize("actor_features", ["conv", "latent"])
def test_the_actor_loss_trains_the_actor_only(actor_features: str) -> None:
    model = make_model(policy_kwargs={**POLICY_KWARGS, "actor_features": actor_features})
    views = model._sample_views(16)
    temperature = model.log_ent_coef.item()
    assert moved(model, lambda: model._update_actor_and_temperature(views)) == {"actor"}
    assert model.log_ent_coef.item() != temperature
    assert all(p.grad is None for p in model.critic.parameters())


def test_targets_follow_at_their_own_rates() -> None:
    model = make_model(tau=0.25, encoder_tau=0.5)
    with th.no_grad():
        for parameter in model.critic.parameters():
            parameter.add_(1.0)
    before = parts(model)
    assert moved(model, model._update_targets) == {"key_encoder", "target_heads"}
    after = parts(model)
    for name, rate in (("key_encoder", 0.5), ("target_heads", 0.25)):
        for old, new in zip(before[name], after[name], strict=True):
            assert th.allclose(new - old, th.full_like(old, rate), atol=1e-6), name


def test_target_networks_are_copies_at_construction_and_frozen() -> None:
    model = make_model()
    online, target = model.critic.state_dict(), model.critic_target.state_dict()
    assert online.keys() == target.keys() and all(th.equal(online[key], target[key]) for key in online)
    assert model.policy.key_encoder is model.critic_target.features_extractor
    assert model.policy.key_encoder is not model.critic.features_extractor
    assert model.actor.features_extractor is model.critic.features_extractor
    assert not any(p.requires_grad for p in model.critic_target.parameters())


def test_both_gradients_are_taken_at_the_same_weights() -> None:
    """The order of the two optimizers' steps must not matter: neither gradient sees the other's step."""
    model = make_model()
    reference = copy.deepcopy(model.policy)
    th.manual_seed(1)
    views = model._sample_views(16)
    views.anchor.images, views.positive.images, views.bootstrap.images  # draw the augmentations  # noqa: B018
    th.manual_seed(2)
    encoder = list(model.critic.features_extractor.parameters())
    views.anchor.__dict__["latent"] = model.critic.features_extractor(views.anchor.images)  # with its graph
    critic_loss = model._critic_loss(views)
    total = sum(objective(views) / 3 for objective in model.policy.objectives.values())
    gradients = [th.autograd.grad(loss, encoder, retain_graph=True) for loss in (critic_loss, total)]
    views.anchor.forget_encoding()

    th.manual_seed(2)
    model._update_critic_and_encoder(views)
    # Adam's first step is -lr * sign(gradient) wherever the gradient is not tiny: lr 1e-3 for both optimizers
    old = reference.critic.features_extractor.parameters()
    for parameter, before, g_td, g_aux in zip(encoder, old, *gradients, strict=True):
        expected = -1e-3 * (g_td / (g_td.abs() + 1e-8) + g_aux / (g_aux.abs() + 1e-8))
        assert th.allclose(parameter - before, expected, atol=2e-6)


def test_each_view_is_encoded_at_most_once_per_network() -> None:
    model = make_model()
    calls: list[tuple[str, int]] = []
    networks = {"online": model.critic.features_extractor, "key": model.policy.key_encoder}
    for name, network in networks.items():
        network.convolutions.register_forward_hook(lambda module, args, out, name=name: calls.append((name, len(args[0]))))
    model.train(gradient_steps=2, batch_size=16)  # the second update has an actor and a target step too
    assert calls.count(("online", 16)) == 2 * 2  # anchor, bootstrap
    assert calls.count(("key", 16)) == 2 * 2  # bootstrap, positive
    assert len(calls) == 8

    calls.clear()
    plain = make_model(objectives={})
    plain.critic.features_extractor.convolutions.register_forward_hook(lambda *_: calls.append(("online", 0)))
    plain.policy.key_encoder.convolutions.register_forward_hook(lambda *_: calls.append(("key", 0)))
    plain.train(gradient_steps=2, batch_size=16)
    assert sorted(calls) == [("key", 0)] * 2 + [("online", 0)] * 4  # no positive is made


def test_the_view_table_holds() -> None:
    """Anchor, positive and bootstrap are independent crops of the frames that the table in views.py names."""
    model = make_model()
    seen: dict[str, list[th.Tensor]] = {"online": [], "key": []}
    for name, network in (("online", model.critic.features_extractor), ("key", model.policy.key_encoder)):
        network.convolutions.register_forward_pre_hook(lambda module, args, name=name: seen[name].append(args[0] * 255))
    batch = model.replay_buffer.sample(16)
    model.replay_buffer.sample_frames = lambda batch_size, env=None: batch
    model.train(gradient_steps=2, batch_size=16)

    def source(pixels: th.Tensor) -> str:
        for name in ("observations", "next_observations"):
            windows = getattr(batch, name)[0].unfold(1, 34, 1).unfold(2, 34, 1).float()  # every crop of sample 0
            if ((windows - pixels[0].round()[:, None, None]).abs().amax(dim=(0, 3, 4)) < 0.5).any():
                return name
        return "neither"

    assert [source(pixels) for pixels in seen["online"]] == ["next_observations", "observations"] * 2
    assert [source(pixels) for pixels in seen["key"]] == ["next_observations", "observations"] * 2
    (bootstrap, anchor), (key_bootstrap, positive) = seen["online"][:2], seen["key"][:2]
    assert th.equal(bootstrap, key_bootstrap)
    assert not th.equal(anchor, positive)


class Teacher(AuxiliaryObjective):
    """A layer to train, and one that never is."""

    def __init__(self, latent_dim: int, *shapes: Any):
        super().__init__(latent_dim, *shapes)
        self.fixed = nn.Linear(latent_dim, 8).requires_grad_(False)
        self.student = nn.Linear(latent_dim, 8)

    def forward(self, views: Views) -> th.Tensor:
        return F.mse_loss(self.student(views.query.latent), self.fixed(views.positive.key_latent))


@pytest.mark.parametrize(
    ("frozen", "own"),
    [
        *((frozen, {}) for frozen in ("teacher", "convolutions", "projection", "encoder", "actor", "heads")),
        *(("encoder", own) for own in ({"joint_update": True}, {"reencode": True}, {"max_grad_norm": 1.0})),
    ],
    ids=str,
)
def test_frozen_weights_stay_and_the_others_learn(frozen: str, own: dict[str, Any]) -> None:
    model = make_model(objectives={"contrastive": 0.5, f"{__name__}.Teacher": 0.5}, policy_delay=1, **own)
    encoder, objectives = model.policy.critic.features_extractor, model.policy.objectives
    modules = {
        "teacher": [objectives["Teacher"].fixed],
        **{"convolutions": [encoder.convolutions], "projection": [encoder.projection], "encoder": [encoder]},
        **{"actor": model.actor.own_modules(), "heads": model.policy.critic.q_networks},
    }[frozen]
    weights = [parameter.requires_grad_(False) for module in modules for parameter in module.parameters()]
    before = [weight.clone() for weight in weights]
    others = [parameter for parameter in model.policy.parameters() if parameter.requires_grad]
    old = [parameter.detach().clone() for parameter in others]
    model.train(gradient_steps=3, batch_size=16)
    assert all(map(th.equal, weights, before))
    assert not any(map(th.equal, others, old))
    assert all(np.isfinite(value) for name, value in model.logger.name_to_value.items() if name.startswith("train/"))


def test_a_frozen_encoder_without_objectives() -> None:
    model = make_model(objectives={})
    model.policy.critic.features_extractor.requires_grad_(False)
    trained = moved(model, lambda: model.train(gradient_steps=2, batch_size=16))
    assert trained - {"key_encoder"} == {"q_heads", "actor", "target_heads"}  # averaging equal weights rounds
