"""The ladder under learning from pixels: what must work before the next rung is worth a try.

State SAC shows that the environment can be learned at all, SAC from positions with an error how well an encoder has to see,
the probe what a latent knows before it has learned anything, teaching what the encoder can see, and overfitting that each loss
can be minimised. The rungs above are runs of ``train.py``.

N frames, B batch, Z latent, S state.
"""

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TransformReward
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor
from torch import nn

from sb3_crc.augmentations import random_shift
from sb3_crc.buffers import FrameReplayBuffer
from sb3_crc.crc_sac import CRCSAC
from sb3_crc.encoder import PixelEncoder
from sb3_crc.envs.dmc import make_dmc
from sb3_crc.experiments.seen_positions import SeenPositions
from sb3_crc.export import environment_of, load_policy
from sb3_crc.schedules import lr_schedule

#: SB3's SAC from states, with the replay ratio of the laptop class
STATE_SAC = {"learning_rate": 1e-3, "learning_starts": 500, "gradient_steps": 2, "tau": 0.01}
#: Settings of the losses that are overfitted: the default, and what else a loss can be asked for
OVERFITTED: tuple[tuple[str, dict[str, Any]], ...] = (
    ("contrastive", {}),
    ("consistency", {}),
    ("reconstruction", {}),
    ("reconstruction", {"target": "clean", "half_size": True, "standardize": True}),
)
#: Of the actions of an episode, in turn, where a policy leads to the frames that an encoder is taught
RANDOM_SHARES = (0.0, 0.15, 0.4, 0.8)
#: Ridge penalties that the probe tries, on standardised inputs
PENALTIES = (1e-3, 1e-2, 1e-1, 1.0, 10.0)


def state_sac(
    task: str,
    *,
    agent_steps: int = 12_500,
    evaluations: int = 5,
    episodes: int = 10,
    reward_scale: float = 1.0,
    seed: int = 0,
) -> dict[str, Any]:
    """
    Train stock SAC on the task's states, at the repeat that its pixels have.

    :param task: as for :func:`~sb3_crc.make_dmc`
    :param agent_steps: decisions to train for
    :param evaluations: how often it is evaluated, at equal distances
    :param episodes: fresh ones of each evaluation, with the policy's mean
    :param reward_scale: factor on the rewards that it learns from
    :param seed: of everything; evaluations use seed + 1000
    :return: curve as environment steps, means and standard deviations
    """
    env, fresh = (make_dmc(task, observation="state", seed=seed + offset) for offset in (0, 1000))
    scaled = TransformReward(env, lambda reward: reward_scale * float(reward))
    model = SAC("MlpPolicy", scaled, seed=seed, device="cpu", **STATE_SAC)  # type: ignore[arg-type]
    curve = learning_curve(model, Monitor(fresh), agent_steps, evaluations, episodes, env.action_repeat)
    settings = {**STATE_SAC, "reward_scale": reward_scale}
    return {"task": task, "seed": seed, "settings": settings, "episodes": episodes, "curve": curve}


def seen_state_sac(
    task: str,
    *,
    error: float,
    n_steps: int = 1,
    target_entropy: float = -1.0,
    falling_rates: bool = False,
    agent_steps: int = 7_500,
    evaluations: int = 6,
    episodes: int = 10,
    seed: int = 0,
) -> dict[str, Any]:
    """
    Train stock SAC on what an encoder of cartpole's pictures could deliver, with the laptop class's heads and rewards.

    :param task: of cartpole
    :param error: of what is read off a frame, in metres: :class:`~sb3_crc.experiments.seen_positions.SeenPositions`
    :param n_steps: of the return
    :param target_entropy: of the policy
    :param falling_rates: learning rates fall linearly to 0 over the run
    :param agent_steps: decisions to train for
    :param evaluations: how often it is evaluated, at equal distances
    :param episodes: fresh ones of each evaluation, with the policy's mean
    :param seed: of everything; evaluations use seed + 1000
    :return: curve as environment steps, means and standard deviations
    """
    states = [make_dmc(task, observation="state", seed=seed + offset) for offset in (0, 1000)]
    env, fresh = (SeenPositions(state, error=error, seed=seed) for state in states)
    settings = {**STATE_SAC, "ent_coef": "auto_0.1", "n_steps": n_steps, "target_entropy": target_entropy, "batch_size": 128}
    heads = {"net_arch": [256, 256], "activation_fn": normalized([256, 256])}
    scaled = TransformReward(env, lambda reward: 0.1 * float(reward))
    rate: Any = lr_schedule("lin_0.001") if falling_rates else settings["learning_rate"]
    model = SAC("MlpPolicy", scaled, seed=seed, device="cpu", policy_kwargs=heads, **{**settings, "learning_rate": rate})
    curve = learning_curve(model, Monitor(fresh), agent_steps, evaluations, episodes, states[0].action_repeat)
    settings |= {"reward_scale": 0.1, "error": error, "falling_rates": falling_rates}
    return {"task": task, "seed": seed, "settings": settings, "episodes": episodes, "curve": curve}


