"""Folders of runs, as ``train.py`` leaves them, and what they say about themselves.

::

    <anything>/<preset>/<env>_1/      a run: evaluations.npz, progress.csv, 0.monitor.csv, checkpoints/, ...
        checkpoints/DONE              training has ended
        <env>/args.yml, config.yml    flags and settings
        <env>.zip                     the final policy, once training has ended
        provenance.json               machine, versions, revision of its training, and of each time that it went on
        final.json                    what the final policy was worth: see final.py
    <anything>/spec.json              of runs that a comparison made: see specs.py
    <anything>/failure.json           why the last attempt at it ended early
"""

import json
import zipfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_crc.atomic import atomic_write
from sb3_crc.envs.tasks import NAMESPACE, default_action_repeat, task_of

FINAL, PROVENANCE, SPEC, FAILURE = "final.json", "provenance.json", "spec.json", "failure.json"
EVALUATIONS, CHECKPOINTS, DONE = "evaluations.npz", "checkpoints", "DONE"


class _ZooLoader(yaml.SafeLoader):
    """rl_zoo3 writes OrderedDicts; anything else that is no plain data is refused."""


def _ordered_dict(loader: yaml.SafeLoader, node: yaml.Node) -> dict[str, Any]:
    assert isinstance(node, yaml.SequenceNode)
    (pairs,) = loader.construct_sequence(node, deep=True)
    return {str(key): value for key, value in pairs}


def _list(loader: yaml.SafeLoader, node: yaml.Node) -> list[Any]:
    assert isinstance(node, yaml.SequenceNode)
    return list(loader.construct_sequence(node, deep=True))


_ZooLoader.add_constructor("tag:yaml.org,2002:python/object/apply:collections.OrderedDict", _ordered_dict)
_ZooLoader.add_constructor("tag:yaml.org,2002:python/tuple", _list)


@dataclass(frozen=True)
class Run:
    """
    A folder in which ``train.py`` has begun a training.

    :param folder: ``<anything>/<preset>/<env>_<number>``
    :raises FileNotFoundError: if it is no such folder
    :raises ValueError: from properties, if what is in it cannot be read
    """

    folder: Path

    def __post_init__(self) -> None:
        if self._described is None:
            raise FileNotFoundError(f"{self.folder} is no run of train.py: there is no */args.yml in it")

    @property
    def preset(self) -> str:
        """``--algo``: a preset, or a stock algorithm."""
        return str(self.arguments["algo"])

    @property
    def method(self) -> str:
        """What it is called in tables: the preset, if the comparison that it belongs to says nothing else."""
        return str(self.spec.get("method", self.preset))

    @property
    def task(self) -> str:
        """domain-task, or the id of an environment that is none of the suite."""
        return task_of(self.arguments["env"])

    @property
    def seed(self) -> int:
        """Of the training."""
        return int(self.arguments["seed"])

    @property
    def is_of_suite(self) -> bool:
        """Whether its environment is one of :func:`~sb3_crc.make_dmc`; else it is the user's."""
        return str(self.arguments["env"]).startswith(f"{NAMESPACE}/")

    @property
    def action_repeat(self) -> int:
        """Environment steps per agent step."""
        own = default_action_repeat(self.task) if self.is_of_suite else 1
        return int(self.env_kwargs.get("action_repeat") or own)

    @property
    def budget(self) -> int:
        """Environment steps that it was asked for."""
        asked = int(self.arguments["n_timesteps"])
        return (asked if asked > 0 else int(self.settings["n_timesteps"])) * self.action_repeat

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Arguments of its environment, of make_dmc for instance."""
        return {**(self.arguments.get("env_kwargs") or {}), **(self.settings.get("env_kwargs") or {})}

    @property
    def model(self) -> Path:
        """The final policy; missing until training has ended, or was interrupted."""
        assert self._described is not None
        return self.folder / f"{self._described.name}.zip"

    @property
    def status(self) -> str:
        """finished, unevaluated (``sb3-crc evaluate`` was not run), failed, or unfinished: see :attr:`has_ended`."""
        if (self.folder / FINAL).exists():
            return "finished"
        if self.spec_folder is not None and (self.spec_folder / FAILURE).exists():
            return "failed"
        return "unevaluated" if self.has_ended else "unfinished"

    @property
    def agent_steps(self) -> int | None:
        """That the policy in :attr:`model` has seen; None: there is none, or it cannot be read."""
        try:
            with zipfile.ZipFile(self.model) as file:
                return int(json.loads(file.read("data"))["num_timesteps"])
        except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
            return None

    @property
    def has_ended(self) -> bool:
        """Whether the final policy is there and has seen exactly the budget; rl_zoo3 saves one after an interruption too."""
        checkpoints = self.folder / CHECKPOINTS
        whole = not checkpoints.is_dir() or (checkpoints / DONE).exists()
        return whole and self.agent_steps == self.budget // self.action_repeat

    @property
    def final(self) -> dict[str, Any] | None:
        """What :func:`~sb3_crc.experiments.final.evaluate_final` wrote; None if it has not been evaluated."""
        path = self.folder / FINAL
        return read_json(path) if path.exists() else None

    @property
    def provenance(self) -> dict[str, Any]:
        """Of its training's beginning, and ``resumed``: of each time that it went on; empty if it was not recorded."""
        path = self.folder / PROVENANCE
        return read_json(path) if path.exists() else {}

    def distinct(self, name: str) -> list[Any]:
        """:param name: of an entry of :attr:`provenance`; :return: what it was, each value once, in the order of time"""
        recorded = self.provenance
        values = [one.get(name) for one in (recorded, *recorded.get("resumed", []))]
        return [value for place, value in enumerate(values) if value is not None and value not in values[:place]]

    @property
    def evaluations(self) -> dict[str, np.ndarray] | None:
        """Evaluations during training, see :func:`read_evaluations`; None before the first one."""
        path = self.folder / EVALUATIONS
        return read_evaluations(path) if path.exists() else None

    @cached_property
    def arguments(self) -> dict[str, Any]:
        """Flags of train.py."""
        return self._read("args.yml")

    @cached_property
    def settings(self) -> dict[str, Any]:
        """Hyper-parameters, with env_kwargs and n_timesteps."""
        return self._read("config.yml")

    @property
    def spec_folder(self) -> Path | None:
        """The folder that a comparison made for it; None if it was trained by hand."""
        folder = self.folder.parent.parent
        return folder if (folder / SPEC).exists() else None

    @cached_property
    def spec(self) -> dict[str, Any]:
        """What the comparison asked for; empty if it was trained by hand."""
        return {} if self.spec_folder is None else read_json(self.spec_folder / SPEC)

    @property
    def _described(self) -> Path | None:
        return next((path.parent for path in sorted(self.folder.glob("*/args.yml"))), None)

    def _read(self, name: str) -> dict[str, Any]:
        assert self._described is not None
        path = self._described / name
        try:
            return dict(yaml.load(path.read_text(encoding="utf-8"), _ZooLoader))  # a SafeLoader
        except (OSError, yaml.YAMLError, ValueError, TypeError) as error:
            raise ValueError(f"{path} cannot be read: {error}") from error


