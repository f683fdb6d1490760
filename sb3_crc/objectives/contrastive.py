"""The contrastive loss of CURL and CRC-RL: which key belongs to which query?

B batch, Z latent.
"""

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_crc.objectives.base import AuxiliaryObjective
from sb3_crc.views import Views


def info_nce(query: th.Tensor, key: th.Tensor, bilinear: th.Tensor) -> th.Tensor:
    """
    InfoNCE with bilinear similarity, the other samples of the batch as negatives (CRC-RL, section on contrastive learning;
    CURL, eq. 4): the mean over the batch of ``-log(exp(q_i W k_i) / sum_j exp(q_i W k_j))``.

    :param query: ``(B, Z)``
    :param key: ``(B, Z)``, ``key[i]`` being the positive of ``query[i]``
    :param bilinear: W, ``(Z, Z)``
    :return: scalar; log B where the keys tell nothing
    """
    logits = query.float() @ bilinear.float() @ key.float().T  # (B, B)
    return F.cross_entropy(logits, th.arange(len(query), device=query.device))


class Contrastive(AuxiliaryObjective):
    """
    InfoNCE between the online encoding of the anchor and the key encoder's of the positive.

    W starts at I / sqrt(Z) and stays symmetric, as the paper asks: it is (A + A') / 2 of the parameter A.
    """

    def __init__(self, latent_dim: int, observation_shape: tuple[int, int, int], action_dim: int):
        super().__init__(latent_dim, observation_shape, action_dim)
        self.weight = nn.Parameter(th.eye(latent_dim) / latent_dim**0.5)  # A

    @property
    def bilinear(self) -> th.Tensor:
        """W, ``(Z, Z)``, symmetric."""
        return (self.weight + self.weight.T) / 2

    def forward(self, views: Views) -> th.Tensor:
        """:param views: the views of one batch; :return: the loss, a scalar"""
        return info_nce(views.anchor.latent, views.positive.key_latent, self.bilinear)