def normalized(net_arch: Any) -> Any:
    """
    :param net_arch: width of each layer of the heads
    :return: what SB3 can put behind each of them: LayerNorm, then ReLU
    :raises ValueError: if they have several widths
    """
    if not isinstance(net_arch, list) or len(set(net_arch)) != 1:
        raise ValueError(f"net_arch={net_arch!r} with layer_norm: layers of one width are needed, for instance [256, 256]")
    return lambda: nn.Sequential(nn.LayerNorm(net_arch[0]), nn.ReLU())


def learning_curve(
    model: SAC, fresh: gym.Env[Any, Any], agent_steps: int, evaluations: int, episodes: int, action_repeat: int
) -> list[dict[str, float]]:
    """
    Train, and stop to evaluate.

    :param model: that has not learned yet
    :param fresh: in which it is evaluated
    :param agent_steps: to train for
    :param evaluations: how often it is evaluated, at equal distances
    :param episodes: of each evaluation
    :param action_repeat: environment steps of an agent step
    :return: of each evaluation environment steps, mean, standard deviation and least return
    """
    with TemporaryDirectory() as folder:
        evaluation = EvalCallback(
            fresh, eval_freq=agent_steps // evaluations, n_eval_episodes=episodes, log_path=folder, verbose=0
        )
        model.learn(agent_steps, callback=evaluation)
        with np.load(Path(folder) / "evaluations.npz") as evaluated:
            measured = list(zip(evaluated["timesteps"], evaluated["results"], strict=True))
    return [
        {
            "environment_steps": int(agent_step) * action_repeat,
            "mean": float(np.mean(returns)),
            "std": float(np.std(returns, ddof=1)),
            "min": float(np.min(returns)),
        }
        for agent_step, returns in measured
    ]


