"""The consistency loss of CRC-RL: can the latent be predicted from another view of the same frames?

B batch, Z latent.
"""

import torch as th
from torch import nn

from sb3_crc.encoder import init_orthogonal
from sb3_crc.objectives.base import AuxiliaryObjective
from sb3_crc.views import Views

REDUCTIONS = ("sum", "mean")


def consistency_loss(predicted: th.Tensor, target: th.Tensor, reduction: str = "sum") -> th.Tensor:
    """
    L_c of CRC-RL, ``E ||h(s') - s||^2``.

    :param predicted: h(s'), ``(B, Z)``
    :param target: s, ``(B, Z)``; it receives gradient as well
    :param reduction: ``"sum"`` or ``"mean"`` over the latent; over the batch it is always the mean
    :return: scalar
    :raises ValueError: for an unknown reduction
    """
    if reduction not in REDUCTIONS:
        raise ValueError(f"unknown reduction {reduction!r}; known: {', '.join(REDUCTIONS)}")
    squared = (predicted - target).square()  # (B, Z)
    return squared.sum(dim=1).mean() if reduction == "sum" else squared.mean()


class Consistency(AuxiliaryObjective):
    """
    Predict the online latent s of the anchor from the key encoder's latent s' of the positive.

    The encoder receives its gradient through s only; alone this loss collapses the latent, so use it beside others.

    :param hidden_dim: width of the predictor h
    :param reduction: see :func:`consistency_loss`
    """

    def __init__(
        self,
        latent_dim: int,
        observation_shape: tuple[int, int, int],
        action_dim: int,
        *,
        hidden_dim: int = 128,
        reduction: str = "sum",
    ):
        super().__init__(latent_dim, observation_shape, action_dim)
        if reduction not in REDUCTIONS:
            raise ValueError(f"consistency: unknown reduction {reduction!r}; known: {', '.join(REDUCTIONS)}")
        self.reduction = reduction
        self.predictor = nn.Sequential(
            nn.Linear(latent_dim, hidden_dim), nn.LayerNorm(hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, latent_dim)
        )
        self.predictor.apply(init_orthogonal)

    def forward(self, views: Views) -> th.Tensor:
        """:param views: the views of one batch; :return: the loss, a scalar"""
        return consistency_loss(self.predictor(views.positive.key_latent), views.anchor.latent, self.reduction)
