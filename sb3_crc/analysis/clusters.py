"""Do latents of like actions lie together? Clusters of actions, and how pure they are among the latents.

n decisions, Z latent, A action, k clusters.
"""

from collections.abc import Sequence

import numpy as np

CLUSTERS = 5  # as in the paper's figure
NEIGHBOURS = 10
#: Shuffles of the labels, whose mean is the chance level
SHUFFLES = 10
PERPLEXITY = 30.0


def action_clusters(
    actions: Sequence[np.ndarray], clusters: int = CLUSTERS, *, seed: int = 0
) -> tuple[list[np.ndarray], np.ndarray]:
    """
    k-means of all models' actions together, so that a cluster is the same kind of action everywhere.

    :param actions: of each model, ``(n, A)``
    :param clusters: k
    :param seed: of k-means
    :return: labels of each model ``(n,)``, and the mean actions ``(k, A)``; clusters are ordered by the first coordinate
    :raises ValueError: if there are fewer different actions than clusters, or fewer than two clusters
    """
    from sklearn.cluster import KMeans  # type: ignore[import-untyped]

    together = np.concatenate([np.asarray(one, np.float64) for one in actions])
    different = len(np.unique(together.round(6), axis=0))
    if clusters < 2:
        raise ValueError(f"{clusters} clusters say nothing: at least 2 are needed")
    if different < clusters:
        raise ValueError(
            f"{clusters} clusters need at least as many different actions; in {len(together)} samples there are {different}"
        )
    found = KMeans(clusters, n_init=10, random_state=seed).fit(together)
    order = np.lexsort(found.cluster_centers_.T[::-1])  # by the first coordinate, then by the next
    labels = np.argsort(order)[found.labels_]
    return np.split(labels, np.cumsum([len(one) for one in actions])[:-1]), found.cluster_centers_[order]


def silhouettes(points: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """
    How much nearer a point is to its own cluster than to the next one (Rousseeuw 1987).

    :param points: ``(n, Z)``
    :param labels: ``(n,)``
    :return: ``(n,)`` in [-1, 1], whose mean is the silhouette; NaN where all points are of one cluster or each of its own
    """
    return _silhouettes(distances(points), labels)


def neighbour_purities(
    points: np.ndarray, labels: np.ndarray, episodes: np.ndarray, neighbours: int = NEIGHBOURS
) -> np.ndarray:
    """
    How many of a point's nearest neighbours are of its cluster. Only points of other episodes count: the frames before and
    after a decision look like it and are acted on like it, whatever the latent.

    :param points: ``(n, Z)``
    :param labels: ``(n,)``
    :param episodes: ``(n,)``; if there is but one, its other points count
    :param neighbours: how many
    :return: ``(n,)`` in [0, 1], whose mean is the purity
    :raises ValueError: if there are too few points
    """
    return _purities(_neighbours(distances(points), episodes, neighbours), labels)


def cluster_scores(
    points: np.ndarray, labels: np.ndarray, episodes: np.ndarray, *, neighbours: int = NEIGHBOURS, seed: int = 0
) -> dict[str, tuple[np.ndarray, float]]:
    """
    :param points: ``(n, Z)``
    :param labels: ``(n,)``
    :param episodes: ``(n,)``
    :param neighbours: for the purity
    :param seed: of the shuffles
    :return: ``"silhouette"`` and ``"purity"``, each with the points' scores ``(n,)`` and their mean for shuffled labels
    :raises ValueError: if there are too few points for the neighbours
    """
    apart = distances(points)
    near = _neighbours(apart, episodes, neighbours)
    rng = np.random.default_rng(seed)
    shuffled = [rng.permutation(labels) for _ in range(SHUFFLES)]
    return {
        "silhouette": (_silhouettes(apart, labels), float(np.mean([_silhouettes(apart, one) for one in shuffled]))),
        "purity": (_purities(near, labels), float(np.mean([_purities(near, one) for one in shuffled]))),
    }


def tsne(points: np.ndarray, *, seed: int = 0) -> np.ndarray:
    """
    t-SNE (van der Maaten & Hinton 2008), started from the first two principal components.

    :param points: ``(n, Z)``
    :param seed: of the optimisation
    :return: ``(n, 2)``
    :raises ValueError: if there are fewer than five points
    """
    from sklearn.manifold import TSNE  # type: ignore[import-untyped]

    if len(points) < 5:
        raise ValueError(f"t-SNE needs at least 5 samples, there are {len(points)}")
    perplexity = min(PERPLEXITY, (len(points) - 1) / 3)
    spread = points.std(axis=0)
    init = "pca" if np.count_nonzero(spread) >= 2 else "random"
    return np.asarray(TSNE(2, perplexity=perplexity, init=init, random_state=seed).fit_transform(points))


def distances(points: np.ndarray) -> np.ndarray:
    """:param points: ``(n, Z)``; :return: Euclidean, ``(n, n)``, with zeros on the diagonal"""
    centred = np.asarray(points, np.float64)
    centred = centred - centred.mean(axis=0)
    squares = (centred**2).sum(axis=1)
    found = np.sqrt(np.maximum(squares[:, None] + squares - 2 * centred @ centred.T, 0))
    np.fill_diagonal(found, 0)
    return np.asarray(found)


def _silhouettes(apart: np.ndarray, labels: np.ndarray) -> np.ndarray:
    from sklearn.metrics import silhouette_samples  # type: ignore[import-untyped]

    if not 2 <= len(np.unique(labels)) < len(labels):
        return np.full(len(labels), np.nan)
    return np.asarray(silhouette_samples(apart, labels, metric="precomputed"))


def _neighbours(apart: np.ndarray, episodes: np.ndarray, count: int) -> np.ndarray:
    """Rows of the nearest, ``(n, count)``."""
    excluded = episodes[:, None] == episodes if len(np.unique(episodes)) > 1 else np.eye(len(apart), dtype=bool)
    allowed = len(apart) - int(excluded.sum(axis=1).max())
    if allowed < count:
        raise ValueError(f"{count} neighbours from other episodes are more than there are: {allowed}; roll more decisions")
    return np.argpartition(np.where(excluded, np.inf, apart), count - 1, axis=1)[:, :count]


def _purities(near: np.ndarray, labels: np.ndarray) -> np.ndarray:
    return np.asarray((labels[near] == labels[:, None]).mean(axis=1))
