"""Rollouts of saved policies, with latents and physics: collected once, then read from the run's folder.

n decisions, C channels (of the whole frame stack), H, W height and width, Z latent, A action, P physics.
"""

import hashlib
import importlib
import json
import time
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC

from sb3_crc.analysis.networks import BATCH, encode
from sb3_crc.analysis.physics import physics_state
from sb3_crc.analysis.policies import SavedPolicy
from sb3_crc.atomic import atomic_write
from sb3_crc.checkpoints.store import checksum
from sb3_crc.experiments.runs import Run
from sb3_crc.image_spaces import image_key

#: Of the environment; no training, no evaluation and no final score begins with it
SEED = 30_000
#: Subfolder of a run
FOLDER = "analysis"
#: Of the files; another one is collected anew
FORMAT = 1
LONGEST_EPISODE = 10_000
#: Settings by which rl_zoo3 puts wrappers around an environment
WRAPPERS = ("env_wrapper", "vec_env_wrapper", "frame_stack", "normalize")


@dataclass(frozen=True)
class Rollout:
    """
    :param latents: float32 ``(n, Z)``, what the Q heads read
    :param actions: float32 ``(n, A)``, the policy's mean in [-1, 1]
    :param observations: uint8 ``(n, C, H, W)``, the images
    :param physics: float64 ``(n, P)``; P = 0 without a dm_control simulator
    :param physics_names: ``(P,)``
    :param values: ``(n,)``, the lowest of the critics' Q(s, a), in units of return (divided by ``reward_scale``); it holds
        the entropy bonus of the soft return
    :param rewards: ``(n,)``, of the decision
    :param returns: ``(n,)``, from here to the end of the episode, undiscounted
    :param discounted_returns: ``(n,)``, with the discount of the training; a time limit cuts both kinds of return
    :param episodes: ``(n,)``, number of the episode; episode k starts equally for all policies of a task
    :param steps: ``(n,)``, decisions since the episode began
    :param about: JSON scalars: environment_steps of the training, render_fps, frame_channels, gamma
    """

    latents: np.ndarray
    actions: np.ndarray
    observations: np.ndarray
    physics: np.ndarray
    physics_names: np.ndarray
    values: np.ndarray
    rewards: np.ndarray
    returns: np.ndarray
    discounted_returns: np.ndarray
    episodes: np.ndarray
    steps: np.ndarray
    about: dict[str, Any]

    def __len__(self) -> int:
        return len(self.latents)

    @property
    def newest_frames(self) -> np.ndarray:
        """uint8 ``(n, 3 or 1, H, W)``"""
        return self.observations[:, -int(self.about["frame_channels"]) :]


def rollout_of(
    policy: SavedPolicy,
    *,
    decisions: int = 1_000,
    episodes: int = 4,
    seed: int = SEED,
    report: Callable[[str], None] = lambda line: None,
) -> Rollout:
    """
    Read the policy's rollout from ``analysis/`` in its run's folder, or collect it and write it there.

    A file is used again only if model (by its sha256) and settings are those that it was made with.

    :param policy: which
    :param decisions: at least so many
    :param episodes: at least so many; all are whole
    :param seed: of the environment, from which all its episodes follow
    :param report: is told where the rollout comes from and how long that took
    :return: the rollout
    :raises ValueError: if the policy cannot act in the environment of its run, or that is wrapped by rl_zoo3
    """
    settings = {
        "format": FORMAT,
        "env": policy.run.arguments["env"],
        "env_kwargs": policy.run.env_kwargs,
        "decisions": decisions,
        "episodes": episodes,
        "seed": seed,
    }
    written = json.dumps(settings, sort_keys=True, default=str)
    identity = json.dumps({"settings": written, "model": checksum(policy.file)})
    key = hashlib.sha256(written.encode()).hexdigest()[:8]  # a model that has changed replaces what its forerunner left
    path = policy.run.folder / FOLDER / f"{policy.file.stem}-{key}.npz"
    rollout = _read(path, identity)
    if rollout is not None:
        report(f"{policy.name}: {len(rollout)} decisions from {path}")
        return rollout
    started = time.perf_counter()
    model = policy.load()
    loaded = time.perf_counter()
    env = make_environment(policy.run, seed)
    try:
        rollout = roll(model, env, decisions=decisions, episodes=episodes, seed=seed)
    finally:
        env.close()
    rollout.about["environment_steps"] = model.num_timesteps * policy.run.action_repeat
    report(
        f"{policy.name}: {len(rollout)} decisions, loaded in {loaded - started:.1f} s, rolled in "
        f"{time.perf_counter() - loaded:.1f} s"
    )
    try:
        path.parent.mkdir(exist_ok=True)
        _write(rollout, path, identity)
    except OSError as error:
        report(f"{policy.name}: the rollout is not kept: {error}")
    return rollout


