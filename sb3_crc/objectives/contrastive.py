"""The contrastive loss of CURL and CRC-RL: which key belongs to which query?

B batch, Z latent.
"""

import math

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_crc.objectives.base import AuxiliaryObjective
from sb3_crc.settings import check_name
from sb3_crc.views import Views

KEYS = ("positive", "next", "bootstrap")
INITIALIZATIONS = ("identity", "uniform")


def info_nce(query: th.Tensor, key: th.Tensor, bilinear: th.Tensor) -> th.Tensor:
    """
    InfoNCE with bilinear similarity, the other samples of the batch as negatives (CRC-RL, section on contrastive learning;
    CURL, eq. 4): the mean over the batch of ``-log(exp(q_i W k_i) / sum_j exp(q_i W k_j))``.

    :param query: ``(B, Z)``
    :param key: ``(B, Z)``, ``key[i]`` being the positive of ``query[i]``
    :param bilinear: W, ``(Z, Z)``
    :return: scalar; log B where the keys tell nothing
    """
    return _cross_entropy(_logits(query, key, bilinear))


class Contrastive(AuxiliaryObjective):
    """
    InfoNCE between the online encoding of the anchor and the key encoder's of another view.

    :param key: name of that view in :class:`~sb3_crc.views.Views`: ``"positive"``: o_t, augmented anew (CURL, CRC-RL);
        ``"next"``: o_{t+1}, so that the latent must hold what moves and how (augmented temporal contrast, arXiv 2009.08319);
        ``"bootstrap"``: o_{t+n}, whose key latent the Q targets need anyway: no further pass through an encoder
    :param initialization: of A: ``"identity"``: I / sqrt(Z), so that q'Wk starts as a scaled dot product; ``"uniform"``:
        U[0, 1) (CURL, the released code of CRC-RL)
    :param symmetric: W is (A + A') / 2, symmetric as the paper asks; False: W is A
    """

    def __init__(
        self,
        latent_dim: int,
        observation_shape: tuple[int, int, int],
        action_dim: int,
        *,
        key: str = "positive",
        initialization: str = "identity",
        symmetric: bool = True,
    ):
        super().__init__(latent_dim, observation_shape, action_dim)
        check_name("contrastive: key", key, KEYS)
        check_name("contrastive: initialization", initialization, INITIALIZATIONS)
        self.key = key
        self.reads_next = key == "next"
        self.symmetric = symmetric
        start = th.eye(latent_dim) / latent_dim**0.5 if initialization == "identity" else th.rand(latent_dim, latent_dim)
        self.weight = nn.Parameter(start)  # A

    @property
    def bilinear(self) -> th.Tensor:
        """W, ``(Z, Z)``."""
        return (self.weight + self.weight.T) / 2 if self.symmetric else self.weight

    def forward(self, views: Views) -> th.Tensor:
        """
        :param views: the views of one batch
        :return: the loss, a scalar; ``metrics`` then hold the share of queries whose own key scores best, and log B minus the
            loss, a lower bound of the mutual information in nats (arXiv 1807.03748)
        """
        logits = _logits(views.query.latent, getattr(views, self.key).key_latent, self.bilinear)
        loss = _cross_entropy(logits)
        correct = logits.detach().argmax(dim=1) == th.arange(len(logits), device=logits.device)
        self.metrics = {"accuracy": correct.float().mean(), "information": math.log(len(logits)) - loss.detach()}
        return loss


def _logits(query: th.Tensor, key: th.Tensor, bilinear: th.Tensor) -> th.Tensor:
    return query.float() @ bilinear.float() @ key.float().T  # (B, B)


def _cross_entropy(logits: th.Tensor) -> th.Tensor:
    return F.cross_entropy(logits, th.arange(len(logits), device=logits.device))
