"""Gradients of what is trained, where not everything need be."""

from collections.abc import Sequence

import torch as th


def gradients_of(
    outputs: Sequence[th.Tensor],
    inputs: Sequence[th.Tensor],
    at_outputs: Sequence[th.Tensor] | None = None,
    *,
    retain_graph: bool = False,
) -> tuple[th.Tensor | None, ...]:
    """
    As :func:`torch.autograd.grad`, but inputs may be frozen.

    :param outputs: to differentiate
    :param inputs: with respect to which; a weight whose ``requires_grad`` is False is left alone
    :param at_outputs: gradient of some loss at each of ``outputs``; None: these are scalars, and are summed
    :param retain_graph: keep the graph for another call
    :return: one for each of ``inputs``; None where none reaches it
    """
    pairs = zip(outputs, [None] * len(outputs) if at_outputs is None else at_outputs, strict=True)
    ends = [pair for pair in pairs if pair[0].requires_grad]
    trained = [tensor for tensor in inputs if tensor.requires_grad]
    if not (ends and trained):
        return (None,) * len(inputs)
    from_outputs, at_ends = zip(*ends, strict=True)
    found = iter(th.autograd.grad(from_outputs, trained, at_ends, retain_graph=retain_graph, allow_unused=True))
    return tuple(next(found) if tensor.requires_grad else None for tensor in inputs)
