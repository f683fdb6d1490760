"""The paper's tables: published scores, ours beside them, and what is missing."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_crc.experiments.published import HARDER_TASKS, NOTES, SIX_TASKS, STEPS, TASKS, published
from sb3_crc.experiments.scores import PROTOCOL, Missing, MixedProtocols, Scores, final_means, one_protocol
from sb3_crc.presets import PRESETS

if TYPE_CHECKING:
    import pandas as pd

#: The row below the tasks
SIX_TASK_MEAN = "mean of six tasks"
CURL = "curl"


@dataclass(frozen=True)
class PublishedScore:
    """
    :param mean: return
    :param std: as published; None if not known
    :param seeds: of the training; None if not known
    :param environment_steps: as published; None in the row of means
    :param note: what is known about how it was measured
    :param source: citation
    """

    mean: float
    std: float | None = None
    seeds: int | None = None
    environment_steps: int | None = None
    note: str = "mean of the tasks' means"
    source: str = ""


@dataclass(frozen=True)
class OurScore:
    """
    Each seed counts by the mean over the episodes of its final evaluation.

    :param mean: over seeds
    :param std: over seeds, with n - 1; None for one seed, or for the six tasks if their seeds differ
    :param seeds: how many; None for the six tasks if their seeds differ
    :param iqm: interquartile mean of all runs; None for the six tasks if their seeds differ
    :param lowest: seed
    :param highest: seed
    :param budgets: environment steps, usually one
    :param percent_over_our_curl: of the mean, over that of our runs of ``curl``; None without such
    :param percent_over_published_curl: the same over CURL's published mean; None without one after as many steps
    """

    mean: float
    std: float | None
    seeds: int | None
    iqm: float | None
    lowest: float | None
    highest: float | None
    budgets: tuple[int, ...]
    percent_over_our_curl: float | None = None
    percent_over_published_curl: float | None = None


@dataclass(frozen=True)
class PaperTable:
    """
    :param name: 100k or 500k
    :param tasks: rows
    :param published: column -> task, or :data:`SIX_TASK_MEAN` where all six are there -> score
    :param ours: the same of our methods
    :param notes: sentences that belong under it
    :param missing: runs that are not in it
    """

    name: str
    tasks: tuple[str, ...]
    published: dict[str, dict[str, PublishedScore]]
    ours: dict[str, dict[str, OurScore]]
    notes: tuple[str, ...]
    missing: tuple[Missing, ...]

    @property
    def rows(self) -> tuple[str, ...]:
        """The tasks, and the six-task mean if any column has it."""
        columns: list[Mapping[str, object]] = [*self.published.values(), *self.ours.values()]
        return (*self.tasks, SIX_TASK_MEAN) if any(SIX_TASK_MEAN in column for column in columns) else self.tasks


def paper_table(scores: Scores, table: str, *, allow_mixed: bool = False) -> PaperTable:
    """
    :param scores: ours; of these only the final policies' count. The rest of the table is there without any
    :param table: 100k or 500k environment steps. On the four harder tasks 500k takes runs of 300k as well: there, CRC-RL
        reports "300K training steps"
    :param allow_mixed: let runs of other budgets and protocols pass; a note says which they are
    :return: published columns as in the paper, then presets, then other methods
    :raises MixedProtocols: if runs have other budgets, or differ in protocol, naming them
    :raises ValueError: if there is no such table, a seed was run twice, or the evaluation of a run is not whole
    """
    cells = published(table)
    final = scores.final
    if not allow_mixed:
        _check_budgets(final, table)
    one_protocol(final, allow_mixed=allow_mixed)
    from_papers = _published_columns(cells)
    tasks = (*TASKS[table], *(task for task in dict.fromkeys(final["task"]) if task not in TASKS[table]))
    ours = _our_columns(final, from_papers["CURL"])
    notes = (*NOTES[table], *_sources(cells), *_our_notes(final, table))
    return PaperTable(table, tasks, from_papers, ours, notes, scores.missing)


# What stands in the table


def _check_budgets(final: "pd.DataFrame", table: str) -> None:
    others = []
    for (task, budget), rows in final.groupby(["task", "budget"], sort=False):
        if not fits(table, task, budget):
            others.append(f"{', '.join(dict.fromkeys(rows['method']))} on {task}: {budget:,}")
    if others:
        allowed = f"{STEPS[table][0]:,} environment steps"
        if table == "500k":
            allowed += f" (300,000 too on {', '.join(HARDER_TASKS)})"
        raise MixedProtocols(
            f"the table {table} takes runs of {allowed}, and there are others: {'; '.join(others)}. "
            "--allow-mixed puts them into it all the same"
        )


def fits(table: str, task: str, budget: float) -> bool:
    """:param table: 100k or 500k; :return: whether runs of this budget, in environment steps, may stand in it"""
    allowed = STEPS[table] if task in HARDER_TASKS else STEPS[table][:1]
    return any(same_steps(budget, steps) for steps in allowed)


def same_steps(budget: float, steps: float) -> bool:
    """:return: whether two numbers of environment steps are the same, but for a remainder"""
    return math.isclose(budget, steps, rel_tol=1e-3)  # a budget is a whole number of decisions


def _published_columns(cells: "pd.DataFrame") -> dict[str, dict[str, PublishedScore]]:
    columns: dict[str, dict[str, PublishedScore]] = {}
    for row in cells.itertuples():
        columns.setdefault(row.column, {})[row.task] = PublishedScore(
            float(row.mean),
            None if math.isnan(row.std) else float(row.std),
            _known(row.seeds),
            int(row.environment_steps),
            row.note,
            row.source,
        )
    for of_task in columns.values():
        if all(task in of_task for task in SIX_TASKS):
            of_task[SIX_TASK_MEAN] = PublishedScore(float(np.mean([of_task[task].mean for task in SIX_TASKS])))
    return columns


def _our_columns(final: "pd.DataFrame", published_curl: Mapping[str, PublishedScore]) -> dict[str, dict[str, OurScore]]:
    if final.empty:
        return {}
    returns: dict[str, dict[str, dict[int, float]]] = {}
    for method, task, seed, value in final_means(final)[["method", "task", "seed", "return"]].itertuples(index=False):
        returns.setdefault(method, {}).setdefault(task, {})[int(seed)] = float(value)
    budgets = final.groupby(["method", "task"])["budget"].unique()
    columns: dict[str, dict[str, OurScore]] = {}
    for method in _ordered(final):
        columns[method] = {}
        for task, of_seed in returns[method].items():
            steps = tuple(sorted(int(one) for one in budgets[method, task]))
            columns[method][task] = _our_score(list(of_seed.values()), list(of_seed.values()), steps)
        if all(task in returns[method] for task in SIX_TASKS):
            six = [returns[method][task] for task in SIX_TASKS]
            steps = tuple(sorted({one for task in SIX_TASKS for one in columns[method][task].budgets}))
            columns[method][SIX_TASK_MEAN] = _six_task_score(six, steps)
    our_curl = columns.get(CURL, {})
    for method, of_task in columns.items():
        for task, score in of_task.items():
            ours = None if method == CURL or task not in our_curl else _percent_over(score.mean, our_curl[task].mean)
            theirs = _published_mean(published_curl, task, score.budgets)
            over = _percent_over(score.mean, theirs)
            of_task[task] = replace(score, percent_over_our_curl=ours, percent_over_published_curl=over)
    return columns


def _our_score(of_seed: Sequence[float], of_run: Sequence[float], budgets: tuple[int, ...]) -> OurScore:
    from scipy.stats import trim_mean

    std = float(np.std(of_seed, ddof=1)) if len(of_seed) > 1 else None
    iqm = float(trim_mean(of_run, 0.25))  # as rliable.metrics.aggregate_iqm
    return OurScore(float(np.mean(of_seed)), std, len(of_seed), iqm, min(of_seed), max(of_seed), budgets)


def _six_task_score(six: Sequence[Mapping[int, float]], budgets: tuple[int, ...]) -> OurScore:
    if any(set(of_seed) != set(six[0]) for of_seed in six):  # then no seed's mean over the tasks is one of the same tasks
        mean = float(np.mean([np.mean(list(of_seed.values())) for of_seed in six]))
        return OurScore(mean, None, None, None, None, None, budgets)
    of_seed = [float(np.mean([of_task[seed] for of_task in six])) for seed in six[0]]
    return _our_score(of_seed, [value for of_task in six for value in of_task.values()], budgets)


def _published_mean(curl: Mapping[str, PublishedScore], task: str, budgets: tuple[int, ...]) -> float | None:
    if task not in curl:
        return None
    parts = SIX_TASKS if task == SIX_TASK_MEAN else (task,)
    same = all(same_steps(budget, curl[part].environment_steps or 0) for part in parts for budget in budgets)
    return curl[task].mean if same else None


def _percent_over(mean: float, other: float | None) -> float | None:
    return 100 * (mean / other - 1) if other else None


def _ordered(final: "pd.DataFrame") -> list[str]:
    """Presets in their order, each before its variants; then the others by name."""
    order = {preset: place for place, preset in enumerate(PRESETS)}
    pairs = final[["method", "preset"]].drop_duplicates("method").itertuples(index=False)
    return [pair.method for pair in sorted(pairs, key=lambda one: _place(order, one.method, one.preset))]


def _place(order: Mapping[str, int], method: str, preset: str) -> tuple[int, bool, str, str]:
    return order.get(preset, len(order)), preset in order and method != preset, preset, method


# Notes


def _sources(cells: "pd.DataFrame") -> list[str]:
    """A sentence for each source, with the columns that come from it."""
    of: dict[tuple[str, str, int | None], list[str]] = {}
    for row in cells.itertuples():
        columns = of.setdefault((row.source, row.note, _known(row.seeds)), [])
        if row.column not in columns:
            columns.append(row.column)
    sentences = []
    for (source, note, seeds), columns in of.items():
        counted = "number of seeds not known" if seeds is None else f"{seeds} seeds"
        sentences.append(f"{'; '.join(columns)}: {source}; {note}; {counted}.")
    return sentences


def _our_notes(final: "pd.DataFrame", table: str) -> list[str]:
    if final.empty:
        return ["Ours: there is no run with a score of its final policy."]
    notes = [
        "Ours: final policies only, never the best checkpoint. Mean over training seeds of the mean over the final "
        "evaluation's episodes ± standard deviation over seeds (n - 1); one seed has no ±. IQM: as rliable's, the mean of the "
        "runs without a quarter of them, rounded down, at either end. Over CURL: of the means; over the published one only "
        "after as many steps."
    ]
    of: dict[str, list[str]] = {}
    for task, rows in final.groupby("task", sort=False):
        of.setdefault(", ".join(_values(rows, column) for column in PROTOCOL), []).append(task)
    notes += [f"Ours on {', '.join(tasks)}: {protocol}." for protocol, tasks in of.items()]
    if table == "500k" and any(task in HARDER_TASKS for task in final["task"]):
        notes.append("Budgets of ours are environment steps; whether CRC-RL's 300k training steps are, is not known.")
    return notes


def _values(rows: "pd.DataFrame", column: str) -> str:
    """One value of all, or each with the methods that have it."""
    methods = rows.groupby(column, dropna=False)["method"].agg(lambda names: ", ".join(dict.fromkeys(names)))
    name = column.replace("_", " ")
    if len(methods) == 1:
        return f"{name} {_plain(methods.index[0])}"
    return f"{name} {' and '.join(f'{_plain(value)} ({names})' for value, names in methods.items())}"


def _plain(value: Any) -> str:
    if isinstance(value, str):
        return value
    return "unknown" if math.isnan(value) else f"{value:,.0f}"


def _known(seeds: Any) -> int | None:
    import pandas as pd

    return None if pd.isna(seeds) else int(seeds)
