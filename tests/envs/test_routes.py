"""Every way to an environment, in one process and in several: gym.make, make_vec_env by callable and by id, the zoo."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_crc.envs.dmc import make_dmc

TASK = "cartpole-swingup"
ID = f"dmc_pixels/{TASK}-v0"
SMALL: dict[str, Any] = {"image_size": 36, "render_quality": "fast", "frame_stack": 2}  # those of tests/tiny.yml
VEC_ENVS = [DummyVecEnv, pytest.param(SubprocVecEnv, marks=pytest.mark.slow)]

Route = Callable[[type[VecEnv], dict[str, Any], Path], VecEnv]


def by_callable(vec_env: type[VecEnv], kwargs: dict[str, Any], _: Path) -> VecEnv:
    return make_vec_env(make_dmc, n_envs=2, seed=0, env_kwargs={"task": TASK, **kwargs}, vec_env_cls=vec_env)  # type: ignore[arg-type]


def by_id(vec_env: type[VecEnv], kwargs: dict[str, Any], _: Path) -> VecEnv:
    return make_vec_env(f"sb3_crc:{ID}", n_envs=2, seed=0, env_kwargs=kwargs, vec_env_cls=vec_env)  # type: ignore[arg-type]


def by_gym_make(vec_env: type[VecEnv], kwargs: dict[str, Any], _: Path) -> VecEnv:
    return vec_env([lambda: Monitor(gym.make(f"sb3_crc:{ID}", **kwargs))] * 2)  # type: ignore[call-arg,arg-type]


def by_the_zoo(vec_env: type[VecEnv], kwargs: dict[str, Any], folder: Path) -> VecEnv:
    from sb3_crc.zoo import CRCExperimentManager, register

    register()
    manager = CRCExperimentManager(
        Namespace(),
        "crc",
        ID,
        str(folder),
        config=str(Path(__file__).parent.parent / "tiny.yml"),
        hyperparams={"n_envs": 2, "env_kwargs": kwargs},
        vec_env_type="subproc" if vec_env is SubprocVecEnv else "dummy",
        verbose=0,
        device="cpu",
    )
    model, _ = manager.setup_experiment()  # type: ignore[misc]
    assert isinstance(model.env, vec_env)
    return model.env


ROUTES = [by_callable, by_id, by_gym_make, by_the_zoo]


@pytest.mark.parametrize("vec_env", VEC_ENVS)
@pytest.mark.parametrize("route", ROUTES)
def test_episodes_are_125_decisions(route: Route, vec_env: type[VecEnv], tmp_path: Path) -> None:
    """Monitor sits outside the action repeat, whoever puts it there."""
    venv = route(vec_env, SMALL, tmp_path)
    assert venv.observation_space.shape == (6, 36, 36)
    first = venv.reset()
    assert first.shape == (2, 6, 36, 36) and first.dtype == np.uint8
    action = np.ones((2, 1), np.float32)
    for decision in range(1, 126):
        observation, _, dones, infos = venv.step(action)
        assert dones.tolist() == [decision == 125] * 2
    for info in infos:
        assert info["episode"]["l"] == 125 and info["TimeLimit.truncated"]
        assert info["episode_env_steps"] == 1000
        assert info["terminal_observation"].shape == (6, 36, 36)
    assert np.any(observation != first)
    # what checkpoints and films ask for
    assert venv.get_attr("action_repeat") == [8, 8] and venv.get_attr("frame_channels") == [3, 3]
    assert [state["simulator"]["env_steps"] for state in venv.env_method("get_state")] == [1000, 1000]
    venv.close()


@pytest.mark.parametrize(
    ("vec_env", "observation"),
    [
        (DummyVecEnv, "state"),
        pytest.param(DummyVecEnv, "pixels", marks=pytest.mark.slow),
        pytest.param(SubprocVecEnv, "state", marks=pytest.mark.slow),
        pytest.param(SubprocVecEnv, "pixels", marks=pytest.mark.slow),
        pytest.param(SubprocVecEnv, "dict", marks=pytest.mark.slow),
    ],
)
def test_a_state_goes_from_one_vec_env_into_another(vec_env: type[VecEnv], observation: str) -> None:
    """Through Monitor and processes; the environments of one VecEnv keep apart; the next episode begins equally too."""
    kwargs = {**SMALL, "observation": observation, "action_repeat": 20}
    original = by_id(vec_env, kwargs, Path())
    original.reset()
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (70, 2, 1)).astype(np.float32)
    for action in actions[:10]:
        original.step(action)
    states = original.env_method("get_state")

    copy = by_callable(DummyVecEnv, {**kwargs, "seed": 5}, Path())
    copy.reset()  # for Monitor
    for index, state in enumerate(states):
        copy.env_method("set_state", state, indices=index)
    if vec_env is SubprocVecEnv:  # and back into the processes, which are ahead by one step
        original.step(actions[0])
        for index, state in enumerate(copy.env_method("get_state")):
            original.env_method("set_state", state, indices=index)
    ends = 0
    for action in actions[10:]:
        observations, rewards, dones, infos = original.step(action)
        copied, copied_rewards, copied_dones, copied_infos = copy.step(action)
        for name in observations if observation == "dict" else [slice(None)]:
            np.testing.assert_array_equal(observations[name], copied[name])
        np.testing.assert_array_equal(np.float32(rewards), copied_rewards)  # DummyVecEnv has float32 ones
        np.testing.assert_array_equal(dones, copied_dones)
        for info, copied_info in zip(infos, copied_infos, strict=True):
            assert info["env_steps"] == copied_info["env_steps"]
            assert info["episode_env_steps"] == copied_info["episode_env_steps"]
        ends += dones.sum()
    assert ends == 2
    original.close()
    copy.close()


def test_an_unknown_id_names_the_nearest() -> None:
    with pytest.raises(gym.error.NameNotFound, match="cartpole-swingup"):
        gym.make("dmc_pixels/cartpole-swing_up-v0")
