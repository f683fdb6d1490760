"""What ``sb3-crc probe`` writes: how much of the state each latent tells a linear reader."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.analysis.figures import evolution_figure, probe_figure, save
from sb3_crc.analysis.networks import encode, untrained_extractor
from sb3_crc.analysis.probes import Probe, pixel_components, probe
from sb3_crc.analysis.subjects import States, Subject, by_run, common_states, thinned
from sb3_crc.analysis.tables import Row, estimate_columns, estimate_of, number, write_lines, write_rows
from sb3_crc.experiments.comparison_summary import markdown

UNTRAINED, PIXELS = "untrained encoder", "PCA of pixels"
#: Random weights that the untrained encoder is drawn with
DRAWS = 3
ALL = "all"
#: More quantities than these stand in probe.csv only
COORDINATES = 14
EXPLANATION = """\
R^2 of ridge regression from the latent to each quantity of the simulator, on episodes that the fit has not seen (five groups
of episodes in turn; the penalty is chosen within the others). 1: read off exactly; 0: no better than the mean; below 0: worse.
Quantities are in the simulator's units; "all" is the mean over the task's own observations; those of
MuJoCo's joints, `qpos` and `qvel`, are in probe.csv.

- {data}
- **untrained encoder**: the same architecture with random weights, mean of {draws} draws. **PCA of pixels**: as many principal
  components of the frame stacks as the latent has dimensions. What a latent tells beyond these two, training has put there.
- In parentheses: 95 % bootstrap intervals over episodes. Models of several seeds are dots in the figure.
- Angles are read through their sine and cosine in the task's observations; `qpos` of a hinge counts turns, which no picture
  shows."""
COMMON = """\
All encode the same {states} observations, as many from the rollout of each model, evenly over time; episodes that begin
  equally are held out together."""
OWN = """\
**Each model encodes the states that its own policy visits.** These numbers are no comparison: a policy that stands still has
  little to tell apart, and R^2 is relative to the variance. Without --own-states all encode the same observations."""


@dataclass(frozen=True)
class _Reader:
    """Whose latents were probed, on which states, with which result."""

    columns: dict[str, Any]
    result: Probe


def write_probes(subjects: Sequence[Subject], folder: Path, *, states: int, own_states: bool = False) -> list[Path]:
    """
    Write ``probe.png``, ``probe.csv``, ``probe.json`` and ``probe.md``; of several models of one run
    ``probe_evolution.png`` too.

    :param subjects: the models
    :param folder: to write to
    :param states: observations in all
    :param own_states: let each model encode its own rollout, and not all the same observations
    :return: what was written
    :raises ValueError: if there is no physics state, no observation fits all, or there are too few episodes
    """
    for subject in subjects:
        if not subject.rollout.physics_names.size:
            raise ValueError(f"{subject.name}: {subject.policy.run.task} has no physics state to probe for")
    shared = None if own_states else common_states(subjects, states)
    each = [thinned(subject.rollout, states) if shared is None else shared for subject in subjects]
    quantities = list(map(str, each[0].physics_names))
    if any(list(map(str, one.physics_names)) != quantities for one in each):
        raise ValueError("the models have different quantities: they are of different tasks")
    readers = _readers(subjects, each)
    columns: dict[str, tuple[int, ...]] = {name: (index,) for index, name in enumerate(quantities)}
    own = [index for index, name in enumerate(quantities) if not name.startswith(("qpos.", "qvel."))]
    columns |= {ALL: tuple(own)}
    rows: list[dict[str, Any]] = []
    for reader in readers:
        for name, indices in columns.items():
            rows.append({**reader.columns, "number": f"R^2 of {name}", **estimate_columns(reader.result.r2(*indices))})
    rows = _mean_of_draws(rows)

    folder.mkdir(parents=True, exist_ok=True)
    drawn = [*(quantities[index] for index in own), ALL]
    if len(drawn) > COORDINATES:
        drawn = [ALL]  # humanoids have hundreds
    title = "the same states for all" if shared is not None else "each policy's own states: no comparison"
    written = [save(probe_figure(rows, drawn, f"Linear probes of held-out episodes, {title}"), folder / "probe.png")]
    written += write_rows(rows, folder, "probe")
    data = OWN if shared is None else COMMON.format(states=len(shared.observations))
    lines = ["# What can be read off the latents", "", EXPLANATION.format(data=data, draws=DRAWS), ""]
    lines += markdown(("", *drawn), _cells(rows, drawn))
    if by_run(subjects):
        of_models = [row for row in rows if row["file"] is not None]
        written.append(save(evolution_figure(of_models, [f"R^2 of {name}" for name in drawn]), folder / "probe_evolution.png"))
        lines += ["", "probe_evolution.png: R^2 of a run's models over the environment steps of its training."]
    return [*written, write_lines(lines, folder / "probe.md")]


def _readers(subjects: Sequence[Subject], each: Sequence[States]) -> list[_Reader]:
    readers = []
    dimensions: dict[int, States] = {}
    untrained: dict[str, str] = {}  # architecture -> name
    for subject, states in zip(subjects, each, strict=True):
        model = subject.policy.load()
        latents = encode(model, states.observations)
        readers.append(_Reader(subject.columns, probe(latents, states.physics, states.episodes)))
        dimensions[latents.shape[1]] = states
        architecture = repr((model.policy.features_extractor_class, model.policy.features_extractor_kwargs))
        if architecture in untrained:
            continue
        untrained[architecture] = f"{UNTRAINED} {len(untrained) + 1}" if untrained else UNTRAINED
        for seed in range(DRAWS):
            random = encode(model, states.observations, untrained_extractor(model, seed))
            columns = dict.fromkeys(subject.columns) | {"model": untrained[architecture], "method": UNTRAINED, "seed": seed}
            readers.append(_Reader(columns, probe(random, states.physics, states.episodes)))
    for dimension, states in dimensions.items():
        name = PIXELS if len(dimensions) == 1 else f"{PIXELS}, {dimension}"
        columns = dict.fromkeys(subjects[0].columns) | {"model": name, "method": PIXELS}
        components = pixel_components(states.observations, dimension)
        readers.append(_Reader(columns, probe(components, states.physics, states.episodes)))
    return sorted(readers, key=lambda reader: reader.columns["file"] is None)  # models first


def _mean_of_draws(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row instead of those of an untrained encoder's draws, with the lowest and the highest of them as interval."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault((row["model"], row["number"]), []).append(row)
    merged = []
    for same in found.values():
        values = [row["value"] for row in same]
        spread = {"value": float(np.mean(values)), "low": min(values), "high": max(values), "seed": None}
        merged.append(same[0] if len(same) == 1 else same[0] | spread)
    return merged


def _cells(rows: Sequence[Row], drawn: Sequence[str]) -> list[list[str]]:
    found: dict[str, list[str]] = {}
    for row in rows:
        if row["number"].removeprefix("R^2 of ") in drawn:
            text = number(row["value"]) if np.isnan(row["value"]) else estimate_of(row).text(".2f")
            found.setdefault(row["model"], [row["model"]]).append(text)
    return list(found.values())
