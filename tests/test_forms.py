"""The forms of the algorithm: each setting changes what its documentation says, and nothing fails silently."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from torch.nn import functional as F

from sb3_crc import CRCSAC, PRESETS
from sb3_crc.augmentations import center_crop, random_crop, random_overlay
from sb3_crc.objectives import AuxiliaryObjective, Consistency, Contrastive, Reconstruction
from sb3_crc.objectives.reconstruction import quantize
from sb3_crc.views import Views
from tests.conftest import POLICY_KWARGS, make_model

SHAPE = (3, 40, 40)


def encoder_of(model: CRCSAC) -> list[th.Tensor]:
    return [parameter.detach().clone() for parameter in model.critic.features_extractor.parameters()]


def distance(first: list[th.Tensor], second: list[th.Tensor]) -> float:
    return th.cat([(a - b).flatten() for a, b in zip(first, second, strict=True)]).norm().item()


def count_encoder_backwards(model: CRCSAC) -> list[int]:
    """Filled with one entry each time a gradient passes the convolutions."""
    passes: list[int] = []

    def watch(module: th.nn.Module, args: Any, output: th.Tensor) -> None:
        if output.requires_grad:
            output.register_hook(lambda gradient: passes.append(1))

    model.critic.features_extractor.convolutions.register_forward_hook(watch)
    return passes


def test_joint_update_passes_the_encoder_once_with_the_sum_of_both_gradients() -> None:
    model = make_model(joint_update=True)
    encoder = list(model.critic.features_extractor.parameters())
    stepped_by_objectives = {id(p) for g in model.policy.encoder_optimizer.param_groups for p in g["params"]}
    assert stepped_by_objectives.isdisjoint(map(id, encoder))
    views = model._sample_views(16)
    views.anchor.images, views.positive.images, views.bootstrap.images  # draw the augmentations  # noqa: B018
    before = encoder_of(model)
    th.manual_seed(2)
    views.anchor.__dict__["latent"] = model.critic.features_extractor(views.anchor.images)  # with its graph
    loss = model._critic_loss(views) + sum(objective(views) / 3 for objective in model.policy.objectives.values())
    gradients = th.autograd.grad(loss, encoder)
    views.anchor.forget_encoding()

    passes = count_encoder_backwards(model)
    th.manual_seed(2)
    model._update_critic_and_encoder(views)
    assert len(passes) == 1
    for now, old, gradient in zip(encoder, before, gradients, strict=True):
        # Adam's first step; where the gradient is almost nothing its sign is rounding
        expected = -1e-3 * gradient / (gradient.abs() + 1e-8)
        clear = gradient.abs() > 1e-5
        assert th.allclose((now - old)[clear], expected[clear], atol=1e-6)


def test_two_gradients_pass_the_encoder_twice() -> None:
    model = make_model()
    passes = count_encoder_backwards(model)
    model.train(gradient_steps=1, batch_size=16)
    assert len(passes) == 2


def test_reencode_looks_again_after_the_critics_step() -> None:
    model = make_model(reencode=True)
    encoded: list[th.Tensor] = []
    first = model.critic.features_extractor.convolutions[0]
    model.critic.features_extractor.convolutions.register_forward_hook(
        lambda module, args, output: encoded.append(first.weight.detach().clone())
    )
    model.train(gradient_steps=1, batch_size=16)
    bootstrap, critic, objectives = encoded
    assert th.equal(bootstrap, critic)
    assert not th.equal(critic, objectives)
    encoded.clear()
    model.train(gradient_steps=1, batch_size=16)  # with an actor step
    assert len(encoded) == 4
    assert not th.equal(encoded[2], encoded[3])


@pytest.mark.parametrize("reencode", [False, True])
def test_objectives_can_step_at_every_second_update_only(reencode: bool) -> None:
    model = make_model(auxiliary_interval=2, reencode=reencode)
    passes = count_encoder_backwards(model)
    own = [parameter.detach().clone() for parameter in model.policy.objectives.parameters()]

    def moved() -> bool:
        return any(not th.equal(a, b) for a, b in zip(own, model.policy.objectives.parameters(), strict=True))

    model.train(gradient_steps=1, batch_size=16)
    assert len(passes) == 1 and not moved()  # of the critic alone
    model.train(gradient_steps=1, batch_size=16)
    assert len(passes) == 3 and moved()
    assert "representation/contrastive" in model.logger.name_to_value


@pytest.mark.parametrize("form", [{}, {"reencode": True}, {"joint_update": True}])
def test_objectives_rest_while_their_rate_is_zero(form: dict[str, Any]) -> None:
    """They are not computed then; jointly with the critic they still reach the encoder, by the critic's rate."""
    model = make_model(encoder_learning_rate="lin_0.01_0.5", qf_learning_rate=0.001, **form)
    computed: list[int] = []
    model.policy.objectives["contrastive"].register_forward_hook(lambda *_: computed.append(model._n_updates))
    for remaining in (1.0, 0.6, 0.4):
        model._current_progress_remaining = remaining
        own = [parameter.detach().clone() for parameter in model.policy.objectives.parameters()]
        encoder = [parameter.detach().clone() for parameter in model.critic.features_extractor.parameters()]
        model.train(gradient_steps=1, batch_size=16)
        moved = not all(map(th.equal, own, model.policy.objectives.parameters()))
        assert moved == (remaining > 0.5)
        assert not all(map(th.equal, encoder, model.critic.features_extractor.parameters()))  # by the critic at least
    assert computed == ([1, 2, 3] if "joint_update" in form else [1, 2])


