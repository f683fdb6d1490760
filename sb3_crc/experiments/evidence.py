"""What scores show, and what they do not: one page, made from raw files alone. What ``sb3-crc results`` writes."""

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sb3_crc.experiments.comparison_summary import difference_table, markdown
from sb3_crc.experiments.pairs import compare_by_task, ranges
from sb3_crc.experiments.published import SIX_TASKS, published, read_published
from sb3_crc.experiments.runs import read_json
from sb3_crc.experiments.scores import BETWEEN, Missing, final_means, one_protocol, read_scores
from sb3_crc.experiments.statistics import ENOUGH_SEEDS, HIGHEST_RETURN, NOT_RESOLVED, aggregate
from sb3_crc.presets import PRESETS
from sb3_crc.settings import check_name
from sb3_crc.stock import STOCK

if TYPE_CHECKING:
    import pandas as pd

#: The paper's row, and for each task the highest published mean of an agent without a language model, at 100 000 steps
PAPER = "CRC-RL"
BEST: dict[str, str] = {
    "cartpole-swingup": "Simoun",
    "ball_in_cup-catch": "Simoun",
    "finger-spin": "TD-MPC2",
    "reacher-easy": "ResAct (as in COVR)",
    "cheetah-run": "Simoun",
    "walker-walk": "Simoun",
}
#: Columns of the published table that say where these scores lie
OTHERS = ("MLR", "DrQ", "CURL", "SAC+AE", "pixel SAC", "state SAC")
BUDGET = 100_000
#: Of the bootstrap of a mean
SAMPLES = 10_000


def results_page(
    sources: Sequence[Path], *, baselines: Sequence[str], landmarks: Path | None = None, trials: Sequence[Path] = ()
) -> str:
    """
    :param sources: CSV files of scores, or folders that contain runs
    :param baselines: methods with each of which the others are compared
    :param landmarks: file of ``sb3-crc landmarks``
    :param trials: tables of the trials that led to the settings
    :return: Markdown. The same files give the same page
    :raises FileNotFoundError: if a file does not exist
    :raises ValueError: if final scores, or those of a baseline, are not there, episodes are missing, or scores do not match
    """
    scores = read_scores(sources)
    final = scores.final
    if final.empty:
        raise ValueError(f"there is no score of a final policy in {', '.join(map(str, sources))}")
    means = final_means(one_protocol(final, remedy=""))
    for baseline in baselines:
        check_name("baseline", baseline, list(dict.fromkeys(means["method"])))
    lines = ["# Results", ""]
    lines += _paragraph(
        "Made by `sb3-crc results` from raw files alone; do not edit. Every figure is the return of the FINAL policy after "
        "exactly the budget, random first steps and repeated actions included: mean action, episodes whose seeds are the same "
        "for all methods and were used by no training; trials before used them too. All runs are shown."
    )
    measured = {} if landmarks is None else read_json(landmarks)["returns"]
    for task in dict.fromkeys(means["task"]):
        lines += _task(task, means[means["task"] == task], measured.get(task, {}))
    lines += _compared(means, list(dict.fromkeys(baselines)))
    lines += _conditions(final)
    if trials:
        lines += _trials(trials)
    absent = [f"- {line}" for line in _missing(scores.missing)]
    absent += [f"- no run on {task}" for task in SIX_TASKS if task not in set(means["task"])]
    absent += [f"- no run of {name}" for name in (*PRESETS, *STOCK) if name not in set(means["method"])]
    if absent:
        lines += ["## Not done", "", *absent, ""]
    return "\n".join(lines)


def probability_of_reaching(returns: Sequence[float], goal: float, *, seed: int = 0) -> float | None:
    """
    :param returns: one of each training seed
    :param goal: return
    :param seed: of the bootstrap
    :return: share of bootstrap samples of the seeds whose mean reaches it; None with too few seeds
    """
    if len(returns) < ENOUGH_SEEDS:
        return None
    drawn = np.random.default_rng(seed).choice(np.asarray(returns, float), (SAMPLES, len(returns)))
    return float((drawn.mean(axis=1) >= goal).mean())


def goals(task: str) -> dict[str, float]:
    """:param task: domain-task; :return: what is published for it at 100 000 environment steps: who -> mean"""
    cells = read_published()
    cells = cells[(cells["task"] == task) & (cells["environment_steps"] == BUDGET)].set_index("method")["mean"]
    return {name: float(cells[name]) for name in (PAPER, BEST.get(task, PAPER)) if name in cells}


def others(task: str) -> dict[str, float]:
    """:param task: domain-task; :return: what is published for :data:`OTHERS` at 100 000 environment steps, highest first"""
    cells = published("100k")
    cells = cells[(cells["task"] == task) & cells["column"].isin(OTHERS)]
    return {str(name): float(mean) for name, mean in cells.sort_values("mean", ascending=False)[["column", "mean"]].to_numpy()}


