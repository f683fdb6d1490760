"""FrameReplayBuffer: what it stores and refuses, and that a transition which it refuses leaves no trace."""

import io
import zipfile
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_crc
from sb3_crc.buffers import FrameReplayBuffer
from sb3_crc.buffers.files import save_buffer_file
from tests.buffers.worlds import ACTIONS, Transition, World, assert_equal_buffers, drawn, fill


class WholeWorld(World):
    """Observations of any space, which are no stacks."""

    def __init__(self, space: spaces.Box, n_envs: int = 1, special: float | None = None):
        super().__init__(n_envs)
        self.space, self.special = space, special
        self.space.seed(0)
        self.now = self.draw()

    def draw(self) -> np.ndarray:
        drawn = np.stack([self.space.sample() for _ in range(self.n_envs)])
        if self.special is not None:
            drawn.flat[self.rng.integers(drawn.size)] = self.special
        return drawn

    def observe(self) -> np.ndarray:
        return self.now.copy()

    def advance(self) -> None:
        self.now = self.draw()

    def start(self, env: int, how: str = "repeated") -> None:
        if hasattr(self, "now"):
            self.now[env] = self.space.sample()


WHOLE = [
    spaces.Box(0, 255, (3, 4, 5), np.uint8),
    spaces.Box(0, 255, (4, 5, 3), np.uint8),
    spaces.Box(-1, 1, (4,), np.float32),
    spaces.Box(-1, 1, (2, 3), np.float64),
    spaces.Box(-9, 9, (3,), np.int16),
    spaces.Box(0, 1, (6,), np.bool_),
]


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("space", WHOLE, ids=str)
def test_observations_that_are_not_stacks_are_stored_whole(space: spaces.Box, n_envs: int) -> None:
    world = WholeWorld(space, n_envs)
    buffer, twin = world.buffer(8, frame_channels=None), world.twin(8)
    fill(world.episodes(13, 4), buffer, twin)
    assert_equal_buffers(buffer, twin)
    # o_{t+1} is the next o_t: eight rows hold nine observations, and one more for each episode that begins in them
    assert len(buffer.store) <= n_envs * (8 + 1 + 2) + n_envs


def test_zero_and_nan_keep_their_bytes() -> None:
    """0.0 equals -0.0 but is not the same; NaN equals nothing but goes on where it is."""
    for special in (np.nan, -0.0, 0.0):
        world = WholeWorld(spaces.Box(-1, 1, (2,), np.float32), special=special)
        buffer, twin = world.buffer(30, frame_channels=None), world.twin(30)
        for _ in range(25):
            transition = world.step()
            if special == 0:  # the environment is reset to the same state, but for a sign
                world.now = np.where(world.now == 0, -world.now, world.now)
            fill([transition], buffer, twin)
        assert_equal_buffers(buffer, twin)
        if np.isnan(special):
            assert len(buffer.store) == 26


def test_a_stack_with_nan_overlaps_itself() -> None:
    space = spaces.Box(-1, 1, (2, 3), np.float32)
    buffer = FrameReplayBuffer(5, space, ACTIONS, "cpu", frame_channels=1)
    frames = np.full((4, 1, 3), np.nan, np.float32)
    for t in range(2):
        obs, next_obs = (frames[t + i : t + i + 2].reshape(1, 2, 3) for i in range(2))
        buffer.add(obs, next_obs, np.zeros((1, 2)), np.zeros(1), np.zeros(1), [{}])
    assert buffer.size() == 2 and np.isnan(buffer.observations).all()


def test_read_only_and_strided_observations_are_stored(recwarn: pytest.WarningsRecorder) -> None:
    """VecTransposeImage hands out strided views."""
    world = World(2, k=2, c=3)
    buffer, twin = world.buffer(6), world.twin(6)
    for transition in world.episodes(9):
        obs, next_obs = (np.asfortranarray(part) for part in transition[:2])
        obs.flags.writeable = next_obs.flags.writeable = False
        buffer.add(obs, next_obs, *transition[2:])
        fill([transition], twin)
    assert_equal_buffers(buffer, twin)
    assert not recwarn.list


