"""Which scores are compared with which: each method with the baseline on what these two have, whatever other methods lack."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from sb3_crc.experiments.statistics import HIGHEST_RETURN, REPS, Difference, ScoreMatrices, differences, score_matrices

if TYPE_CHECKING:
    import pandas as pd

#: (method, task) -> seed -> return
Returns = dict[tuple[str, str], dict[int, float]]


@dataclass(frozen=True)
class Pair:
    """
    :param difference: of a method and the baseline
    :param tasks: on which both were trained
    :param seeds: that both have on each of these tasks
    """

    difference: Difference
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]


def compare_pairs(means: "pd.DataFrame", baseline: str, *, reps: int = REPS) -> tuple[list[Pair], list[str]]:
    """
    Each method with the baseline, on the grid of tasks and seeds that these two have.

    :param means: of ``scores.final_means``
    :param baseline: what the others are compared with
    :param reps: bootstrap samples
    :return: one pair for each method that shares something with the baseline, and what is in none and why
    """
    returns = _by_run(means)
    found, left_out = [], []
    for method in _others(means, baseline):
        tasks, absent = _common_tasks(returns, method, baseline)
        shared = score_matrices(means[means["method"].isin([baseline, method]) & means["task"].isin(tasks)])
        left_out += absent
        if len(tasks) == 1:
            left_out += _lacking_seeds(returns, method, baseline, tasks[0])
        else:
            left_out += [f"{method} against {baseline} on all tasks: {one}" for one in shared.dropped]
        if shared.scores:
            (difference,) = differences(shared.scores, baseline, reps=reps)
            found.append(Pair(difference, shared.tasks, shared.seeds))
    return found, left_out


def compare_by_task(means: "pd.DataFrame", baseline: str, *, reps: int = REPS) -> tuple[list[Pair], list[str]]:
    """
    Each method with the baseline on each task by itself, with all seeds that these two have on it.

    :param means: of ``scores.final_means``
    :param baseline: what the others are compared with
    :param reps: bootstrap samples
    :return: one pair for each method and task, and what is in none and why
    """
    returns = _by_run(means)
    found, left_out = [], []
    for method in _others(means, baseline):
        tasks, absent = _common_tasks(returns, method, baseline)
        left_out += absent
        for task in tasks:
            own, other = returns[method, task], returns[baseline, task]
            left_out += _lacking_seeds(returns, method, baseline, task)
            if seeds := sorted({*own} & {*other}):
                pair = {name: _column(of, seeds) for name, of in ((baseline, other), (method, own))}
                (difference,) = differences(pair, baseline, reps=reps)
                found.append(Pair(difference, (task,), tuple(seeds)))
    return found, left_out


def own_matrices(means: "pd.DataFrame") -> tuple[dict[str, ScoreMatrices], list[str]]:
    """
    Each method on the tasks that all methods have, with the seeds that it has on all of these.

    :param means: of ``scores.final_means``
    :return: method -> its scores, and what is not in there and why
    """
    returns = _by_run(means)
    methods = list(dict.fromkeys(method for method, _ in returns))
    tasks, left_out = [], []
    for task in dict.fromkeys(task for _, task in returns):
        if lacking := [method for method in methods if (method, task) not in returns]:
            left_out.append(f"{task}: no {', '.join(lacking)}")
        else:
            tasks.append(task)
    found = {}
    for method in methods if tasks else ():
        seeds = sorted(set.intersection(*({*returns[method, task]} for task in tasks)))
        for seed in sorted(set.union(*({*returns[method, task]} for task in tasks)) - {*seeds}):
            lacking = [task for task in tasks if seed not in returns[method, task]]
            left_out.append(f"{method}, seed {seed}: not on {', '.join(lacking)}")
        if seeds:
            scores = np.hstack([_column(returns[method, task], seeds) for task in tasks])
            found[method] = ScoreMatrices({method: scores}, tuple(seeds), tuple(tasks), ())
        else:
            left_out.append(f"{method}: no seed on each of {', '.join(tasks)}")
    return found, left_out


def ranges(numbers: Sequence[int]) -> str:
    """:param numbers: in order; :return: ``1, 4-7``"""
    cuts = [0, *(place for place, (one, later) in enumerate(pairwise(numbers), 1) if later != one + 1), len(numbers)]
    runs = [numbers[start:end] for start, end in pairwise(cuts)]
    return ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs)


def _others(means: "pd.DataFrame", baseline: str) -> list[str]:
    return [method for method in dict.fromkeys(map(str, means["method"])) if method != baseline]


def _common_tasks(returns: Returns, method: str, baseline: str) -> tuple[list[str], list[str]]:
    """:return: tasks that both have, and who lacks the others"""
    tasks = list(dict.fromkeys(task for name, task in returns if name in (baseline, method)))
    left_out = []
    for one in (method, baseline):
        if absent := [task for task in tasks if (one, task) not in returns]:
            left_out.append(f"{method}: no {one} on {', '.join(absent)}")
    return [task for task in tasks if {(method, task), (baseline, task)} <= returns.keys()], left_out


def _lacking_seeds(returns: Returns, method: str, baseline: str, task: str) -> list[str]:
    """:return: who lacks which of the other's seeds"""
    own, other = {*returns[method, task]}, {*returns[baseline, task]}
    return [
        f"{method} on {task}: no {name} with seed {', '.join(map(str, sorted(lacking)))}"
        for name, lacking in ((method, other - own), (baseline, own - other))
        if lacking
    ]


def _by_run(means: "pd.DataFrame") -> Returns:
    found: Returns = {}
    for method, task, seed, value in zip(*(means[name] for name in ("method", "task", "seed", "return")), strict=True):
        found.setdefault((str(method), str(task)), {})[int(seed)] = float(value)
    return found


def _column(returns: dict[int, float], seeds: Sequence[int]) -> np.ndarray:
    """(S, 1), returns / 1000"""
    return np.array([[returns[seed]] for seed in seeds]) / HIGHEST_RETURN
