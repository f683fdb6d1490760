"""Learning curves."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.experiments.runs import read_evaluations


def plot_learning_curve(
    evaluations: Path,
    picture: Path,
    *,
    action_repeat: int = 1,
    title: str = "",
    references: Mapping[str, float] | None = None,
) -> None:
    """
    Draw the evaluations of one run: mean over the episodes of each evaluation, and their range.

    :param evaluations: the ``evaluations.npz`` that SB3's EvalCallback writes
    :param picture: the file to write; its ending names the format
    :param action_repeat: environment steps per agent step, for the lower axis
    :param title: above the picture
    :param references: name -> return of policies to compare with, drawn as horizontal lines
    :raises FileNotFoundError: if there are no evaluations
    :raises ValueError: if they cannot be read, naming the file
    """
    from matplotlib.figure import Figure  # without pyplot no display is asked for

    found = read_evaluations(evaluations)
    steps, returns = found["timesteps"], found["results"]  # (evaluations,), (evaluations, episodes)
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    environment_steps = steps * action_repeat
    axes.fill_between(environment_steps, returns.min(axis=1), returns.max(axis=1), alpha=0.25, label="range of episodes")
    axes.plot(environment_steps, returns.mean(axis=1), marker="o", markersize=3, label=f"mean of {returns.shape[1]} episodes")
    _finish(axes, action_repeat, title, references, lowest=float(returns.min()))
    figure.savefig(picture, dpi=150)


def plot_learning_curves(
    runs: Mapping[str, Sequence[Path]],
    picture: Path,
    *,
    action_repeat: int = 1,
    title: str = "",
    references: Mapping[str, float] | None = None,
) -> None:
    """
    Draw runs side by side: each seed as a thin line, the mean of a method's seeds, where all were evaluated, as a thick one.

    :param runs: method -> the ``evaluations.npz`` of each of its seeds
    :param picture: as for :func:`plot_learning_curve`, like what follows
    :raises FileNotFoundError: as there, like ValueError
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for number, (method, files) in enumerate(runs.items()):
        seeds: list[dict[int, float]] = []
        for file in files:
            found = read_evaluations(file)
            points = zip(found["timesteps"], found["results"].mean(axis=1), strict=True)
            seeds.append({int(step) * action_repeat: float(mean) for step, mean in points})
            axes.plot(list(seeds[-1]), list(seeds[-1].values()), color=f"C{number}", linewidth=0.8, alpha=0.5)
        shared = sorted(set.intersection(*(set(seed) for seed in seeds)))
        mean = [float(np.mean([seed[step] for seed in seeds])) for step in shared]
        label = f"{method}, {len(seeds)} seed{'s' * (len(seeds) > 1)}"
        axes.plot(shared, mean, color=f"C{number}", marker="o", markersize=3, linewidth=2, label=label)
    _finish(axes, action_repeat, title, references)
    figure.savefig(picture, dpi=150)


def _finish(axes: Any, action_repeat: int, title: str, references: Mapping[str, float] | None, lowest: float = 0.0) -> None:
    for style, (name, value) in zip(cycle(("--", ":", "-.")), (references or {}).items(), strict=False):
        axes.axhline(value, linestyle=style, color="black", linewidth=1, label=f"{name} ({value:.0f})")
    axes.set_xlabel(f"environment steps ({action_repeat} per agent step)")
    axes.set_ylabel("return of an evaluation episode")
    axes.set_title(title)
    axes.margins(y=0.08)
    axes.set_ylim(bottom=min(0.0, lowest))
    axes.grid(alpha=0.3)
    axes.legend(loc="best")