def test_what_is_added_may_be_written_to_afterwards() -> None:
    world = World(k=2)
    buffer, twin = world.buffer(6, n_steps=3), world.twin(6, 3)
    for transition in world.episodes(9):
        fill([transition], buffer, twin)
        for part in transition[:5]:
            part[...] = 1
    assert_equal_buffers(buffer, twin)


def test_it_is_exported() -> None:
    assert sb3_crc.FrameReplayBuffer is FrameReplayBuffer
    assert sb3_crc.DictFrameReplayBuffer.__mro__[1] is FrameReplayBuffer


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"frame_channels": 2}, r"frame_channels=2 must divide the 9 channels .*\(9, 4, 5\): 1, 3, 9, or None"),
    ({"frame_channels": 0}, "frame_channels=0 must divide"),
    ({"frame_channels": -3}, "frame_channels=-3 must divide"),
    ({"frame_channels": 12}, "frame_channels=12 must divide"),
    ({"optimize_memory_usage": True}, "optimize_memory_usage=True is not supported"),
    ({"n_steps": 0}, "n_steps=0 must be at least 1"),
]


@pytest.mark.parametrize(("arguments", "message"), REFUSED)
def test_arguments_that_cannot_work_are_refused(arguments: dict[str, Any], message: str) -> None:
    space = spaces.Box(0, 255, (9, 4, 5), np.uint8)
    with pytest.raises(ValueError, match=message):
        FrameReplayBuffer(10, space, ACTIONS, "cpu", **arguments)


def test_observations_that_cannot_be_stored_are_refused() -> None:
    for dtype in (np.longdouble, np.complex256):
        space = spaces.Box(-1, 1, (4,), np.float32)
        space.dtype = np.dtype(dtype)
        with pytest.raises(ValueError, match=f"{np.dtype(dtype)} cannot be stored"):
            FrameReplayBuffer(10, space, ACTIONS, "cpu")
    with pytest.raises(ValueError, match=r"stores Box observations, got Discrete\(4\)$"):
        FrameReplayBuffer(10, spaces.Discrete(4), ACTIONS, "cpu")
    with pytest.raises(ValueError, match="DictFrameReplayBuffer"):
        FrameReplayBuffer(10, spaces.Dict({"image": space}), ACTIONS, "cpu")


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize(
    "action_space", [spaces.Box(-1, 1, (2, 3), np.float64), spaces.Discrete(4), spaces.MultiDiscrete([2, 3])], ids=str
)
def test_actions_of_any_space(action_space: spaces.Space[Any], n_envs: int) -> None:
    world = World(n_envs)
    arguments = 12, world.space, action_space, "cpu", n_envs
    buffer, twin = FrameReplayBuffer(*arguments, frame_channels=1), ReplayBuffer(*arguments)
    for transition in world.episodes(7):
        fill([transition._replace(action=np.stack([action_space.sample() for _ in range(n_envs)]))], buffer, twin)
    assert_equal_buffers(buffer, twin)


def test_time_limits_can_count_as_terminations() -> None:
    world = World(2)
    buffer = world.buffer(9, handle_timeout_termination=False)
    twin = ReplayBuffer(18, world.space, ACTIONS, "cpu", 2, handle_timeout_termination=False)
    for transition in world.episodes(14):
        fill([transition._replace(infos=[])], buffer, twin)
    assert_equal_buffers(buffer, twin)
    assert drawn(buffer).dones.any()


def test_sizes_are_sb3s() -> None:
    for size, n_envs in ((10, 1), (10, 3), (2, 3), (0, 1)):
        world = World(n_envs)
        arguments = size, world.space, ACTIONS, "cpu", n_envs
        assert FrameReplayBuffer(*arguments).buffer_size == ReplayBuffer(*arguments).buffer_size


class VectorEnv(gym.Env[np.ndarray, np.ndarray]):
    observation_space = spaces.Box(-9, 9, (3,), np.float32)
    action_space = ACTIONS

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(**kwargs)
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 3.0, False, self.np_random.random() < 0.2, {}


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("norm_obs", [False, True])
def test_vec_normalize_normalizes_what_is_sampled(norm_obs: bool, n_steps: int) -> None:
    env = VecNormalize(DummyVecEnv([VectorEnv] * 2), norm_obs=norm_obs)
    env.reset()
    for _ in range(20):
        env.step(np.zeros((2, 2)))
    world = WholeWorld(VectorEnv.observation_space, 2)
    buffer, twin = world.buffer(8, frame_channels=None, n_steps=n_steps), world.twin(8, n_steps)
    fill(world.episodes(11), buffer, twin)
    assert_equal_buffers(buffer, twin, env)
    assert not th.equal(drawn(buffer, env).rewards, drawn(buffer).rewards)
    assert th.equal(drawn(buffer, env).observations, drawn(buffer).observations) != norm_obs


