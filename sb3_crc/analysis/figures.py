"""Figures of the analyses: latents in the plane, heat maps, bars, and numbers over training."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.analysis.subjects import Subject, by_method
from sb3_crc.analysis.tables import Row

DOTS_PER_INCH = 150
#: Where bars and curves of R^2 end: what is worse than the mean is equally useless
LOWEST_R2 = -0.25


def save(figure: Any, path: Path) -> Path:
    """:param figure: of matplotlib; :param path: PNG file; :return: the path"""
    figure.savefig(path, dpi=DOTS_PER_INCH)
    return path


def cluster_colours(clusters: int) -> list[tuple[float, float, float]]:
    """:return: RGB in [0, 1], in an order that the eye follows: clusters are ordered by their action"""
    import matplotlib

    shades = matplotlib.colormaps["turbo"](np.linspace(0.08, 0.92, clusters))
    return [(float(red), float(green), float(blue)) for red, green, blue, _ in shades]


def cluster_names(centers: np.ndarray) -> list[str]:
    """:param centers: mean actions ``(k, A)``; :return: for legends"""
    return [f"action {' '.join(f'{value:+.2f}' for value in center[:4])}{' ...' * (len(center) > 4)}" for center in centers]


def tsne_figure(
    subjects: Sequence[Subject],
    planes: Sequence[np.ndarray],
    labels: Sequence[np.ndarray],
    centers: np.ndarray,
    titles: Sequence[str],
) -> Any:
    """
    Methods one above the other, each one's models side by side.

    :param subjects: the models
    :param planes: of each, ``(n, 2)``
    :param labels: of each, ``(n,)``
    :param centers: mean actions ``(k, A)``
    :param titles: of each model's panel
    :return: the figure
    """
    methods = by_method(subjects)
    columns = max(map(len, methods.values()))
    figure = new_figure(max(3.4 * columns, 4.5), 3.3 * len(methods) + 0.7)
    grid = figure.subplots(len(methods), columns, squeeze=False)
    colours = np.array(cluster_colours(len(centers)))
    place = {subject.name: index for index, subject in enumerate(subjects)}
    for axes in grid.flat:
        axes.set_axis_off()
    for row, models in zip(grid, methods.values(), strict=True):
        for axes, subject in zip(row, models, strict=False):
            index = place[subject.name]
            axes.set_axis_on()
            axes.scatter(*planes[index].T, c=colours[labels[index]], s=7, linewidths=0)
            axes.set_title(titles[index], fontsize=8)
            axes.set_xticks([])
            axes.set_yticks([])
    handles = [grid[0, 0].scatter([], [], color=colour, s=30) for colour in colours]
    figure.legend(
        handles, cluster_names(centers), loc="outside lower center", ncols=min(5, 2 * columns), frameon=False, fontsize=9
    )
    figure.suptitle("t-SNE of the latents, coloured by the cluster of the action", fontsize=11)
    return figure


def correlation_figure(correlations: np.ndarray, names: tuple[str, str], title: str) -> Any:
    """
    :param correlations: ``(2 n, 2 n)``, n of each model
    :param names: of the two models
    :param title: of the figure
    :return: the heat map
    """
    figure = new_figure(6.4, 5.6)
    axes = figure.subplots()
    image = axes.imshow(correlations, cmap="RdBu_r", vmin=-1, vmax=1, interpolation="nearest")
    half = len(correlations) // 2
    axes.axhline(half - 0.5, color="black", linewidth=1)
    axes.axvline(half - 0.5, color="black", linewidth=1)
    middles = [half / 2, half * 1.5]
    axes.set_xticks(middles, names)
    axes.set_yticks(middles, names, rotation=90, va="center")
    axes.tick_params(length=0)
    axes.set_title(title, fontsize=10)
    figure.colorbar(image, ax=axes, label="Pearson correlation of two feature vectors", shrink=0.85)
    return figure


def similarity_figure(rows: Sequence[Row], names: Sequence[str], numbers: Sequence[str]) -> Any:
    """
    :param rows: of pairs, with ``first``, ``second`` and the numbers
    :param names: of the models
    :param numbers: one panel for each
    :return: a heat map of all pairs for each number
    """
    side = 1.6 + 0.62 * len(names)
    figure = new_figure(max(2 * side + 2.2, 6.5), side + 1.2)
    panels = figure.subplots(1, len(numbers), squeeze=False)[0]
    place = {name: index for index, name in enumerate(names)}
    for axes, name in zip(panels, numbers, strict=True):
        values = np.eye(len(names))
        for row in rows:
            i, j = place[row["first"]], place[row["second"]]
            values[i, j] = values[j, i] = row[name]
        axes.imshow(values, cmap="viridis", vmin=0, vmax=1)
        for (i, j), value in np.ndenumerate(values):
            axes.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=8, color="white" if value < 0.6 else "black")
        axes.set_xticks(range(len(names)), names, rotation=40, ha="right", fontsize=8)
        axes.set_yticks(range(len(names)), names if axes is panels[0] else [""] * len(names), fontsize=8)
        chance = np.mean([row[f"{name}, chance"] for row in rows])
        axes.set_title(f"{name} (chance {chance:.2f})", fontsize=10)
    figure.suptitle("How alike two models see the same observations", fontsize=11)
    return figure


def probe_figure(rows: Sequence[Row], quantities: Sequence[str], title: str) -> Any:
    """
    :param rows: R^2 by model, with ``method``, ``number``, ``value``, ``low``, ``high``
    :param quantities: groups of bars
    :param title: of the figure
    :return: a bar for each method, the mean over its models, with a dot for each; of one model its interval
    """
    methods = list(dict.fromkeys(row["method"] for row in rows))
    figure = new_figure(max(7.0, 1.5 + 0.28 * len(quantities) * (len(methods) + 1)), 4.4)
    axes = figure.subplots()
    width = 0.8 / len(methods)
    for number, method in enumerate(methods):
        own = {
            name: [row for row in rows if row["method"] == method and row["number"] == f"R^2 of {name}"] for name in quantities
        }
        means = np.array([np.mean([row["value"] for row in own[name]]) for name in quantities])
        x = np.arange(len(quantities)) + (number - (len(methods) - 1) / 2) * width
        colour = f"C{number}" if own[quantities[0]][0]["file"] is not None else ("0.55", "0.8")[(len(methods) - number) % 2]
        axes.bar(x, means.clip(LOWEST_R2), width * 0.92, color=colour, label=method)
        for at, name in zip(x, quantities, strict=True):
            models = own[name]
            if len(models) > 1:
                values = np.array([row["value"] for row in models])
                axes.plot(np.full(len(values), at), values.clip(LOWEST_R2), "o", color="black", markersize=2.5)
            elif models[0]["low"] is not None:
                ends = np.clip([models[0]["low"], models[0]["high"]], LOWEST_R2, None)
                axes.plot([at, at], ends, color="black", linewidth=1)
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set_ylim(LOWEST_R2 if axes.dataLim.y0 < -0.01 else 0, 1.02)
    axes.set_xticks(range(len(quantities)), quantities, rotation=30, ha="right")
    axes.set_ylabel("R$^2$ of a linear probe")
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.3, axis="y")
    figure.legend(loc="outside lower center", ncols=min(4, len(methods)), frameon=False, fontsize=9)
    return figure


def evolution_figure(rows: Sequence[Row], numbers: Sequence[str]) -> Any:
    """
    :param rows: of models, with ``file``, ``method``, ``seed``, ``environment_steps``, ``number``, ``value``, ``low``,
        ``high`` and, if it has one, ``chance``
    :param numbers: one panel for each
    :return: curves over environment steps: one for each run, with its intervals; chance is dotted
    """
    from matplotlib.ticker import EngFormatter, MaxNLocator

    columns = 2 if len(numbers) == 4 else min(3, len(numbers))
    lines = -(-len(numbers) // columns)
    figure = new_figure(1.2 + 3.4 * columns, 0.8 + 2.6 * lines)
    grid = figure.subplots(lines, columns, squeeze=False)
    runs = list(dict.fromkeys((row["method"], row["seed"], str(Path(row["file"]).parent)) for row in rows))
    handles: dict[str, Any] = {}
    for axes in grid.flat[len(numbers) :]:
        axes.remove()
    for axes, name in zip(grid.flat, numbers, strict=False):
        for index, (method, seed, folder) in enumerate(runs):
            own = {r["environment_steps"]: r for r in rows if r["number"] == name and str(Path(r["file"]).parent) == folder}
            x = sorted(own)
            points = [own[step] for step in x]
            (line,) = axes.plot(x, [point["value"] for point in points], "o-", color=f"C{index % 10}", markersize=4)
            handles[f"{method}, seed {seed}"] = line
            if all(point["low"] is not None for point in points):
                ends = [point["low"] for point in points], [point["high"] for point in points]
                axes.fill_between(x, *ends, color=f"C{index % 10}", alpha=0.15, linewidth=0)
            if points[0].get("chance") is not None:
                axes.plot(x, [point["chance"] for point in points], ":", color=f"C{index % 10}")
        axes.set_title(name.replace("R^2", "R$^2$"), fontsize=9)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.grid(alpha=0.3)
        if name.startswith("R^2"):
            axes.set_ylim(max(axes.get_ylim()[0], LOWEST_R2), 1.02)
    for axes in grid.flat[max(0, len(numbers) - columns) : len(numbers)]:  # the lowest of each column
        axes.set_xlabel("environment steps of training", fontsize=9)
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=min(4, len(handles)), frameon=False, fontsize=9
    )
    return figure


def spectrum_figure(curves: Mapping[str, np.ndarray]) -> Any:
    """:param curves: model -> share of the variance in the first components; :return: the figure"""
    figure = new_figure(6.0, 4.0)
    axes = figure.subplots()
    for name, shares in curves.items():
        axes.plot(np.arange(1, len(shares) + 1), shares, label=name)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("principal components of the latents")
    axes.set_ylabel("share of the variance")
    axes.set_ylim(0, 1.02)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize=9)
    return figure


def new_figure(width: float, height: float) -> Any:
    """:param width: inches; :param height: inches; :return: an empty figure of matplotlib"""
    from matplotlib.figure import Figure  # without pyplot no display is asked for

    return Figure(figsize=(width, height), layout="constrained")