def _task(task: str, means: "pd.DataFrame", landmarks: Mapping[str, Sequence[float]]) -> Iterator[str]:
    wanted = goals(task)
    header = ["method", "seeds: return of each", "mean", "IQM", *(f"P(mean >= {value:.0f})" for value in wanted.values())]
    rows = []
    for method, own in means.groupby("method", sort=False):
        returns = [float(value) for value in own.sort_values("seed")["return"]]
        (statistics,) = aggregate({"": np.array(returns)[:, None] / HIGHEST_RETURN}).values()
        each = ", ".join(f"{seed}: {value:.0f}" for seed, value in sorted(zip(own["seed"], own["return"], strict=True)))
        chances = [probability_of_reaching(returns, goal) for goal in wanted.values()]
        shown = ["" if chance is None else f"{chance:.2f}" for chance in chances]
        rows.append([str(method), each, statistics["mean"].text(), statistics["IQM"].text(), *shown])
    for name, measured in landmarks.items():
        rows.append([f"*{name} actions*", "", f"{np.mean(measured):.0f}", "", *("" for _ in wanted)])
    yield from [f"## {task}", "", *markdown(header, rows), ""]
    if wanted:
        cited = "; ".join(f"{value:.0f}: {name}" for name, value in wanted.items())
        beside = ", ".join(f"{value:.0f}: {name}" for name, value in others(task).items())
        yield from _paragraph(
            f"Published at {BUDGET:,} environment steps: {cited}; beside them {beside or 'nothing'}. {PAPER}'s ± is over "
            "evaluation runs of an unstated number of trainings, and whether its steps are environment steps is not certain. "
            "In parentheses: 95 % intervals, bootstrap over seeds, which with few seeds are too narrow. P: share of "
            f"{SAMPLES:,} bootstrap samples of the seeds, from {ENOUGH_SEEDS} seeds on."
        )


def _compared(means: "pd.DataFrame", baselines: Sequence[str]) -> Iterator[str]:
    compared = {baseline: compare_by_task(means, baseline) for baseline in baselines}
    if not any(found for found, _ in compared.values()):
        return
    for baseline, (found, _) in compared.items():
        if found:
            yield from [f"## Against {baseline}", "", *difference_table(found), ""]
    yield from _paragraph(
        "A row for each task, with all seeds that the method and the baseline both have on it. "
        f"'{NOT_RESOLVED}': the interval of the difference, paired by seed, includes 0, or there are fewer than "
        f"{ENOUGH_SEEDS} seeds."
    )
    if left_out := dict.fromkeys(one for _, absent in compared.values() for one in absent):
        yield from ["In no row:", "", *(f"- {one}" for one in left_out), ""]


def _missing(runs: Sequence[Missing]) -> Iterator[str]:
    """:return: a line for each method, task and reason"""
    seeds: dict[tuple[str, str, str], list[int]] = {}
    for one in runs:
        seeds.setdefault((one.method, one.task, one.reason), []).append(one.seed)
    for (method, task, reason), numbers in seeds.items():
        yield f"{method} on {task}, seed{'s' * (len(numbers) > 1)} {ranges(sorted(numbers))}: {reason}"


def _conditions(final: "pd.DataFrame") -> Iterator[str]:
    yield from ["## Conditions", ""]
    for task, rows in final.groupby("task", sort=False):
        about = [f"{rows['action_repeat'].iloc[0]} environment steps per action", f"{rows['render_quality'].iloc[0]} pictures"]
        about += [f"{rows['episodes'].iloc[0]} episodes", f"from seed {rows['first_seed'].iloc[0]}"]
        yield f"- {task}: {', '.join(about)}"
    for column, title in (("machine", "machines"), ("versions", "versions"), ("git_revision", "revisions")):
        values = {one for value in final[column].dropna().unique() for one in str(value).split(BETWEEN)}
        yield f"- {title}: {BETWEEN.join(sorted(values)) or 'not recorded'}"
    yield ""


def _trials(paths: Sequence[Path]) -> Iterator[str]:
    import pandas as pd

    counted = []
    for path in paths:
        try:
            found = pd.read_csv(path)
            counts = found["algo"].value_counts(sort=False)
            seeds = sorted(set(found["seed"])) if "seed" in found else []
        except (ValueError, KeyError) as error:
            raise ValueError(f"{path} is no table of trials: {error}") from error
        with_seeds = f", with seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}" if seeds else ""
        counted.append(f"{', '.join(f'{number} of {name}' for name, number in counts.items())}{with_seeds} ({path.name})")
    yield from ["## Trials", ""]
    yield from _paragraph(
        f"Trials on cartpole-swingup, before these runs and beside: {'; '.join(counted)}; none of any other method: they have "
        "the settings that `rad` was tuned for."
    )


def _paragraph(text: str) -> list[str]:
    return [*textwrap.wrap(text, 127, break_long_words=False, break_on_hyphens=False), ""]
