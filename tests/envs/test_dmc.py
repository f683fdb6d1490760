"""make_dmc: what an observation, a reward, a step and a seed are."""

from __future__ import annotations

import time
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from sb3_crc.envs.dmc import DecisionEnv, PixelStack, make_dmc
from sb3_crc.envs.simulator import SimulatorStep
from sb3_crc.envs.tasks import PAPER_TASKS

SMALL: dict[str, Any] = {"image_size": 36, "render_quality": "fast"}


def make_small(task: str = "cartpole-swingup", **kwargs: Any) -> DecisionEnv:
    return make_dmc(task, **{**SMALL, **kwargs})


def count_renderings(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Record the height of every picture that the simulator draws."""
    from dm_control.mujoco.engine import Camera

    draw = Camera.render
    heights: list[int] = []

    def counted(camera: Camera, *args: Any, **kwargs: Any) -> np.ndarray:
        heights.append(camera.height)
        return draw(camera, *args, **kwargs)

    monkeypatch.setattr(Camera, "render", counted)
    return heights


# --- observations ---------------------------------------------------------------------------------------------------------


def test_observation_is_a_contiguous_stack_of_byte_frames() -> None:
    env = make_small(frame_stack=4)
    observation, _ = env.reset(seed=0)
    assert env.observation_space == gym.spaces.Box(0, 255, (12, 36, 36), np.uint8)
    assert observation.dtype == np.uint8 and observation.shape == (12, 36, 36) and observation.flags.c_contiguous
    assert env.get_wrapper_attr("frame_channels") == 3
    assert env.get_wrapper_attr("action_repeat") == 8
    env.close()


def test_the_default_picture() -> None:
    env = make_dmc("cartpole-swingup")
    assert env.observation_space.shape == (9, 100, 100)
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    env.close()


def test_first_frame_repeats_and_the_newest_is_last() -> None:
    env = make_small()
    reset_observation, _ = env.reset(seed=0)
    oldest, middle, newest = np.split(reset_observation, 3)
    np.testing.assert_array_equal(oldest, newest)
    np.testing.assert_array_equal(middle, newest)

    action = np.ones(1, np.float32)
    observation, *_ = env.step(action)
    np.testing.assert_array_equal(observation[:6], reset_observation[3:])
    assert np.any(observation[6:] != newest)
    picture = env.unwrapped.render()  # the simulator's own, height x width x RGB
    np.testing.assert_array_equal(observation[6:].transpose(1, 2, 0), picture)

    again, _ = env.reset(seed=0)
    np.testing.assert_array_equal(again, reset_observation)
    env.close()


def test_observations_handed_out_never_change() -> None:
    env = make_small()
    observations = [env.reset(seed=0)[0]]
    copies = [observations[0].copy()]
    for _ in range(4):
        observation, *_ = env.step(np.ones(1, np.float32))
        observations.append(observation)
        copies.append(observation.copy())
    for observation, copy in zip(observations, copies, strict=True):
        np.testing.assert_array_equal(observation, copy)
    assert not any(np.shares_memory(a, b) for a, b in pairwise(observations))
    env.close()


def test_one_rendering_per_decision(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_small()
    heights = count_renderings(monkeypatch)
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros(1, np.float32))
    assert heights == [36] * 6
    env.close()


def test_state_observation_draws_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_dmc("cartpole-swingup", observation="state", seed=0)
    heights = count_renderings(monkeypatch)
    state, info = env.reset()
    assert env.observation_space == gym.spaces.Box(-np.inf, np.inf, (5,), np.float32)
    assert state.dtype == np.float32 and info["env_steps"] == 0
    # alphabetical: position (cart, cos, sin), velocity (cart, pole)
    physics = env.get_wrapper_attr("physics")
    np.testing.assert_array_equal(state[:3], physics.bounded_position().astype(np.float32))
    state, _, _, _, info = env.step(np.ones(1, np.float32))
    np.testing.assert_array_equal(state[3:], physics.velocity().astype(np.float32))
    assert state.dtype == np.float32 and info["env_steps"] == 8
    assert heights == []
    env.close()


# --- actions, rewards, ends, counts ---------------------------------------------------------------------------------------


def test_rewards_of_the_repeated_steps_are_summed() -> None:
    decisions = make_dmc("walker-walk", observation="state", action_repeat=4)
    single_steps = make_dmc("walker-walk", observation="state", action_repeat=1)
    decisions.reset(seed=0)
    single_steps.reset(seed=0)
    action = np.full(6, 0.3, np.float32)
    state, reward, *_ = decisions.step(action)
    singles = [single_steps.step(action) for _ in range(4)]
    assert type(reward) is float
    assert reward == pytest.approx(sum(single[1] for single in singles), rel=1e-12) and reward > 0
    np.testing.assert_array_equal(state, singles[-1][0])


def test_time_limit_truncates_and_counts_a_partial_repeat() -> None:
    env = make_dmc("cartpole-swingup", observation="state", action_repeat=7)  # 1000 = 142 x 7 + 6
    env.reset(seed=0)
    for decision in range(1, 144):
        _, _, terminated, truncated, info = env.step(np.zeros(1, np.float32))
        assert not terminated
        assert truncated == (decision == 143)
        assert info["episode_env_steps"] == min(7 * decision, 1000)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(1, np.float32))
    _, info = env.reset()
    assert (info["env_steps"], info["episode_env_steps"]) == (1000, 0)
    *_, info = env.step(np.zeros(1, np.float32))
    assert (info["env_steps"], info["episode_env_steps"]) == (1007, 7)


def test_discount_zero_terminates(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_dmc("cartpole-swingup", observation="state", action_repeat=4)
    env.reset(seed=0)
    task = env.get_wrapper_attr("task")
    monkeypatch.setattr(task, "get_termination", lambda physics: 0.0 if physics.time() > 0.055 else None)
    _, _, terminated, truncated, info = env.step(np.zeros(1, np.float32))
    assert not terminated and not truncated and info["episode_env_steps"] == 4
    _, _, terminated, truncated, info = env.step(np.zeros(1, np.float32))
    assert terminated and not truncated
    assert info["episode_env_steps"] == 6  # the end inside the repeat: control step 0.01 s


@pytest.mark.parametrize("observation", ["pixels", "state", "dict"])
def test_stepping_before_the_first_reset_is_refused(observation: str) -> None:
    with pytest.raises(ResetNeeded):
        make_small(observation=observation).step(np.zeros(1, np.float32))
    with pytest.raises(ResetNeeded):
        gym.make("dmc_pixels/cartpole-swingup-v0", **SMALL, observation=observation).step(np.zeros(1, np.float32))


def test_actions_are_rescaled_to_the_tasks_bounds() -> None:
    env = make_dmc("quadruped-walk", observation="state", action_repeat=1)
    env.reset(seed=0)
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (12,), np.float32)
    physics = env.get_wrapper_attr("physics")
    low, high = physics.model.actuator_ctrlrange.T
    assert np.any(high != 1.0)
    for action, expected in ((1.0, high), (-1.0, low), (0.0, (low + high) / 2)):
        env.step(np.full(12, action, np.float32))
        np.testing.assert_allclose(physics.control(), expected, atol=1e-6)


def test_unlimited_actuators_take_the_action_as_it_is() -> None:
    env = make_dmc("lqr-lqr_2_1", observation="state", seed=0)
    env.reset()
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    env.step(np.full(1, 0.25, np.float32))
    np.testing.assert_array_equal(env.get_wrapper_attr("physics").control(), [0.25])


# --- seeds ----------------------------------------------------------------------------------------------------------------


def rollout(env: DecisionEnv, observation: np.ndarray, decisions: int = 12) -> tuple[np.ndarray, list[float]]:
    observations, rewards = [observation], []
    for _ in range(decisions):
        observation, reward, *_ = env.step(env.action_space.sample())
        observations.append(observation)
        rewards.append(reward)
    observations.append(env.reset()[0])  # the second episode follows from the same seed
    return np.stack(observations), rewards


@pytest.mark.parametrize("task", ["cartpole-swingup", "reacher-easy", "finger-turn_hard", "quadruped-walk"])
def test_same_seed_same_trajectory_and_pixels(task: str) -> None:
    seeded = make_small(task, seed=7)
    reset_seeded = make_small(task)
    reset_seeded.action_space.seed(7)
    other = make_small(task, seed=8)
    pixels, rewards = rollout(seeded, seeded.reset()[0])
    same_pixels, same_rewards = rollout(reset_seeded, reset_seeded.reset(seed=7)[0])
    other_pixels, _ = rollout(other, other.reset()[0])
    np.testing.assert_array_equal(pixels, same_pixels)
    assert rewards == same_rewards
    assert np.any(pixels != other_pixels)
    for env in (seeded, reset_seeded, other):
        env.close()


def test_a_seed_of_reset_takes_precedence_and_restarts_the_count() -> None:
    env = make_dmc("cartpole-swingup", observation="state", seed=1)
    wanted = make_dmc("cartpole-swingup", observation="state").reset(seed=2)[0]
    np.testing.assert_array_equal(env.reset(seed=2)[0], wanted)
    assert np.any(env.reset()[0] != wanted)
    env.step(env.action_space.sample())
    assert env.reset()[1]["env_steps"] == 8
    assert env.reset(seed=2)[1]["env_steps"] == 0


# --- rendering quality and large pictures ---------------------------------------------------------------------------------


def test_fast_pictures_differ_and_stay_fast_on_a_new_model() -> None:
    from dm_control.suite import cheetah

    benchmark = make_dmc("cheetah-run", seed=0, image_size=48)
    fast = make_dmc("cheetah-run", seed=0, image_size=48, render_quality="fast")
    beautiful, plain = benchmark.reset()[0], fast.reset()[0]
    assert np.any(beautiful != plain)
    assert np.abs(beautiful.astype(int) - plain).mean() < 25  # the same scene nevertheless

    quality = fast.get_wrapper_attr("physics").model.vis.quality
    assert (quality.offsamples, quality.shadowsize) == (0, 0)
    physics = fast.get_wrapper_attr("physics")
    physics.reload_from_xml_string(*cheetah.get_model_and_assets())
    assert physics.model.vis.quality.offsamples != 0
    again, _ = fast.reset(seed=0)
    assert (physics.model.vis.quality.offsamples, physics.model.vis.quality.shadowsize) == (0, 0)
    np.testing.assert_array_equal(again, plain)
    for env in (benchmark, fast):
        env.close()


def test_quadruped_fills_its_picture() -> None:
    """The default camera follows the body; camera 0 shows a speck."""

    def body_share(camera_id: int | None) -> float:
        env = make_dmc("quadruped-walk", seed=0, camera_id=camera_id, render_quality="fast")
        picture = env.reset()[0][-3:].astype(int)
        env.close()
        return float((picture[0] - picture[2] > 40).mean())  # its body is the one orange thing

    assert body_share(None) > 0.03
    assert body_share(0) < 0.01


def test_the_benchmark_picture_is_dm_controls_own() -> None:
    from dm_control import suite

    simulator = suite.load("walker", "walk", task_kwargs={"random": 3})
    simulator.reset()
    env = make_dmc("walker-walk", image_size=84, seed=3)
    picture = env.reset()[0][-3:].transpose(1, 2, 0)
    np.testing.assert_array_equal(picture, simulator.physics.render(84, 84, camera_id=0))
    env.close()


def test_render_is_large_and_disturbs_no_observation() -> None:
    env, undisturbed = make_small(seed=0), make_small(seed=0)
    env.reset()
    undisturbed.reset()
    picture = env.render()
    assert picture.shape == (480, 480, 3) and picture.dtype == np.uint8 and picture.flags.c_contiguous
    action = np.ones(1, np.float32)
    np.testing.assert_array_equal(env.step(action)[0], undisturbed.step(action)[0])
    env.close()
    undisturbed.close()


def test_pictures_may_exceed_the_suites_buffer() -> None:
    env = make_dmc("cartpole-swingup", image_size=700, frame_stack=1, render_quality="fast")
    assert env.reset(seed=0)[0].shape == (3, 700, 700)
    assert env.render().shape == (700, 700, 3)
    env.close()


def test_frame_rates_belong_to_the_instance() -> None:
    cartpole = make_dmc("cartpole-swingup", observation="state")
    walker = make_dmc("walker-walk", observation="state")
    assert cartpole.metadata["render_fps"] == pytest.approx(1 / (0.01 * 8))
    assert walker.metadata["render_fps"] == pytest.approx(1 / (0.025 * 2))
    assert cartpole.metadata["render_modes"] == ["rgb_array"]


def test_render_mode_none_draws_observations_only() -> None:
    env = make_small(render_mode=None)
    assert env.reset(seed=0)[0].any()
    assert env.render_mode is None and env.render() is None
    env.close()


# --- mistakes -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "kwargs", "message"),
    [
        ("cartpole-swing_up", {}, "Did you mean 'cartpole-swingup'"),
        ("cartpol-swingup", {}, "Did you mean 'cartpole-swingup'"),
        ("ball-in-cup-catch", {}, "Did you mean 'ball_in_cup-catch'"),
        ("cartpole-Swingup", {}, "Did you mean 'cartpole-swingup'"),
        (
            "cartpole-swingup",
            {"observation": "pixel"},
            "observation='pixel'.*'state', 'dict'.*Did you mean 'pixels'",
        ),
        ("cartpole-swingup", {"observation": 3}, "observation=3.*'pixels', 'state', 'dict'"),
        ("cartpole-swingup", {"render_quality": "fats"}, "render_quality='fats'.*'benchmark', 'fast'.*Did you mean 'fast'"),
        ("cartpole-swingup", {"render_quality": "bench"}, "render_quality='bench'.*Did you mean 'benchmark'"),
        ("cartpole-swingup", {"render_mode": "human"}, "render_mode='human'.*'rgb_array', None.*Did you mean 'rgb_array'"),
        ("cartpole-swingup", {"image_size": 0}, "image_size=0"),
        ("cartpole-swingup", {"image_size": 84.0}, "image_size=84.0"),
        ("cartpole-swingup", {"action_repeat": 0}, "action_repeat=0"),
        ("cartpole-swingup", {"frame_stack": 0}, "frame_stack=0"),
        ("cartpole-swingup", {"camera_id": 2}, "camera_id=2.*from -1 to 1; cartpole-swingup has 2 cameras"),
    ],
)
def test_mistakes_are_named(task: str, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_dmc(task, **kwargs)


# --- with the libraries around --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", PAPER_TASKS)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_check_env(task: str) -> None:
    env = make_small(task)
    gymnasium_check_env(env)
    sb3_check_env(env)
    env.close()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_check_env_of_states() -> None:
    env = make_dmc("quadruped-walk", observation="state")
    gymnasium_check_env(env)
    sb3_check_env(env)


def test_gymnasium_makes_it_by_id() -> None:
    env = gym.make("dmc_pixels/reacher-easy-v0", render_mode="rgb_array", image_size=36, render_quality="fast")
    assert isinstance(env, PixelStack)
    assert env.reset(seed=0)[0].shape == (9, 36, 36)
    assert env.metadata["render_fps"] == pytest.approx(1 / (0.02 * 4))
    remade = gym.make(env.spec)  # type: ignore[arg-type]
    np.testing.assert_array_equal(remade.reset(seed=0)[0], env.reset(seed=0)[0])
    env.close()
    remade.close()


def test_our_wrappers_cost_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rendering and Shimmy replaced by constants, what remains is Gymnasium's and our wrappers."""
    env = make_dmc("cartpole-swingup", seed=0)
    env.reset()
    picture = env.unwrapped.render()
    result = env.unwrapped.step(np.zeros(1))
    monkeypatch.setattr(SimulatorStep, "render", lambda _: picture)
    monkeypatch.setattr(env.unwrapped, "step", lambda action: (*result[:4], dict(result[4])))
    action = np.zeros(1, np.float32)
    durations = []
    for _ in range(200):
        start = time.perf_counter()
        env.step(action)
        durations.append(time.perf_counter() - start)
    assert np.median(durations) < 0.3e-3
    env.close()
