"""Distracted environments as environments: the task, the seed, states, other processes, and wrong arguments."""

import warnings
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from dm_control.mujoco import Physics
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_crc import make_dmc
from sb3_crc.envs.distractions import DISTRACTIONS
from sb3_crc.envs.distractions.clips import bilinear
from sb3_crc.envs.distractions.textures import Scene
from sb3_crc.envs.tasks import PAPER_TASKS

#: Ten decisions are an episode
SMALL: dict[str, Any] = {"image_size": 36, "frame_stack": 2, "render_quality": "fast", "action_repeat": 100}
KINDS = ("color_hard", "video_hard", "dcs_hard")


def rolled(env: Any, steps: int, seed: int = 0) -> list[tuple[np.ndarray, float]]:
    """Observations and rewards, over the ends of episodes."""
    rng = np.random.default_rng(seed)
    outcome = []
    for _ in range(steps):
        observation, reward, terminated, truncated, _ = env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
        outcome.append((observation, reward))
        if terminated or truncated:
            outcome.append((env.reset()[0], 0.0))
    return outcome


def same(one: list[tuple[np.ndarray, float]], other: list[tuple[np.ndarray, float]]) -> bool:
    return all(np.array_equal(a[0], b[0]) and a[1] == b[1] for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("mode", [*DISTRACTIONS[:4], "dcs_hard"])
def test_the_task_stays_the_same_and_pictures_follow_from_the_seed(mode: str) -> None:
    env, equal, other = (make_dmc("cartpole-swingup", seed=seed, distraction=mode, **SMALL) for seed in (0, 0, 1))
    plain = make_dmc("cartpole-swingup", seed=0, **SMALL)
    for one in (env, equal, other, plain):
        one.reset()
    outcome, undistracted = rolled(env, 12), rolled(plain, 12)
    assert len(outcome) == 13  # an episode ended
    assert same(outcome, rolled(equal, 12))
    assert [reward for _, reward in outcome] == [reward for _, reward in undistracted]
    assert not any(np.array_equal(ours[0], plains[0]) for ours, plains in zip(outcome, undistracted, strict=True))
    if not mode.startswith("video"):  # nothing of the benchmark's videos is drawn by lot
        colours = [np.median(one.reset(seed=seed)[0], axis=(1, 2)) for one, seed in ((env, 0), (other, 1))]
        assert not np.array_equal(*colours)


@pytest.mark.parametrize("mode", KINDS)
def test_a_seed_makes_it_as_good_as_new(mode: str) -> None:
    new = make_dmc("cartpole-swingup", seed=7, distraction=mode, **SMALL)
    used = make_dmc("cartpole-swingup", seed=1, distraction=mode, **SMALL)
    used.reset()
    rolled(used, 13)
    assert np.array_equal(new.reset()[0], used.reset(seed=7)[0])
    assert same(rolled(new, 12), rolled(used, 12))
    assert np.array_equal(new.reset()[0], used.reset()[0])


@pytest.mark.parametrize("mode", KINDS)
def test_a_fresh_environment_continues_a_state_exactly(mode: str) -> None:
    env = make_dmc("cartpole-swingup", seed=0, distraction=mode, **SMALL)
    env.reset()
    rolled(env, 13)
    state, picture = env.get_state(), env.render()
    fresh = make_dmc("cartpole-swingup", seed=9, distraction=mode, **SMALL)
    fresh.set_state(state)
    used = make_dmc("cartpole-swingup", seed=8, distraction=mode, **SMALL)
    used.reset()
    rolled(used, 14)
    used.set_state(state)
    outcome = rolled(env, 24)
    assert len(outcome) == 26  # over two resets
    for other in (fresh, used):
        assert same(rolled(other, 24), outcome)
    used.set_state(state)
    assert np.array_equal(used.render(), picture)


@pytest.mark.parametrize("mode", KINDS)
def test_a_state_from_before_the_first_reset_is_one_too(mode: str) -> None:
    new, equal = (make_dmc("cartpole-swingup", seed=3, distraction=mode, **SMALL) for _ in range(2))
    used = make_dmc("cartpole-swingup", seed=1, distraction=mode, **SMALL)
    used.reset()
    rolled(used, 3)
    used.set_state(new.get_state())
    for other in (equal, used):
        assert np.array_equal(new.render(), other.render())
    first, _ = new.reset()
    for other in (equal, used):
        assert np.array_equal(first, other.reset()[0])


def test_a_state_of_another_distraction_is_refused() -> None:
    make = partial(make_dmc, "cartpole-swingup", seed=0, **SMALL)
    env = make(distraction="video_hard")
    env.reset()
    assert env.settings["distraction"] == "video_hard"
    assert make_dmc(**env.settings).get_wrapper_attr("distraction_label") == env.get_wrapper_attr("distraction_label")
    for kwargs in ({}, {"distraction": "video_easy"}, {"distraction": "video_hard", "distraction_mask": "segmentation"}):
        other = make(**kwargs)
        with pytest.raises(ValueError, match="distraction"):
            other.set_state(env.get_state())
        with pytest.raises(ValueError, match="distraction"):
            env.set_state(other.get_state())


def test_gymnasium_accepts_it() -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*is different from the unwrapped version.*")
        check_env(make_dmc("cartpole-swingup", distraction="dcs_hard", **SMALL), skip_render_check=True)


def test_its_specification_is_text() -> None:
    env = gym.make("dmc_pixels/cartpole-swingup-v0", seed=2, distraction="color_hard", **SMALL)
    assert env.spec is not None
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert np.array_equal(env.reset()[0], again.reset()[0])


def test_other_processes() -> None:
    makers = [partial(make_dmc, "cartpole-swingup", seed=3, distraction=mode, **SMALL) for mode in KINDS]
    observations = []
    for vec_env in (DummyVecEnv, SubprocVecEnv):
        env = vec_env(makers)  # type: ignore[arg-type]
        frames = [env.reset()] + [env.step(np.full((3, 1), 0.5, np.float32))[0] for _ in range(11)]
        observations.append(np.stack(frames))
        if vec_env is SubprocVecEnv:
            labels = env.env_method("get_wrapper_attr", "distraction_label")
            assert labels == ["color_hard (generated)", "video_hard (procedural)", "dcs_hard (procedural)"]
        env.close()
    assert np.array_equal(*observations)


@pytest.mark.parametrize("task", PAPER_TASKS)
def test_all_tasks_of_the_paper_can_be_distracted(task: str) -> None:
    plain, _ = make_dmc(task, seed=2, **SMALL).reset()
    for mode in KINDS:
        env = make_dmc(task, seed=2, distraction=mode, **SMALL)
        observation, _ = env.reset()
        assert (observation != plain).mean() > 0.3
        env.close()


@pytest.mark.parametrize("quality", ["fast", "benchmark"])
@pytest.mark.parametrize("mode", KINDS)
def test_the_large_picture_shows_the_same(mode: str, quality: str) -> None:
    env = make_dmc("cartpole-swingup", seed=2, distraction=mode, **{**SMALL, "render_quality": quality})
    env.reset()
    observation, *_ = env.step(np.ones(1, np.float32))
    large = env.render()
    assert large.shape == (480, 480, 3)
    difference = bilinear(large, 36).astype(int) - observation[-3:].transpose(1, 2, 0)
    assert np.median(np.abs(difference)) < 4
    assert np.array_equal(large, env.render())  # to look changes nothing


# -- What users get wrong ----------------------------------------------------------------------------------------------


def test_reacher_warns_and_is_as_it_is() -> None:
    with pytest.warns(UserWarning, match="video_easy changes nothing of reacher") as caught:
        env = make_dmc("reacher-easy", seed=0, distraction="video_easy", **SMALL)
    assert [warning.filename for warning in caught if "reacher" in str(warning.message)] == [__file__]
    assert np.array_equal(env.reset()[0], make_dmc("reacher-easy", seed=0, **SMALL).reset()[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        make_dmc("reacher-easy", distraction="video_hard", **SMALL)
        make_dmc("finger-spin", distraction="video_easy", **SMALL)
    with pytest.warns(UserWarning, match="video_easy changes nothing of fish"):  # in water there is no sky
        make_dmc("fish-swim", distraction="video_easy", **SMALL)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"distraction": "video_eazy"}, "video_eazy.*Did you mean 'video_easy'"),
        ({"distraction": "video_easy", "distraction_mask": "depth"}, "depth.*chroma.*segmentation"),
        ({"distraction": "color_easy", "observation": "state"}, "observation='state' has none"),
        ({"distraction_data": "somewhere"}, "none is given"),
        ({"distraction": "dcs_easy", "camera_id": -1}, "free camera"),
    ],
)
def test_arguments_that_cannot_be(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_dmc("cartpole-swingup", **{**SMALL, **kwargs})


def test_a_scene_without_sky_or_floor_is_named() -> None:
    bare = Physics.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    message = "own-task cannot be distracted: its scene has no texture 'skybox', no texture 'grid', no material 'grid'"
    with pytest.raises(ValueError, match=message):
        Scene(bare, "own-task")
