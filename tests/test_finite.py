"""Losses, gradients, rewards, observations and actions that are not finite stop a training, or are skipped."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_crc import CRCSAC
from tests.buffers.test_multi_input import Both
from tests.compared_models import parameters
from tests.conftest import POLICY_KWARGS, NoiseEnv, make_model

NAN, INFINITY = float("nan"), float("inf")


@pytest.mark.parametrize("gradient_steps", [1, 4])
@pytest.mark.parametrize(
    ("place", "term"), [("rewards", "critic_loss"), ("objective", "reconstruction"), ("actor", "actor_loss")]
)
def test_a_loss_that_is_not_finite_stops_the_training(place: str, term: str, gradient_steps: int, tmp_path: Path) -> None:
    """The error names the update, the agent step and the term; the batch of that very update lies in a file."""
    from stable_baselines3.common.logger import configure

    model = make_model()
    model.set_logger(configure(str(tmp_path), []))
    model.train(gradient_steps=3, batch_size=16)
    if place == "rewards":
        model.replay_buffer.rewards[:] = INFINITY
    elif place == "objective":
        objective = model.policy.objectives["reconstruction"]
        objective.forward = lambda views: views.anchor.latent.sum() * NAN
    else:
        update = model._update_actor_and_temperature
        model._update_actor_and_temperature = lambda views: {**update(views), "train/actor_loss": th.tensor(NAN)}

    sampled: list[Any] = []
    sample = model.replay_buffer.sample_frames
    model.replay_buffer.sample_frames = lambda *args, **kwargs: sampled.append(sample(*args, **kwargs)) or sampled[-1]
    with pytest.raises(FloatingPointError, match=rf"{term}.*(nan|inf).*update 4.*agent step 40.*saved in ") as error:
        model.train(gradient_steps=gradient_steps, batch_size=16)
    folder = Path(str(error.value).rpartition("saved in ")[2])
    assert folder.is_dir() and tmp_path in folder.parents
    saved = th.load(folder / "batch.pt", weights_only=True)
    for name in ("observations", "actions", "next_observations", "dones", "rewards"):
        assert th.equal(saved[name], getattr(sampled[0].whole(), name)), name
    stored = model.replay_buffer.actions[saved["rows"].numpy(), saved["environments"].numpy()]
    assert np.array_equal(stored, saved["actions"].numpy())


class Broken(NoiseEnv):
    """Once it is told to be, its sixth step is broken."""

    broken = False

    def step(self, action: np.ndarray) -> Any:
        observation, reward, *rest = super().step(action)
        return observation, NAN if self.broken and self.steps == 6 else reward, *rest


def test_a_reward_of_nan_stops_before_it_is_stored(tmp_path: Path) -> None:
    env = Broken()
    model = make_model(env, tensorboard_log=str(tmp_path))
    env.broken = True
    stored = model.replay_buffer.size()
    message = r"the reward of environment 0 is nan at agent step 46, with 45 rows stored: the environment returned it"
    with pytest.raises(FloatingPointError, match=message) as error:
        model.learn(20, reset_num_timesteps=False)
    assert model.replay_buffer.size() == stored + 5
    saved = np.load(Path(str(error.value).rpartition("saved in ")[2]) / "transition.npz")
    assert saved["observation"].shape == saved["next_observation"].shape == (1, 9, 40, 40)
    assert np.isnan(saved["reward"]).all() and np.isfinite(saved["action"]).all()
    assert all(bool(th.isfinite(parameter).all()) for parameter in model.policy.parameters())


class Unstable(Both):
    """Once it is told to be, an episode ends with numbers that are not finite."""

    broken = False

    def step(self, action: np.ndarray) -> Any:
        observation, reward, _, end, info = super().step(action)
        if self.broken and end:
            observation["state"] = np.full((2, 2), INFINITY, np.float32)
        return observation, reward, end, False, info


@pytest.mark.parametrize("on_nonfinite", ["stop", "skip"])
def test_the_last_observation_of_an_episode_is_looked_at_too(on_nonfinite: str, tmp_path: Path) -> None:
    """By then the environment has been reset; what is stored is what it showed before."""
    env = Unstable(NoiseEnv(channels=3))
    model = CRCSAC(
        "MultiInputPolicy",
        DummyVecEnv([lambda: Both(NoiseEnv(channels=3, length=100)), lambda: env]),
        **{"buffer_size": 200, "batch_size": 8, "learning_starts": 8, "policy_kwargs": POLICY_KWARGS, "seed": 0},
        on_nonfinite=on_nonfinite,
        tensorboard_log=str(tmp_path),
    )
    model.learn(40)
    env.broken = True
    if on_nonfinite == "stop":
        message = r"the terminal observation\['state'\] of environment 1 is inf at agent step 60, with 29 rows stored: the env"
        with pytest.raises(FloatingPointError, match=message) as error:
            model.learn(40, reset_num_timesteps=False)
        saved = np.load(Path(str(error.value).rpartition("saved in ")[2]) / "transition.npz")
        assert np.isinf(saved["terminal_observation/state"]).all() and np.isfinite(saved["next_observation/state"]).all()
    else:
        model.learn(40, reset_num_timesteps=False)
        assert model.logger.name_to_value["rollout/skipped_transitions"] == 4  # two ends, both environments
        assert model.logger.name_to_value["train/skipped_updates"] == 0
    stored = model.replay_buffer.size()
    assert np.isfinite(model.replay_buffer.next_observations["state"][:stored]).all()


def test_weights_of_nan_stop_before_they_act() -> None:
    model = make_model()
    with th.no_grad():
        model.actor.mu.bias.fill_(NAN)
    with pytest.raises(FloatingPointError, match="the action of environment 0 is nan.*weights or what it was shown"):
        model.learn(2, reset_num_timesteps=False)


@pytest.mark.parametrize("place", ["rewards", "objective", "gradient"])
def test_no_step_is_made_on_what_is_not_finite(place: str) -> None:
    """And what is finite of the same update is stepped on."""
    model = make_model(policy_delay=2)
    model.train(gradient_steps=2, batch_size=16)
    objective = model.policy.objectives["reconstruction"]
    forward = objective.forward
    before = parameters(model)
    states = [float(state["step"]) for state in model.critic.optimizer.state.values()]
    if place == "rewards":
        model.replay_buffer.rewards[:] = INFINITY
    elif place == "objective":
        objective.forward = lambda views: forward(views) * NAN
    else:  # the loss is finite, its gradient is not
        objective.forward = lambda views: forward(views) + (views.query.latent[0, 0] * 0).abs().sqrt()
    name = {"rewards": "critic_loss", "objective": "reconstruction", "gradient": "encoder_gradient_norm"}[place]
    with pytest.raises(FloatingPointError, match=f"{name} is (nan|inf) at update 3"):
        model.train(gradient_steps=1, batch_size=16)
    after = parameters(model)
    assert all(bool(th.isfinite(parameter).all()) for parameter in after)
    if place == "rewards":
        assert [float(state["step"]) for state in model.critic.optimizer.state.values()] == states
    heads = {id(parameter) for parameter in model.critic.head_parameters()}
    moved = {id(p) for p, old, new in zip(model.policy.parameters(), before, after, strict=True) if not th.equal(old, new)}
    assert bool(moved & heads) == (place != "rewards")
    assert model.policy.gradient_norms.isfinite().all()


@pytest.mark.parametrize("gradient_steps", [1, 4])
def test_skipped_updates_are_counted_and_training_goes_on(gradient_steps: int) -> None:
    model = make_model(on_nonfinite="skip", objectives={})
    finite = model.replay_buffer.rewards.copy()
    model.replay_buffer.rewards[:] = NAN
    model.train(gradient_steps=gradient_steps, batch_size=16)
    logged = model.logger.name_to_value
    assert logged["train/skipped_updates"] == gradient_steps and "train/critic_loss" not in logged
    model.replay_buffer.rewards[:] = finite
    before = parameters(model)
    model.train(gradient_steps=2, batch_size=16)
    assert logged["train/skipped_updates"] == gradient_steps and np.isfinite(logged["train/critic_loss"])
    assert not all(map(th.equal, before, parameters(model)))


def test_skipped_transitions_are_not_stored(tmp_path: Path) -> None:
    env = Broken()
    model = make_model(env, on_nonfinite="skip", n_steps=3)
    env.broken = True
    stored = model.replay_buffer.size()
    model.learn(20, reset_num_timesteps=False)
    assert model.replay_buffer.size() == stored + 18  # two episodes of ten steps, each with a broken one
    assert model.logger.name_to_value["rollout/skipped_transitions"] == 2
    assert np.isfinite(model.replay_buffer.rewards[: model.replay_buffer.size()]).all()
    assert model.replay_buffer.interrupted[stored + 4]  # no return reaches over the gap
    model.save(tmp_path / "model")
    assert CRCSAC.load(tmp_path / "model")._skipped_transitions == 2
