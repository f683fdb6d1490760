"""Saved policies of runs: which of them an analysis looks at, and how they are loaded."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from stable_baselines3 import SAC
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_crc.crc_sac import CRCSAC
from sb3_crc.experiments.runs import Run, find_runs
from sb3_crc.image_spaces import image_shape, image_space
from sb3_crc.presets import PRESETS
from sb3_crc.settings import check_name
from sb3_crc.stock import STOCK

#: What SB3's CheckpointCallback, train.py's ``--save-freq``, writes on the way; the number is of agent steps
CHECKPOINT = re.compile(r"rl_model_(\d+)_steps\.zip")


@dataclass(frozen=True)
class SavedPolicy:
    """
    :param run: that trained it
    :param file: the zip in the run's folder
    """

    run: Run
    file: Path

    @property
    def name(self) -> str:
        """For tables and legends: method, seed and, if it is not the final policy, which one of the run's."""
        name = f"{self.run.method}, seed {self.run.seed}"
        if self.file.name == self.run.model.name:
            return name
        checkpoint = CHECKPOINT.fullmatch(self.file.name)
        if checkpoint is None:
            return f"{name}, {self.file.stem}"
        return f"{name}, {int(checkpoint[1]) * self.run.action_repeat} steps"

    @property
    def environment_steps(self) -> int:
        """Of its training until it was saved, as the file says."""
        data, _, _ = load_from_zip_file(self.file, device="cpu")
        assert data is not None
        return int(data["num_timesteps"]) * self.run.action_repeat

    def load(self) -> SAC:
        """
        :return: the model, on the CPU, in evaluation mode
        :raises ValueError: if its method is unknown, if it sees no pictures, or if the file is no saved model
        """
        check_name(f"preset of {self.run.folder}:", self.run.preset, [*PRESETS, *STOCK])
        algorithm = CRCSAC if self.run.preset in PRESETS else SAC
        model = algorithm.load(self.file, device="cpu")
        try:
            image_shape(image_space(model.observation_space))
        except ValueError as error:
            raise ValueError(f"{self.file} does not see pictures, only such policies are analysed: {error}") from None
        model.policy.set_training_mode(False)
        return model


def find_policies(paths: Iterable[Path], *, checkpoints: bool = False) -> list[SavedPolicy]:
    """
    :param paths: of models, which lie in the folder of their run, of runs, and of folders that contain runs
    :param checkpoints: of each run, take also the models that were saved on the way
    :return: one policy for each model, each once, in the order of the paths and of training
    :raises FileNotFoundError: if there is no such path, no run, or a run without a model
    :raises ValueError: if a file is no zip, or checkpoints are asked for and there are none
    """
    found: dict[Path, SavedPolicy] = {}
    for path in paths:
        for policy in _policies(path, checkpoints):
            found.setdefault(policy.file.resolve(), policy)
    return list(found.values())


def unique_names(policies: Sequence[SavedPolicy]) -> list[str]:
    """:return: the names of the policies, with the path of the run where two would be equal"""
    names = [policy.name for policy in policies]
    return [
        f"{name} ({policy.run.folder})" if names.count(name) > 1 else name
        for name, policy in zip(names, policies, strict=True)
    ]


def _policies(path: Path, checkpoints: bool) -> list[SavedPolicy]:
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist")
    if path.is_file():
        if path.suffix != ".zip":
            raise ValueError(f"{path} is no saved model: those are .zip files")
        return [SavedPolicy(Run(path.parent), path)]
    runs = list(find_runs([path]))
    if not runs:
        raise FileNotFoundError(f"no run of train.py in {path}")
    return [policy for run in runs for policy in _policies_of(run, checkpoints)]


def _policies_of(run: Run, checkpoints: bool) -> list[SavedPolicy]:
    steps = {path: CHECKPOINT.fullmatch(path.name) for path in run.folder.glob("rl_model_*_steps.zip")}
    on_the_way = sorted((path for path, match in steps.items() if match), key=lambda path: int(steps[path][1]))  # type: ignore[index]
    if checkpoints and not on_the_way:
        raise ValueError(f"no rl_model_*_steps.zip in {run.folder}: train.py saves them with --save-freq")
    files = [*(on_the_way if checkpoints else ()), *([run.model] if run.model.exists() else ())]
    if not files:
        raise FileNotFoundError(f"{run.folder} has no final policy: its training has not ended ({run.model.name} is missing)")
    return [SavedPolicy(run, file) for file in files]