def find_runs(folders: Iterable[Path]) -> Iterator[Run]:
    """
    :param folders: of runs, or of anything that contains runs
    :return: every run in them, in the order of their paths
    :raises FileNotFoundError: if one does not exist
    """
    seen = set()
    for folder in folders:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder} is no folder")
        for described in sorted(folder.rglob("args.yml")):
            run = described.parent.parent
            if run not in seen:
                seen.add(run)
                yield Run(run)


def read_json(path: Path) -> dict[str, Any]:
    """
    :raises ValueError: if it is no JSON mapping, naming the file
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} is no JSON mapping")
    return content


def read_evaluations(path: Path) -> dict[str, np.ndarray]:
    """
    :param path: ``evaluations.npz``, as SB3's EvalCallback or :class:`~sb3_crc.evaluation.QBiasEvalCallback` write it
    :return: arrays by name, among them ``timesteps`` ``(evaluations,)`` in agent steps, and ``results``
        ``(evaluations, episodes)``
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if it cannot be read or holds no evaluations, naming it
    """
    try:
        with np.load(path) as file:
            found = dict(file)
    except FileNotFoundError:
        raise
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    if not {"timesteps", "results"} <= found.keys():
        raise ValueError(f"{path} holds no evaluations: there are only {', '.join(found) or 'no arrays'} in it")
    return found


def add_provenance(made: dict[str, Any], folder: Path) -> None:
    """:param made: machine, versions, revision; :param folder: of a run that goes on, whose file keeps the earlier ones"""
    path = folder / PROVENANCE
    recorded = read_json(path) if path.exists() else {}
    write_json({**recorded, "resumed": [*recorded.get("resumed", []), made]}, path)


def write_json(content: dict[str, Any], path: Path) -> None:
    """:param content: plain data; :param path: file to write, which appears whole or not at all"""
    with atomic_write(path) as unfinished:
        unfinished.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
