"""Scores of runs as one tidy table, a row per evaluation episode: what tables and curves are made of.

Reading it never averages silently: what is missing from a comparison is listed, and rows that were measured in different ways
do not meet in one table unless that is asked for.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_crc.experiments.runs import FAILURE, SPEC, Run, find_runs, read_json

if TYPE_CHECKING:
    import pandas as pd

#: Columns of the table, and what they hold
COLUMNS: dict[str, str] = {
    "method": "what it is called in tables: the preset, or the name of a variant of it",
    "preset": "--algo of train.py: a preset, or a stock algorithm",
    "task": "domain-task",
    "seed": "of the training",
    "policy": "current: evaluated during training; final: after exactly the budget",
    "budget": "environment steps that the run was for",
    "environment_steps": "done when this policy was evaluated",
    "agent_steps": "decisions, by then",
    "updates": "gradient steps, by then",
    "seconds": "of training by then, without evaluations",
    "episode": "number of the episode within the evaluation",
    "return": "undiscounted sum of the task's rewards in that episode",
    "first_seed": "of the evaluation environment; the other episodes follow from it",
    "episodes": "of that evaluation",
    "action_repeat": "environment steps per agent step",
    "render_quality": "of the pictures in training and evaluation; none: states",
    "machine": "of the training",
    "versions": "of the training",
    "git_revision": "of the training",
    "run": "folder",
}
#: What must be equal for the final policies of two runs of one task to stand in one table
PROTOCOL = ("budget", "episodes", "first_seed", "action_repeat", "render_quality")
#: Stands between machines, versions or revisions of a run that went on with others
BETWEEN = "; "
#: Columns that name one episode of one evaluation of a run
EPISODE = ("method", "task", "seed", "policy", "budget", "environment_steps", "episode", "run")
_WHOLE = {"first_seed": "Int64", "updates": "Int64"}  # pandas' integers that may be missing


class MixedProtocols(ValueError):
    """Scores that were measured in different ways were to be put beside one another."""


@dataclass(frozen=True)
class Missing:
    """
    A run that a comparison lacks.

    :param reason: not begun, unfinished, unevaluated, failed, or absent
    """

    method: str
    task: str
    seed: int
    reason: str

    def __str__(self) -> str:
        return f"{self.method} on {self.task}, seed {self.seed}: {self.reason}"


@dataclass(frozen=True)
class Scores:
    """
    :param table: one row per evaluation episode, with the :data:`COLUMNS`
    :param missing: runs that a comparison asked for, or that were begun, without a score of their final policy
    """

    table: "pd.DataFrame"
    missing: tuple[Missing, ...]

    @property
    def final(self) -> "pd.DataFrame":
        """The rows of final policies."""
        return self.table[self.table["policy"] == "final"]


def read_scores(sources: Iterable[Path]) -> Scores:
    """
    :param sources: CSV files of :func:`write_scores`, runs, or folders that contain runs
    :return: everything in them; a run that is found twice counts once
    :raises FileNotFoundError: if one does not exist
    :raises ValueError: if a file cannot be read, naming it, or two sources differ in the return of one episode of a run
    """
    import pandas as pd

    tables, missing, folders = [], [], []
    for source in sources:
        if source.is_file():
            tables.append(_read_csv(source))
        else:
            folders.append(source)
    for run in find_runs(folders):
        tables.append(run_scores(run))
        if run.status != "finished":
            missing.append(Missing(run.method, run.task, run.seed, run.status))
    missing += _not_begun(folders)
    table = pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=list(COLUMNS))
    _check_agreement(tables)
    table = table.drop_duplicates(list(EPISODE))
    return Scores(table, tuple([*missing, *_absent(table, missing)]))


def run_scores(run: Run) -> "pd.DataFrame":
    """
    :param run: finished or not
    :return: its evaluations, in rows as described by :data:`COLUMNS`
    """
    import pandas as pd

    states = run.env_kwargs.get("observation") == "state"
    common = {
        "method": run.method,
        "preset": run.preset,
        "task": run.task,
        "seed": run.seed,
        "budget": run.budget,
        "action_repeat": run.action_repeat,
        "render_quality": "none" if states else run.env_kwargs.get("render_quality", "benchmark"),
        "machine": recorded(run, "machine"),
        "versions": recorded(run, "versions"),
        "git_revision": recorded(run, "git_revision"),
        "run": str(run.folder),
    }
    rows = [common | row for row in (*_current(run), *_final(run))]
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype(_WHOLE)


def write_scores(scores: Scores, path: Path) -> None:
    """
    :param scores: to be read again by :func:`read_scores`
    :param path: CSV file to write
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    scores.table.to_csv(path, index=False)


def one_protocol(
    table: "pd.DataFrame", *, allow_mixed: bool = False, remedy: str = "; --allow-mixed puts them into one table all the same"
) -> "pd.DataFrame":
    """
    :param table: rows of final policies
    :param allow_mixed: let different ones pass
    :param remedy: what the error says at its end
    :return: ``table``
    :raises MixedProtocols: if rows of one task differ in any of :data:`PROTOCOL`, naming which and of which runs. States have
        no pictures, so their render quality fits every other
    """
    if allow_mixed:
        return table
    for task, rows in table.groupby("task"):
        for column in PROTOCOL:
            seen = rows[rows["render_quality"] != "none"] if column == "render_quality" else rows
            values = seen.groupby(column, dropna=False)["method"].agg(lambda methods: ", ".join(sorted(set(methods))))
            if len(values) > 1:
                found = "; ".join(f"{value} ({methods})" for value, methods in values.items())
                raise MixedProtocols(
                    f"{task}: {column} differs: {found}. Scores of different protocols do not compare{remedy}"
                )
    return table


