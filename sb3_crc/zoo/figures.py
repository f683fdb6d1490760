"""rl_zoo3's plots: axes that name their unit, files where no window can open, and normalised scores for rliable."""

import argparse
import pickle
import re
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.envs.tasks import environment_id, task_names
from sb3_crc.zoo.messages import say

#: Returns of a suite task lie between these: 1000 steps with rewards in [0, 1].
LOWEST, HIGHEST = 0.0, 1000.0

Flags = list[str]


def split_figures_flag(flags: Flags) -> tuple[Path | None, Flags]:
    """
    :param flags: of a plotting command
    :return: the folder of ``--figures``, if given, and the other flags
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--figures", type=Path)
    known, rest = parser.parse_known_args(flags)
    return known.figures, rest


@contextmanager
def figures(folder: Path | None) -> Iterator[None]:
    """
    What is plotted within is shown in windows, or written as PNG files if there is a folder or no window can open.

    :param folder: None: ``figures``, if no window can open
    """
    from matplotlib import pyplot as plt
    from matplotlib.backends.registry import BackendFilter, backend_registry

    blind = backend_registry.list_builtin(BackendFilter.NON_INTERACTIVE)  # type: ignore[no-untyped-call]
    windows = plt.get_backend().lower() not in blind
    show = plt.show

    def label_and_show() -> None:
        _name_units()
        if windows and folder is None:
            show()

    plt.show = label_and_show  # type: ignore[assignment]
    try:
        yield
    finally:
        plt.show = show
    _name_units()
    if folder is not None or not windows:
        _save_all(folder or Path("figures"))


def _name_units() -> None:
    """Monitor and EvalCallback count decisions, which rl_zoo3 calls timesteps."""
    from matplotlib import pyplot as plt

    for number in plt.get_fignums():
        for axes in plt.figure(number).axes:
            axes.set_xlabel(axes.get_xlabel().replace("Timesteps", "Agent steps (decisions)"))


def _save_all(folder: Path) -> None:
    from matplotlib import pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    for number in plt.get_fignums():
        figure = plt.figure(number)
        manager = figure.canvas.manager
        title = manager.get_window_title() if manager is not None else ""
        path = folder / f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', title) or f'figure_{number}'}.png"
        figure.savefig(path, dpi=150, bbox_inches="tight")
        say(f"Figure: {path}")


def register_reference_scores() -> None:
    """Tell rl_zoo3 between which returns the tasks of the suite lie; a second call changes nothing."""
    from rl_zoo3.plots import score_normalization

    for task in task_names():
        score = score_normalization.ReferenceScore(environment_id(task), LOWEST, HIGHEST)
        if score.env_id not in score_normalization.min_max_score_per_env:
            score_normalization.reference_scores.append(score)
            score_normalization.min_max_score_per_env[score.env_id] = score


@contextmanager
def normalized_inputs(flags: Flags) -> Iterator[Flags]:
    """
    Flags for rl_zoo3's ``plot_from_file``. It normalises scores of PyBullet only, so for rliable, whose metrics need scores
    from 0 to 1, it is given files in which the scores of suite tasks are normalised already.

    :param flags: of ``plot_from_file``
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("-i", "--input")
    parser.add_argument("--merge", nargs="+", default=[])
    parser.add_argument("-r", "--rliable", action="store_true")
    parser.add_argument("-iqm", "--iqm", action="store_true")  # or it would be read as -i qm
    known, rest = parser.parse_known_args(flags)
    if not known.rliable or known.input is None:
        yield flags
        return
    register_reference_scores()
    say(f"For rliable the returns of suite tasks are divided by {HIGHEST:.0f}.")
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".* not found for normalizing scores")
        given = [name if name.endswith(".pkl") else f"{name}.pkl" for name in (known.input, *known.merge)]
        written = [str(Path(folder) / f"{number}.pkl") for number in range(len(given))]
        for source, target in zip(given, written, strict=True):
            Path(target).write_bytes(pickle.dumps(_normalized(pickle.loads(Path(source).read_bytes()))))
        merged = ["--merge", *written[1:]] if known.merge else []
        yield ["-i", written[0], *merged, "-r", *["-iqm"] * known.iqm, *rest]


def _normalized(results: dict[str, Any]) -> dict[str, Any]:
    normalized = {}
    for env, runs in results.items():
        env_id = None if env == "results_table" else _suite_id(env)
        normalized[env] = runs if env_id is None else {key: _scaled(env_id, key, records) for key, records in runs.items()}
    return normalized


def _scaled(env_id: str, key: str, records: dict[str, Any]) -> dict[str, Any]:
    from rl_zoo3.plots.score_normalization import normalize_score

    if np.ndim(records["last_evals"]) == 0:
        raise SystemExit(f"rliable needs two or more runs of each algorithm and task; there is one of {key} on {env_id}")
    return {
        name: values if name == "timesteps" else normalize_score(np.asarray(values), env_id)
        for name, values in records.items()
    }


def _suite_id(env: str) -> str | None:
    """The first suite task in whose runs' folders ``all_plots -e env`` looks."""
    ids = (environment_id(task) for task in task_names())
    return next((env_id for env_id in ids if env in env_id.replace("/", "-")), None)
