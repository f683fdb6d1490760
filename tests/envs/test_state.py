"""get_state and set_state: another environment continues where one was, exactly."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from sb3_crc.envs.dmc import DecisionEnv, make_dmc
from sb3_crc.envs.state import MODEL_FIELDS
from sb3_crc.envs.tasks import PAPER_TASKS, task_names

SMALL: dict[str, Any] = {"image_size": 36, "render_quality": "fast"}


def leaves(state: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every value of nested dictionaries with the keys that lead to it."""
    if type(state) is dict:
        for name, part in state.items():
            yield from leaves(part, (*path, name))
    else:
        yield path, state


def through_files(state: dict[str, Any]) -> dict[str, Any]:
    """What comes back from npz, without pickles, and from JSON."""
    arrays = {"/".join(path): value for path, value in leaves(state) if isinstance(value, np.ndarray)}
    scalars = {"/".join(path): value for path, value in leaves(state) if not isinstance(value, np.ndarray)}
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    file.seek(0)
    values = {**np.load(file, allow_pickle=False), **json.loads(json.dumps(scalars))}
    copy: dict[str, Any] = {}
    for path, _ in leaves(state):
        place = copy
        for name in path[:-1]:
            place = place.setdefault(name, {})
        place[path[-1]] = values["/".join(path)]
    return copy


def assert_same(left: Any, right: Any) -> None:
    """Equal to the last bit, in type too; arrays may be nested in dictionaries."""
    lefts, rights = dict(leaves(left)), dict(leaves(right))
    assert lefts.keys() == rights.keys()
    for path, value in lefts.items():
        assert type(value) is type(rights[path]), path
        if isinstance(value, np.ndarray):
            assert value.dtype == rights[path].dtype
            np.testing.assert_array_equal(value, rights[path], err_msg=str(path))
        else:
            assert value == rights[path], path


def step_randomly(env: DecisionEnv, decisions: int) -> bool:
    """Take up to so many steps; return whether the episode is over."""
    for _ in range(decisions):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            return True
    return False


def restored(env: DecisionEnv, task: str, **kwargs: Any) -> DecisionEnv:
    """A new environment with another seed and past, brought into the state of ``env``, which itself moves on."""
    other = make_dmc(task, seed=99, **kwargs)
    other.reset()
    step_randomly(other, 7)
    state = through_files(env.get_state())
    other.set_state(state)
    assert_same(other.get_state(), env.get_state())
    for _, value in leaves(state):  # the environment has its own copy
        if isinstance(value, np.ndarray):
            value.fill(0)
    return other


def assert_same_future(env: DecisionEnv, other: DecisionEnv, decisions: int, *, over: bool = False) -> None:
    """Step both with their own random actions, and reset both without a seed where an episode ends."""
    for _ in range(decisions):
        if over:
            (observation, info), (other_observation, other_info) = env.reset(), other.reset()
            over = False
        else:
            action, other_action = env.action_space.sample(), other.action_space.sample()
            np.testing.assert_array_equal(action, other_action)
            observation, *outcome, info = env.step(action)
            other_observation, *other_outcome, other_info = other.step(other_action)
            assert outcome == other_outcome
            over = outcome[1] or outcome[2]
        assert_same(observation, other_observation)
        assert_same(info, other_info)
        data, other_data = (e.get_wrapper_attr("physics").data for e in (env, other))
        np.testing.assert_array_equal(data.qpos, other_data.qpos)
        np.testing.assert_array_equal(data.qvel, other_data.qvel)
        np.testing.assert_array_equal(data.qacc_warmstart, other_data.qacc_warmstart)


# --- exactness ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "observation"),
    [
        ("cartpole-swingup", "pixels"),
        ("cartpole-swingup", "state"),
        ("finger-spin", "state"),
        ("finger-turn_hard", "dict"),
        ("quadruped-walk", "state"),
        ("reacher-easy", "pixels"),
    ],
)
def test_another_environment_continues_exactly(task: str, observation: str) -> None:
    kwargs = {**SMALL, "observation": observation}
    env = make_dmc(task, seed=0, **kwargs)
    env.reset()
    step_randomly(env, 12)
    other = restored(env, task, **kwargs)
    np.testing.assert_array_equal(env.render(), other.render())
    assert_same_future(env, other, 10)
    assert_same_future(env, other, 5, over=True)
    for e in (env, other):
        e.close()


