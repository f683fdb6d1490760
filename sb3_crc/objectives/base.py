"""What an auxiliary objective is."""

from abc import ABC, abstractmethod
from typing import Any

import torch as th
from torch import nn
from typing_extensions import Self

from sb3_crc.encoder import PixelEncoder
from sb3_crc.views import Views


class AuxiliaryObjective(nn.Module, ABC):
    """
    A loss on the latents that trains the encoder beside the critic, with the weights that only this loss needs.

    Subclass it, implement ``forward``, and name it in ``objectives={"my_package.MyObjective": 0.1}``: optimizer, device,
    train/eval mode, save/load and log key follow. Keyword arguments of a subclass become keys of its settings:
    ``{"my_package.MyObjective": {"weight": 0.1, "margin": 2.0}}``. An objective that reads o_{t+1}, ``views.next``, declares
    it: ``reads_next = True`` in its class, or of itself.

    :param latent_dim: Z
    :param observation_shape: ``(C, H, W)`` of what the encoder is fed
    :param action_dim: A
    """

    #: Whether ``forward`` reads ``views.next``, which replay buffers with n-step returns do not all keep
    reads_next: bool = False

    def __init__(self, latent_dim: int, observation_shape: tuple[int, int, int], action_dim: int):
        super().__init__()
        self.latent_dim = latent_dim
        self.observation_shape = observation_shape
        self.action_dim = action_dim
        #: Scalars of the last forward pass, logged as ``representation/<objective>_<name>``
        self.metrics: dict[str, th.Tensor] = {}

    @classmethod
    def for_encoder(cls, encoder: PixelEncoder, action_dim: int, **own: Any) -> Self:
        """
        Build the objective that goes with ``encoder``; override it where more than the encoder's shapes matters.

        :param own: the objective's own settings, without its weight
        """
        return cls(encoder.features_dim, encoder.input_shape, action_dim, **own)

    @abstractmethod
    def forward(self, views: Views) -> th.Tensor:
        """:param views: the views of one batch; :return: the loss, a scalar"""
