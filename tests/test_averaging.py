"""``q_augmentations`` and ``target_augmentations``: DrQ's two averages (arXiv 2004.13649, equations 1 and 3)."""

from typing import Any

import pytest
import torch as th
from torch.nn import functional as F

from sb3_crc import CRCSAC
from sb3_crc.views import Views
from tests.conftest import make_model

M, K = 2, 3


def drq_loss(model: CRCSAC, views: Views) -> th.Tensor:
    """The critic loss as the paper writes it, each augmentation through the whole network for itself."""
    encoder, key_encoder = model.critic.features_extractor, model.policy.key_encoder
    alpha = model.log_ent_coef.detach().exp()
    with th.no_grad():
        values = []
        for bootstrap in views.bootstraps:
            actions, log_prob = model.actor.action_log_prob(bootstrap.images)
            q_values = model.critic_target.q_values(key_encoder(bootstrap.images), actions, None)
            values.append(q_values.amin(dim=1, keepdim=True) - alpha * log_prob.view(-1, 1))
        targets = views.rewards + views.discounts * sum(values) / K
    errors = []
    for anchor in views.anchors:
        q_values = model.critic.q_values(encoder(anchor.images), views.actions, None)
        errors += [0.5 * F.mse_loss(q_values[:, [head]], targets) for head in range(q_values.shape[1])]
    return sum(errors) / M


@pytest.mark.parametrize("form", [{"objectives": {}}, {}, {"joint_update": True}, {"reencode": True}], ids=str)
def test_the_critics_gradient_is_that_of_drqs_average(form: dict[str, Any]) -> None:
    model = make_model(q_augmentations=M, target_augmentations=K, **form)
    views = model._sample_views(16)
    images = [view.images for view in (*views.anchors, *views.bootstraps)]
    assert len(images) == K + M
    assert not any(th.equal(a, b) for i, a in enumerate(images) for b in images[:i])  # each augmented for itself
    parameters = model.critic.optimizer.param_groups[0]["params"]
    if model.policy.objectives and model.joint_update:
        objectives = list(model.policy.objectives.values())
        views.positive.images  # draw its augmentation  # noqa: B018
    else:
        objectives = []
    th.manual_seed(2)
    loss = drq_loss(model, views)
    if objectives:  # which see the first anchor alone
        views.anchor.__dict__["latent"] = model.critic.features_extractor(views.anchor.images)
        loss = loss + sum(objective(views) / 3 for objective in objectives)
    expected = th.autograd.grad(loss, parameters)
    views.forget_encodings()

    steps: list[Any] = []
    step = model._step
    model._step = lambda name, optimizer, gradients: steps.append((name, gradients)) or step(name, optimizer, gradients)
    th.manual_seed(2)
    model._update_critic_and_encoder(views)
    (gradients,) = [gradients for name, gradients in steps if name == "critic"]
    for ours, theirs in zip(gradients, expected, strict=True):
        assert th.allclose(ours, theirs, rtol=1e-4, atol=1e-7)


def test_more_targets_have_less_variance() -> None:
    """Of 12 draws each: the mean of 8 independent augmentations varies less than one of them."""

    def spread(augmentations: int) -> float:
        model = make_model(target_augmentations=augmentations, objectives={})
        sample = model.replay_buffer.sample_frames(16)
        model.replay_buffer.sample_frames = lambda *_, **__: sample
        draws = []
        for _ in range(12):
            views = model._sample_views(16)
            draws.append(th.stack([model._next_values(view) for view in views.bootstraps]).mean(dim=0))
        return th.stack(draws).var(dim=0).mean().item()

    assert spread(8) < 0.5 * spread(1)


@pytest.mark.parametrize("name", ["q_augmentations", "target_augmentations"])
@pytest.mark.parametrize("value", [0, -1, 1.5])
def test_fewer_than_one_is_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"{name}={value} must be an integer >= 1"):
        make_model(**{name: value})