def test_the_end_of_an_episode_is_a_state_too() -> None:
    kwargs = {"observation": "state", "action_repeat": 100}
    env = make_dmc("cartpole-swingup", seed=0, **kwargs)
    env.reset()
    assert step_randomly(env, 10)
    other = restored(env, "cartpole-swingup", **kwargs)
    with pytest.raises(ResetNeeded):
        other.step(np.zeros(1, np.float32))
    assert_same_future(env, other, 15, over=True)


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["before", "reset", "middle", "end"])
@pytest.mark.parametrize("task", PAPER_TASKS)
def test_the_papers_tasks_continue_exactly_over_episodes(task: str, moment: str) -> None:
    env = make_dmc(task, seed=0, **SMALL)
    over = moment == "before"
    if moment != "before":
        env.reset()
    if moment == "middle":
        step_randomly(env, 200 // env.action_repeat)
    if moment == "end":
        over = step_randomly(env, 1000)
        assert over
    other = restored(env, task, **SMALL)
    whole_episode = 1000 // env.action_repeat
    assert_same_future(env, other, whole_episode + 60, over=over)  # well into the next episode
    for _ in range(2):
        assert_same_future(env, other, 3, over=True)
    for e in (env, other):
        e.close()


@pytest.mark.slow
@pytest.mark.parametrize("task", sorted(set(task_names()) - set(PAPER_TASKS)))
def test_the_other_tasks_continue_exactly(task: str) -> None:
    kwargs = {**SMALL, "observation": "dict"}
    env = make_dmc(task, seed=0, **kwargs)
    env.reset()
    step_randomly(env, 100)
    other = restored(env, task, **kwargs)
    assert_same_future(env, other, 60)
    assert_same_future(env, other, 20, over=True)
    for e in (env, other):
        e.close()


def model_values(model: Any) -> dict[str, np.ndarray]:
    """Every number in MuJoCo's model, options and visual settings included."""
    values: dict[str, np.ndarray] = {}
    for prefix, part in (("", model), ("opt.", model.opt), ("stat.", model.stat), ("vis.quality.", model.vis.quality)):
        for name in dir(part):
            value = None if name.startswith("_") else getattr(part, name)
            if isinstance(value, (int, float, np.ndarray)):
                values[prefix + name] = np.array(value)
    return values


@pytest.mark.slow
@pytest.mark.parametrize("task", task_names())
def test_episodes_change_nothing_else(task: str) -> None:
    """Neither another field of the model nor an attribute of the task."""
    env, other = (make_dmc(task, seed=seed, observation="state") for seed in (0, 1))
    attributes = {name: str(value) for name, value in vars(env.get_wrapper_attr("task")).items() if name != "_random"}
    assert attributes
    before = model_values(env.get_wrapper_attr("physics").model.ptr)
    assert len(before) > 300 and set(MODEL_FIELDS) <= before.keys()
    for _ in range(3):
        env.reset()
        step_randomly(env, 5)
        after = [model_values(e.get_wrapper_attr("physics").model.ptr) for e in (env, other)]
        for values in after:
            changed = {name for name, value in before.items() if not np.array_equal(value, values[name], equal_nan=True)}
            assert changed <= set(MODEL_FIELDS)
        for e in (env, other):
            task_now = vars(e.get_wrapper_attr("task"))
            assert {name: str(value) for name, value in task_now.items() if name != "_random"} == attributes


def test_the_next_picture_is_right_without_a_step() -> None:
    """Another terrain, which OpenGL has a copy of, and another pose."""
    kwargs = {**SMALL, "observation": "state"}
    env = make_dmc("quadruped-escape", seed=0, **kwargs)
    env.reset()
    step_randomly(env, 3)
    other = make_dmc("quadruped-escape", seed=1, **kwargs)
    other.reset()
    assert np.any(other.render() != env.render())
    other.set_state(env.get_state())
    np.testing.assert_array_equal(other.render(), env.render())
    for e in (env, other):
        e.close()


# --- what a state is ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("observation", ["pixels", "state", "dict"])
def test_a_state_is_arrays_and_json_scalars(observation: str) -> None:
    state = make_dmc("walker-walk", seed=0, **SMALL, observation=observation).get_state()
    for path, value in leaves(state):
        assert type(path[-1]) is str and "/" not in path[-1]
        assert type(value) in (np.ndarray, str, bool, int, float, type(None)), path
        assert not (isinstance(value, np.ndarray) and value.dtype.hasobject), path
    assert_same(through_files(state), state)


def test_a_pending_seed_is_part_of_it() -> None:
    env = make_dmc("cartpole-swingup", seed=3, observation="state")
    other = make_dmc("cartpole-swingup", seed=4, observation="state")
    other.reset()
    other.set_state(env.get_state())
    np.testing.assert_array_equal(other.reset()[0], env.reset()[0])


def test_a_task_that_measures_its_body_at_a_reset_needs_none() -> None:
    env, other = (make_dmc("dog-stand", seed=seed, observation="state") for seed in (0, 1))
    env.reset()
    other.set_state(env.get_state())
    assert_same_future(env, other, 2)


def test_made_by_id_it_steps_without_a_reset() -> None:
    made = [gym.make("dmc_pixels/cartpole-swingup-v0", seed=seed, **SMALL) for seed in (0, 1)]
    made[0].reset()
    made[0].step(np.ones(1, np.float32))
    made[1].get_wrapper_attr("set_state")(made[0].get_wrapper_attr("get_state")())
    assert_same(made[1].step(np.ones(1, np.float32))[0], made[0].step(np.ones(1, np.float32))[0])


def test_an_environment_survives_pickling() -> None:
    """With cloudpickle, as SB3 does: Gymnasium's wrappers hold functions without a name. The kept camera is native memory."""
    env = make_dmc("cartpole-swingup", seed=0, **SMALL)
    env.reset()
    copy = cloudpickle.loads(cloudpickle.dumps(env))
    action = np.ones(1, np.float32)
    np.testing.assert_array_equal(copy.step(action)[0], env.step(action)[0])
    copy.close()
    env.close()


# --- mistakes -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cartpole() -> Iterator[DecisionEnv]:
    env = make_dmc("cartpole-swingup", seed=0, **SMALL)
    yield env
    env.close()


@pytest.mark.parametrize(
    ("theirs", "message"),
    [
        ({"task": "cartpole-balance"}, "with task='cartpole-balance', but this one has task='cartpole-swingup'"),
        ({"frame_stack": 2}, "with frame_stack=2, but this one has frame_stack=3"),
        ({"image_size": 40}, "with image_size=40, but this one has image_size=36"),
        ({"render_quality": "benchmark"}, "render_quality='benchmark', but this one has render_quality='fast'"),
        ({"action_repeat": 4, "camera_id": 1}, "action_repeat=4, camera_id=1, but this one has action_repeat=8, camera_id=0"),
        ({"observation": "dict"}, "with observation='dict', but this one has observation='pixels'"),
        (
            {"observation": "state"},
            "observation='state', no image_size, .*, but this one has observation='pixels', image_size=36",
        ),
    ],
)
def test_a_state_of_other_settings_is_refused(cartpole: DecisionEnv, theirs: dict[str, Any], message: str) -> None:
    state = make_dmc(**{"task": "cartpole-swingup", **SMALL, **theirs}).get_state()
    before = cartpole.get_state()
    with pytest.raises(ValueError, match=message):
        cartpole.set_state(state)
    assert_same(cartpole.get_state(), before)


def test_settings_of_pictures_do_not_matter_without_pictures() -> None:
    env = make_dmc("cartpole-swingup", seed=0, observation="state", image_size=84, frame_stack=1)
    env.reset()
    other = make_dmc("cartpole-swingup", observation="state", render_quality="fast")
    other.set_state(env.get_state())
    assert_same_future(env, other, 3)


DELETED = object()


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("settings",), DELETED, "no settings"),
        (("frames",), DELETED, "state lacks 'frames'"),
        (("simulator", "task", "model", "geom_pos"), DELETED, r"state\['simulator'\]\['task'\]\['model'\] lacks 'geom_pos'"),
        (("simulator", "task", "random", "state", "pos"), DELETED, "lacks 'pos'"),
        (("simulator", "colour"), 1, "unknown entries 'colour'"),
        (("simulator", "task", "integration"), np.zeros(3), r"\['integration'\] is an array float64\(3,\); it must be"),
        (("simulator", "task", "sensors"), [1.0], "is of type list"),
        (("frames",), np.zeros((9, 36, 36)), "float64.*must be an array uint8"),
        (("simulator", "episode_over"), 0, "an integer or None; it must be of type bool"),
        (("simulator", "env_steps"), "0", "is of type str; it must be an integer"),
        (("simulator", "task"), None, "not a dictionary"),
        (("action_space", "bit_generator"), "MT19937", "'MT19937'; it must be 'PCG64'"),
    ],
)
def test_a_damaged_state_is_refused_before_anything_changes(
    cartpole: DecisionEnv, path: tuple[str, ...], value: Any, message: str
) -> None:
    cartpole.reset()
    state = cartpole.get_state()
    place = state
    for name in path[:-1]:
        place = place[name]
    if value is DELETED:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    step_randomly(cartpole, 2)
    before = cartpole.get_state()
    with pytest.raises(ValueError, match=message):
        cartpole.set_state(state)
    assert_same(cartpole.get_state(), before)


@pytest.mark.parametrize("state", [None, {}, {"settings": None}, [1]])
def test_what_is_no_state_is_refused(state: Any) -> None:
    with pytest.raises(ValueError, match="not a state of get_state"):
        make_dmc("cartpole-swingup", observation="state").set_state(state)
