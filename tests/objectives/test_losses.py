"""Each loss against its closed form and against an independent derivation in NumPy."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch as th
from torch.nn import functional as F

from sb3_crc.encoder import PixelEncoder
from sb3_crc.objectives import (
    OBJECTIVES,
    AuxiliaryObjective,
    Consistency,
    Contrastive,
    Reconstruction,
    build_objectives,
    consistency_loss,
    info_nce,
    reconstruction_loss,
)
from sb3_crc.views import Views
from tests.conftest import make_model
from tests.test_encoder import image_space

SHAPE = (3, 40, 40)


def test_info_nce_is_log_b_when_keys_tell_nothing() -> None:
    query, key = th.randn(32, 8), th.ones(32, 8)
    assert info_nce(query, key, th.eye(8)).item() == pytest.approx(math.log(32), rel=1e-6)
    assert info_nce(query, th.randn(32, 8), th.zeros(8, 8)).item() == pytest.approx(math.log(32), rel=1e-6)


def test_info_nce_of_orthogonal_pairs_in_closed_form() -> None:
    eye = th.eye(6)
    for scale in (0.5, 3.0):
        expected = -scale + math.log(math.exp(scale) + 5)
        assert info_nce(eye, eye, scale * eye).item() == pytest.approx(expected, rel=1e-5)


def test_info_nce_equals_numpy() -> None:
    rng = np.random.default_rng(0)
    query, key, bilinear = rng.normal(size=(7, 5)), rng.normal(size=(7, 5)), rng.normal(size=(5, 5))
    total = 0.0
    for i in range(7):  # sample by sample, as the paper writes it
        scores = [math.exp(query[i] @ bilinear @ key[j]) for j in range(7)]
        total -= math.log(scores[i] / sum(scores))
    assert info_nce(*(th.tensor(x) for x in (query, key, bilinear))).item() == pytest.approx(total / 7, rel=1e-5)


def test_reconstruction_loss_equals_numpy() -> None:
    rng = np.random.default_rng(0)
    decoded, target = rng.normal(size=(4, 3, 5, 6)), rng.normal(size=(4, 3, 5, 6))
    expected = sum((d - t) ** 2 for d, t in zip(decoded.ravel(), target.ravel(), strict=True)) / decoded.size
    assert reconstruction_loss(th.tensor(decoded), th.tensor(target)).item() == pytest.approx(expected)
    summed = reconstruction_loss(th.tensor(decoded), th.tensor(target), reduction="sum")
    assert summed.item() == pytest.approx(expected * 3 * 5 * 6)
    assert reconstruction_loss(th.full((2, 3, 4, 4), 0.25), th.full((2, 3, 4, 4), 0.75)).item() == pytest.approx(0.25)


def test_reconstruction_loss_has_the_gradient_of_mse_loss() -> None:
    decoded, target = (th.randn(4, 3, 5, 6, dtype=th.float64, requires_grad=True) for _ in range(2))
    for reduction, factor in (("mean", 1), ("sum", 3 * 5 * 6)):
        ours = th.autograd.grad(reconstruction_loss(decoded, target, reduction), [decoded, target])
        th.testing.assert_close(ours, th.autograd.grad(factor * F.mse_loss(decoded, target), [decoded, target]))


def test_consistency_loss_equals_numpy_in_both_reductions() -> None:
    rng = np.random.default_rng(0)
    predicted, target = rng.normal(size=(4, 10)), rng.normal(size=(4, 10))
    expected = sum(np.linalg.norm(p - t) ** 2 for p, t in zip(predicted, target, strict=True)) / 4
    pair = th.tensor(predicted), th.tensor(target)
    assert consistency_loss(*pair).item() == pytest.approx(expected)
    assert consistency_loss(*pair, reduction="mean").item() == pytest.approx(expected / 10)
    with pytest.raises(ValueError, match="median.*did you mean.*sum, mean"):
        consistency_loss(*pair, reduction="median")


def test_consistency_trains_both_sides() -> None:
    predicted, target = th.ones(2, 3, requires_grad=True), th.zeros(2, 3, requires_grad=True)
    consistency_loss(predicted, target).backward()
    assert th.equal(predicted.grad, th.ones(2, 3)) and th.equal(target.grad, -th.ones(2, 3))


def test_the_bilinear_matrix_starts_positive_and_stays_symmetric() -> None:
    objective = Contrastive(16, SHAPE, 2)
    assert th.allclose(objective.bilinear, th.eye(16) / 4)
    with th.no_grad():
        objective.weight += th.randn(16, 16)
    assert th.equal(objective.bilinear, objective.bilinear.T)


def test_reconstruction_adds_the_papers_penalties() -> None:
    class Query:
        latent = th.randn(4, 16)
        images = th.randint(0, 256, (4, *SHAPE), dtype=th.uint8)
        pixels = images / 255

    class Batch:
        query = Query

    objective = Reconstruction(16, SHAPE, 2, channels=(8,), strides=(2,), latent_penalty=0.3, decoder_penalty=0.01)
    squared_error = ((objective.decoder(Query.latent) - Query.pixels) ** 2).mean()
    latent = 0.3 * (Query.latent**2).sum() / 4 / 2
    weights = 0.01 * sum((parameter**2).sum() for parameter in objective.decoder.parameters()) / 2
    assert objective(Batch).item() == pytest.approx((squared_error + latent + weights).item(), rel=1e-5)


@pytest.mark.parametrize("key", ["positive", "next", "bootstrap"])
def test_the_key_is_the_latent_of_the_view_that_is_named(key: str) -> None:
    latents = {name: SimpleNamespace(latent=th.randn(6, 16), key_latent=th.randn(6, 16)) for name in ("query", key)}
    objective = Contrastive(16, SHAPE, 2, key=key)
    expected = info_nce(latents["query"].latent, latents[key].key_latent, objective.bilinear)
    assert th.equal(objective(SimpleNamespace(**latents)), expected)  # no other view is there to be read
    assert objective.reads_next == (key == "next")


def test_a_key_that_is_no_view_is_refused() -> None:
    with pytest.raises(ValueError, match=r"key 'future'.*positive, next, bootstrap"):
        Contrastive(16, SHAPE, 2, key="future")


def reconstruction_views(images: th.Tensor, latents: th.Tensor) -> SimpleNamespace:
    """Views whose query has a latent and no images, where only the clean view's may be read."""
    return SimpleNamespace(query=SimpleNamespace(latent=latents), clean=SimpleNamespace(images=images, pixels=images / 255))


