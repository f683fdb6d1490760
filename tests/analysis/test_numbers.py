"""The numbers of the analyses, on arrays for which they are known."""

import numpy as np
import pytest
import torch as th

from sb3_crc.analysis.clusters import action_clusters, cluster_scores, neighbour_purities, silhouettes, tsne
from sb3_crc.analysis.intervals import mean_over_models, ratio_over_episodes
from sb3_crc.analysis.probes import pixel_components, probe
from sb3_crc.analysis.rollouts import returns_to_go
from sb3_crc.analysis.saliency import saliency, saliency_on_motion
from sb3_crc.analysis.similarity import (
    debiased_cka,
    effective_rank,
    explained_variance,
    linear_cka,
    mean_absolute_correlations,
    mean_cca,
    sample_correlations,
)

EPISODES = np.repeat(np.arange(8), 25)  # 200 decisions


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(1)


def rotation(rng: np.random.Generator, size: int) -> np.ndarray:
    return np.asarray(np.linalg.qr(rng.normal(size=(size, size)))[0])


def test_returns_to_go_by_hand() -> None:
    rewards, episodes = np.array([1.0, 2.0, 4.0, 8.0, 16.0]), np.array([0, 0, 0, 1, 1])
    assert returns_to_go(rewards, episodes).tolist() == [7, 6, 4, 24, 16]
    assert returns_to_go(rewards, episodes, 0.5).tolist() == [3, 4, 4, 16, 16]


def test_separated_clusters_score_near_one_and_noise_at_chance(rng: np.random.Generator) -> None:
    labels = np.tile(np.arange(5), 40)
    centers = 10 * np.eye(5, 7)
    apart = cluster_scores(centers[labels] + 0.1 * rng.normal(size=(200, 7)), labels, EPISODES)
    noise = cluster_scores(rng.normal(size=(200, 7)), labels, EPISODES)
    for name, chance in (("silhouette", 0.0), ("purity", 0.2)):
        each, by_chance = apart[name]
        assert each.mean() > 0.95 and by_chance == pytest.approx(chance, abs=0.1)
        each, by_chance = noise[name]
        assert each.mean() == pytest.approx(by_chance, abs=0.05)


def test_the_silhouette_by_hand() -> None:
    points, labels = np.array([[0.0], [1.0], [5.0], [7.0]]), np.array([0, 0, 1, 1])
    assert silhouettes(points, labels) == pytest.approx([1 - 1 / 6, 1 - 1 / 5, 1 - 2 / 4.5, 1 - 2 / 6.5])
    assert np.isnan(silhouettes(points, np.zeros(4, int))).all()


def test_neighbours_in_time_do_not_count() -> None:
    """Each episode is a place of its own with a label of its own: perfectly pure, if its own points counted."""
    points = np.repeat(np.arange(4.0), 10)[:, None] + 0.001 * np.arange(40)[:, None]
    labels = episodes = np.repeat(np.arange(4), 10)
    assert neighbour_purities(points, labels, episodes, 5).max() == 0
    assert neighbour_purities(points, labels, np.zeros(40, int), 5).min() == 1  # with one episode they must
    with pytest.raises(ValueError, match="31 neighbours from other episodes are more than there are: 30"):
        neighbour_purities(points, labels, episodes, 31)


def test_actions_are_clustered_together_and_ordered() -> None:
    low, high = np.array([[-0.9], [-1.0], [0.0]]), np.array([[0.9], [1.0], [0.1], [-0.95]])
    (first, second), centers = action_clusters([low, high], 3)
    assert first.tolist() == [0, 0, 1] and second.tolist() == [2, 2, 1, 0]
    assert centers[:, 0] == pytest.approx([-0.95, 0.05, 0.95])
    with pytest.raises(ValueError, match="5 clusters need at least as many different actions; in 40 samples there are 2"):
        action_clusters([np.tile([[1.0], [-1.0]], (20, 1))])
    with pytest.raises(ValueError, match="1 clusters say nothing"):
        action_clusters([low], 1)


def test_tsne_keeps_clusters_apart_and_repeats_itself(rng: np.random.Generator) -> None:
    labels = np.tile([0, 1], 40)
    points = 20.0 * labels[:, None] + rng.normal(size=(80, 6))
    plane = tsne(points)
    assert plane.shape == (80, 2) and silhouettes(plane, labels).mean() > 0.6
    assert np.array_equal(plane, tsne(points))
    assert np.isfinite(tsne(np.ones((20, 6)))).all()
    with pytest.raises(ValueError, match="at least 5 samples, there are 4"):
        tsne(points[:4])