def test_an_interval_of_no_updates_is_refused() -> None:
    with pytest.raises(ValueError, match="auxiliary_interval=0 must be an integer >= 1"):
        make_model(auxiliary_interval=0)


def test_joint_update_and_reencode_exclude_each_other() -> None:
    with pytest.raises(ValueError, match="joint_update and reencode"):
        make_model(joint_update=True, reencode=True)


def test_encoder_steps_equal_as_many_adams_on_one_gradient() -> None:
    """The released code steps three optimizers on one gradient; ours is one at three times the rate."""
    model = make_model(policy_kwargs={**POLICY_KWARGS, "encoder_steps": 3}, encoder_learning_rate=2e-3)
    model.critic.optimizer.step = lambda: None
    encoder = list(model.critic.features_extractor.parameters())
    copies = [parameter.detach().clone().requires_grad_() for parameter in encoder]
    adams = [th.optim.Adam(copies, lr=2e-3) for _ in range(3)]

    def follow(optimizer: th.optim.Optimizer, *_: Any) -> None:
        for copied, parameter in zip(copies, optimizer.param_groups[0]["params"], strict=True):
            copied.grad = parameter.grad.clone()
        for adam in adams:
            adam.step()

    model.policy.encoder_optimizer.register_step_pre_hook(follow)
    for _ in range(5):
        model.train(gradient_steps=1, batch_size=16)
    for parameter, copied in zip(encoder, copies, strict=True):
        assert th.allclose(parameter, copied, atol=1e-6)


def test_grad_norm_balance_divides_each_objective_by_its_norm_at_the_latent() -> None:
    model = make_model(balance="grad_norm")
    views = model._sample_views(16)
    td_gradient = th.randn(16, 16)
    first = model._auxiliary_gradients(views, td_gradient)
    norms = {name: first.metrics[f"representation/{name}_gradient_norm"] for name in model.policy.objectives}
    assert th.allclose(model.policy.gradient_norms, th.stack(list(norms.values())))
    expected = th.zeros(16, 16)
    for objective in model.policy.objectives.values():
        gradient = th.autograd.grad(objective(views), views.anchor.latent)[0]
        expected += gradient / gradient.norm() / 3
    assert th.allclose(first.leaves[0], expected, atol=1e-5)

    second = model._auxiliary_gradients(model._sample_views(16), td_gradient)
    for index, name in enumerate(norms):
        moving = 0.99 * norms[name] + 0.01 * second.metrics[f"representation/{name}_gradient_norm"]
        assert model.policy.gradient_norms[index].item() == pytest.approx(moving.item(), rel=1e-5)


class Features(AuxiliaryObjective):
    """Asks nothing of the latent."""

    def forward(self, views: Views) -> th.Tensor:
        return views.query.features.square().mean()


