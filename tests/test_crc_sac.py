"""The algorithm as a whole: defaults, values, determinism, save and load, clear errors."""

import inspect
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_crc import CRCSAC, PRESETS, CRCPolicy
from sb3_crc.schedules import lr_schedule
from tests.conftest import POLICY_KWARGS, ClockEnv, NoiseEnv, make_model


def test_the_crc_preset_is_the_constructors_defaults() -> None:
    sac = inspect.signature(super(CRCSAC, CRCSAC).__init__).parameters
    defaults = {**sac, **inspect.signature(CRCSAC.__init__).parameters}
    for name, value in PRESETS["crc"].items():
        assert defaults[name].default == value, name


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_trains(preset: str) -> None:
    large = ("batch_size", "buffer_size", "learning_starts", "initial_updates")
    own = {key: value for key, value in PRESETS[preset].items() if key not in large}
    model = make_model(**own)
    before = [p.detach().clone() for p in model.policy.critic.features_extractor.parameters()]
    model.train(gradient_steps=2, batch_size=16)
    assert not all(map(th.equal, before, model.policy.critic.features_extractor.parameters()))
    for name in PRESETS[preset].get("objectives", {}):
        for key in (name, f"{name}_gradient_norm", f"{name}_td_cosine"):
            assert np.isfinite(model.logger.name_to_value[f"representation/{key}"])
    assert ("representation/loss" in model.logger.name_to_value) == bool(PRESETS[preset]["objectives"])


@pytest.mark.parametrize(("terminates", "expected"), [(False, 10.0), (True, 1 + 0.9 + 0.81 + 0.729 + 0.6561)])
def test_a_time_limit_bootstraps_and_a_termination_does_not(terminates: bool, expected: float) -> None:
    model = CRCSAC(
        "CnnPolicy",
        ClockEnv(terminates),
        objectives={},
        augmentation="center_crop",
        image_size=36,
        gamma=0.9,
        ent_coef=0.0,
        learning_rate=1e-3,
        batch_size=32,
        buffer_size=300,
        learning_starts=200,
        tau=0.1,
        encoder_tau=0.1,
        target_update_interval=1,
        gradient_steps=700,
        policy_kwargs=POLICY_KWARGS,
        seed=0,
    )
    model.learn(201)
    first = th.as_tensor(ClockEnv(terminates).reset()[0][None])
    with th.no_grad():
        q_values = th.cat(model.critic(first, th.zeros(1, 1)), dim=1)
    assert q_values.mean().item() == pytest.approx(expected, rel=0.05)


def train_twice(model: CRCSAC) -> list[th.Tensor]:
    model.learn(50, reset_num_timesteps=False)
    return [p.detach().clone() for p in model.policy.parameters()]


def test_the_same_seed_gives_the_same_weights() -> None:
    first, second = train_twice(make_model(seed=7)), train_twice(make_model(seed=7))
    assert all(map(th.equal, first, second))
    assert not all(map(th.equal, first, train_twice(make_model(seed=8))))


def test_arguments_are_stored_raw_and_load_takes_them_again(tmp_path: Path) -> None:
    settings: dict[str, Any] = {
        "learning_rate": "lin_0.001",
        "objectives": {"contrastive": 0.7, "consistency": {"weight": 0.3, "reduction": "mean"}},
        "policy_kwargs": POLICY_KWARGS,
        "image_size": 36,
    }
    model = make_model(**settings)
    model.save(tmp_path / "model.zip")
    loaded = CRCSAC.load(tmp_path / "model.zip", env=NoiseEnv(), **settings)
    for m in (model, loaded):
        assert {key: getattr(m, key) for key in settings} == settings


def test_a_policy_saves_and_loads_alone(tmp_path: Path) -> None:
    policy = make_model().policy
    policy.save(tmp_path / "policy.pth")
    loaded = CRCPolicy.load(tmp_path / "policy.pth")
    observation = NoiseEnv().reset(seed=3)[0]
    assert np.array_equal(*(p.predict(observation, deterministic=True)[0] for p in (policy, loaded)))


def test_learning_rates_are_separate_and_follow_their_schedules() -> None:
    model = make_model(
        learning_rate="lin_0.01", qf_learning_rate=0.002, encoder_learning_rate="lin_0.03", ent_coef_learning_rate=None
    )
    model._current_progress_remaining = 0.5
    model.train(gradient_steps=1, batch_size=16)
    optimizers = model.actor.optimizer, model.critic.optimizer, model.policy.encoder_optimizer, model.ent_coef_optimizer
    assert [o.param_groups[0]["lr"] for o in optimizers] == pytest.approx([0.005, 0.002, 0.015, 0.005])
    assert model.ent_coef_optimizer.param_groups[0]["betas"] == (0.5, 0.999)
    early = lr_schedule("lin_0.02_0.5")
    assert [early(remaining) for remaining in (1, 0.75, 0.5, 0.4, 0)] == pytest.approx([0.02, 0.01, 0, 0, 0])
    for bad in ("linear_1", "lin", "0.1", "lin_1_0", "lin_1_1.5", "lin_1_x", "lin_1_1_1", "lin_1_nan"):
        with pytest.raises(ValueError, match=f"{bad!r}.*lin_x"):
            lr_schedule(bad)


