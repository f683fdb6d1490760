"""What the arguments of public classes lead to: each probe takes some of them and returns what a short use leaves."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC

from sb3_crc import AuxiliaryLossCallback, FrameReplayBuffer, PixelDecoder, PixelEncoder, TrainingCheckpoint, make_dmc
from tests.fixtures.make import SMALL, Stripes, new_model

ENCODER = SMALL["policy_kwargs"]["features_extractor_kwargs"]
IMAGES = gym.spaces.Box(0, 255, (3, 24, 24), np.uint8)
ACTIONS = gym.spaces.Box(-1, 1, (2,), np.float32)


def trained(**arguments: Any) -> dict[str, Any]:
    """What a short training leaves: weights, temperature, counts, the replay buffer."""
    model = new_model(**arguments)
    model.learn(20)
    buffer, temperature = model.replay_buffer, model._temperature()
    np.random.seed(0)
    return {
        **{name: value.numpy() for name, value in model.policy.state_dict().items()},
        "temperature": temperature.detach().numpy(),
        "counts": [model._n_updates, model.num_timesteps, model.ep_info_buffer.maxlen],
        "actions": buffer.actions[: buffer.size()],
        "sampled": buffer.sample(16).rewards.numpy(),
        "buffer": type(buffer).__name__,
    }


def with_policy(**arguments: Any) -> dict[str, Any]:
    return trained(policy_kwargs={**SMALL["policy_kwargs"], **arguments})


def with_encoder(**arguments: Any) -> dict[str, Any]:
    return with_policy(features_extractor_kwargs={**ENCODER, **arguments})


def with_objective(name: str) -> Callable[..., dict[str, Any]]:
    return lambda **arguments: trained(objectives={name: {"weight": 1.0, **arguments}})


def decoded(**arguments: Any) -> dict[str, Any]:
    th.manual_seed(0)
    settings = {"latent_dim": 6, "observation_shape": (3, 24, 24), "channels": (2, 4), "strides": (2, 1), **arguments}
    decoder = PixelDecoder(**settings)
    return {"images": decoder(th.ones(1, settings["latent_dim"])).detach().numpy()}


def replayed(**arguments: Any) -> dict[str, Any]:
    """What a buffer of 12 transitions gives, one of which ends at a time limit."""
    settings = {"buffer_size": 20, "observation_space": IMAGES, "action_space": ACTIONS, "device": "cpu", **arguments}
    buffer = FrameReplayBuffer(**settings)
    envs = [Stripes() for _ in range(buffer.n_envs)]
    observations = np.stack([env.reset(seed=seed)[0] for seed, env in enumerate(envs)])
    for number in range(12):
        steps = [env.step(np.zeros(2)) for env in envs]
        following = np.stack([step[0] for step in steps])
        ends = np.array([step[3] for step in steps])
        infos = [{"TimeLimit.truncated": bool(end)} for end in ends]
        rewards = np.full(len(envs), float(number))
        buffer.add(observations, following, np.zeros((len(envs), 2)), rewards, ends, infos)
        observations = np.stack([env.reset()[0] if end else f for env, end, f in zip(envs, ends, following, strict=True)])
    np.random.seed(0)
    sample = buffer.sample(64)
    return {
        **{name: getattr(sample, name).numpy() for name in ("observations", "rewards", "dones")},
        "discounts": np.zeros(1) if sample.discounts is None else sample.discounts.numpy(),
        "frame": buffer.frame_channels,
        "rows": buffer.rewards.shape,
    }


def seen(**arguments: Any) -> dict[str, Any]:
    """The beginning of an episode of dm_control."""
    settings = {"task": "cartpole-swingup", "seed": 0, "image_size": 36, "render_quality": "fast", **arguments}
    env = make_dmc(**settings)
    observation, _ = env.reset()
    following, reward, *_ = env.step(np.full(env.action_space.shape, 0.5, np.float32))
    shown = env.render() if settings.get("render_mode", "rgb_array") else "nothing"
    env.close()
    return {"observations": np.stack([observation, following]), "reward": reward, "shown": shown}


def checkpointed(tmp_path: Path) -> Callable[..., dict[str, Any]]:
    def probe(**arguments: Any) -> dict[str, Any]:
        root = tmp_path / str(len(list(tmp_path.iterdir())))
        folder = root / arguments.pop("folder", "checkpoints")
        new_model().learn(24, callback=TrainingCheckpoint(folder, **{"every": 8, **arguments}))
        return {"there": sorted(str(path.relative_to(root)) for path in root.rglob("manifest.json"))}

    return probe


def with_auxiliary_loss(**arguments: Any) -> dict[str, Any]:
    """The encoder of a stock SAC after a short training."""
    settings = {key: value for key, value in SMALL.items() if key != "policy_kwargs"}
    kwargs = {"net_arch": [8], "features_extractor_class": PixelEncoder, "features_extractor_kwargs": ENCODER}
    model = SAC("CnnPolicy", Stripes(), policy_kwargs=kwargs, **settings)
    model.learn(20, callback=AuxiliaryLossCallback(**arguments))
    return {name: value.numpy() for name, value in model.critic.features_extractor.state_dict().items()}
