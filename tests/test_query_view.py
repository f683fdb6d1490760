"""Objectives may see o_t in an augmentation of their own: the critic and the actor then see nothing of it."""

from typing import Any

import pytest
import torch as th

from sb3_crc import CRCSAC
from sb3_crc.views import Views
from tests.conftest import NoiseEnv, make_model

STRONG = {"objective_augmentation": "random_crop_overlay", "objective_augmentation_kwargs": {"alpha": 0.9}}


def drawn(model: CRCSAC) -> Views:
    """Views whose augmentations are all drawn."""
    views = model._sample_views(16)
    for view in (*views.anchors, views.query, views.positive, *views.bootstraps):
        assert view.images.shape[2:] == (34, 34)
    return views


def encoded(model: CRCSAC, views: Views, *names: str) -> None:
    """Give these views the encoder's output with its graph, so that autograd sees through it."""
    for name in names:
        view = getattr(views, name)
        view.__dict__["features"] = model.critic.features_extractor.convolve(view.pixels)
        view.__dict__["latent"] = model.critic.features_extractor.project(view.features)


def test_without_an_augmentation_of_their_own_objectives_see_the_anchor() -> None:
    views = make_model()._sample_views(16)
    assert views.query is views.anchor


@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("q_augmentations", [1, 2])
def test_each_gradient_comes_from_its_own_view(joint: bool, q_augmentations: int) -> None:
    model = make_model(**STRONG, joint_update=joint, q_augmentations=q_augmentations)
    encoder = list(model.critic.features_extractor.parameters())
    before = [parameter.detach().clone() for parameter in encoder]
    views = drawn(model)
    assert not th.equal(views.query.images, views.anchor.images)

    th.manual_seed(2)
    for anchor in views.anchors:
        anchor.__dict__["latent"] = model.critic.features_extractor(anchor.images)
    critic_loss = model._critic_loss(views)
    encoded(model, views, "query")
    total = sum(objective(views) / 3 for objective in model.policy.objectives.values())
    g_td, g_aux = (th.autograd.grad(loss, encoder, retain_graph=True) for loss in (critic_loss, total))
    views.forget_encodings()

    th.manual_seed(2)
    model._update_critic_and_encoder(views)
    # Adam's first step is -lr * sign(gradient) wherever the gradient is not tiny; both rates are 1e-3
    for parameter, old, td, aux in zip(encoder, before, g_td, g_aux, strict=True):
        gradients = [td + aux] if joint else [td, aux]
        expected = -1e-3 * sum(gradient / (gradient.abs() + 1e-8) for gradient in gradients)
        significant = td.abs().minimum(aux.abs()).minimum((td + aux).abs()) > 1e-6
        assert significant.any()
        assert th.allclose((parameter - old)[significant], expected[significant], atol=2e-5)


def test_critic_and_actor_do_not_see_it() -> None:
    """The same draws with and without: the images of everybody else are the same."""
    seen: list[list[th.Tensor]] = []
    for own in ({}, STRONG):
        model = make_model(**own)
        batch = model.replay_buffer.sample(16)
        model.replay_buffer.sample_frames = lambda batch_size, env=None, batch=batch: batch
        views = model._sample_views(16)
        th.manual_seed(3)
        seen.append([views.anchor.images, views.bootstrap.images, views.positive.images])
        before = th.random.get_rng_state()
        views.query.images  # noqa: B018
        assert th.equal(th.random.get_rng_state(), before) == (not own)
    assert all(th.equal(one, other) for one, other in zip(*seen, strict=True))


def test_a_strong_view_costs_one_encoding_more() -> None:
    model = make_model(**STRONG)
    calls: list[int] = []
    model.critic.features_extractor.convolutions.register_forward_hook(lambda *_: calls.append(1))
    model.train(gradient_steps=1, batch_size=16)
    assert len(calls) == 3  # anchor, query, bootstrap


def test_reencoding_encodes_the_query_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(**STRONG, reencode=True)
    weights = []
    objective = model.policy.objectives["contrastive"]
    original = objective.forward

    def forward(views: Views) -> th.Tensor:
        weights.append(model.critic.features_extractor(views.query.images) - views.query.latent)
        return original(views)

    monkeypatch.setattr(objective, "forward", forward)
    model.train(gradient_steps=1, batch_size=16)
    assert weights[0].abs().max() < 1e-5  # by the weights after the critic's step


def test_it_is_saved_and_bad_names_are_refused(tmp_path: Any) -> None:
    model = make_model(**STRONG)
    model.save(tmp_path / "model")
    loaded = CRCSAC.load(tmp_path / "model", env=NoiseEnv())
    assert loaded.objective_augmentation == "random_crop_overlay"
    images = th.zeros(1, 9, 40, 40, dtype=th.uint8)
    assert loaded._augment_query(images).float().mean() > 50 > loaded._augment(images).float().mean()
    with pytest.raises(ValueError, match="objective_augmentation 'random_crp'.*did you mean 'random_crop'"):
        make_model(objective_augmentation="random_crp")
    with pytest.raises(ValueError, match="beta"):
        make_model(objective_augmentation="random_overlay", objective_augmentation_kwargs={"beta": 1})


def test_where_nothing_asks_for_it_it_is_neither_drawn_nor_encoded() -> None:
    model = make_model(**STRONG, auxiliary_interval=2)
    drawn_names = []
    sample = model._sample_views
    model._sample_views = lambda size: drawn_names.append(sample(size)) or drawn_names[-1]  # type: ignore[func-returns-value]
    model.train(gradient_steps=4, batch_size=16)
    assert ["query" in views.drawn for views in drawn_names] == [False, True, False, True]