def test_intervals_draw_episodes_not_decisions(rng: np.random.Generator) -> None:
    of_episode = rng.normal(size=8)
    scores = of_episode[EPISODES]  # decisions of an episode say all the same
    found = ratio_over_episodes(scores, np.ones(200), EPISODES)
    assert found.value == pytest.approx(of_episode.mean()) and found.interval is not None
    low, high = found.interval
    assert (high - low) / 2 == pytest.approx(1.96 * of_episode.std() / np.sqrt(8), rel=0.2)
    assert ratio_over_episodes(scores, np.ones(200), np.zeros(200, int)).interval is None
    several = mean_over_models([(scores, EPISODES), (scores + 10, EPISODES)])
    assert several.value == pytest.approx(of_episode.mean() + 5) and several.interval is not None
    assert several.interval[1] - several.interval[0] > 9  # the models differ by more than their episodes
    assert mean_over_models([(scores, EPISODES)]).interval is None


def test_cka_is_one_up_to_rotation_shift_and_scale_and_nothing_else(rng: np.random.Generator) -> None:
    x = rng.normal(size=(200, 6)) * np.arange(1, 7)
    turned = 3 * x @ rotation(rng, 6) + rng.normal(size=6)
    for cka in (linear_cka, debiased_cka):
        assert cka(x, x) == pytest.approx(1) and cka(x, turned) == pytest.approx(1)
        assert cka(x, x * [9, 1, 1, 1, 1, 0.1]) < 0.99


def test_cka_of_the_independent_is_zero_if_debiased(rng: np.random.Generator) -> None:
    many = [(rng.normal(size=(50, 40)), rng.normal(size=(50, 40))) for _ in range(10)]
    assert np.mean([debiased_cka(x, y) for x, y in many]) == pytest.approx(0, abs=0.02)
    assert np.mean([linear_cka(x, y) for x, y in many]) > 0.3  # why there is another one
    assert linear_cka(rng.normal(size=(4000, 3)), rng.normal(size=(4000, 3))) < 0.01
    assert np.isnan(linear_cka(np.ones((9, 2)), many[0][0][:9]))
    with pytest.raises(ValueError, match="4 observations, there are 3"):
        debiased_cka(np.eye(3), np.eye(3))


def test_cka_equals_its_definitions_by_gram_matrices(rng: np.random.Generator) -> None:
    x, y = rng.normal(size=(30, 4)), rng.normal(size=(30, 7))
    y[:, :2] += x[:, :2]
    n, k, l = 30, x @ x.T, y @ y.T  # noqa: E741
    h = np.eye(n) - 1 / n
    hsic = [np.trace(a @ h @ b @ h) for a, b in ((k, l), (k, k), (l, l))]
    assert linear_cka(x, y) == pytest.approx(hsic[0] / np.sqrt(hsic[1] * hsic[2]))

    def unbiased(a: np.ndarray, b: np.ndarray) -> float:  # Song et al. 2012, eq. 4, as it stands there
        a, b, one = a - np.diag(np.diag(a)), b - np.diag(np.diag(b)), np.ones(n)
        third = (one @ a @ one) * (one @ b @ one) / ((n - 1) * (n - 2))
        return float((np.trace(a @ b) + third - 2 / (n - 2) * one @ a @ b @ one) / (n * (n - 3)))

    assert debiased_cka(x, y) == pytest.approx(unbiased(k, l) / np.sqrt(unbiased(k, k) * unbiased(l, l)))


def test_cca_is_one_under_any_invertible_map_and_known_for_shared_directions(rng: np.random.Generator) -> None:
    x = rng.normal(size=(300, 5)) * [100, 1, 1, 1, 0.01]
    assert mean_cca(x, x @ rng.normal(size=(5, 5)) + 7, variance=1) == pytest.approx(1)
    assert mean_cca(x, rng.normal(size=(300, 5)), variance=1) < 0.15
    shared = np.column_stack([rng.normal(size=(5000, 2)), rng.normal(size=5000)])
    other = np.column_stack([shared[:, :2], rng.normal(size=5000)])
    assert mean_cca(shared, other, variance=1) == pytest.approx(2 / 3, abs=0.02)
    noisy = np.column_stack([100 * shared[:, :1], 0.01 * rng.normal(size=(5000, 5))])
    assert mean_cca(noisy, shared) == pytest.approx(1, abs=0.01)  # 99 % of the variance is one direction
    assert mean_cca(noisy, shared, variance=1) < 0.5
    assert np.isnan(mean_cca(np.ones((20, 3)), rng.normal(size=(20, 3))))
    with pytest.raises(ValueError, match="10 observations are too few for a CCA of 6 and 5"):
        mean_cca(rng.normal(size=(10, 6)), rng.normal(size=(10, 5)), variance=1)


