"""Policies on the Hugging Face Hub: the files of a repository, and their way there.

The files are named as rl_zoo3's ``push_to_hub`` names them, so that its ``load_from_hub`` makes a run of them again, with
``policy.sb3crc`` beside them, which nobody has to trust. Settings are written anew as plain YAML, without paths and accounts.
"""

import importlib.util
import shutil
import zipfile
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_crc.analysis.films import film
from sb3_crc.analysis.rollouts import make_environment
from sb3_crc.crc_sac import CRCSAC
from sb3_crc.experiments.final import FIRST_SEED, load_final
from sb3_crc.experiments.model_card import CURVE, FILM, POLICY, SETTINGS, environment_arguments, model_card
from sb3_crc.experiments.runs import FINAL, PROVENANCE, Run
from sb3_crc.export import export_policy

#: Flags of train.py that say what was trained
ARGUMENTS = ("algo", "env", "seed", "n_timesteps", "eval_freq", "eval_episodes")


def write_repository(run: Run, folder: Path, repo_id: str, *, filmed: bool = True) -> list[Path]:
    """
    Write what :func:`upload` sends, which takes no network.

    :param run: one that has ended
    :param folder: new or empty
    :param repo_id: ``user/name``, for the page's commands
    :param filmed: film an episode of the final policy, the first one that ``sb3-crc evaluate`` measures
    :return: the files
    :raises FileNotFoundError: if training has not ended
    :raises ValueError: for a folder in which there is something, or a ``repo_id`` of another form
    """
    if not all(repo_id.partition("/")) or repo_id.count("/") != 1:
        raise ValueError(f"{repo_id!r} must have the form user/name")
    model = load_final(run)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder} must be a new or an empty folder")
    folder.mkdir(parents=True, exist_ok=True)
    files: dict[str, str | float] = {}
    if isinstance(model, CRCSAC):
        export_policy(model, folder / POLICY, task=run.task, env_kwargs=environment_arguments(run))
        files[POLICY] = ""
    if filmed and importlib.util.find_spec("av") is not None and run.is_of_suite:
        env = DummyVecEnv([lambda: make_environment(run, FIRST_SEED)])
        try:
            files[FILM] = film(model, env, folder / FILM)
        finally:
            env.close()
    archive = f"{run.preset}-{run.model.name}"
    shutil.copy(run.model, folder / archive)
    files[archive] = "the final model of Stable-Baselines3, with optimizers"
    arguments = {name: run.arguments[name] for name in ARGUMENTS if name in run.arguments} | {"env_kwargs": run.env_kwargs}
    for name, content in {SETTINGS: run.settings, "args.yml": arguments, "env_kwargs.yml": run.env_kwargs}.items():
        _write_yaml(content, folder / name)
        files[name] = ""
    with zipfile.ZipFile(folder / "train_eval_metrics.zip", "w", zipfile.ZIP_DEFLATED) as metrics:
        for path in [*run.folder.glob("evaluations.npz"), *sorted(run.folder.glob("*.csv"))]:
            metrics.write(path, path.name)
    files["train_eval_metrics.zip"] = ""
    for name in (CURVE, FINAL, PROVENANCE):
        if (run.folder / name).exists():
            shutil.copy(run.folder / name, folder / name)
            files[name] = ""
    (folder / "README.md").write_text(model_card(run, repo_id, files, agent_steps=model.num_timesteps), encoding="utf-8")
    return sorted(folder.iterdir())


def upload(folder: Path, repo_id: str, *, private: bool = False, message: str = "A policy of sb3_crc") -> str:
    """
    :param folder: of :func:`write_repository`
    :param repo_id: ``user/name``; it is made if it is not there
    :param private: if it is made, for its owner alone
    :param message: of the commit
    :return: the repository's address
    :raises ValueError: without huggingface_hub or without an access token, naming what is missing
    :raises ConnectionError: if the Hub cannot be reached or refuses, saying so
    """
    if importlib.util.find_spec("huggingface_hub") is None:
        raise ValueError("the Hub needs the extra 'zoo': pip install 'sb3-crc[zoo]'")
    import huggingface_hub

    if huggingface_hub.get_token() is None:
        raise ValueError("there is no access token of Hugging Face: log in by `hf auth login`, or set HF_TOKEN")
    api = huggingface_hub.HfApi()
    try:
        address = api.create_repo(repo_id, private=private, exist_ok=True)
        api.upload_folder(repo_id=repo_id, folder_path=folder, commit_message=message)
    except (OSError, huggingface_hub.errors.HTTPError) as error:  # type: ignore[attr-defined]  # of whichever client it uses
        reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise ConnectionError(f"{repo_id} could not be uploaded: {reason}") from error
    return str(address)


def _write_yaml(content: dict[str, Any], path: Path) -> None:
    path.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120), encoding="utf-8")
