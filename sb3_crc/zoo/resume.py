"""What ``train.py`` knows beside rl_zoo3's flags: checkpoints of the whole training, and how a run goes on from them.

``--checkpoint-every N``: save everything every N agent steps; ``--resume RUN``: go on with the run in this folder, with the
flags that it was started with. Flags beside ``--resume`` come after those and so count instead of them.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sb3_crc.checkpoints.callback import DONE

#: Folder of a run in which its checkpoints are
CHECKPOINTS = "checkpoints"
FLAGS = "flags.json"


@dataclass(frozen=True)
class Plan:
    """
    :param flags: for rl_zoo3
    :param checkpoint_every: agent steps between two checkpoints; None: none are made
    :param run: the run that goes on; None: a new one is begun
    """

    flags: list[str]
    checkpoint_every: int | None
    run: Path | None


def read_plan(flags: Sequence[str]) -> Plan:
    """
    :param flags: of the command line
    :raises SystemExit: with one line that says what is wrong, or that the run has ended
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--checkpoint-every", type=int)
    parser.add_argument("--resume", type=Path)
    own, others = parser.parse_known_args(flags)
    if own.checkpoint_every is not None and own.checkpoint_every < 1:
        parser.error(f"--checkpoint-every {own.checkpoint_every}: it must be at least 1")
    if own.resume is None:
        return Plan(others, own.checkpoint_every, None)
    if "-i" in others or "--trained-agent" in others:
        parser.error("--resume and -i exclude each other: the one goes on exactly, the other begins with trained networks")
    file = own.resume / CHECKPOINTS / FLAGS
    if not file.is_file():
        parser.error(
            f"--resume {own.resume}: there are no checkpoints of a run made with --checkpoint-every ({file} is missing)"
        )
    # Killed between the last checkpoint and the final model, a run has only that to save
    saved_model = any(path.name != "best_model.zip" for path in own.resume.glob("*.zip"))
    if (own.resume / CHECKPOINTS / DONE).exists() and saved_model and not others:
        sys.exit(f"{own.resume} has ended; to prolong it, add -n with a larger number of agent steps")
    saved = json.loads(file.read_text(encoding="utf-8"))
    return Plan([*saved["flags"], *others], own.checkpoint_every or saved["checkpoint_every"], own.resume)


def write_plan(plan: Plan, run: Path) -> None:
    """:param plan: of a new run; :param run: its folder"""
    folder = run / CHECKPOINTS
    folder.mkdir(parents=True, exist_ok=True)
    content = {"flags": plan.flags, "checkpoint_every": plan.checkpoint_every}
    (folder / FLAGS).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
