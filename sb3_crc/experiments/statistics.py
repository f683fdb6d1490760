"""What scores of a few seeds say and what they do not: aggregates, differences and curves with bootstrap intervals.

Intervals are 95 % percentile intervals of the stratified bootstrap of Agarwal et al. 2021 (arXiv 2108.13264): the seeds of
every task are drawn anew, so they hold for these tasks. Matrices hold returns / 1000, a task of the suite giving at most 1000;
results are in units of return again. Needs the extra ``analysis``.

S seeds, T tasks, P points of a curve.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

#: Highest return of a task of the suite
HIGHEST_RETURN = 1000.0
#: Of an aggregate, in the order of tables
STATISTICS = ("IQM", "mean", "median", "optimality gap")
NOT_RESOLVED, ONE_SEED = "not resolved", "one seed: no interval"
#: Below so many seeds a bootstrap says nothing: with two, half of all pairs of equal methods would come out as different
ENOUGH_SEEDS = 3
REPS = 2000

Axis = Literal["environment_steps", "seconds"]
Matrices = Mapping[str, np.ndarray]
Cell = tuple[str, str, int]


@dataclass(frozen=True)
class ScoreMatrices:
    """
    Final returns that a comparison can use.

    :param scores: method -> (S, T), returns / 1000; empty if there is no task and seed that all methods have
    :param seeds: of the rows
    :param tasks: of the columns
    :param dropped: seeds and tasks that not all methods have, each with who lacks it
    """

    scores: dict[str, np.ndarray]
    seeds: tuple[int, ...]
    tasks: tuple[str, ...]
    dropped: tuple[str, ...]


@dataclass(frozen=True)
class Estimate:
    """
    :param value: in the sample
    :param interval: 95 %; None with one seed
    """

    value: float
    interval: tuple[float, float] | None

    def text(self, form: str = ".0f") -> str:
        """
        :param form: of each number
        :return: value and interval
        """
        if self.interval is None:
            return f"{self.value:{form}}"
        low, high = self.interval
        return f"{self.value:{form}} ({low:{form}} to {high:{form}})"


@dataclass(frozen=True)
class Difference:
    """
    :param iqm: IQM of the method minus that of the baseline, in units of return
    :param probability: that a run of the method has a higher return than one of the baseline on the same task, mean over tasks
    :param seeds: how many
    """

    method: str
    baseline: str
    iqm: Estimate
    probability: Estimate
    seeds: int

    @property
    def resolved(self) -> bool:
        """Are there seeds enough, and does the interval of the difference exclude 0?"""
        if self.iqm.interval is None or self.seeds < ENOUGH_SEEDS:
            return False
        return not self.iqm.interval[0] <= 0 <= self.iqm.interval[1]

    @property
    def verdict(self) -> str:
        """In words, for tables."""
        if self.seeds < ENOUGH_SEEDS:
            return f"{NOT_RESOLVED} ({ONE_SEED if self.seeds == 1 else f'{self.seeds} seeds'})"
        if not self.resolved:
            return NOT_RESOLVED
        return "better" if self.iqm.value > 0 else "worse"


@dataclass(frozen=True)
class Curve:
    """
    :param x: (P,)
    :param y: (P,)
    :param interval: (2, P), each point for itself; None with one seed
    :param seeds: how many
    :param tasks: how many
    """

    x: np.ndarray
    y: np.ndarray
    interval: np.ndarray | None
    seeds: int
    tasks: int


@dataclass(frozen=True)
class Curves:
    """
    :param methods: method -> its curve
    :param left_out: runs, tasks and methods that are not in the curves, and why
    """

    methods: dict[str, Curve]
    left_out: tuple[str, ...]


def score_matrices(means: "pd.DataFrame") -> ScoreMatrices:
    """
    A missing run costs its seed in all methods and tasks, so that each method is judged by the same seeds; but a task that has
    less than half as many of the seeds as any seed has of the tasks is left out itself.

    :param means: of ``scores.final_means``
    :return: scores on the tasks and seeds that all methods have, and what was dropped
    """
    returns = {(str(row.method), str(row.task), int(row.seed)): row.mean_return for row in _named(means)}
    methods = list(dict.fromkeys(method for method, _, _ in returns))
    tasks = list(dict.fromkeys(task for _, task, _ in returns))
    seeds = sorted({seed for _, _, seed in returns})
    dropped = []
    while lacking := [(m, t, s) for m in methods for t in tasks for s in seeds if (m, t, s) not in returns]:
        incomplete = {(task, seed) for _, task, seed in lacking}
        have_task = {task: np.mean([(task, seed) not in incomplete for seed in seeds]) for task in tasks}
        have_seed = {seed: np.mean([(task, seed) not in incomplete for task in tasks]) for seed in seeds}
        task, seed = min(tasks, key=lambda one: have_task[one]), min(seeds, key=lambda one: have_seed[one])
        if have_task[task] < have_seed[seed] / 2:
            tasks.remove(task)
            dropped.append(f"{task}: {_who(lacking, task=task)}")
        else:
            seeds.remove(seed)
            dropped.append(f"seed {seed}: {_who(lacking, seed=seed)}")
    if not (tasks and seeds):
        return ScoreMatrices({}, (), (), tuple(dropped))
    scores = {m: np.array([[returns[m, t, s] for t in tasks] for s in seeds]) / HIGHEST_RETURN for m in methods}
    return ScoreMatrices(scores, tuple(seeds), tuple(tasks), tuple(dropped))


def aggregate(matrices: Matrices, *, reps: int = REPS, seed: int = 0) -> dict[str, dict[str, Estimate]]:
    """
    :param matrices: method -> (S, T), returns / 1000
    :param reps: bootstrap samples
    :param seed: of the bootstrap
    :return: method -> :data:`STATISTICS` -> estimate in units of return. The median is that of the tasks' means, the
        optimality gap what the mean lacks to 1000
    """
    from rliable import metrics

    functions = (metrics.aggregate_iqm, metrics.aggregate_mean, metrics.aggregate_median, metrics.aggregate_optimality_gap)

    def all_of_them(scores: np.ndarray) -> np.ndarray:
        return HIGHEST_RETURN * np.array([function(scores) for function in functions])

    found = {}
    for method, scores in matrices.items():
        values, interval = _bootstrap(all_of_them, scores, reps, seed)
        found[method] = {name: _estimate(values, interval, index) for index, name in enumerate(STATISTICS)}
    return found


def differences(matrices: Matrices, baseline: str, *, reps: int = REPS, seed: int = 0) -> list[Difference]:
    """
    The interval of a difference of IQMs is paired by seed: row s of all matrices belongs to one seed, and each bootstrap
    sample draws the same seeds of a task for method and baseline. The probability of improvement compares every run with every
    run, so there the two are drawn independently.

    With few seeds all intervals of a bootstrap are too narrow. Of two methods with the same normal distribution of returns on
    one task, the difference came out as resolved in 50 % of 1500 simulated comparisons with 2 seeds, 26 % with 3, 10 % with 5
    and 7 % with 10, instead of in 5 %; on six tasks in 20, 16, 8 and 7 %. Below :data:`ENOUGH_SEEDS` none counts as resolved.

    :param matrices: method -> (S, T), returns / 1000, rows of the same seeds
    :param baseline: what the others are compared with
    :param reps: bootstrap samples
    :param seed: of the bootstrap
    :return: one for each other method, in the order of ``matrices``
    :raises ValueError: if there is no such baseline, or matrices differ in shape
    """
    if baseline not in matrices:
        raise ValueError(f"there is no method {baseline!r} to compare with, only {', '.join(matrices)}")
    other = matrices[baseline]
    found = []
    for method, scores in matrices.items():
        if method == baseline:
            continue
        if scores.shape != other.shape:
            raise ValueError(f"{method} has {scores.shape} (seeds, tasks), {baseline} has {other.shape}: not the same seeds")
        gap = _bootstrap(_iqm_difference, (scores, other), reps, seed, paired=True)
        probability = _bootstrap(probability_of_improvement, (scores, other), reps, seed)
        found.append(Difference(method, baseline, _estimate(*gap), _estimate(*probability), len(scores)))
    return found


def curve(table: "pd.DataFrame", axis: Axis, *, points: int = 50, reps: int = REPS, seed: int = 0) -> Curves:
    """
    IQM, over seeds and tasks, of the mean return of each evaluation during training.

    A method is shown on the tasks that all methods have, with the seeds that it has on all of them. Over environment steps: at
    the evaluations that all these runs share. Over seconds: each run's returns are interpolated linearly on a grid that begins
    where the last of the method's runs was evaluated first, and ends where the first of them ends.

    :param table: of ``Scores``
    :param axis: column of it for the abscissa
    :param points: of the grid over seconds
    :param reps: bootstrap samples
    :param seed: of the bootstrap
    :return: curves in units of return
    """
    runs, left_out = training_runs(table, axis)
    methods = list(dict.fromkeys(method for method, _, _ in runs))
    tasks = []
    for task in dict.fromkeys(task for _, task, _ in runs):
        if lacking := [method for method in methods if not any((method, task) == key[:2] for key in runs)]:
            left_out.append(f"{task}: none of {', '.join(lacking)}")
        else:
            tasks.append(task)
    found = {}
    for method in methods:
        own = {key: run for key, run in runs.items() if key[0] == method and key[1] in tasks}
        seeds = sorted({key[2] for key in own})
        lacking_runs = [(method, task, one) for task in tasks for one in seeds if (method, task, one) not in own]
        incomplete = {one for _, _, one in lacking_runs}
        left_out += [f"{method}, seed {one}: {_who(lacking_runs, seed=one)}" for one in sorted(incomplete)]
        seeds = [one for one in seeds if one not in incomplete]
        if not seeds:
            left_out.append(f"{method}: no seed that was trained on each of the tasks that all methods have")
            continue
        used = [[own[method, task, one] for task in tasks] for one in seeds]
        x = _grid([run for row in used for run in row], axis, points)
        if not len(x):
            left_out.append(f"{method}: its runs share no evaluation")
            continue
        last = max(run[0].max() for row in used for run in row)
        if axis == "environment_steps" and last > x[-1]:
            left_out.append(f"{method}: evaluations after {x[-1]:.0f} environment steps, which not all its runs have reached")
        scores = np.array([[np.interp(x, *run) for run in row] for row in used]) / HIGHEST_RETURN  # (S, T, P)
        y, interval = _bootstrap(_iqm_of_points, scores, reps, seed)
        found[method] = Curve(x, y, interval, len(seeds), len(tasks))
    return Curves(found, tuple(left_out))


def training_runs(table: "pd.DataFrame", axis: Axis) -> tuple[dict[Cell, tuple[np.ndarray, np.ndarray]], list[str]]:
    """
    :param table: of ``Scores``
    :param axis: column of it
    :return: (method, task, seed) -> abscissas and mean returns of the run's evaluations; and what is not in there, and why. Of
        several runs of one seed the finished one counts, or the one that got farthest
    """
    current = table[table["policy"] == "current"]
    finished = set(table[table["policy"] == "final"]["run"])
    runs: dict[Cell, tuple[np.ndarray, np.ndarray]] = {}
    evaluated = set(current["run"])
    none = table[~table["run"].isin(evaluated)].drop_duplicates("run")
    left_out = [f"{row.run}: no evaluations during training" for row in none.itertuples()]
    for (method, task, seed), rows in current.groupby(["method", "task", "seed"], sort=False):
        steps = rows.groupby("run", sort=False)["environment_steps"].max()
        folder = max(steps.index, key=lambda one: (one in finished, steps[one]))
        left_out += [f"{one}: {folder} is of the same method, task and seed" for one in steps.index if one != folder]
        rows = rows[rows["run"] == folder]
        if rows[axis].isna().any():
            left_out.append(f"{folder}: {axis} were not recorded")
            continue
        evaluations = rows.groupby("environment_steps")[[axis, "return"]].mean().astype(float)
        runs[str(method), str(task), int(seed)] = evaluations[axis].to_numpy(), evaluations["return"].to_numpy()
    return runs, left_out


def profile(matrices: Matrices, thresholds: np.ndarray, *, reps: int = REPS, seed: int = 0) -> dict[str, Curve]:
    """
    :param matrices: method -> (S, T), returns / 1000
    :param thresholds: (P,) in units of return
    :param reps: bootstrap samples
    :param seed: of the bootstrap
    :return: method -> share of its runs, over seeds and tasks, with a return above each threshold
    """
    from rliable import library

    def shares(scores: np.ndarray, levels: np.ndarray) -> Any:
        return (scores[..., None] > levels).mean(axis=(0, 1))  # rliable's own, without its loop over thresholds

    found = {}
    for method, scores in matrices.items():
        with _numpy_seed(seed):
            values, intervals = library.create_performance_profile(
                {method: scores}, thresholds / HIGHEST_RETURN, custom_profile_func=shares, reps=reps
            )
        interval = intervals[method] if len(scores) > 1 else None
        found[method] = Curve(thresholds, values[method], interval, *scores.shape)
    return found


def probability_of_improvement(scores: np.ndarray, other: np.ndarray) -> float:
    """
    rliable's metric of that name, as array operations: thousands of Mann-Whitney tests would take minutes.

    :param scores: (S, T)
    :param other: (S', T)
    :return: share of the pairs of runs of a task in which the first is higher, ties as half; mean over tasks
    """
    pairs = scores[:, None, :], other[None, :, :]
    return float(np.mean(np.greater(*pairs)) + np.mean(np.equal(*pairs)) / 2)


def _iqm_difference(scores: np.ndarray, other: np.ndarray) -> float:
    from rliable import metrics

    return HIGHEST_RETURN * float(metrics.aggregate_iqm(scores) - metrics.aggregate_iqm(other))


def _iqm_of_points(scores: np.ndarray) -> np.ndarray:
    """(S, T, P) -> (P,), as metrics.aggregate_iqm gives for each point"""
    ordered = np.sort(scores.reshape(-1, scores.shape[-1]), axis=0)
    cut = len(ordered) // 4
    return HIGHEST_RETURN * np.asarray(ordered[cut : len(ordered) - cut].mean(axis=0))


def _bootstrap(
    function: Callable[..., Any],
    scores: np.ndarray | tuple[np.ndarray, np.ndarray],
    reps: int,
    seed: int,
    paired: bool = False,
) -> tuple[np.ndarray, np.ndarray | None]:
    """:return: values, (2, ...) their interval or None: samples of one seed would all be equal, and the interval empty"""
    from rliable import library

    samples = scores if isinstance(scores, tuple) else (scores,)
    values = np.atleast_1d(function(*samples))
    if min(len(sample) for sample in samples) < 2:
        return values, None
    with _numpy_seed(seed):
        if paired:  # one bootstrap of several arrays draws the same rows of all of them
            interval = library.StratifiedBootstrap(*samples).conf_int(function, reps=reps, size=0.95, method="percentile")
        else:
            given = {"": list(scores) if isinstance(scores, tuple) else scores}
            interval = library.get_interval_estimates(given, function, reps=reps)[1][""]
    return values, np.asarray(interval).reshape(2, -1)


@contextmanager
def _numpy_seed(seed: int) -> Iterator[None]:
    """rliable draws from numpy's global generator, whatever random_state it is given."""
    before = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(before)


def _estimate(values: np.ndarray, interval: np.ndarray | None, index: int = 0) -> Estimate:
    bounds = None if interval is None else (float(interval[0, index]), float(interval[1, index]))
    return Estimate(float(values[index]), bounds)


def _named(means: "pd.DataFrame") -> Any:
    return means.rename(columns={"return": "mean_return"}).itertuples(index=False)  # no attribute can be named return


def _who(lacking: Sequence[Cell], *, task: str | None = None, seed: int | None = None) -> str:
    """Of these runs, the ones of a task or of a seed."""
    if seed is not None:
        return "no " + ", ".join(f"{method} on {one}" for method, one, number in lacking if number == seed)
    of_method: dict[str, list[str]] = {}
    for method, one, number in lacking:
        if one == task:
            of_method.setdefault(method, []).append(str(number))
    return "no " + "; ".join(f"{method} with seed {', '.join(numbers)}" for method, numbers in of_method.items())


def _grid(runs: Sequence[tuple[np.ndarray, np.ndarray]], axis: Axis, points: int) -> np.ndarray:
    if axis == "environment_steps":
        return np.array(sorted(set.intersection(*(set(x) for x, _ in runs))))
    first, last = max(x[0] for x, _ in runs), min(x[-1] for x, _ in runs)
    return np.linspace(first, last, points) if first < last else np.array([first] if first == last else [])
