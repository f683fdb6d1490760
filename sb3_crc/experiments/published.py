"""What papers report for the tasks of CRC-RL: ``published.csv``, and which of it stands in which table."""

from collections.abc import Mapping
from importlib.resources import as_file, files
from typing import TYPE_CHECKING

from sb3_crc.envs.tasks import PAPER_TASKS
from sb3_crc.settings import check_name

if TYPE_CHECKING:
    import pandas as pd

SIX_TASKS, HARDER_TASKS = PAPER_TASKS[:6], PAPER_TASKS[6:]

#: Table -> its tasks, in order
TASKS: dict[str, tuple[str, ...]] = {"100k": SIX_TASKS, "500k": PAPER_TASKS}
#: Table -> environment steps of its published figures. Only CRC-RL has any at 300k, and no others on the same tasks
STEPS: dict[str, tuple[int, ...]] = {"100k": (100_000,), "500k": (500_000, 300_000)}

_PAPER: dict[str, tuple[str, ...]] = {
    "CRC-RL": ("CRC-RL",),
    "CURL": ("CURL", "CURL (as in CRC-RL paper)"),  # the six tasks from its own paper, the harder ones from CRC-RL's
    "PlaNet": ("PlaNet",),
    "Dreamer": ("Dreamer",),
    "SAC+AE": ("SAC+AE",),
    "pixel SAC": ("SAC pixel",),
    "SODA": ("SODA (as in CRC-RL paper)",),
    "state SAC": ("SAC state",),
}
_ANCHORS: dict[str, tuple[str, ...]] = {
    "DrQ": ("DrQ [K=2,M=2]",),  # what the preset `drq` is: the bar that needs no objective
    # RAD's own 100k and 500k are agent steps, 2 to 8 times the budget, and the RAD rows that COVR quotes do not say which
    # steps they are. DrQ's ablation is SAC with one random shift, in environment steps: the nearest to RAD that compares.
    "DrQ [K=1,M=1]": ("DrQ [K=1,M=1] (~RAD)",),
    "MLR": ("MLR",),  # the best auxiliary objective with these action repeats, batch 512 and 10 seeds
    "Simoun": ("Simoun",),  # the highest mean at 100k without a language model
}
#: Table -> column -> names in published.csv
COLUMNS: dict[str, dict[str, tuple[str, ...]]] = {
    "100k": {**_PAPER, **_ANCHORS},
    # MR.Q: the newest with raw scores of evaluations on all ten tasks; on the four harder ones nothing else above has any
    "500k": {**{name: rows for name, rows in _PAPER.items() if name != "SODA"}, **_ANCHORS, "MR.Q": ("MR.Q",)},
}

_SPREAD = (
    "CRC-RL: ± is over 10 evaluation runs; of how many trainings is not stated. Other published ±: over training seeds, "
    "whose number is given where it is known."
)
_UNIT = (
    "CRC-RL: the paper says environment steps, its released code counts agent steps; at action repeat 8, 100k agent steps are "
    "800k environment steps. Figures from other papers count environment steps."
)
_SAME_SAC = "pixel SAC: the same means are printed for 100k and 500k."
#: Table -> what its published columns do not say themselves
NOTES: Mapping[str, tuple[str, ...]] = {
    "100k": (
        _SPREAD,
        _UNIT,
        "SODA: as printed in CRC-RL's table, where the figures equal those of DMControl-GB's Video-Easy test (SODA with "
        "random convolutions): probably not scores of the training environment.",
        _SAME_SAC,
        "DrQ [K=1,M=1]: random shifts without averaging; stands for RAD, whose paper counts agent steps.",
    ),
    "500k": (
        _SPREAD,
        _UNIT,
        f'CRC-RL: no figures for the first six tasks at 500k. {", ".join(HARDER_TASKS)}: CRC-RL after 300k "training steps", '
        "unit not stated; CURL after 500k, as printed in CRC-RL's table.",
        _SAME_SAC,
        "DrQ [K=1,M=1]: random shifts without averaging; stands for RAD, whose paper counts agent steps.",
        "MR.Q: action repeat 2 on every task.",
    ),
}


def read_published() -> "pd.DataFrame":
    """
    :return: all that is shipped, a row per method, task and environment steps: columns method, task, environment_steps, mean,
        std and seeds (missing where not known), note, source
    """
    import pandas as pd

    with as_file(files("sb3_crc.experiments") / "published.csv") as path:
        return pd.read_csv(path, dtype={"seeds": "Int64"}, encoding="utf-8")


def published(table: str) -> "pd.DataFrame":
    """
    :param table: a key of :data:`COLUMNS`
    :return: its cells: the columns of :func:`read_published`, and ``column``, in the order of columns and tasks
    :raises ValueError: if there is no such table
    """
    import pandas as pd

    check_name("table", table, COLUMNS)
    rows = read_published()
    rows = rows[rows["task"].isin(TASKS[table]) & rows["environment_steps"].isin(STEPS[table])]
    order = {task: place for place, task in enumerate(TASKS[table])}
    found = []
    for column, methods in COLUMNS[table].items():
        of_column = rows[rows["method"].isin(methods)].sort_values("task", key=lambda tasks: tasks.map(order))
        found.append(of_column.assign(column=column))
    return pd.concat(found, ignore_index=True)
