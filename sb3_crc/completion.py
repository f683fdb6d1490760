"""What a shell offers for a value after Tab. It imports tables alone: a key press must not wait for torch."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

from sb3_crc.envs.tasks import task_names
from sb3_crc.presets import PRESETS

#: ``sb3_crc.stock.STOCK``, without importing it; a test compares them
STOCK_ALGORITHMS = ("sac", "sac_matched", "state_sac")
#: Folders that are looked into for runs, at one key press
LOOKS = 300

Complete = Callable[[str], list[str]]


def one_of(*names: str) -> Complete:
    """:param names: that are allowed; :return: what completes one of them"""

    def complete(incomplete: str) -> list[str]:
        return [name for name in names if name.startswith(incomplete)]

    return complete


def several_of(*names: str) -> Complete:
    """:param names: that are allowed; :return: what completes the last of some that are separated by commas"""

    def complete(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",")
        given = before.split(",")
        return [before + comma + name for name in names if name.startswith(last) and name not in given]

    return complete


def distractions(incomplete: str) -> list[str]:
    """Those of ``contact-sheet``, separated by commas."""
    from sb3_crc.envs.distractions.modes import DISTRACTIONS

    return several_of(*DISTRACTIONS)(incomplete)


def modes(incomplete: str) -> list[str]:
    """Those of ``generalize``, separated by commas: distractions, and none of them."""
    from sb3_crc.envs.distractions.modes import DISTRACTIONS

    return several_of("none", *DISTRACTIONS)(incomplete)


def runs(incomplete: str) -> list[str]:
    """Folders of runs that begin so, wherever they are below, and whatever else of the file system begins so."""
    folder = Path(incomplete) if incomplete.endswith("/") else Path(incomplete).parent
    prefix = incomplete.removeprefix("./")
    beside = [path for path in _listed(folder) if str(path).startswith(prefix)]
    places = [path for path in beside if path.is_dir()]
    found = [str(run) for run in _runs_below(places)]
    return list(dict.fromkeys([*(f"{path}/" if path.is_dir() else str(path) for path in beside), *found]))


def _runs_below(places: list[Path]) -> Iterator[Path]:
    """Breadth first: what lies deep in a large tree is not waited for."""
    for _ in range(LOOKS):
        if not places:
            return
        folder = places.pop(0)
        inside = [path for path in _listed(folder) if path.is_dir()]
        if any((path / "args.yml").exists() for path in inside):
            yield folder
        else:
            places += inside


def _listed(folder: Path) -> list[Path]:
    try:
        names = sorted(os.listdir(folder))
    except OSError:
        return []
    return [folder / name for name in names if not name.startswith(".")]


methods = several_of(*PRESETS, *STOCK_ALGORITHMS)
tasks = one_of(*task_names())
several_tasks = several_of(*task_names())
