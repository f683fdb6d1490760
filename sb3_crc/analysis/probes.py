"""Linear probes: how much of the state can be read off a latent by ridge regression.

n observations, Z latent, P quantities of the state.
"""

from dataclasses import dataclass

import numpy as np

from sb3_crc.analysis.intervals import ratio_over_episodes
from sb3_crc.experiments.ladder import PENALTIES
from sb3_crc.experiments.statistics import Estimate

FOLDS = 5
#: Variance below which a quantity counts as constant
CONSTANT = 1e-8


@dataclass(frozen=True)
class Probe:
    """
    :param predicted: ``(n, P)``, of each row by a fit that has not seen its episode; NaN where the quantity is constant
    :param targets: ``(n, P)``
    :param episodes: ``(n,)``
    """

    predicted: np.ndarray
    targets: np.ndarray
    episodes: np.ndarray

    def r2(self, *columns: int) -> Estimate:
        """
        :param columns: quantities
        :return: R^2 with its interval over episodes, for several quantities their mean, each quantity in units of its own
            standard deviation; NaN if none of them varies
        """
        targets, predicted = self.targets[:, columns], self.predicted[:, columns]
        varies = np.isfinite(predicted).all(axis=0)
        if not varies.any():
            return Estimate(float("nan"), None)
        targets, predicted = targets[:, varies], predicted[:, varies]
        variances = targets.var(axis=0)
        errors = ((predicted - targets) ** 2 / variances).mean(axis=1)
        about_the_mean = ((targets - targets.mean(axis=0)) ** 2 / variances).mean(axis=1)
        unexplained = ratio_over_episodes(errors, about_the_mean, self.episodes)
        interval = None if unexplained.interval is None else (1 - unexplained.interval[1], 1 - unexplained.interval[0])
        return Estimate(1 - unexplained.value, interval)


def probe(inputs: np.ndarray, targets: np.ndarray, episodes: np.ndarray, *, folds: int = FOLDS) -> Probe:
    """
    Predict each quantity in episodes that the fit has not seen: episode by episode in ``folds`` groups, the penalty chosen for
    each quantity in the same way within the others.

    :param inputs: ``(n, Z)``
    :param targets: ``(n, P)``
    :param episodes: ``(n,)``; those that begin equally must have one number
    :param folds: groups of episodes
    :return: the predictions
    :raises ValueError: for fewer than three episodes
    """
    numbers = np.unique(episodes)
    if len(numbers) < 3:
        raise ValueError(
            f"a probe needs at least 3 episodes, to fit, to choose the penalty and to be scored; there are {len(numbers)}"
        )
    predicted = np.full(targets.shape, np.nan)
    varies = targets.var(axis=0) > CONSTANT
    wanted = np.asarray(targets[:, varies], np.float64)
    found = np.empty_like(wanted)
    for held_out in _groups(episodes, folds):
        x, y = inputs[~held_out], wanted[~held_out]
        errors = np.zeros((len(PENALTIES), wanted.shape[1]))
        for scored in _groups(episodes[~held_out], folds):
            for number, penalty in enumerate(PENALTIES):
                guess = _ridge(x[~scored], y[~scored], x[scored], penalty)
                errors[number] += ((guess - y[scored]) ** 2).sum(axis=0)
        best = errors.argmin(axis=0)
        for number in np.unique(best):
            chosen = best == number
            found[np.ix_(held_out, chosen)] = _ridge(x, y[:, chosen], inputs[held_out], PENALTIES[number])
    predicted[:, varies] = found
    return Probe(predicted, np.asarray(targets, np.float64), episodes)


def pixel_components(images: np.ndarray, dimension: int) -> np.ndarray:
    """
    The first principal components of the pixels: what any linear encoder of this size could keep of the images' variance.

    :param images: uint8 ``(n, C, H, W)``
    :param dimension: Z
    :return: ``(n, min(Z, n - 1))``
    """
    flat = images.reshape(len(images), -1)
    gram = np.zeros((len(flat), len(flat)))
    for start in range(0, flat.shape[1], 4096):
        part = flat[:, start : start + 4096].astype(np.float32) / 255
        part -= part.mean(axis=0)
        gram += part @ part.T
    values, vectors = np.linalg.eigh(gram)
    kept = min(dimension, len(flat) - 1)
    return np.asarray((vectors[:, ::-1] * np.sqrt(values[::-1].clip(0)))[:, :kept])


def _ridge(inputs: np.ndarray, targets: np.ndarray, new: np.ndarray, penalty: float) -> np.ndarray:
    """Fit on standardised inputs and predict for the new ones."""
    mean, std = inputs.mean(axis=0), inputs.std(axis=0)
    scale = np.maximum(std, max(0.01 * std.max(), 1e-12))  # what hardly ever varies must not explode when it does
    x, center = np.asarray((inputs - mean) / scale, np.float64), targets.mean(axis=0)
    gram = x.T @ x + penalty * len(x) * np.eye(x.shape[1])
    weights = np.linalg.solve(gram, x.T @ (targets - center))
    return np.asarray((new - mean) / scale @ weights + center)


def _groups(episodes: np.ndarray, folds: int) -> list[np.ndarray]:
    """Masks of rows, ``(n,)`` each; every row is in one."""
    numbers = np.unique(episodes)
    return [np.isin(episodes, numbers[fold::folds]) for fold in range(min(folds, len(numbers)))]
