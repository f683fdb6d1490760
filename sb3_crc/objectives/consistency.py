"""The consistency loss of CRC-RL: can the latent be predicted from another view of the same frames?

B batch, Z latent.
"""

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_crc.encoder import init_orthogonal
from sb3_crc.objectives.base import AuxiliaryObjective
from sb3_crc.settings import check_name
from sb3_crc.views import Views

REDUCTIONS = ("sum", "mean")
SIDES = ("key", "online")
TARGETS = ("clean", "positive")
PREDICTORS = ("layer_norm", "batch_norm")


def consistency_loss(predicted: th.Tensor, target: th.Tensor, reduction: str = "sum") -> th.Tensor:
    """
    L_c of CRC-RL, ``E ||h(s') - s||^2``.

    :param predicted: h(s'), ``(B, Z)``
    :param target: s, ``(B, Z)``; it receives gradient as well
    :param reduction: ``"sum"`` or ``"mean"`` over the latent; over the batch it is always the mean
    :return: scalar
    :raises ValueError: for an unknown reduction
    """
    check_name("reduction", reduction, REDUCTIONS)
    squared = (predicted - target).square()  # (B, Z)
    return squared.sum(dim=1).mean() if reduction == "sum" else squared.mean()


class Consistency(AuxiliaryObjective):
    """
    Predict one network's latent from the other's. Alone this loss collapses the latent, so use it beside others.

    :param predictor_side: ``"key"``: h(s') predicts s, as the paper writes: from the key encoder's latent of the positive the
        online latent of the anchor, through which alone the encoder receives gradient; ``"online"``: h(s) predicts
        the key encoder's latent of ``target``, as the released code does (and SODA, arXiv 2011.13389)
    :param target: with the predictor on the online side, and only there: ``"clean"``, the middle of the frame (the released
        code; None is this too), or ``"positive"``, which is augmented like what the critic sees (SODA)
    :param predictor: ``"layer_norm"``: Linear, LayerNorm, ReLU, Linear; ``"batch_norm"``: Linear, BatchNorm, ReLU twice, then
        Linear (the released code)
    :param hidden_dim: width of the predictor
    :param normalize: both sides are divided by their norm first (the released code, SODA)
    :param reduction: see :func:`consistency_loss`
    """

    def __init__(
        self,
        latent_dim: int,
        observation_shape: tuple[int, int, int],
        action_dim: int,
        *,
        predictor_side: str = "key",
        target: str | None = None,
        predictor: str = "layer_norm",
        hidden_dim: int = 128,
        normalize: bool = False,
        reduction: str = "sum",
    ):
        super().__init__(latent_dim, observation_shape, action_dim)
        check_name("consistency: predictor_side", predictor_side, SIDES)
        if target is not None:
            check_name("consistency: target", target, TARGETS)
            if predictor_side == "key":
                raise ValueError(f"consistency: target={target!r} needs predictor_side='online': with 'key' it is the anchor")
        check_name("consistency: predictor", predictor, PREDICTORS)
        check_name("consistency: reduction", reduction, REDUCTIONS)
        self.predictor_side = predictor_side
        self.target = target or "clean"
        self.normalize = normalize
        self.reduction = reduction
        norm, hidden_layers = (nn.LayerNorm, 1) if predictor == "layer_norm" else (nn.BatchNorm1d, 2)
        layers: list[nn.Module] = []
        for width in (latent_dim, hidden_dim)[:hidden_layers]:
            layers += [nn.Linear(width, hidden_dim), norm(hidden_dim), nn.ReLU()]
        self.predictor = nn.Sequential(*layers, nn.Linear(hidden_dim, latent_dim)).apply(init_orthogonal)

    def forward(self, views: Views) -> th.Tensor:
        """:param views: the views of one batch; :return: the loss, a scalar"""
        if self.predictor_side == "key":
            predicted, target = self.predictor(views.positive.key_latent), views.query.latent
        else:
            predicted, target = self.predictor(views.query.latent), getattr(views, self.target).key_latent
        if self.normalize:
            predicted, target = F.normalize(predicted, dim=1), F.normalize(target, dim=1)
        return consistency_loss(predicted, target, self.reduction)
