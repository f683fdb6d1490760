"""What ``sb3-crc tsne`` writes: latents in the plane, coloured by clusters of actions, and how pure the clusters are."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.analysis.clusters import action_clusters, cluster_scores, tsne
from sb3_crc.analysis.figures import evolution_figure, save, tsne_figure
from sb3_crc.analysis.html import write_html
from sb3_crc.analysis.intervals import mean_over_models, ratio_over_episodes
from sb3_crc.analysis.subjects import Subject, by_method, by_run
from sb3_crc.analysis.tables import Row, estimate_columns, estimate_of, number, write_lines, write_rows
from sb3_crc.experiments.comparison_summary import markdown

EXPLANATION = """\
Each point is a decision of the policy's own rollout; its colour is the cluster (k-means, {clusters} clusters, of all models'
actions together) of the action that the policy takes there.

- **silhouette**: how much nearer a point lies to the other points of its cluster than to the nearest other cluster, relative
  to the larger of the two; -1 to 1, no structure at 0.
- **purity**: share of a point's {neighbours} nearest neighbours, among the points of other episodes, that have its cluster.
- **chance**: the mean over ten shuffles of the labels. A number says something only where its interval lies above it.
- In parentheses: 95 % bootstrap intervals over episodes, since decisions of one episode follow from each other; of a method
  over its models and their episodes. With three models such an interval is too narrow.
- The latent counts; the plane is a picture of it, in which t-SNE exaggerates clusters, and distances between clusters and
  their sizes mean nothing.
- A silhouette can be low although actions can be read off the latent: it asks for compact clusters, the purity does not."""
NUMBERS = tuple((score, where) for where in ("latent", "plane") for score in ("silhouette", "purity"))


@dataclass(frozen=True)
class Clustered:
    """
    :param labels: of each model, ``(n,)``
    :param centers: mean actions, ``(k, A)``
    :param planes: of each model, ``(n, 2)``
    :param rows: numbers of each model and of each method
    """

    labels: list[np.ndarray]
    centers: np.ndarray
    planes: list[np.ndarray]
    rows: list[dict[str, Any]]


def write_clusters(subjects: Sequence[Subject], folder: Path, *, clusters: int, neighbours: int) -> list[Path]:
    """
    Write ``tsne.png``, ``tsne.html``, ``tsne.csv``, ``tsne.json`` and ``tsne.md``; of several models of one run
    ``tsne_evolution.png`` too.

    :param subjects: the models
    :param folder: to write to
    :param clusters: of the actions
    :param neighbours: for the purity
    :return: what was written
    :raises ValueError: if there are too few samples for the clusters or for the neighbours
    """
    found = clustered(subjects, clusters=clusters, neighbours=neighbours)
    folder.mkdir(parents=True, exist_ok=True)
    written = [
        save(
            tsne_figure(subjects, found.planes, found.labels, found.centers, _titles(subjects, found.rows)),
            folder / "tsne.png",
        )
    ]
    written.append(write_html(subjects, found.planes, found.labels, found.centers, folder / "tsne.html"))
    written += write_rows(found.rows, folder, "tsne")
    header = ("model", *(f"{score}, {where}" for score, where in NUMBERS))
    lines = ["# Latents by action", "", EXPLANATION.format(clusters=clusters, neighbours=neighbours), ""]
    lines += markdown(header, _cells(found.rows, "model"))
    if any(len(own) > 1 for own in by_method(subjects).values()):
        lines += ["", "Methods, mean over their models:", "", *markdown(header, _cells(found.rows, "method"))]
    if by_run(subjects):
        lines += ["", "tsne_evolution.png: the same numbers of a run's models over the environment steps of its training."]
        labels = [f"{score}, {where}" for score, where in NUMBERS]
        of_models = [row for row in found.rows if row["model"]]
        written.append(save(evolution_figure(of_models, labels), folder / "tsne_evolution.png"))
    written.append(write_lines(lines, folder / "tsne.md"))
    return written


def clustered(subjects: Sequence[Subject], *, clusters: int, neighbours: int) -> Clustered:
    """
    :param subjects: the models
    :param clusters: of the actions
    :param neighbours: for the purity
    :return: labels, planes and numbers
    :raises ValueError: if there are too few samples for the clusters or for the neighbours
    """
    labels, centers = action_clusters([subject.rollout.actions for subject in subjects], clusters)
    planes, rows = [], []
    scores: dict[tuple[str, str], dict[str, list[tuple[np.ndarray, np.ndarray, float]]]] = {key: {} for key in NUMBERS}
    for subject, own in zip(subjects, labels, strict=True):
        latents, episodes = subject.rollout.latents, subject.rollout.episodes
        found = {"latent": cluster_scores(latents, own, episodes, neighbours=neighbours)}  # bad input fails before t-SNE
        planes.append(tsne(latents))
        found["plane"] = cluster_scores(planes[-1], own, episodes, neighbours=neighbours)
        for score, where in NUMBERS:
            each, chance = found[where][score]
            scores[score, where].setdefault(subject.method, []).append((each, episodes, chance))
            estimate = ratio_over_episodes(each, np.ones(len(each)), episodes)
            rows.append({**subject.columns, "number": f"{score}, {where}", **estimate_columns(estimate), "chance": chance})
    for (score, where), of_methods in scores.items():
        for method, models in of_methods.items():
            estimate = mean_over_models([(each, episodes) for each, episodes, _ in models])
            columns = dict.fromkeys(subjects[0].columns) | {"method": method, "number": f"{score}, {where}"}
            rows.append({**columns, **estimate_columns(estimate), "chance": float(np.mean([chance for *_, chance in models]))})
    return Clustered(labels, centers, planes, rows)


def _titles(subjects: Sequence[Subject], rows: Sequence[Row]) -> list[str]:
    titles = []
    for subject in subjects:
        own = {row["number"]: row for row in rows if row["model"] == subject.name}
        texts = [
            f"{score} {number(own[f'{score}, latent']['value'])} (plane {number(own[f'{score}, plane']['value'])}, "
            f"chance {number(own[f'{score}, latent']['chance'])})"
            for score in ("silhouette", "purity")
        ]
        titles.append("\n".join((subject.name, *texts)))
    return titles


def _cells(rows: Sequence[Row], what: str) -> list[list[str]]:
    """Of models or of methods: a line for each, with value, interval and chance."""
    chosen = [row for row in rows if bool(row["model"]) == (what == "model")]
    cells: dict[str, list[str]] = {}
    for row in chosen:
        text = "-" if np.isnan(row["value"]) else f"{estimate_of(row).text('.2f')}, chance {number(row['chance'])}"
        cells.setdefault(row[what], [row[what]]).append(text)
    return list(cells.values())
