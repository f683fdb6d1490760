"""What an analysis is about: saved policies with their rollouts, and the observations that all of them are shown.

n observations, C channels, H, W height and width, Z latent, P physics.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_crc.analysis.policies import SavedPolicy, find_policies, unique_names
from sb3_crc.analysis.rollouts import Rollout, rollout_of


@dataclass(frozen=True)
class Subject:
    """
    :param name: for tables and legends
    :param policy: the saved policy
    :param rollout: its own
    """

    name: str
    policy: SavedPolicy
    rollout: Rollout

    @property
    def method(self) -> str:
        """What it was trained by."""
        return self.policy.run.method

    @property
    def environment_steps(self) -> int:
        """Of its training until it was saved."""
        return int(self.rollout.about["environment_steps"])

    @property
    def columns(self) -> dict[str, Any]:
        """What every row of a table says of it."""
        return {
            "model": self.name,
            "method": self.method,
            "task": self.policy.run.task,
            "seed": self.policy.run.seed,
            "environment_steps": self.environment_steps,
            "file": str(self.policy.file),
        }


@dataclass(frozen=True)
class States:
    """
    Observations that several encoders are shown.

    :param observations: uint8 ``(n, C, H, W)``
    :param physics: ``(n, P)``
    :param physics_names: ``(P,)``
    :param episodes: ``(n,)``; episodes of one number begin equally, whoever acts
    :param steps: ``(n,)``, decisions since the episode began
    """

    observations: np.ndarray
    physics: np.ndarray
    physics_names: np.ndarray
    episodes: np.ndarray
    steps: np.ndarray


def gather(
    paths: Iterable[Path],
    *,
    checkpoints: bool = False,
    decisions: int = 1_000,
    episodes: int = 4,
    report: Callable[[str], None] = lambda line: None,
) -> list[Subject]:
    """
    :param paths: of models, runs, and folders that contain runs
    :param checkpoints: of each run, take also the models that were saved on the way
    :param decisions: of each rollout, at least
    :param episodes: of each rollout, at least
    :param report: is told where each rollout comes from
    :return: a subject for each model
    :raises FileNotFoundError: see :func:`~sb3_crc.analysis.policies.find_policies`
    :raises ValueError: see there, and if a policy cannot act in its environment
    """
    policies = find_policies(paths, checkpoints=checkpoints)
    rolled = [rollout_of(policy, decisions=decisions, episodes=episodes, report=report) for policy in policies]
    return [Subject(*one) for one in zip(unique_names(policies), policies, rolled, strict=True)]


def common_states(subjects: Sequence[Subject], count: int) -> States:
    """
    :param subjects: whose rollouts the observations are taken from, as many of each, evenly over time
    :param count: about so many in all; fewer if the rollouts are shorter
    :return: the same observations for everybody
    :raises ValueError: if they differ in their task or in the shape of their observations, naming both
    """
    first = subjects[0]
    for other in subjects[1:]:
        for what, own, others in (
            ("the task", first.policy.run.task, other.policy.run.task),
            ("observations of shape", first.rollout.observations.shape[1:], other.rollout.observations.shape[1:]),
        ):
            if own != others:
                raise ValueError(f"{first.name} has {what} {own}, {other.name} {others}: no observation fits both")
    parts = [thinned(subject.rollout, -(-count // len(subjects))) for subject in subjects]
    return States(
        np.concatenate([part.observations for part in parts]),
        np.concatenate([part.physics for part in parts]),
        parts[0].physics_names,
        np.concatenate([part.episodes for part in parts]),
        np.concatenate([part.steps for part in parts]),
    )


def thinned(rollout: Rollout, count: int) -> States:
    """:param rollout: any; :param count: how many of its states at most; :return: them, evenly over time"""
    rows = np.unique(np.linspace(0, len(rollout) - 1, min(count, len(rollout))).astype(int))
    arrays = rollout.observations[rows], rollout.physics[rows], rollout.physics_names
    return States(*arrays, rollout.episodes[rows], rollout.steps[rows])


def by_method(subjects: Sequence[Subject]) -> dict[str, list[Subject]]:
    """:return: method -> its subjects, in the order in which they were given"""
    found: dict[str, list[Subject]] = {}
    for subject in subjects:
        found.setdefault(subject.method, []).append(subject)
    return found


def by_run(subjects: Sequence[Subject]) -> dict[Path, list[Subject]]:
    """:return: folder of a run -> its models at different times, in the order of training, where there are several"""
    found: dict[Path, dict[int, Subject]] = {}
    for subject in subjects:
        found.setdefault(subject.policy.run.folder, {})[subject.environment_steps] = subject
    return {folder: [own[step] for step in sorted(own)] for folder, own in found.items() if len(own) > 1}
