"""Bootstrap intervals over episodes, and over models and their episodes.

Decisions of an episode follow from each other, so whole episodes are drawn, not decisions: intervals of single decisions would
be several times too narrow. What was measured of each decision is kept as it is, so that no sample contains copies of a point
that are each other's nearest neighbours.

n decisions, R bootstrap samples.
"""

from collections.abc import Sequence

import numpy as np

from sb3_crc.experiments.statistics import Estimate

REPS = 1_000
LEVELS = (2.5, 97.5)


def ratio_over_episodes(
    numerators: np.ndarray, denominators: np.ndarray, episodes: np.ndarray, *, reps: int = REPS, seed: int = 0
) -> Estimate:
    """
    A ratio of sums, for instance a mean (denominators 1) or an unexplained share of a variance.

    :param numerators: ``(n,)``
    :param denominators: ``(n,)``
    :param episodes: ``(n,)``
    :param reps: R
    :param seed: of the bootstrap
    :return: the ratio and its 95 % interval; none with one episode
    """
    value, samples = _ratio_samples(numerators, denominators, episodes, reps, np.random.default_rng(seed))
    return Estimate(value, _interval(samples))


def mean_over_models(scores: Sequence[tuple[np.ndarray, np.ndarray]], *, reps: int = REPS, seed: int = 0) -> Estimate:
    """
    :param scores: of each model: what was measured of each decision ``(n,)``, and their episodes ``(n,)``
    :param reps: R
    :param seed: of the bootstrap
    :return: mean over the models of their means; its interval draws models, then each one's episodes; none with one model
    """
    rng = np.random.default_rng(seed)
    each = [_ratio_samples(values, np.ones(len(values)), episodes, reps, rng) for values, episodes in scores]
    value = float(np.mean([mean for mean, _ in each]))
    if len(each) < 2 or any(samples is None for _, samples in each):
        return Estimate(value, None)
    samples = np.stack([one for _, one in each if one is not None])  # (models, R)
    drawn = rng.integers(len(each), size=(len(each), reps))
    return Estimate(value, _interval(np.take_along_axis(samples, drawn, axis=0).mean(axis=0)))


def _ratio_samples(
    numerators: np.ndarray, denominators: np.ndarray, episodes: np.ndarray, reps: int, rng: np.random.Generator
) -> tuple[float, np.ndarray | None]:
    total = denominators.sum()
    if not total > 0:
        return float("nan"), None
    _, group = np.unique(episodes, return_inverse=True)
    count = group.max() + 1
    above, below = (np.bincount(group, weights, count) for weights in (numerators, denominators))
    drawn = rng.integers(count, size=(reps, count))
    with np.errstate(invalid="ignore", divide="ignore"):
        samples = above[drawn].sum(axis=1) / below[drawn].sum(axis=1)
    return float(above.sum() / total), samples if count > 1 else None


def _interval(samples: np.ndarray | None) -> tuple[float, float] | None:
    if samples is None or not np.isfinite(samples).any():
        return None
    low, high = np.percentile(samples[np.isfinite(samples)], LEVELS)
    return float(low), float(high)