def test_an_objective_that_does_not_reach_the_latent_keeps_its_weight_in_the_balance() -> None:
    model = make_model(balance="grad_norm", objectives={"contrastive": 0.5, f"{__name__}.Features": 0.5})
    views = model._sample_views(16)
    found = model._auxiliary_gradients(views, th.randn(16, 16))
    own = th.autograd.grad(Features.forward(model.policy.objectives["Features"], views), views.query.features)[0]
    assert th.allclose(found.leaves[1], 0.5 * own)
    assert found.metrics["representation/loss"] < 1e3
    assert model.policy.gradient_norms[1] == 0 < model.policy.gradient_norms[0]


def test_the_balance_is_saved(tmp_path: Any) -> None:
    model = make_model(balance="grad_norm")
    model.train(gradient_steps=2, batch_size=16)
    model.save(tmp_path / "model")
    assert model.policy.gradient_norms.min() > 0
    assert th.equal(CRCSAC.load(tmp_path / "model").policy.gradient_norms, model.policy.gradient_norms)


def test_the_cosine_with_the_critics_gradient_is_logged() -> None:
    model = make_model(objectives={"contrastive": 1.0})
    views = model._sample_views(16)
    gradient = th.autograd.grad(model.policy.objectives["contrastive"](views), views.anchor.latent)[0]
    for td_gradient, cosine in ((3 * gradient, 1.0), (-gradient, -1.0)):
        metrics = model._auxiliary_gradients(views, td_gradient).metrics
        assert metrics["representation/contrastive_td_cosine"].item() == pytest.approx(cosine, abs=1e-5)


def test_anchor_center_crop_is_not_augmented() -> None:
    model = make_model(anchor="center_crop")
    batch = model.replay_buffer.sample(16)
    model.replay_buffer.sample_frames = lambda batch_size, env=None: batch
    views = model._sample_views(16)
    assert th.equal(views.anchor.images, center_crop(batch.observations, 34))
    assert not th.equal(views.positive.images, center_crop(batch.observations, 34))


def test_uniform_unsymmetric_bilinear() -> None:
    objective = Contrastive(16, SHAPE, 2, initialization="uniform", symmetric=False)
    assert objective.bilinear.min() >= 0
    assert objective.bilinear.max() < 1
    assert objective.bilinear.mean().item() == pytest.approx(0.5, abs=0.1)
    assert not th.equal(objective.bilinear, objective.bilinear.T)