def final_means(table: "pd.DataFrame") -> "pd.DataFrame":
    """
    :param table: rows of final policies
    :return: columns method, task, seed, return: the mean over the episodes of each run's final evaluation
    :raises ValueError: if episodes of an evaluation are missing, or a seed of a method was run twice, naming the runs
    """
    for run, rows in table.groupby("run"):
        lacking = len(rows) != rows["episodes"].iloc[0]
        if lacking or rows["return"].isna().any():
            what = f"{len(rows)} of {rows['episodes'].iloc[0]} episodes" if lacking else "an episode without a return"
            raise ValueError(f"the final evaluation of {run} is not whole: {what}")
    runs = table.groupby(["method", "task", "seed"], sort=False)["run"].unique()
    for (method, task, seed), folders in runs.items():
        if len(folders) > 1:
            raise ValueError(f"{method} on {task}, seed {seed} was run more than once: {', '.join(folders)}")
    return table.groupby(["method", "task", "seed"], sort=False, as_index=False)["return"].mean()


def _current(run: Run) -> list[dict[str, Any]]:
    data = run.evaluations
    if data is None:
        return []
    rows = []
    for index, returns in enumerate(data["results"]):
        at: dict[str, Any] = {
            "policy": "current",
            "agent_steps": int(data["timesteps"][index]),
            "environment_steps": int(data["timesteps"][index]) * run.action_repeat,
            "episodes": len(returns),
        }
        for name, column in (("updates", "updates"), ("seconds", "seconds"), ("seeds", "first_seed")):
            at[column] = data[name][index].item() if name in data else None  # older runs have no such arrays
        rows += [at | {"episode": episode, "return": float(value)} for episode, value in enumerate(returns)]
    return rows


def _final(run: Run) -> list[dict[str, Any]]:
    final = run.final
    if final is None:
        return []
    at = {name: final[name] for name in ("environment_steps", "agent_steps", "updates", "seconds", "first_seed")}
    at |= {"policy": "final", "episodes": len(final["returns"])}
    return [at | {"episode": episode, "return": float(value)} for episode, value in enumerate(final["returns"])]


def _not_begun(folders: Sequence[Path]) -> list[Missing]:
    missing = []
    for path in sorted({path for folder in folders for path in folder.rglob(SPEC)}):
        if not any(path.parent.glob("*/*/*/args.yml")):
            spec = read_json(path)
            reason = "failed" if (path.parent / FAILURE).exists() else "not begun"
            missing.append(Missing(spec["method"], spec["task"], spec["seed"], reason))
    return missing


def _absent(table: "pd.DataFrame", known: Sequence[Missing]) -> list[Missing]:
    """Of a task, every method should have been trained with every seed that any method of it has been trained with."""
    listed = {(one.method, one.task, one.seed) for one in known}
    absent = []
    for task, rows in table.groupby("task", sort=False):
        final = rows[rows["policy"] == "final"]
        have = set(zip(final["method"], final["seed"], strict=True))
        for method in dict.fromkeys(rows["method"]):
            for seed in sorted(set(rows["seed"])):
                if (method, seed) not in have and (method, task, seed) not in listed:
                    begun = ((rows["method"] == method) & (rows["seed"] == seed)).any()
                    absent.append(Missing(str(method), str(task), int(seed), "unfinished" if begun else "absent"))
    return absent


def _check_agreement(tables: Sequence["pd.DataFrame"]) -> None:
    """:raises ValueError: if two of them have different returns for one episode: one of the two is out of date"""
    import pandas as pd

    if len(tables) < 2:
        return
    keys = list(EPISODE)
    each = pd.concat([table.drop_duplicates(keys) for table in tables], ignore_index=True)
    for key, returns in each[each.duplicated(keys, keep=False)].groupby(keys, dropna=False, sort=False)["return"]:
        lowest, highest = returns.min(), returns.max()
        if highest - lowest > 1e-6 * max(1.0, abs(highest)):
            *_, policy, _, steps, episode, run = key
            raise ValueError(
                f"{run}: episode {episode} of its {policy} policy after {steps} environment steps has a return of "
                f"{lowest:.3f} in one source, of {highest:.3f} in another: one of the two is out of date, leave it out"
            )


def _read_csv(path: Path) -> "pd.DataFrame":
    import pandas as pd

    try:
        types = {"git_revision": "str", "render_quality": "str", **_WHOLE}
        table = pd.read_csv(path, keep_default_na=False, na_values=[""], dtype=types)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    if lacking := [column for column in COLUMNS if column not in table]:
        raise ValueError(f"{path} is no table of scores: it has no column {', '.join(lacking)}")
    return table


def recorded(run: Run, name: str) -> str | None:
    """:param name: of an entry of its provenance; :return: what it was in the run's parts; None: nothing was recorded"""
    return BETWEEN.join(one if isinstance(one, str) else one_line(one) or "" for one in run.distinct(name)) or None


def one_line(content: Mapping[str, Any] | None) -> str | None:
    """:param content: of provenance: a machine, or versions; :return: what is known of it; None: nothing was recorded"""
    return None if content is None else ", ".join(f"{name} {value}" for name, value in content.items() if value is not None)
