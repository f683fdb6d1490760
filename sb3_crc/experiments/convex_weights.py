"""What the weights of the three losses do, if they sum to 1: a triangle. What ``sb3-crc curves --weights`` draws."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.experiments.comparison_figures import DOTS_PER_INCH
from sb3_crc.experiments.comparison_summary import about, listed, markdown
from sb3_crc.experiments.scores import Scores, final_means, one_protocol
from sb3_crc.experiments.specs import read_sweep
from sb3_crc.experiments.statistics import REPS, ScoreMatrices, aggregate, score_matrices
from sb3_crc.objectives import objective_weights

LOSSES = ("contrastive", "reconstruction", "consistency")
#: Shares of :data:`LOSSES`
Weights = tuple[float, float, float]


def convex_weights(file: Path) -> dict[str, Weights]:
    """
    :param file: a sweep
    :return: variant -> weights of contrastive, reconstruction and consistency, in shares of 1; none for a variant without them
    :raises FileNotFoundError: as :func:`~sb3_crc.experiments.specs.read_sweep`, like ValueError
    """
    found = {}
    for spec in read_sweep(file):
        weights = objective_weights(spec.settings.get("objectives", {}))
        own = [weights.get(name, 0.0) for name in LOSSES]
        if sum(own) > 0:
            found[spec.method] = own[0] / sum(own), own[1] / sum(own), own[2] / sum(own)
    return found


def draw_weights(
    scores: Scores, folder: Path, weights: Mapping[str, Weights], *, allow_mixed: bool = False, reps: int = REPS
) -> list[Path]:
    """
    Write ``weights.png``, a triangle with a point for each convex combination of the losses' weights, coloured by the mean
    final return, and ``weights.md`` with the numbers and what was left out.

    :param scores: of the runs
    :param folder: to write to
    :param weights: method -> shares of contrastive, reconstruction and consistency, which sum to 1; others are not drawn
    :param allow_mixed: as for :func:`~sb3_crc.experiments.comparison_figures.draw_comparison`
    :param reps: bootstrap samples
    :return: what was written
    :raises ValueError: if weights are no shares, or no task and seed has a final score of every method that has some
    :raises MixedProtocols: as for :func:`~sb3_crc.experiments.comparison_figures.draw_comparison`
    """
    for method, shares in weights.items():
        if min(shares) < 0 or abs(sum(shares) - 1) > 1e-6:
            raise ValueError(f"weights of {method} are no shares of 1: {shares}")
    final = scores.final[scores.final["method"].isin(list(weights))]
    matrices = score_matrices(final_means(one_protocol(final, allow_mixed=allow_mixed)))
    if not matrices.scores:
        raise ValueError("no triangle to draw: no task and seed has a final score of every method with convex weights")
    means = {method: found["mean"] for method, found in aggregate(matrices.scores, reps=reps).items()}
    folder.mkdir(parents=True, exist_ok=True)
    picture, text = folder / "weights.png", folder / "weights.md"
    figure = _weights_figure({method: (weights[method], mean.value) for method, mean in means.items()}, matrices)
    figure.savefig(picture, dpi=DOTS_PER_INCH)
    rows = [(method, *(f"{share:.3g}" for share in weights[method]), mean.text()) for method, mean in means.items()]
    lines = ["# Convex weights", "", about(matrices), ""]
    lines += markdown(("method", *LOSSES, "mean final return"), rows)
    lines.append("")
    absent = [f"{method}: no final score" for method in weights if method not in means]
    missing = [str(one) for one in scores.missing if one.method in weights]
    lines += listed("Left out", [*absent, *matrices.dropped, *missing])
    text.write_text("\n".join(lines), encoding="utf-8")
    return [picture, text]


def _weights_figure(points: Mapping[str, tuple[Weights, float]], matrices: ScoreMatrices) -> Any:
    from matplotlib.figure import Figure  # without pyplot no display is asked for

    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 3**0.5 / 2]])  # of LOSSES
    at_one_place: dict[Weights, list[float]] = {}
    for (first, second, third), value in points.values():
        at_one_place.setdefault((round(first, 6), round(second, 6), round(third, 6)), []).append(value)
    places = np.array(list(at_one_place)) @ corners
    figure = Figure(figsize=(7, 5.6), layout="constrained")
    axes: Any = figure.subplots()
    axes.set_aspect("equal")
    axes.axis("off")
    for share in (0.25, 0.5, 0.75):
        for first, second, third in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            ends = [share * corners[first] + (1 - share) * corners[other] for other in (second, third)]
            axes.plot(*np.transpose(ends), color="0.85", linewidth=0.8, zorder=0)
    axes.plot(*np.transpose(corners[[0, 1, 2, 0]]), color="0.4", linewidth=1, zorder=1)
    colours = [float(np.mean(values)) for values in at_one_place.values()]
    drawn = axes.scatter(*places.T, c=colours, s=150, cmap="viridis", edgecolors="black", linewidths=0.8, zorder=2)
    for place, values in zip(places, at_one_place.values(), strict=True):
        text = " / ".join(f"{value:.0f}" for value in values)
        axes.annotate(text, place, (9, 6), textcoords="offset points", fontsize=10, zorder=3)
    for (x, y), name, offset in zip(corners, LOSSES, (-22, -22, 30), strict=True):
        axes.annotate(f"{name} alone", (x, y), (0, offset), textcoords="offset points", ha="center", va="center", fontsize=11)
    axes.set_xlim(-0.12, 1.16)
    axes.set_ylim(-0.12, 1.0)
    figure.colorbar(drawn, ax=axes, label="mean final return", shrink=0.75)
    figure.supxlabel(about(matrices, names=len(matrices.tasks) < 3), fontsize=9)
    return figure