def test_quantize_keeps_the_highest_bits_and_dithers() -> None:
    images = th.arange(256, dtype=th.uint8).view(1, 1, 16, 16)
    quantized = quantize(images, 5)
    level = th.floor((quantized + 0.5) * 32)
    assert th.equal(level.flatten(), (th.arange(256) // 8).float())
    assert quantized.min() >= -0.5
    assert quantized.max() < 0.5
    assert not th.equal(quantized, quantize(images, 5))


class Latents:
    """Stands for views whose encodings are given."""

    def __init__(self, batch: int = 8, dim: int = 16):
        rows = [th.randn(batch, dim) for _ in range(3)]
        self.query, self.positive, self.clean = (type("V", (), {"latent": row, "key_latent": row + 1}) for row in rows)


def test_reconstruction_of_quantised_pixels() -> None:
    views = Latents()
    views.query.images = th.randint(0, 256, (8, *SHAPE), dtype=th.uint8)
    objective = Reconstruction(16, SHAPE, 2, channels=(8,), strides=(2,), bits=5, latent_penalty=0, decoder_penalty=0)
    th.manual_seed(0)
    loss = objective(views)
    th.manual_seed(0)
    expected = F.mse_loss(objective.decoder(views.query.latent), quantize(views.query.images, 5))
    assert loss.item() == pytest.approx(expected.item())


def test_consistency_of_the_released_code() -> None:
    views = Latents()
    objective = Consistency(
        16, SHAPE, 2, predictor_side="online", predictor="batch_norm", normalize=True, reduction="mean", hidden_dim=24
    )
    names = [type(layer).__name__ for layer in objective.predictor]
    assert names == ["Linear", "BatchNorm1d", "ReLU", "Linear", "BatchNorm1d", "ReLU", "Linear"]
    predicted = objective.predictor(views.query.latent)
    for target in ("clean", "positive"):
        objective.target = target
        cosine = F.cosine_similarity(predicted, getattr(views, target).key_latent, dim=1)
        assert objective(views).item() == pytest.approx(
            ((2 - 2 * cosine) / 16).mean().item(), rel=1e-4
        )  # |a-b|^2, unit vectors


def test_batch_norm_statistics_are_learned_and_saved(tmp_path: Any) -> None:
    model = make_model(objectives={"contrastive": 0.5, "consistency": {"weight": 0.5, "predictor": "batch_norm"}})
    norm = model.policy.objectives["consistency"].predictor[1]
    model.train(gradient_steps=2, batch_size=16)
    assert norm.num_batches_tracked == 2
    model.save(tmp_path / "model")
    loaded = CRCSAC.load(tmp_path / "model").policy.objectives["consistency"].predictor[1]
    assert th.equal(loaded.running_mean, norm.running_mean)
    assert norm.running_mean.any()


def test_the_released_codes_crop_never_touches_the_last_offset() -> None:
    images = th.arange(12, dtype=th.uint8).view(1, 1, 1, 12).expand(2_000, 1, 12, 12)
    lefts = {int(left) for left in random_crop(images, 8, last_offset=False)[:, 0, 0, 0]}
    assert lefts == {0, 1, 2, 3}


def test_random_overlay_blends_one_picture_over_the_stack(tmp_path: Any) -> None:
    from PIL import Image

    for level in (0, 200):
        Image.fromarray(np.full((9, 7, 3), level, np.uint8)).save(tmp_path / f"{level}.png")
    images = th.full((200, 9, 20, 24), 100, dtype=th.uint8)
    blended = random_overlay(images, alpha=0.25, source=str(tmp_path))
    assert {int(image.unique()) for image in blended} == {75, 125}
    assert th.equal(random_overlay(images, alpha=0.0), images)
    procedural = random_overlay(images, alpha=1.0)
    assert th.equal(procedural[:, :3], procedural[:, 3:6])
    assert len(procedural.unique(dim=0)) > 30
    with pytest.raises(ValueError, match="no pictures"):
        random_overlay(images, source=str(tmp_path / "nothing"))


def test_pictures_that_are_none_or_too_large_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from PIL import Image

    images = th.zeros(2, 3, 8, 8, dtype=th.uint8)
    (tmp_path / "text").mkdir()
    (tmp_path / "text" / "no.png").write_text("no picture")
    with pytest.raises(ValueError, match=r"no\.png cannot be read as a picture"):
        random_overlay(images, source=str(tmp_path / "text"))
    (tmp_path / "large").mkdir()
    Image.new("RGB", (30, 40)).save(tmp_path / "large" / "large.png")
    monkeypatch.setattr("sb3_crc.augmentations.MOST_PIXELS", 1_000)
    with pytest.raises(ValueError, match=r"large\.png.*it has 30 x 40 pixels; at most 1000 of them are decoded"):
        random_overlay(images, source=str(tmp_path / "large"))


def test_crc_release_reproduces_its_rows() -> None:
    release = {key: value for key, value in PRESETS["crc_release"].items() if key not in ("batch_size", "policy_kwargs")}
    model = make_model(**release, policy_kwargs={**POLICY_KWARGS, **PRESETS["crc_release"]["policy_kwargs"]})
    objectives = model.policy.objectives
    assert PRESETS["crc_release"]["batch_size"] == 128  # row 10
    assert objectives["consistency"].predictor_side == "online"  # row 3
    assert objectives["consistency"].normalize  # row 4
    assert objectives["reconstruction"].bits == 5  # row 5
    weight = model._objective_weights["reconstruction"]
    assert weight * objectives["reconstruction"].latent_penalty == pytest.approx(1e-6)  # row 6
    assert weight * objectives["reconstruction"].decoder_penalty == pytest.approx(1e-7)
    assert not objectives["contrastive"].symmetric  # row 7
    assert [group["lr_factor"] for group in model.policy.encoder_optimizer.param_groups] == [3, 1]  # row 8
    before = copy.deepcopy(encoder_of(model))
    model.train(gradient_steps=1, batch_size=16)
    assert distance(before, encoder_of(model)) > 0


@pytest.mark.parametrize(("name", "value"), [("anchor", "centre_crop"), ("balance", "grad_norms"), ("augmentation", "crop")])
def test_unknown_choices_are_named_with_the_nearest(name: str, value: str) -> None:
    with pytest.raises(ValueError, match=f"unknown {name} {value!r}; did you mean .*Known: "):
        make_model(**{name: value})