def saved(buffer: FrameReplayBuffer) -> dict[str, Any]:
    """The bytes that saving writes, but for the names of files."""
    stream = io.BytesIO()
    save_buffer_file(buffer, stream)
    with zipfile.ZipFile(stream) as archive:
        contents = {name.split("-")[0]: archive.read(name) for name in archive.namelist()}
        with np.load(archive.open("index.npz")) as index:
            contents["index.npz"] = b"".join(index[key].tobytes() for key in index.files if key != "header")
    return contents | {"state": (buffer.pos, buffer.full, str(buffer.latest), buffer.store.first, buffer.store.end)}


def broken_overlap(transition: Transition, env: int) -> Transition:
    next_obs = transition.next_obs.copy()
    next_obs[env, 0, 0, 0] ^= 1
    return transition._replace(next_obs=next_obs)


BROKEN: dict[str, tuple[Callable[[Transition], Transition], str]] = {
    "overlap of environment 0": (
        lambda t: broken_overlap(t, 0),
        "transition {pos} of environment 0: .*frame_channels=1 .*None",
    ),
    "overlap of environment 2": (lambda t: broken_overlap(t, 2), "transition {pos} of environment 2: "),
    "no stack axis": (lambda t: t._replace(obs=t.obs[:, 0]), r"shape \(3, 2, 3\) do not fit .* \(3, 3, 2, 3\)"),
    "next_obs too small": (lambda t: t._replace(next_obs=t.next_obs[..., :2]), r"shape \(3, 3, 2, 2\)"),
    "too few environments": (lambda t: t._replace(obs=t.obs[:2]), r"shape \(2, 3, 2, 3\)"),
    "actions of the wrong size": (lambda t: t._replace(action=t.action[:, :1]), r"size 3 .*\(3,2\)"),
    "too few rewards": (lambda t: t._replace(reward=t.reward[:2]), "shape"),
    "too few dones": (lambda t: t._replace(done=t.done[:2]), "shape"),
    "too few infos": (lambda t: t._replace(infos=t.infos[:2]), "shape"),
}


@pytest.mark.parametrize("rows", [1, 20, 6])
@pytest.mark.parametrize("what", BROKEN)
def test_a_transition_that_is_refused_leaves_no_trace(what: str, rows: int) -> None:
    """Neither between two of an episode nor at its start, in a buffer that is full and in one that is not."""
    broken, message = BROKEN[what]
    world = World(3)
    buffer, twin = world.buffer(rows, n_steps=2), world.twin(rows, 2)
    for transition in world.episodes(11, 4):
        before = saved(buffer)
        with pytest.raises(ValueError, match=message.format(pos=buffer.pos)):
            fill([broken(transition)], buffer)
        assert saved(buffer) == before
        fill([transition], buffer, twin)
        assert_equal_buffers(buffer, twin)


@pytest.mark.parametrize("stop_at", range(6))
def test_interrupted_by_ctrl_c_all_rows_can_be_read(stop_at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The zoo saves the buffer then: its full rows must still have their frames, wherever ``add`` was stopped."""
    world = World(2)
    *transitions, last = world.episodes(9)
    buffer, twin = world.buffer(5), world.twin(5)
    fill(transitions, buffer, twin)
    append, calls = buffer.store.append, []

    def stopped(frame: np.ndarray) -> int:
        calls.append(frame)
        if len(calls) > stop_at:
            raise KeyboardInterrupt
        return append(frame)

    with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
        patch.setattr(buffer.store, "append", stopped)
        fill([last], buffer)
    if buffer.pos == twin.pos:
        assert_equal_buffers(buffer, twin)
        fill([last], buffer)
    fill([last], twin)
    fill(world.episodes(3), buffer, twin)
    assert_equal_buffers(buffer, twin)