def test_the_heat_map_and_its_blocks_by_hand(rng: np.random.Generator) -> None:
    x, y = rng.normal(size=(20, 9)), rng.normal(size=(30, 9))
    correlations = sample_correlations(x, y)
    assert np.allclose(correlations, np.corrcoef(np.concatenate([x, y])))
    found = mean_absolute_correlations(correlations, 20)
    assert found["between"] == pytest.approx(np.abs(correlations[:20, 20:]).mean())
    assert found["within_first"] == pytest.approx(np.abs(correlations[:20, :20][~np.eye(20, dtype=bool)]).mean())
    alike = mean_absolute_correlations(sample_correlations(np.ones((5, 1)) * x[:1], y), 5)
    assert alike["within_first"] == pytest.approx(1) and alike["within_second"] < 0.6
    with pytest.raises(ValueError, match="9 and 4 dimensions"):
        sample_correlations(x, y[:, :4])


def test_effective_rank_counts_directions(rng: np.random.Generator) -> None:
    assert effective_rank(np.column_stack([np.eye(4), -np.eye(4)]) @ rotation(rng, 8)) == pytest.approx(3)  # centred
    x = rng.normal(size=(4000, 6))
    assert effective_rank(x) == pytest.approx(6, abs=0.05) and effective_rank(x[:, :1] @ np.ones((1, 6))) == pytest.approx(1)
    assert explained_variance(np.diag([2.0, 1.0, 0.0]) - np.array([2.0, 1.0, 0.0]) / 3)[-1] == pytest.approx(1)


def test_a_probe_reads_what_is_linear_and_nothing_else(rng: np.random.Generator) -> None:
    latents = rng.normal(size=(200, 6))
    targets = np.column_stack([latents @ rng.normal(size=6) + 3, rng.normal(size=200), np.ones(200), latents[:, 0] ** 2])
    found = probe(latents, targets, EPISODES)
    linear, noise, constant, square = (found.r2(column) for column in range(4))
    assert linear.value > 0.999 and linear.interval is not None and linear.interval[0] > 0.99
    assert noise.value <= 0.02 and square.value < 0.3
    assert np.isnan(constant.value) and found.r2(0, 2).value == pytest.approx(linear.value)
    assert found.r2(0, 1).value == pytest.approx((linear.value + noise.value) / 2, abs=0.02)


def test_a_probe_is_scored_on_episodes_that_it_has_not_seen() -> None:
    """A latent that tells only which episode it is would be perfect on rows held out of the same episodes."""
    latents, level = np.eye(8)[EPISODES], np.random.default_rng(0).normal(size=8)
    assert probe(latents, level[EPISODES][:, None], EPISODES).r2(0).value < 0.1
    with pytest.raises(ValueError, match="at least 3 episodes.*there are 2"):
        probe(latents[:50], np.ones((50, 1)), EPISODES[:50])


def test_principal_components_of_pixels_are_those_of_a_singular_value_decomposition(rng: np.random.Generator) -> None:
    images = rng.integers(0, 256, (20, 3, 50, 40), dtype=np.uint8)  # more pixels than one part of the sum
    flat = images.reshape(20, -1) / 255
    basis, singular, _ = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    found = pixel_components(images, 4)
    assert np.allclose(np.abs(found), np.abs(basis[:, :4] * singular[:4]), atol=1e-3)
    assert pixel_components(images, 50).shape == (20, 19)


def test_saliency_is_where_the_value_depends_on_the_newest_frame() -> None:
    weights = th.zeros(6, 10, 10)
    weights[3, 2, 5], weights[5, 2, 5], weights[4, 7, 1] = 2.0, -1.0, 0.5
    weights[1, 9, 9] = 4.0  # of an older frame
    found = saliency(lambda pixels: (pixels * weights).sum(dim=(1, 2, 3)), th.rand(3, 6, 10, 10), 3)
    assert found.shape == (3, 10, 10) and np.count_nonzero(found[0]) == 2
    assert found[:, 2, 5].tolist() == [3, 3, 3] and found[:, 7, 1].tolist() == [0.5, 0.5, 0.5]


def test_saliency_on_motion_by_hand() -> None:
    frames = np.full((5, 3, 4, 4), 100, np.uint8)
    frames[2, :, 0, :2] = 200  # moves in one frame
    frames[3, 1, 3, 3] = 110  # less than what counts
    maps = np.ones((5, 4, 4))
    maps[2, 0, 0] = 15
    maps[4] = 0
    share, area = saliency_on_motion(maps, frames)
    assert area.tolist() == [0, 0, 2 / 16, 0, 0]
    assert share[:4].tolist() == [0, 0, 16 / 30, 0] and np.isnan(share[4])