def test_a_half_size_standardised_reconstruction_of_the_clean_view_equals_numpy() -> None:
    encoder = PixelEncoder(image_space(6, 20), channels=(4, 8), strides=(2, 1), features_dim=16, frame_differences=4.0)
    settings = {"weight": 1.0, "target": "clean", "half_size": True, "standardize": True}
    objective = build_objectives({"reconstruction": {**settings, "latent_penalty": 0, "decoder_penalty": 0}}, encoder, 2)
    images, latents = th.randint(0, 256, (5, 6, 20, 20), dtype=th.uint8), th.randn(5, 16)
    decoded = objective["reconstruction"].decoder(latents).detach().numpy()
    assert decoded.shape == (5, 6, 9, 9)  # of the first convolution's output

    halved = images.numpy()[:, :, 1:18:2, 1:18:2] / 255  # under the middles of its kernels
    fed = np.concatenate([4 * (halved[:, 3:] - halved[:, :3]), halved[:, 3:]], axis=1)
    deviation = fed - fed.mean(axis=0)
    target = deviation / np.sqrt((deviation**2).mean(axis=(0, 2, 3), keepdims=True))
    views = reconstruction_views(images, latents)
    assert objective["reconstruction"](views).item() == pytest.approx(((decoded - target) ** 2).mean(), rel=1e-4)


def test_standardised_a_reconstruction_sees_a_small_dot_that_moves() -> None:
    """All but one pixel is always the same. Compared is what is left of the loss, as a share of what the mean image leaves."""
    images = th.full((16, 3, 16, 16), 250, dtype=th.uint8)
    images[th.arange(16), :, th.arange(16), th.arange(16).flip(0)] = 170
    left = {}
    for standardize in (False, True):
        th.manual_seed(0)
        latents = th.randn(16, 16)
        objective = Reconstruction(
            16, (3, 16, 16), 1, channels=(8, 8), strides=(2, 1), target="clean", standardize=standardize
        )
        optimizer = th.optim.Adam(objective.parameters(), lr=1e-3)
        views = reconstruction_views(images, latents)
        mean_image = th.tensor(1.0) if standardize else (views.clean.pixels - views.clean.pixels.mean(dim=0)).square().mean()
        for _ in range(300):
            loss = objective(views)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        left[standardize] = (loss / mean_image).item()
    assert left[True] < 0.5 < 0.9 < left[False]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"target": "next"}, "target 'next'.*anchor, clean"),
        ({"half_size": True, "channels": (8,), "strides": (2,)}, "two conv"),
    ],
)
def test_a_reconstruction_that_cannot_be_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Reconstruction(16, SHAPE, 2, **settings)


