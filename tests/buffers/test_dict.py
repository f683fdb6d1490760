"""DictFrameReplayBuffer beside SB3's DictReplayBuffer."""

import io
import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_crc.buffers import DictFrameReplayBuffer
from sb3_crc.buffers.files import load_buffer_file, save_buffer_file
from sb3_crc.buffers.store import FrameStacks
from tests.buffers.test_replay import saved
from tests.buffers.worlds import (
    ACTIONS,
    ENDS,
    STARTS,
    DictWorld,
    Transition,
    assert_equal_buffers,
    assert_same,
    drawn,
    drawn_envs,
    fill,
)


@pytest.mark.parametrize("rows", [1, 2, 7, 40])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_the_same_is_sampled(n_envs: int, rows: int) -> None:
    world = DictWorld(n_envs, c=3)
    buffer, twin = world.buffer(rows), world.twin(rows)
    rng = np.random.default_rng(0)
    for step in range(50):
        ends = [ENDS[rng.choice(3, p=[0.8, 0.1, 0.1])] for _ in range(n_envs)]
        fill([world.step(ends, STARTS[rng.integers(3)])], buffer, twin)
        assert_equal_buffers(buffer, twin)
        if step % 9 == 5:
            world.start(0)
        if step % 10 == 7:
            buffer = pickle.loads(pickle.dumps(buffer))
        if step % 10 == 3:
            save_buffer_file(buffer, stream := io.BytesIO())
            load_buffer_file(buffer, stream)


def test_only_the_image_is_left_in_the_store() -> None:
    world = DictWorld(2)
    buffer = world.buffer(9)
    fill(world.episodes(12), buffer)
    observations = buffer.sample_frames(5).observations
    assert isinstance(observations["camera"], FrameStacks)
    assert {key: value.shape for key, value in observations.items()} == {
        "camera": (5, 3, 2, 3),
        "state": (5, 3),
        "height": (5, 1),
        "mode": (5, 1),
    }


def test_n_steps_with_vectors() -> None:
    """SB3 has no such buffer; the images are those of its NStepReplayBuffer, and the vectors lie in the same rows."""
    world = DictWorld(2, k=2)
    buffer, twin = world.buffer(9, n_steps=3), super(DictWorld, world).twin(9, 3)
    everything = world.twin(9)
    for transition in world.episodes(22):
        fill([transition], buffer, everything)
        image = [part["camera"] for part in transition[:2]]
        fill([Transition(*image, *transition[2:])], twin)
    samples, expected = drawn(buffer), drawn(twin)
    assert_same(samples.observations["camera"], expected.observations)
    assert_same(samples.next_observations["camera"], expected.next_observations)
    for field in ("rewards", "dones", "discounts", "actions"):
        assert_same(getattr(samples, field), getattr(expected, field), field)
    rows, envs = drawn_envs(buffer)
    steps = np.rint(np.log(expected.discounts.numpy()[:, 0]) / np.log(0.99)).astype(int)
    assert set(steps) == {1, 2, 3}
    for key in ("state", "height", "mode"):
        one_step, after = everything.next_observations[key], (rows + steps - 1) % 9
        assert_same(samples.one_step_observations[key].numpy(), one_step[rows, envs])
        assert_same(samples.next_observations[key].numpy(), one_step[after, envs])
        assert_same(samples.observations[key].numpy(), everything.observations[key][rows, envs])


def test_a_reset_that_shows_the_same_image_ends_the_sum() -> None:
    """The vectors tell that the trajectory does not go on."""
    world = DictWorld(2)
    buffer = world.buffer(9, n_steps=3)
    fill([world.step() for _ in range(3)], buffer)
    world.mode[1] = (world.mode[1] + 1) % 4
    fill([world.step() for _ in range(3)], buffer)
    assert np.argwhere(buffer.interrupted).tolist() == [[2, 1]]


def test_nan_among_the_vectors_goes_on() -> None:
    world = DictWorld()
    buffer = world.buffer(9, n_steps=3)
    transitions = [world.step() for _ in range(5)]
    for transition in transitions:
        transition.obs["state"][0, 1] = transition.next_obs["state"][0, 1] = np.nan
    fill(transitions, buffer)
    assert not buffer.interrupted.any()
    assert len(buffer.store) <= 5 + 3


def without(key: str) -> Any:
    return lambda obs: {name: value for name, value in obs.items() if name != key}


BROKEN: dict[str, Any] = {
    "no image": without("camera"),
    "no vector": without("mode"),
    "vector of the wrong size": lambda obs: {**obs, "state": obs["state"][:, :2]},
    "vector of too few environments": lambda obs: {**obs, "height": obs["height"][:1]},
    "image of the wrong size": lambda obs: {**obs, "camera": obs["camera"][..., 1:]},
}


@pytest.mark.parametrize("part", ["obs", "next_obs"])
@pytest.mark.parametrize("what", BROKEN)
def test_a_transition_that_is_refused_leaves_no_trace(what: str, part: str) -> None:
    world = DictWorld(2)
    buffer, twin = world.buffer(4), world.twin(4)
    for transition in world.episodes(9):
        before = saved(buffer)
        with pytest.raises((ValueError, KeyError)):
            fill([transition._replace(**{part: BROKEN[what](getattr(transition, part))})], buffer)
        assert saved(buffer) == before
        fill([transition], buffer, twin)
        assert_equal_buffers(buffer, twin)


IMAGE = spaces.Box(0, 255, (3, 40, 40), np.uint8)


@pytest.mark.parametrize("others", [{}, {"second": IMAGE}])
def test_one_image_is_needed(others: dict[str, spaces.Space[Any]]) -> None:
    without_image = spaces.Dict({"state": spaces.Box(-1, 1, (3,)), **others, **({"third": IMAGE} if others else {})})
    with pytest.raises(ValueError, match="one uint8 image .* found (none|2)"):
        DictFrameReplayBuffer(10, without_image, ACTIONS, "cpu")
    with pytest.raises(ValueError, match="expected Dict observations"):
        DictFrameReplayBuffer(10, IMAGE, ACTIONS, "cpu")


def test_an_image_alone_in_a_dict() -> None:
    world = DictWorld()
    world.dict_space = spaces.Dict({"camera": world.image_space})
    buffer, twin = world.buffer(6), world.twin(6)
    transitions = world.episodes(9)
    for transition in transitions:
        alone = [{"camera": part["camera"]} for part in transition[:2]]
        fill([Transition(*alone, *transition[2:])], buffer, twin)
        assert_equal_buffers(buffer, twin)


class BothEnv(gym.Env[dict[str, np.ndarray], np.ndarray]):
    action_space = ACTIONS

    def __init__(self, world: DictWorld):
        self.observation_space = spaces.Dict({key: world.dict_space[key] for key in ("camera", "state", "height")})

    def reset(self, **kwargs: Any) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        super().reset(**kwargs)
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 3.0, False, False, {}


def test_vec_normalize_normalizes_vectors() -> None:
    world = DictWorld(2)
    world.dict_space = BothEnv(world).observation_space
    env = VecNormalize(DummyVecEnv([lambda: BothEnv(world)] * 2), norm_obs_keys=["state"])
    env.reset()
    for _ in range(20):
        env.step(np.zeros((2, 2)))
    buffer, twin = world.buffer(6), world.twin(6)
    fill(world.episodes(9), buffer, twin)
    assert_equal_buffers(buffer, twin, env)
    for key in world.dict_space:
        normalized, raw = (drawn(buffer, e).observations[key] for e in (env, None))
        assert np.array_equal(normalized, raw) == (key != "state")
