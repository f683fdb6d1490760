"""What ``sb3-crc correlate`` writes: how alike the latents of two methods are, beside those of two seeds of one method."""

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.analysis.figures import correlation_figure, evolution_figure, save, similarity_figure
from sb3_crc.analysis.networks import encode
from sb3_crc.analysis.similarity import (
    debiased_cka,
    linear_cka,
    mean_absolute_correlations,
    mean_cca,
    sample_correlations,
)
from sb3_crc.analysis.subjects import Subject, by_run, common_states
from sb3_crc.analysis.tables import number, write_lines, write_rows
from sb3_crc.experiments.comparison_summary import markdown

#: Feature vectors of each model in the heat map, as in the paper
SAMPLES = 200
SAME, SEEDS, DIFFERENT = "one run", "one method, two seeds", "two methods"
NUMBERS = ("linear CKA", "debiased CKA", "mean CCA")
EXPLANATION = """\
All models encode the same {states} observations, as many from the rollout of each, evenly over time.

- **debiased CKA**: 1 for latents that differ by rotation, shift and scale, 0 for independent ones. **linear CKA** is the usual
  estimate of it, which is too high where observations are few beside dimensions.
- **mean CCA**: mean canonical correlation of the principal components that hold 99 % of each latent's variance; 1 if one is a
  linear map of the other. Small components count as much as large ones.
- **chance**: the observations of the second model shuffled.
- The null is another seed of the same method: {null}
  Two methods differ in what they see only as far as their numbers lie below those of two seeds of one method.
- **mean absolute correlation**, the paper's heat map: of {samples} feature vectors of each of two models, each vector about
  its own mean. Between two models it compares dimension i of one with dimension i of the other, which nothing ties together:
  two seeds of one method, even one latent rotated, look as unrelated as two methods. Within a model it says how much its
  vectors share whatever the observation."""


def write_similarities(subjects: Sequence[Subject], folder: Path, *, states: int) -> list[Path]:
    """
    Write ``correlation.png`` (the paper's heat map, of the first model and the first of another method), ``similarity.png``
    (all pairs), ``correlate.csv``, ``correlate.json`` and ``correlate.md``; of several models of one run
    ``correlate_evolution.png`` too: debiased CKA with the last of them.

    :param subjects: two or more
    :param folder: to write to
    :param states: observations that all encode
    :return: what was written
    :raises ValueError: if there are fewer than two, no observation fits all, or the observations are too few
    """
    if len(subjects) < 2:
        raise ValueError(f"a comparison needs at least 2 models, there is only {subjects[0].name}")
    shown = common_states(subjects, states)
    count = len(shown.observations)
    latents = [encode(subject.policy.load(), shown.observations) for subject in subjects]
    first, second = 0, next((i for i, one in enumerate(subjects) if one.method != subjects[0].method), 1)
    few = np.unique(np.linspace(0, count - 1, min(SAMPLES, count)).astype(int))
    few = few[np.argsort(shown.steps[few], kind="stable")]
    rows = [_pair(subjects, latents, few, i, j) for i, j in combinations(range(len(subjects)), 2)]

    folder.mkdir(parents=True, exist_ok=True)
    names = [subject.name for subject in subjects]
    written = []
    blocks = [latents[first][few], latents[second][few]]
    if blocks[0].shape[1] == blocks[1].shape[1]:
        title = f"{len(few)} feature vectors each, of the same observations,\nby decisions since the episode began"
        pair = names[first], names[second]
        written.append(save(correlation_figure(sample_correlations(*blocks), pair, title), folder / "correlation.png"))
    written.append(save(similarity_figure(rows, names, NUMBERS[1:]), folder / "similarity.png"))
    written += write_rows(rows, folder, "correlate")
    lines = _text(rows, count, len(few))
    if blocks[0].shape[1] != blocks[1].shape[1]:
        sizes = " and ".join(str(one.shape[1]) for one in blocks)
        lines += [
            "",
            f"No correlation.png: the feature vectors of {names[first]} and {names[second]} have {sizes} dimensions.",
        ]
    runs = by_run(subjects)
    if runs:
        place = {subject.name: index for index, subject in enumerate(subjects)}
        to_last = [
            {**one.columns, "number": "debiased CKA with the last model", "low": None, "high": None, "chance": None}
            | {"value": debiased_cka(latents[place[one.name]], latents[place[own[-1].name]])}
            for own in runs.values()
            for one in own
        ]
        figure = evolution_figure(to_last, ["debiased CKA with the last model"])
        written += [save(figure, folder / "correlate_evolution.png"), *write_rows(to_last, folder, "correlate_evolution")]
        lines += ["", "correlate_evolution.png: how alike each of a run's models is to its last one, over environment steps."]
    return [*written, write_lines(lines, folder / "correlate.md")]


def _pair(subjects: Sequence[Subject], latents: Sequence[np.ndarray], few: np.ndarray, i: int, j: int) -> dict[str, Any]:
    x, y = latents[i], latents[j]
    a, b = subjects[i], subjects[j]
    row: dict[str, Any] = {"first": a.name, "second": b.name, "kind": _kind(a, b), "states": len(x)}
    shuffled = y[np.random.default_rng(0).permutation(len(y))]
    for name, function in zip(NUMBERS, (linear_cka, debiased_cka, mean_cca), strict=True):
        row |= {name: function(x, y), f"{name}, chance": function(x, shuffled)}
    correlations = dict.fromkeys(("within_first", "within_second", "between"), float("nan"))
    if x.shape[1] == y.shape[1]:
        correlations = mean_absolute_correlations(sample_correlations(x[few], y[few]), len(few))
    return row | {f"mean absolute correlation, {name.replace('_', ' ')}": value for name, value in correlations.items()}


def _kind(a: Subject, b: Subject) -> str:
    if a.policy.run.folder == b.policy.run.folder:
        return SAME
    return SEEDS if a.method == b.method else DIFFERENT


def _text(rows: Sequence[dict[str, Any]], states: int, samples: int) -> list[str]:
    kinds = [kind for kind in (DIFFERENT, SEEDS, SAME) if any(row["kind"] == kind for row in rows)]
    null = "see 'one method, two seeds' below." if SEEDS in kinds else "none was given (--null RUN)."
    between = "mean absolute correlation, between"
    lines = ["# Similarity of latents", "", EXPLANATION.format(states=states, null=null, samples=samples), ""]
    cells = []
    for kind in kinds:
        own = [row for row in rows if row["kind"] == kind]
        cells.append([kind, str(len(own)), *(_range([row[name] for row in own]) for name in (*NUMBERS[1:], between))])
    lines += markdown(("pairs of", "pairs", "debiased CKA", "mean CCA", between), cells)
    lines += ["", "Mean over the pairs (lowest to highest).", ""]
    header = ("models", *NUMBERS, "mean absolute correlation within, within, between")
    cells = []
    for row in rows:
        numbers = [f"{number(row[name])}, chance {number(row[f'{name}, chance'])}" for name in NUMBERS]
        absolute = [number(row[f"mean absolute correlation, {name}"]) for name in ("within first", "within second", "between")]
        cells.append([f"{row['first']} and {row['second']}", *numbers, ", ".join(absolute)])
    return [*lines, *markdown(header, cells)]


def _range(values: Sequence[float]) -> str:
    known = [value for value in values if not np.isnan(value)]
    if not known:
        return "-"
    mean = f"{np.mean(known):.2f}"
    return mean if len(known) == 1 else f"{mean} ({min(known):.2f} to {max(known):.2f})"