def probe_random_encoder(
    task: str, encoder_kwargs: Mapping[str, Any], *, frames: int = 4_000, image_size: int = 64, seed: int = 0
) -> dict[str, Any]:
    """
    How much of the state can be read off the latent of an untrained encoder, and off its convolutions, by ridge regression.

    :param task: as for :func:`~sb3_crc.make_dmc`
    :param encoder_kwargs: arguments of :class:`~sb3_crc.PixelEncoder`
    :param frames: stacks that are collected with random actions; the last fifth, later episodes, is held out
    :param image_size: side of the frames in pixels, drawn in the fast quality
    :param seed: of environment, actions and weights
    :return: R^2 on held-out frames, by what is looked at and by the name of the task's observation (mean over its coordinates)
    """
    images, states = _frames(task, frames, image_size, seed)
    th.manual_seed(seed)
    encoder = PixelEncoder(spaces.Box(0, 255, images.shape[1:], np.uint8), **encoder_kwargs)
    with th.no_grad():
        convolved = th.cat([encoder.convolve(th.from_numpy(part)) for part in np.array_split(images, max(1, frames // 256))])
        latents = encoder.project(convolved)
    looks = {"latent": latents.numpy(), "convolutions": convolved.numpy()}
    scores = {look: {name: linear_probe(inputs, values) for name, values in states.items()} for look, inputs in looks.items()}
    return {"task": task, "seed": seed, "frames": frames, "encoder": dict(encoder_kwargs), "r2": scores}


def teach_encoder(
    task: str,
    encoder_kwargs: Mapping[str, Any],
    *,
    updates: int = 500,
    frames: int = 4_000,
    batch_size: int = 128,
    learning_rate: float = 1e-3,
    pad: int = 3,
    image_size: int = 64,
    policy: str | Path | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """
    How much of the state the encoder can learn to see, and how fast, when it is simply told: what no agent can exceed.

    :param task: as for :func:`~sb3_crc.make_dmc`
    :param encoder_kwargs: arguments of :class:`~sb3_crc.PixelEncoder`
    :param updates: of encoder and a linear head, on the mean squared error of the standardised state
    :param frames: stacks that are collected; the last fifth, later episodes, is held out
    :param batch_size: frames per update
    :param learning_rate: of Adam
    :param pad: of the random shift
    :param image_size: side of the frames in pixels, drawn in the fast quality
    :param policy: exported policy that acts, its actions mixed with random ones (:data:`RANDOM_SHARES`), so that the frames
        are of all that an agent comes to see, and ``image_size`` and quality the policy's; None: random actions alone
    :param seed: of environment, actions and weights
    :return: R^2 on held-out frames by the name of the task's observation (mean over its coordinates), and root mean squared
        error of each coordinate, in its unit
    :raises ValueError: if the policy is one for another task
    """
    images, states = _frames(task, frames, image_size, seed, policy)
    split = round(0.8 * frames)
    targets = np.concatenate([values.reshape(frames, -1) for values in states.values()], axis=1)
    mean, std = targets[:split].mean(axis=0), targets[:split].std(axis=0) + 1e-6
    pixels, standardised = th.from_numpy(images), th.as_tensor((targets - mean) / std, dtype=th.float32)
    th.manual_seed(seed)
    rng = np.random.default_rng(seed)
    encoder = PixelEncoder(spaces.Box(0, 255, images.shape[1:], np.uint8), **encoder_kwargs)
    head = nn.Linear(encoder.features_dim, targets.shape[1])
    optimizer = th.optim.Adam([*encoder.parameters(), *head.parameters()], lr=learning_rate)
    for _ in range(updates):
        rows = th.from_numpy(rng.integers(0, split, batch_size))
        loss = (head(encoder(random_shift(pixels[rows], pad))) - standardised[rows]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with th.no_grad():
        predicted = th.cat([head(encoder(part)) for part in th.split(pixels[split:], 256)]).numpy()
    held_out = standardised[split:].numpy()
    scores = 1 - ((predicted - held_out) ** 2).mean(axis=0) / held_out.var(axis=0).clip(1e-8)
    sizes = np.cumsum([values.reshape(frames, -1).shape[1] for values in states.values()])[:-1]
    r2 = {name: float(part.mean()) for name, part in zip(states, np.split(scores, sizes), strict=True)}
    errors = np.sqrt(((predicted - held_out) ** 2).mean(axis=0)) * std
    rmse = {name: part.tolist() for name, part in zip(states, np.split(errors, sizes), strict=True)}
    acting = {} if policy is None else {"policy": Path(policy).as_posix()}
    about = {"task": task, "seed": seed, "frames": frames, "updates": updates, **acting, "encoder": dict(encoder_kwargs)}
    return {**about, "r2": r2, "rmse": rmse}


def linear_probe(inputs: np.ndarray, targets: np.ndarray, *, held_out: float = 0.2) -> float:
    """
    :param inputs: ``(N, Z)``
    :param targets: ``(N, S)``
    :param held_out: share of the rows, from the end, on which it is scored; as many before them choose the penalty
    :return: R^2 of ridge regression, the mean over the targets' coordinates that vary
    """
    rows = round(len(inputs) * held_out)
    mean, std = inputs[:-rows].mean(axis=0), inputs[:-rows].std(axis=0)
    scaled = (inputs - mean) / np.maximum(std, 0.01 * std.max())  # what hardly ever varies must not explode when it does
    x = np.concatenate([scaled, np.ones((len(inputs), 1))], axis=1).astype(np.float64)
    targets = targets[:, targets[:-rows].var(axis=0) > 1e-8].astype(np.float64)
    penalty = max(PENALTIES, key=lambda penalty: _ridge_r2(x[:-rows], targets[:-rows], rows, penalty))
    return _ridge_r2(x, targets, rows, penalty)


def _ridge_r2(x: np.ndarray, targets: np.ndarray, rows: int, penalty: float) -> float:
    """Fit on all but the last ``rows``, score on those."""
    train = x[:-rows]
    gram = train.T @ train + penalty * len(train) * np.eye(x.shape[1])
    predicted = x[-rows:] @ np.linalg.solve(gram, train.T @ targets[:-rows])
    errors = ((predicted - targets[-rows:]) ** 2).mean(axis=0)
    return float(1 - (errors / targets[-rows:].var(axis=0).clip(1e-8)).mean())


def overfit_one_batch(
    task: str,
    objective: str,
    policy_kwargs: Mapping[str, Any],
    *,
    objective_kwargs: Mapping[str, Any] | None = None,
    updates: int = 1_000,
    batch_size: int = 128,
    learning_rate: float = 1e-3,
    image_size: int = 64,
    seed: int = 0,
) -> dict[str, Any]:
    """
    Train encoder and objective on one batch of real frames, which are not augmented; the critic stands still.

    :param task: as for :func:`~sb3_crc.make_dmc`
    :param objective: its name
    :param policy_kwargs: of :class:`~sb3_crc.CRCSAC`
    :param objective_kwargs: settings of the objective
    :param updates: how many
    :param batch_size: transitions in the batch
    :param learning_rate: of encoder and objective
    :param image_size: side of the frames in pixels, drawn in the fast quality
    :param seed: of everything
    :return: the loss at the first and at the last update; "pixel_variance" is what a decoder of one mean picture would leave
        of a reconstruction that is not standardised (of one that is: 1)
    """
    env = make_dmc(task, image_size=image_size, render_quality="fast", seed=seed)
    settings = {"qf_learning_rate": 0.0, "encoder_learning_rate": learning_rate, "learning_starts": 4 * batch_size}
    model = CRCSAC(
        "CnnPolicy",
        env,
        objectives={objective: {"weight": 1.0, **(objective_kwargs or {})}},
        augmentation="center_crop",
        image_size=image_size,
        batch_size=batch_size,
        buffer_size=4 * batch_size,
        policy_kwargs=dict(policy_kwargs),
        seed=seed,
        **settings,  # type: ignore[arg-type]
    )
    model.learn(4 * batch_size)
    assert isinstance(model.replay_buffer, FrameReplayBuffer)
    batch = model.replay_buffer.sample(batch_size)
    model.replay_buffer.sample_frames = lambda *_, **__: batch  # type: ignore[method-assign, assignment]
    losses = []
    for _ in range(updates):
        model.train(gradient_steps=1, batch_size=batch_size)
        losses.append(float(model.logger.name_to_value[f"representation/{objective}"]))
    pixels = batch.observations.float() / 255
    return {
        "objective": objective,
        "settings": dict(objective_kwargs or {}),
        "updates": updates,
        "first": losses[0],
        "last": losses[-1],
        "pixel_variance": float((pixels - pixels.mean(dim=0)).square().mean()),
    }


def _frames(
    task: str, frames: int, image_size: int, seed: int, policy: str | Path | None = None
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """:raises ValueError: if the policy is one for another task"""
    drawing: dict[str, Any] = {"image_size": image_size, "render_quality": "fast"}
    agent = None
    if policy is not None:
        own_task, drawing = environment_of(policy)
        if own_task != task:
            raise ValueError(f"{policy} is a policy for {own_task}, not for {task}")
        agent = load_policy(policy, device="cpu")
    env = make_dmc(task, **{**drawing, "observation": "dict"}, seed=seed)
    rng = np.random.default_rng(seed)
    observations = []
    observation, _ = env.reset()
    episode = 0
    for _ in range(frames):
        observations.append(observation)
        action = env.action_space.sample()
        if agent is not None and rng.random() >= RANDOM_SHARES[episode % len(RANDOM_SHARES)]:
            action, _ = agent.predict(observation["pixels"])
        observation, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            observation, _ = env.reset()
            episode += 1
    env.close()
    states = {key: np.stack([o[key] for o in observations]) for key in observations[0] if key != "pixels"}
    return np.stack([o["pixels"] for o in observations]), states
