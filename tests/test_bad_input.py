"""What cannot work fails at once, or at the latest where it happens, with its name, its value and what is allowed."""

import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_crc import CRCSAC
from tests.conftest import POLICY_KWARGS, NoiseEnv, make_model


class SpacesEnv(NoiseEnv):
    """NoiseEnv with other spaces."""

    def __init__(self, observation_space: gym.Space[Any] | None = None, action_space: gym.Space[Any] | None = None):
        super().__init__()
        self.observation_space = observation_space or self.observation_space
        self.action_space = action_space or self.action_space


def images(*shape: int, high: float = 255, dtype: Any = np.uint8) -> gym.spaces.Box:
    return gym.spaces.Box(0, high, shape, dtype)


def construct(env: gym.Env[Any, Any] | None = None, **settings: Any) -> CRCSAC:
    return CRCSAC("CnnPolicy", env or NoiseEnv(), **{"buffer_size": 50, "policy_kwargs": POLICY_KWARGS, **settings})


# -- Names -------------------------------------------------------------------------------------------------------------


def test_an_unknown_preset_is_named_with_the_nearest_and_the_known() -> None:
    from sb3_crc.zoo import preset_class

    with pytest.raises(ValueError, match="crcc.*did you mean 'crc'.*pixel_sac"):
        preset_class("crcc")


def test_an_unknown_algorithm_on_the_command_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from sb3_crc.zoo import train

    monkeypatch.setattr(sys, "argv", ["train.py", "--algo", "crcc", "--env", "dmc_pixels/cartpole-swingup-v0"])
    with pytest.raises(SystemExit) as stop:
        train()
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert "crcc" in message and all(name in message for name in ("crc", "rad", "pixel_sac"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"objectives": {"reconstructoin": 1.0}}, "reconstructoin.*did you mean 'reconstruction'.*contrastive"),
        ({"objectives": ["contrastive"]}, "objectives.*mapping.*contrastive"),
        ({"augmentation": "randomshift"}, "randomshift.*did you mean 'random_shift'.*center_crop"),
        ({"augmentation_kwargs": {"sise": 30}}, "augmentation_kwargs.*sise.*size"),
        ({"augmentation": "random_shift", "augmentation_kwargs": {"size": 30}}, "augmentation_kwargs.*size.*pad"),
        ({"policy_kwargs": {"features_extractor_kwargs": {"latent_activation": "tahn"}}}, "tahn.*did you mean 'tanh'.*none"),
        ({"policy_kwargs": {"actor_features": "latnet"}}, "latnet.*did you mean 'latent'.*conv"),
    ],
)
def test_unknown_names_are_met_with_the_nearest_and_the_known(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        construct(**settings)


# -- Environments ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (images(3, 40, 40, high=1, dtype=np.float32), r"uint8 images.*float32"),
        (images(3, 40, 40, dtype=np.float32), r"uint8 images.*float32"),
        (images(3, 40, 40, high=254), r"values in \[0, 255\].*254"),
        (images(40, 40), r"uint8 images.*\(40, 40\)"),
        (images(3, 3, 40, 40), r"uint8 images.*\(3, 3, 40, 40\)"),
        (gym.spaces.Box(-1, 1, (7,), np.float32), r"uint8 images.*\(7,\)"),
        (gym.spaces.Discrete(5), r"uint8 images.*Discrete\(5\)"),
    ],
)
@pytest.mark.parametrize("image_size", [None, 30])
def test_observations_that_are_not_byte_images_are_refused(space: Any, message: str, image_size: int | None) -> None:
    with pytest.raises(ValueError, match=message):
        construct(SpacesEnv(space), image_size=image_size)


SPEED = gym.spaces.Box(-1, 1, (2,), np.float32)


@pytest.mark.parametrize("settings", [{}, {"n_steps": 3, "image_size": 30}])
def test_the_policy_must_suit_the_observations(settings: dict[str, Any]) -> None:
    env = SpacesEnv(gym.spaces.Dict(image=images(3, 40, 40), speed=SPEED))
    with pytest.raises(ValueError, match=r"CnnPolicy.*Dict.*MultiInputPolicy"):
        CRCSAC("CnnPolicy", env, buffer_size=50, **settings)
    with pytest.raises(ValueError, match=r"MultiInputPolicy.*one image.*CnnPolicy"):
        CRCSAC("MultiInputPolicy", SpacesEnv(images(3, 40, 40)), buffer_size=50, **settings)


@pytest.mark.parametrize("spaces", [{"speed": SPEED}, {"left": images(3, 40, 40), "right": images(3, 40, 40)}])
def test_dict_observations_have_exactly_one_image(spaces: dict[str, gym.Space[Any]]) -> None:
    with pytest.raises(ValueError, match=r"expected one uint8 image.*found (none|2 \(left, right\))"):
        CRCSAC("MultiInputPolicy", SpacesEnv(gym.spaces.Dict(spaces)), buffer_size=50)


