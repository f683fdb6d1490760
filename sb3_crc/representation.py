"""The auxiliary gradient: what each objective asks of the latent, weighted and summed.

B batch, F flattened convolution output, Z latent.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_crc.gradients import gradients_of
from sb3_crc.settings import described
from sb3_crc.views import Views

#: Share of the old value in the moving average of the gradient norms
NORM_DECAY = 0.99

Gradient = th.Tensor | None


@dataclass(frozen=True)
class AuxiliaryGradients:
    """
    Gradient of the weighted sum of the objectives.

    :param leaves: at the query's latent ``(B, Z)`` and features ``(B, F)``; None where no objective depends on one
    :param own: for each of the objectives' own parameters, in the order of ``objectives.parameters()``
    :param metrics: log key -> scalar
    """

    leaves: tuple[Gradient, Gradient]
    own: list[Gradient]
    metrics: dict[str, th.Tensor]


def auxiliary_gradients(
    objectives: nn.ModuleDict,
    weights: Mapping[str, float | th.Tensor],
    views: Views,
    td_gradient: th.Tensor,
    gradient_norms: th.Tensor,
    *,
    balance: bool,
) -> AuxiliaryGradients:
    """
    Differentiate each objective down to the latent, where their sizes and directions can be compared.

    :param objectives: name -> objective
    :param weights: name -> weight, a number or a scalar on the device
    :param views: of one batch
    :param td_gradient: of the critic loss at the latent, ``(B, Z)``, to compare directions with
    :param gradient_norms: moving average of each objective's gradient norm at the latent, updated in place
    :param balance: divide each objective by its moving average before weighting, where it has one: not if it reads the
        features alone
    :raises ValueError: if an objective returns no loss, or one that is detached
    """
    leaves: list[Gradient] = [None, None]
    own: list[Gradient] = []
    metrics: dict[str, th.Tensor] = {}
    total = td_gradient.new_zeros(())
    for index, (name, objective) in enumerate(objectives.items()):
        loss = checked_loss(name, objective, views)
        inputs = [*views.query.leaves, *objective.parameters()]
        gradients = gradients_of([loss], inputs)
        at_latent = th.zeros_like(td_gradient) if gradients[0] is None else gradients[0]
        norm = at_latent.norm()
        old = gradient_norms[index]
        moved = th.where(old > 0, NORM_DECAY * old + (1 - NORM_DECAY) * norm, norm)
        gradient_norms[index] = th.where(norm.isfinite(), moved, old)

        scale = weights[name]
        if balance:  # an objective that does not reach the latent has nothing to be compared by
            known = gradient_norms[index]
            scale = th.where(known > 0, scale / known.clamp(min=1e-12), scale)
        leaves = [_add(*pair, scale) for pair in zip(leaves, gradients[:2], strict=True)]
        own += [_add(None, gradient, scale) for gradient in gradients[2:]]
        total = total + scale * loss.detach()
        metrics[f"representation/{name}"] = loss.detach()
        metrics[f"representation/{name}_gradient_norm"] = norm
        metrics[f"representation/{name}_td_cosine"] = F.cosine_similarity(at_latent.flatten(), td_gradient.flatten(), dim=0)
        for key, value in objective.metrics.items():  # type: ignore[union-attr, operator]
            metrics[f"representation/{name}_{key}"] = value
    metrics["representation/loss"] = total
    return AuxiliaryGradients((leaves[0], leaves[1]), own, metrics)


def checked_loss(name: str, objective: nn.Module, views: Views) -> th.Tensor:
    """
    :param name: of the objective
    :param objective: to ask
    :param views: of one batch
    :return: its loss, a scalar with a graph, if anything is trained; its value is not looked at
    :raises ValueError: if it returns anything else
    """
    loss: Any = objective(views)
    if not isinstance(loss, th.Tensor) or loss.ndim > 0:
        raise ValueError(f"objective {name!r} returned {described(loss)}: it must return a scalar tensor, of shape ()")
    if not loss.requires_grad and any(tensor.requires_grad for tensor in (*views.query.leaves, *objective.parameters())):
        raise ValueError(
            f"objective {name!r} returned a loss that is detached, and trains nothing: it must be computed from the latent or "
            "features of views.query, or from its own parameters, without detach() or no_grad()"
        )
    return loss


def _add(total: Gradient, gradient: Gradient, scale: float | th.Tensor) -> Gradient:
    if gradient is None:
        return total
    return scale * gradient if total is None else total + scale * gradient
