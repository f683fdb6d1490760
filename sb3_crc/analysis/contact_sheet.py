"""A contact sheet: what each task looks like under each distraction."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.analysis.figures import new_figure
from sb3_crc.envs.distractions import DISTRACTIONS, STATIC
from sb3_crc.envs.dmc import make_dmc
from sb3_crc.envs.tasks import PAPER_TASKS

#: On a picture those that stand still look like those that move
MODES = tuple(mode for mode in DISTRACTIONS if not mode.endswith(STATIC))
#: Decisions into the episode, where something has moved
DECISIONS = 5


def draw_contact_sheet(
    path: Path,
    tasks: Sequence[str] = PAPER_TASKS,
    modes: Sequence[str] = MODES,
    *,
    data: Path | None = None,
    image_size: int = 100,
    **env_kwargs: Any,
) -> Path:
    """
    Draw one frame of each task (rows) and each mode (columns), beside the task as it is; the agent acts at random.

    :param path: PNG file to write, in a folder that is made
    :param tasks: domain-task
    :param modes: distractions of :func:`~sb3_crc.make_dmc`
    :param data: see its ``distraction_data``
    :param image_size: side of the pictures in pixels
    :param env_kwargs: others of its arguments
    :return: the path
    :raises ValueError: for an unknown task or mode, or no task at all
    """
    if not tasks:
        raise ValueError("no task is given: there is nothing to draw")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure = new_figure(1.25 * (len(modes) + 1), 1.3 * len(tasks) + 0.3)
    grid = figure.subplots(len(tasks), len(modes) + 1, squeeze=False)
    for row, task in zip(grid, tasks, strict=True):
        for axes, mode in zip(row, (None, *modes), strict=True):
            axes.imshow(_frame(task, mode, data if mode else None, image_size, env_kwargs))
            axes.set_xticks([])
            axes.set_yticks([])
            if task == tasks[0]:
                axes.set_title(mode or "as it is", fontsize=8)
        row[0].set_ylabel(task, fontsize=8)
    figure.savefig(path, dpi=100)
    return path


def _frame(task: str, mode: str | None, data: Path | None, image_size: int, env_kwargs: dict[str, Any]) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "video_easy changes nothing of reacher")  # the sheet shows that
        env = make_dmc(task, seed=0, image_size=image_size, distraction=mode, distraction_data=data, **env_kwargs)
    try:
        observation, _ = env.reset()
        for _ in range(DECISIONS):
            observation, *_ = env.step(env.action_space.sample())
    finally:
        env.close()
    return np.asarray(observation[-3:].transpose(1, 2, 0))
