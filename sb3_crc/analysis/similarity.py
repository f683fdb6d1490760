"""How alike two representations of the same observations are.

n observations, X and Y latents ``(n, Z)`` and ``(n, Z')``, row i of both being of the same observation.
"""

import numpy as np

#: Share of the variance that is kept before a CCA
VARIANCE = 0.99


def sample_correlations(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """
    The paper's heat map: Pearson correlation of feature vectors, each vector about its own mean over the dimensions.

    Between two models it compares dimension i with dimension i, though nothing ties the two dimensions together: rotate one
    latent, which no linear layer behind it would notice, and it changes. Within a model it says how much the vectors share.

    :param x: ``(n, Z)``
    :param y: ``(m, Z)``
    :return: ``(n + m, n + m)``, blocks XX, XY; YX, YY
    :raises ValueError: if the latents have different sizes
    """
    if x.shape[1] != y.shape[1]:
        raise ValueError(f"feature vectors of {x.shape[1]} and {y.shape[1]} dimensions have no correlation")
    vectors = np.concatenate([x, y]).astype(np.float64)
    vectors -= vectors.mean(axis=1, keepdims=True)
    vectors /= np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return np.asarray(vectors @ vectors.T)


def mean_absolute_correlations(correlations: np.ndarray, first: int) -> dict[str, float]:
    """
    :param correlations: of :func:`sample_correlations`
    :param first: n, how many rows are of X
    :return: mean absolute correlation ``within_first`` and ``within_second``, without the diagonal, and ``between``
    """
    return {
        "within_first": _off_diagonal(correlations[:first, :first]),
        "within_second": _off_diagonal(correlations[first:, first:]),
        "between": float(np.abs(correlations[:first, first:]).mean()),
    }


def linear_cka(x: np.ndarray, y: np.ndarray) -> float:
    """
    Linear centred kernel alignment (Kornblith et al. 2019, arXiv 1905.00414, eq. 3 and 5): 1 for latents that differ by
    rotation, translation and one scale. With fewer observations than dimensions it is high for any two latents.

    :param x: ``(n, Z)``
    :param y: ``(n, Z')``
    :return: in [0, 1]; NaN if one does not vary
    """
    x, y = _centred(x), _centred(y)
    return _ratio(_squares(x.T @ y), _squares(x.T @ x), _squares(y.T @ y))


def debiased_cka(x: np.ndarray, y: np.ndarray) -> float:
    """
    :func:`linear_cka` with the unbiased estimator of HSIC (Song et al. 2012, eq. 4; Nguyen et al. 2021, arXiv 2010.15327):
    0 on average for independent latents, however few the observations.

    :param x: ``(n, Z)``
    :param y: ``(n, Z')``
    :return: at most about 1, also below 0; NaN if one does not vary
    :raises ValueError: for fewer than four observations
    """
    if len(x) < 4:
        raise ValueError(f"the unbiased estimator of HSIC needs 4 observations, there are {len(x)}")
    first, second = _centred(x), _centred(y)
    first, second = first @ first.T, second @ second.T
    np.fill_diagonal(first, 0)
    np.fill_diagonal(second, 0)
    return _ratio(_hsic(first, second), _hsic(first, first), _hsic(second, second))


def mean_cca(x: np.ndarray, y: np.ndarray, *, variance: float = VARIANCE) -> float:
    """
    Mean canonical correlation. With ``variance`` < 1 each latent is first reduced to the principal components that hold so
    much of its variance (SVCCA, Raghu et al. 2017, arXiv 1706.05806): directions that hardly vary would count as much as any.

    :param x: ``(n, Z)``
    :param y: ``(n, Z')``
    :param variance: share that is kept; 1: all, and the result is the same for any invertible linear map of a latent
    :return: mean over the smaller number of directions, in [0, 1]; NaN if one does not vary
    :raises ValueError: if there are not more observations than directions: all correlations would be 1
    """
    first, second = _directions(x, variance), _directions(y, variance)
    if not first.shape[1] or not second.shape[1]:
        return float("nan")
    if first.shape[1] + second.shape[1] >= len(x):
        raise ValueError(
            f"{len(x)} observations are too few for a CCA of {first.shape[1]} and {second.shape[1]} directions: more states"
        )
    return float(np.linalg.svd(first.T @ second, compute_uv=False).clip(0, 1).mean())


def effective_rank(x: np.ndarray) -> float:
    """:param x: ``(n, Z)``; :return: exp of the entropy of the normalised singular values (Roy & Vetterli 2007), 1 to Z"""
    singular = np.linalg.svd(_centred(x), compute_uv=False)
    if not singular.sum() > 0:
        return float("nan")
    shares = singular / singular.sum()
    shares = shares[shares > 0]
    return float(np.exp(-(shares * np.log(shares)).sum()))


def explained_variance(x: np.ndarray) -> np.ndarray:
    """:param x: ``(n, Z)``; :return: ``(min(n, Z),)``, share of the variance in the first 1, 2, ... principal components"""
    squares = np.linalg.svd(_centred(x), compute_uv=False) ** 2
    return np.asarray(np.cumsum(squares) / max(squares.sum(), 1e-12))


def _centred(x: np.ndarray) -> np.ndarray:
    x = np.asarray(x, np.float64)
    return np.asarray(x - x.mean(axis=0))


def _squares(matrix: np.ndarray) -> float:
    return float((matrix**2).sum())


def _ratio(shared: float, first: float, second: float) -> float:
    return shared / float(np.sqrt(first * second)) if first > 0 and second > 0 else float("nan")


def _hsic(first: np.ndarray, second: np.ndarray) -> float:
    """Of Gram matrices without diagonals, up to a factor that a ratio does not see."""
    n = len(first)
    sums = first.sum(axis=0), second.sum(axis=0)
    means = sums[0].sum() * sums[1].sum() / ((n - 1) * (n - 2))
    return float((first * second).sum() + means - 2 / (n - 2) * sums[0] @ sums[1])


def _directions(x: np.ndarray, variance: float) -> np.ndarray:
    """Orthonormal, ``(n, directions)``."""
    basis, singular, _ = np.linalg.svd(_centred(x), full_matrices=False)
    kept = singular > 1e-9 * max(singular[0], 1e-300)
    if variance < 1:
        shares = np.cumsum(singular**2) / max((singular**2).sum(), 1e-300)
        kept &= np.arange(len(singular)) <= np.searchsorted(shares, variance)
    return np.asarray(basis[:, kept])


def _off_diagonal(matrix: np.ndarray) -> float:
    count = len(matrix)
    return float((np.abs(matrix).sum() - np.abs(np.diag(matrix)).sum()) / max(count * (count - 1), 1))