def test_settings_reach_the_objective_and_the_decoder_mirrors_the_encoder() -> None:
    encoder = PixelEncoder(image_space(3, 40), channels=(8, 16), strides=(2, 2), features_dim=16)
    modules = build_objectives(
        {"reconstruction": 0.5, "consistency": {"weight": 0.5, "hidden_dim": 7, "reduction": "mean"}}, encoder, 2
    )
    assert modules["reconstruction"].decoder.start_shape == encoder.convolution_shape
    assert modules["consistency"].predictor[0].out_features == 7
    assert modules["consistency"].reduction == "mean"


class OwnObjective(Consistency):
    """A user's objective, found by its dotted path."""


def test_an_own_objective_is_found_by_its_dotted_path() -> None:
    encoder = PixelEncoder(image_space(3, 40), features_dim=16)
    modules = build_objectives({f"{__name__}.OwnObjective": {"weight": 0.1, "hidden_dim": 5}}, encoder, 2)
    assert type(modules["OwnObjective"]) is OwnObjective


@pytest.mark.parametrize(
    ("objectives", "message"),
    [
        ({"contrastiv": 1.0}, "contrastiv.*did you mean 'contrastive'.*reconstruction"),
        ({"contrastive": -0.1}, "contrastive.*>= 0.*-0.1"),
        ({"contrastive": float("nan")}, "finite.*nan"),
        ({"contrastive": {"margin": 1}}, "weight.*None"),
        ({"contrastive": {"weight": 1, "margin": 1}}, "no setting 'margin'.*weight"),
        ({"consistency": {"weight": 1, "hiden_dim": 1}}, "no setting 'hiden_dim'.*hidden_dim"),
        ({"consistency": {"weight": 1, "target": "positive"}}, "target='positive' needs predictor_side='online'"),
        ({"contrastive": 0.0, "consistency": 0}, "all weights.*objectives={}"),
        ({"no.such.Loss": 1.0}, "cannot be imported"),
        ({"math.sqrt": 1.0}, "subclass of AuxiliaryObjective"),
    ],
)
def test_bad_settings_are_named(objectives: dict[str, object], message: str) -> None:
    encoder = PixelEncoder(image_space(3, 40), features_dim=16)
    with pytest.raises(ValueError, match=message):
        build_objectives(objectives, encoder, 2)


@pytest.mark.parametrize(
    "setting", [{"bits": 2.5}, {"bits": True}, {"bits": 9}, {"latent_penalty": -1}, {"decoder_penalty": "1"}]
)
def test_reconstruction_names_the_setting_that_cannot_be(setting: dict[str, Any]) -> None:
    ((name, value),) = setting.items()
    with pytest.raises(ValueError, match=f"reconstruction: {name}={value!r} must be"):
        Reconstruction(16, SHAPE, 2, **setting)


class Returns(AuxiliaryObjective):
    """What its function makes of the latent."""

    function: Any = None

    def forward(self, views: Views) -> th.Tensor:
        return self.function(views.query.latent)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (
            lambda latent: latent.square().mean(dim=1),
            r"a Tensor of shape \(16,\) and type float32: it must return a scalar tensor",
        ),
        (lambda latent: None, "None: it must return a scalar tensor"),
        (lambda latent: 0.5, "0.5: it must return a scalar tensor"),
        (lambda latent: latent.detach().mean(), "a loss that is detached, and trains nothing"),
    ],
)
def test_what_is_no_loss_is_named_with_its_objective(function: Any, message: str) -> None:
    model = make_model(objectives={f"{__name__}.Returns": 1.0})
    model.policy.objectives["Returns"].function = function
    with pytest.raises(ValueError, match=f"objective 'Returns' returned.*{message}"):
        model.train(gradient_steps=1, batch_size=16)


def test_settings_against_the_papers_advice_warn() -> None:
    encoder = PixelEncoder(image_space(3, 40), features_dim=16)
    with pytest.warns(UserWarning, match="collapses"):
        build_objectives({"consistency": 1.0}, encoder, 2)
    with pytest.warns(UserWarning, match="sum to 1"):
        build_objectives(dict.fromkeys(OBJECTIVES, 1.0), encoder, 2)
