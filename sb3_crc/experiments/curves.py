"""Learning curves."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np


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
    """
    from matplotlib.figure import Figure  # without pyplot no display is asked for

    with np.load(evaluations) as data:
        steps, returns = data["timesteps"], data["results"]  # (evaluations,), (evaluations, episodes)
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    environment_steps = steps * action_repeat
    axes.fill_between(environment_steps, returns.min(axis=1), returns.max(axis=1), alpha=0.25, label="range of episodes")
    axes.plot(environment_steps, returns.mean(axis=1), marker="o", markersize=3, label=f"mean of {returns.shape[1]} episodes")
    for style, (name, value) in zip(("--", ":", "-."), (references or {}).items(), strict=False):
        axes.axhline(value, linestyle=style, color="black", linewidth=1, label=f"{name} ({value:.0f})")
    axes.set_xlabel(f"environment steps ({action_repeat} per agent step)")
    axes.set_ylabel("return of an evaluation episode")
    axes.set_title(title)
    axes.set_ylim(bottom=min(0.0, float(returns.min())))
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left")
    figure.savefig(picture, dpi=150)