@pytest.mark.parametrize("space", [gym.spaces.Discrete(3), gym.spaces.MultiBinary(2), gym.spaces.MultiDiscrete([2, 2])])
def test_discrete_actions_are_refused(space: gym.Space[Any]) -> None:
    with pytest.raises((AssertionError, ValueError), match=r"Box.*" + type(space).__name__):
        construct(SpacesEnv(action_space=space))


def test_unbounded_actions_are_refused() -> None:
    with pytest.raises((AssertionError, ValueError), match="finite lower and upper bound"):
        construct(SpacesEnv(action_space=gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)))


@pytest.mark.parametrize(
    ("size", "strides", "minimum"), [(16, (2, 1, 1, 1), 15), (36, (2, 2, 2, 2), 31), (40, (3, 3, 2, 1), None)]
)
def test_images_too_small_for_the_encoder_are_refused_with_the_minimum(
    size: int, strides: tuple[int, ...], minimum: int | None
) -> None:
    policy_kwargs = {"net_arch": [8], "features_extractor_kwargs": {"channels": [8] * 4, "strides": strides}}
    if minimum is None:
        minimum = 63  # the first side from which every convolution leaves a pixel
    with pytest.raises(ValueError, match=f"{round(0.84 * size)}x{round(0.84 * size)}.*{minimum}x{minimum}"):
        construct(SpacesEnv(images(3, size, size)), policy_kwargs=policy_kwargs)
    enough = {"features_extractor_kwargs": {**policy_kwargs["features_extractor_kwargs"], "image_size": minimum}}
    large = SpacesEnv(images(3, 64, 64))
    assert construct(large, policy_kwargs={"net_arch": [8], **enough}).policy.key_encoder.convolution_shape == (8, 1, 1)


# -- Crops -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"image_size": 41}, "41.*40x40"),
        ({"image_size": (30, 41)}, "41.*40x40"),
        ({"image_size": 0}, "image_size=0.*40x40"),
        ({"augmentation_kwargs": {"size": 60}}, "60x60.*40x40"),
        ({"augmentation": "center_crop", "augmentation_kwargs": {"size": (41, 30)}}, "41x30.*40x40"),
        ({"augmentation_kwargs": {"size": 20}}, "34x34.*20x20"),
        ({"augmentation": "random_shift", "augmentation_kwargs": {"pad": -1}}, "pad=-1.*at least 0"),
    ],
)
def test_impossible_crops_fail_at_construction(settings: dict[str, Any], message: str) -> None:
    """Not after the warm-up, when the first batch is cut."""
    with pytest.raises(ValueError, match=message):
        construct(**settings)


def test_the_check_of_the_augmentation_draws_no_random_numbers() -> None:
    """Nor does it depend on them: the same seed gives the same first batch with and without a random augmentation."""
    states = []
    for augmentation in ("center_crop", "random_crop", "random_shift"):
        construct(augmentation=augmentation, image_size=34, seed=3)
        states.append(th.get_rng_state())
    assert all(th.equal(state, states[0]) for state in states[1:])


# -- Numbers -----------------------------------------------------------------------------------------------------------

NAN, INFINITY = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        *[("tau", value, r"\[0, 1\]") for value in (-0.1, 1.5, NAN)],
        *[("encoder_tau", value, r"\[0, 1\]") for value in (-0.1, 1.5, NAN)],
        *[("gamma", value, r"\[0, 1\]") for value in (-0.1, 1.5, NAN)],
        *[("policy_delay", value, ">= 1") for value in (0, -1, 1.5)],
        *[("target_update_interval", value, ">= 1") for value in (0, -1, 1.5)],
        *[("batch_size", value, ">= 1") for value in (0, -1)],
        *[("n_steps", value, ">= 1") for value in (0, -1)],
        ("gradient_steps", -2, ">= -1"),
        *[("initial_updates", value, ">= 0") for value in (-1, 0.5)],
        *[("reward_scale", value, "finite") for value in (NAN, INFINITY, -INFINITY)],
        *[("max_grad_norm", value, "> 0") for value in (0.0, -1.0, NAN)],
    ],
)
def test_numbers_out_of_range_are_refused(name: str, value: float, allowed: str) -> None:
    with pytest.raises(ValueError, match=rf"{name}={value}\b.*({allowed})"):
        construct(**{name: value})


