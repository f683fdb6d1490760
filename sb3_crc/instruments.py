"""What tells a sick run from its log. docs/metrics.md explains each number.

B batch, F flattened convolution output, Z latent.
"""

import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch as th

#: Updates between two looks at the latent's health
HEALTH_INTERVAL = 100
#: A standard deviation of the latent over the batch below which it counts as collapsed
COLLAPSED_STD = 0.02
#: Updates for which it may stay so before the user is warned
COLLAPSED_UPDATES = 1_000


def latent_health(latents: th.Tensor, features: th.Tensor) -> dict[str, th.Tensor]:
    """
    Three numbers that tell a collapsed or dying encoder.

    :param latents: ``(B, Z)``
    :param features: output of the last ReLU, ``(B, F)``
    :return: ``latent_std``: standard deviation over the batch, mean over the latent's dimensions;
        ``effective_rank``: exponential of the entropy of the normalised singular values of the centred batch (Roy & Vetterli
        2007), 1 to Z; ``dead_relus``: share of units that are zero for the whole batch
    """
    centred = latents - latents.mean(dim=0)
    singular_values = th.linalg.svdvals(centred.float())
    shares = singular_values / singular_values.sum().clamp(min=1e-12)
    entropy = -(shares * shares.clamp(min=1e-12).log()).sum()
    return {
        "representation/latent_std": latents.std(dim=0).mean(),
        "representation/effective_rank": entropy.exp(),
        "representation/dead_relus": (features <= 0).all(dim=0).float().mean(),
    }


def update_ratio(before: Iterable[th.Tensor], after: Iterable[th.Tensor]) -> th.Tensor:
    """:return: norm of the change of some weights over their norm, a scalar"""
    old, new = (th.cat([tensor.detach().flatten() for tensor in tensors]) for tensors in (before, after))
    ratio: th.Tensor = (new - old).norm() / old.norm().clamp(min=1e-12)
    return ratio


@contextmanager
def watched(
    latents: Callable[[], tuple[th.Tensor, th.Tensor]], parts: Mapping[str, Sequence[th.Tensor]]
) -> Iterator[dict[str, th.Tensor]]:
    """
    Look at the latent, and at how far weights move within the context.

    :param latents: gives latent ``(B, Z)`` and features ``(B, F)``
    :param parts: name -> weights
    :return: filled with metrics when the context ends
    """
    metrics = latent_health(*(tensor.detach() for tensor in latents()))
    before = {name: [weight.detach().clone() for weight in weights] for name, weights in parts.items()}
    yield metrics
    metrics |= {f"train/{name}_update_ratio": update_ratio(before[name], weights) for name, weights in parts.items()}


class CollapseAlarm:
    """Warns, once for each time, when the latent has been almost the same for every image for a thousand updates."""

    def __init__(self) -> None:
        self._updates = 0

    def check(self, latent_std: float, updates: int) -> None:
        """
        :param latent_std: standard deviation of the latent over the batch
        :param updates: made since the last check
        """
        before = self._updates
        self._updates = before + updates if latent_std < COLLAPSED_STD else 0
        if before < COLLAPSED_UPDATES <= self._updates:
            warnings.warn(
                f"the latent has collapsed: its standard deviation over the batch has been below {COLLAPSED_STD} for "
                f"{self._updates} updates (now {latent_std:.2g}). Lower encoder_learning_rate or the weight of "
                "consistency, or look at the gradient norms in the log",
                stacklevel=2,
            )


class Speedometer:
    """Rates since it was last read."""

    def __init__(self) -> None:
        self._time = time.perf_counter()
        self._counts: dict[str, int] = {}

    def read(self, counts: Mapping[str, int]) -> dict[str, float]:
        """
        :param counts: name -> how many there have been
        :return: name -> how many per second since the last reading
        """
        now = time.perf_counter()
        seconds = max(now - self._time, 1e-9)
        rates = {name: (count - self._counts[name]) / seconds for name, count in counts.items() if name in self._counts}
        self._time, self._counts = now, dict(counts)
        return rates