def make_environment(run: Run, seed: int, **changes: Any) -> gym.Env[Any, Any]:
    """
    :param run: whose environment
    :param seed: of it
    :param changes: arguments that it was not trained with
    :return: the environment that the run was trained in
    :raises ValueError: if rl_zoo3 has put wrappers around that: without them it would be another one
    """
    if wrapped := [name for name in WRAPPERS if run.settings.get(name)]:
        raise ValueError(f"{run.folder} was trained with {wrapped[0]}={run.settings[wrapped[0]]!r}, which is not applied here")
    for package in run.arguments.get("gym_packages") or []:
        importlib.import_module(package)
    seeded = {"seed": seed} if run.is_of_suite else {}  # LQR draws its springs
    return gym.make(run.arguments["env"], **{**run.env_kwargs, **seeded, **changes})


def roll(model: SAC, env: gym.Env[Any, Any], *, decisions: int, episodes: int, seed: int) -> Rollout:
    """
    Act by the policy's mean, for whole episodes.

    :param model: any SAC that sees pictures
    :param env: to act in
    :param decisions: at least so many
    :param episodes: at least so many
    :param seed: of the first reset, from which all follow
    :return: the rollout
    :raises ValueError: if the observations are not what the model was trained on, or an episode does not end
    """
    observations: list[Any] = []
    actions, rewards, states, places = [], list[float](), [], []
    episode = 0
    while len(rewards) < decisions or episode < episodes:
        observation, _ = env.reset(seed=seed if episode == 0 else None)
        for step in range(LONGEST_EPISODE):
            states.append(physics_state(env))
            action, _ = model.predict(observation, deterministic=True)
            observations.append(observation)
            actions.append(model.policy.scale_action(action))
            observation, reward, terminated, truncated, _ = env.step(action)
            rewards.append(float(reward))
            places.append((episode, step))
            if terminated or truncated:
                break
        else:
            raise ValueError(f"an episode does not end within {LONGEST_EPISODE} decisions: the environment needs a time limit")
        episode += 1
    numbers, steps = np.transpose(places)
    images, values = _images_and_values(model, observations, np.array(actions, np.float32))
    return Rollout(
        latents=encode(model, images),
        actions=np.array(actions, np.float32),
        observations=images,
        physics=np.array([list(state.values()) for state in states], np.float64),
        physics_names=np.array(list(states[0]), str),
        values=values / getattr(model, "reward_scale", 1.0),
        rewards=np.array(rewards),
        returns=returns_to_go(np.array(rewards), numbers),
        discounted_returns=returns_to_go(np.array(rewards), numbers, model.gamma),
        episodes=numbers,
        steps=steps,
        about={
            "gamma": model.gamma,
            "render_fps": float(env.metadata.get("render_fps") or 30),
            "frame_channels": _frame_channels(env, images),
        },
    )


def returns_to_go(rewards: np.ndarray, episodes: np.ndarray, gamma: float = 1.0) -> np.ndarray:
    """
    :param rewards: ``(n,)``, in the order of time
    :param episodes: ``(n,)``
    :param gamma: discount per decision
    :return: ``(n,)``, this decision's reward and all later ones of its episode
    """
    returns = np.array(rewards, np.float64)
    for row in range(len(returns) - 2, -1, -1):
        if episodes[row] == episodes[row + 1]:
            returns[row] += gamma * returns[row + 1]
    return returns


def _images_and_values(model: SAC, observations: list[Any], actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    images, values = [], []
    for start in range(0, len(observations), BATCH):
        part: Any = observations[start : start + BATCH]
        batch = {key: np.stack([one[key] for one in part]) for key in part[0]} if isinstance(part[0], dict) else np.stack(part)
        tensors, _ = model.policy.obs_to_tensor(batch)  # channels first, whatever the environment has
        with th.no_grad():
            q_values = th.cat(model.critic(tensors, th.from_numpy(actions[start : start + BATCH])), dim=1)
        values.append(q_values.min(dim=1).values.numpy())
        of_images: Any = tensors[image_key(model.observation_space)] if isinstance(tensors, dict) else tensors
        images.append(of_images.numpy())
    return np.concatenate(images), np.concatenate(values).astype(np.float64)


def _frame_channels(env: gym.Env[Any, Any], images: np.ndarray) -> int:
    try:
        return int(env.get_wrapper_attr("frame_channels"))
    except AttributeError:
        return 3 if images.shape[1] % 3 == 0 else 1


def _write(rollout: Rollout, path: Path, identity: str) -> None:
    arrays = {field.name: getattr(rollout, field.name) for field in fields(rollout) if field.name != "about"}
    with atomic_write(path) as unfinished, unfinished.open("wb") as file:
        np.savez_compressed(file, identity=identity, about=json.dumps(rollout.about), **arrays)


def _read(path: Path, identity: str) -> Rollout | None:
    """None if there is none, if it was made by another model or in another way, or is damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            if str(file["identity"]) != identity:
                return None
            arrays = {field.name: file[field.name] for field in fields(Rollout) if field.name != "about"}
            return Rollout(**arrays, about=json.loads(str(file["about"])))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return None
