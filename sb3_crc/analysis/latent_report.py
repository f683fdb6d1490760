"""What ``sb3-crc latents`` writes: an overview of rollouts and of the latents in them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_crc.analysis.figures import evolution_figure, save, spectrum_figure
from sb3_crc.analysis.similarity import effective_rank, explained_variance
from sb3_crc.analysis.subjects import Subject, by_run
from sb3_crc.analysis.tables import number, write_lines, write_rows
from sb3_crc.experiments.comparison_summary import markdown

NUMBERS = ("return", "effective rank")
EXPLANATION = """\
- **return**: mean undiscounted return of the rollout's episodes (the policy's mean action; the same initial states for all).
- **effective rank**: exp of the entropy of the normalised singular values of the centred latents; 1 to Z, the dimension. What
  is high for noise too says how many directions are used, not that they are useful."""


def write_latents(subjects: Sequence[Subject], folder: Path) -> list[Path]:
    """
    Write ``latents.png`` (how much variance the first components hold), ``latents.csv``, ``latents.json`` and ``latents.md``;
    of several models of one run ``latents_evolution.png`` too.

    :param subjects: the models
    :param folder: to write to
    :return: what was written
    """
    rows: list[dict[str, Any]] = []
    cells = []
    for subject in subjects:
        rollout = subject.rollout
        returns = rollout.returns[rollout.steps == 0]
        values = dict(zip(NUMBERS, (float(returns.mean()), effective_rank(rollout.latents)), strict=True))
        rows += [
            {**subject.columns, "number": name, "value": value, "low": None, "high": None} for name, value in values.items()
        ]
        sizes = f"{len(rollout)} x {rollout.latents.shape[1]}", str(rollout.episodes.max() + 1), str(rollout.physics.shape[1])
        cells.append([subject.name, *sizes, *(number(value) for value in values.values())])
    folder.mkdir(parents=True, exist_ok=True)
    curves = {subject.name: explained_variance(subject.rollout.latents) for subject in subjects}
    written = [save(spectrum_figure(curves), folder / "latents.png"), *write_rows(rows, folder, "latents")]
    lines = ["# Rollouts and their latents", "", EXPLANATION, ""]
    lines += markdown(("model", "latents, n x Z", "episodes", "physics", *NUMBERS), cells)
    if by_run(subjects):
        written.append(save(evolution_figure(rows, NUMBERS), folder / "latents_evolution.png"))
        lines += ["", "latents_evolution.png: the numbers of a run's models over the environment steps of its training."]
    return [*written, write_lines(lines, folder / "latents.md")]