@pytest.mark.parametrize(
    "settings",
    [
        {"tau": 0.0, "encoder_tau": 1.0, "gamma": 1.0},
        {"tau": 1, "encoder_tau": 0, "gamma": 0},
        {"policy_delay": np.int64(1), "target_update_interval": 1, "batch_size": 1, "initial_updates": 0},
        {"gradient_steps": -1, "reward_scale": 2, "max_grad_norm": 5},
    ],
)
def test_the_ends_of_the_ranges_are_allowed(settings: dict[str, Any]) -> None:
    model = make_model(**{"learning_starts": 12, "batch_size": 8, **settings})
    assert model._n_updates == 28


RATES = ("learning_rate", "qf_learning_rate", "encoder_learning_rate", "ent_coef_learning_rate")


@pytest.mark.parametrize("name", RATES)
@pytest.mark.parametrize("value", [-1e-3, NAN, INFINITY, "lin_-0.1", "lin_nan"])
def test_learning_rates_are_finite_and_not_negative(name: str, value: Any) -> None:
    number = str(value).removeprefix("lin_")
    with pytest.raises(ValueError, match=rf"{name}.*{number}"):
        construct(**{name: value})


@pytest.mark.parametrize("name", RATES)
def test_a_schedule_that_becomes_negative_is_stopped_there(name: str) -> None:
    model = make_model(**{name: lambda progress: progress - 0.5})
    model._current_progress_remaining = 0.75
    model.train(gradient_steps=1, batch_size=16)
    model._current_progress_remaining = 0.25
    with pytest.raises(ValueError, match=f"{name}.*-0.25"):
        model.train(gradient_steps=1, batch_size=16)


def test_loading_checks_the_numbers_too(tmp_path: Path) -> None:
    construct().save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="tau=1.5"):
        CRCSAC.load(tmp_path / "model.zip", tau=1.5)


def test_no_gradient_steps_are_no_updates() -> None:
    model = make_model()
    model.train(gradient_steps=0, batch_size=16)
    assert model._n_updates == 0


# -- Data --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_envs", [1, 2])
def test_a_batch_larger_than_what_is_stored_is_refused(n_envs: int) -> None:
    """SB3 would fill it with copies, which are false negatives of the contrastive loss."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    model = construct(DummyVecEnv([NoiseEnv] * n_envs), batch_size=16, learning_starts=4)
    with pytest.raises(ValueError, match=rf"batch_size=16.*\b{6 if n_envs == 2 else 5}\b.*learning_starts"):
        model.learn(20)
    assert model._n_updates == 0
    model = construct(DummyVecEnv([NoiseEnv] * n_envs), batch_size=16, learning_starts=15)
    model.learn(16)
    assert model._n_updates == 1


def test_a_buffer_smaller_than_the_batch_is_refused_when_it_trains(tmp_path: Path) -> None:
    """And not before: whoever only wants to predict may load with the smallest buffer."""
    model = construct(batch_size=16, buffer_size=10, learning_starts=20)
    with pytest.raises(ValueError, match=r"batch_size=16.*\b10\b.*buffer_size"):
        model.learn(21)
    model.save(tmp_path / "model.zip")
    CRCSAC.load(tmp_path / "model.zip", buffer_size=1).predict(np.zeros((9, 40, 40), np.uint8))


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


def test_weights_of_nan_stop_before_they_act() -> None:
    model = make_model()
    with th.no_grad():
        model.actor.mu.bias.fill_(NAN)
    with pytest.raises(FloatingPointError, match="the action of environment 0 is nan.*weights or what it was shown"):
        model.learn(2, reset_num_timesteps=False)


def parameters(model: CRCSAC) -> list[th.Tensor]:
    return [parameter.detach().clone() for parameter in model.policy.parameters()]


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


# -- Memory ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("fits", "hint"), [(5, "batch_size=4 fits"), (0, "no smaller one fits either")])
@pytest.mark.parametrize(
    "error",
    [
        th.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 GiB"),
        RuntimeError("DefaultCPUAllocator: not enough memory"),
    ],
)
def test_where_memory_is_short_the_batch_that_fits_is_named(
    error: Exception, fits: int, hint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = make_model()
    convolve = type(model.critic.features_extractor).convolve

    def short(self: Any, images: Any) -> Any:
        if len(images) > fits:
            raise error
        return convolve(self, images)

    monkeypatch.setattr(type(model.critic.features_extractor), "convolve", short)
    before = parameters(model)
    message = rf"batch_size=16 does not fit into the memory of cpu \({type(error).__name__}: .*memory.*\); {hint}"
    with pytest.raises(MemoryError, match=message):
        model.train(gradient_steps=1, batch_size=16)
    assert all(map(th.equal, before, parameters(model)))


def test_other_errors_of_an_update_are_raised_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model()
    monkeypatch.setattr(model, "_critic_loss", lambda views: (_ for _ in ()).throw(RuntimeError("mat1 and mat2")))
    with pytest.raises(RuntimeError, match="mat1 and mat2"):
        model.train(gradient_steps=1, batch_size=16)