def test_delays_count_updates_across_calls() -> None:
    """SB3's own SAC counts within one call, so that with gradient_steps=1 an interval does nothing (SB3 issue 2158)."""
    model = make_model(policy_delay=3, target_update_interval=2)
    calls: list[tuple[str, int]] = []
    actor_update, target_update = model._update_actor_and_temperature, model._update_targets
    model._update_actor_and_temperature = lambda views: calls.append(("actor", model._n_updates)) or actor_update(views)
    model._update_targets = lambda: calls.append(("targets", model._n_updates)) or target_update()
    for _ in range(6):
        model.train(gradient_steps=1, batch_size=16)
    assert calls == [("targets", 2), ("actor", 3), ("targets", 4), ("actor", 6), ("targets", 6)]


def test_initial_updates_are_made_once() -> None:
    model = make_model(initial_updates=5)
    model.train(gradient_steps=1, batch_size=16)
    assert model._n_updates == 6
    model.train(gradient_steps=1, batch_size=16)
    assert model._n_updates == 7


def test_reward_scale_scales_what_the_critic_sees() -> None:
    views = make_model(reward_scale=10.0)
    batch = views.replay_buffer.sample(8)
    views.replay_buffer.sample_frames = lambda batch_size, env=None: batch
    assert th.equal(views._sample_views(8).rewards, batch.rewards * 10)


def test_max_grad_norm_clips_each_step() -> None:
    model = make_model(max_grad_norm=1e-3)
    norms: list[float] = []
    for optimizer in (model.actor.optimizer, model.critic.optimizer, model.policy.encoder_optimizer):
        optimizer.register_step_pre_hook(
            lambda o, *_: norms.append(th.cat([p.grad.flatten() for g in o.param_groups for p in g["params"]]).norm().item())
        )
    model.train(gradient_steps=2, batch_size=16)
    assert len(norms) == 5 and max(norms) <= 1e-3 * 1.001
    assert min(norms) == pytest.approx(1e-3, rel=1e-2)


def test_n_step_returns_come_from_the_buffer() -> None:
    model = make_model(n_steps=3, gamma=0.9)
    views = model._sample_views(64)
    exponents = (views.discounts.log() / np.log(0.9)).flatten()
    assert th.allclose(exponents, exponents.round(), atol=1e-4)
    assert set(exponents.round().tolist()) == {1.0, 2.0, 3.0}  # shorter at the ends of episodes
    model.train(gradient_steps=2, batch_size=16)


def test_the_environments_steps_are_logged_beside_the_agents() -> None:
    class Repeating(NoiseEnv):
        def step(self, action: np.ndarray) -> Any:
            *result, info = super().step(action)
            self.total = getattr(self, "total", 0) + 4
            return *result, {**info, "env_steps": self.total}

    model = make_model(Repeating())
    model.dump_logs()
    assert model._env_steps == 4 * model.num_timesteps == 160


def test_ent_coef_may_be_fixed(tmp_path: Path) -> None:
    model = make_model(ent_coef=0.3)
    model.train(gradient_steps=2, batch_size=16)
    assert model.logger.name_to_value["train/ent_coef"] == pytest.approx(0.3)
    model.save(tmp_path / "model.zip")
    assert CRCSAC.load(tmp_path / "model.zip")._temperature().item() == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"policy": "MlpPolicy"}, "MlpPolicy.*CnnPolicy.*stable_baselines3.SAC"),
        ({"augmentation": "random_crops"}, "random_crops.*did you mean 'random_crop'"),
        ({"image_size": 41}, "41.*40x40"),
        ({"image_size": 4}, "4x4.*needs 7x7"),
        ({"objectives": {"contrast": 1.0}}, "contrast.*did you mean 'contrastive'"),
        ({"objectives": {"contrastive": -1.0}}, "-1"),
        ({"use_sde": True}, "use_sde"),
        ({"optimize_memory_usage": True}, "optimize_memory_usage"),
        ({"policy_kwargs": {"actor_features": "pixels"}}, "pixels.*conv, latent"),
        ({"policy_kwargs": {"normalize_images": False}}, "normalize_images"),
    ],
)
def test_bad_settings_fail_at_once_with_their_name(settings: dict[str, Any], message: str) -> None:
    settings = {"policy": "CnnPolicy", "env": NoiseEnv(), "policy_kwargs": POLICY_KWARGS, "buffer_size": 100, **settings}
    with pytest.raises(ValueError, match=message):
        CRCSAC(**settings)


def test_observations_that_are_not_images_are_refused() -> None:
    with pytest.raises(ValueError, match="expected uint8 images.*Box"):
        CRCSAC("CnnPolicy", gym.make("Pendulum-v1"))


def test_channel_last_images_and_several_environments_work() -> None:
    from stable_baselines3.common.env_util import make_vec_env

    model = CRCSAC("CnnPolicy", make_vec_env(NoiseEnv, 3), batch_size=8, buffer_size=90, learning_starts=30, gradient_steps=-1)
    model.learn(36)
    assert model._n_updates == 6  # two rounds of three transitions after the warm-up

    class ChannelLast(gym.ObservationWrapper[np.ndarray, np.ndarray, np.ndarray]):
        observation_space = gym.spaces.Box(0, 255, (40, 40, 9), np.uint8)

        def observation(self, observation: np.ndarray) -> np.ndarray:
            return observation.transpose(1, 2, 0)

    assert make_model(ChannelLast(NoiseEnv())).policy.key_encoder.input_shape == (9, 34, 34)
