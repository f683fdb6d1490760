"""Transitions to fill buffers with, and what is compared of two buffers.

N environments, k frames in a stack, C channels of a frame.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer

from sb3_crc.buffers import DictFrameReplayBuffer, FrameReplayBuffer

ACTIONS = spaces.Box(-1, 1, (2,), np.float32)
FIELDS = ("observations", "actions", "next_observations", "dones", "rewards", "discounts")
#: How an episode's first observation comes about: dm_control, SB3's VecFrameStack, anything else
STARTS = ("repeated", "zero_padded", "arbitrary")
#: How a transition ends
ENDS = ("goes_on", "terminated", "truncated")


class Transition(NamedTuple):
    """The arguments of ``ReplayBuffer.add``."""

    obs: Any
    next_obs: Any
    action: np.ndarray
    reward: np.ndarray
    done: np.ndarray
    infos: list[dict[str, Any]]


class World:
    """N environments that show stacks of k frames; some frames are black, so that pictures come up again."""

    def __init__(self, n_envs: int = 1, k: int = 3, c: int = 1, size: tuple[int, int] = (2, 3), seed: int = 0):
        self.n_envs, self.k, self.c = n_envs, k, c
        self.rng = np.random.default_rng(seed)
        self.space = spaces.Box(0, 255, (k * c, *size), np.uint8)
        self.stacks = np.zeros((n_envs, k, c, *size), np.uint8)
        for env in range(n_envs):
            self.start(env)

    def frame(self) -> np.ndarray:
        return self.rng.integers(0, 256, self.stacks.shape[2:], np.uint8) * np.uint8(self.rng.random() > 0.2)

    def start(self, env: int, how: str = "repeated") -> None:
        self.stacks[env] = 0
        self.stacks[env, -1] = self.frame()
        if how == "repeated":
            self.stacks[env] = self.stacks[env, -1]
        elif how == "arbitrary":
            self.stacks[env] = [self.frame() for _ in range(self.k)]

    def observe(self) -> Any:
        return self.stacks.reshape(self.n_envs, *self.space.shape).copy()

    def step(self, ends: Sequence[str] = (), how: str = "repeated") -> Transition:
        """:param ends: of each environment; :param how: those that end start again"""
        ends = [*ends, *["goes_on"] * (self.n_envs - len(ends))]
        obs = self.observe()
        self.stacks = np.concatenate([self.stacks[:, 1:], [[self.frame()] for _ in range(self.n_envs)]], axis=1)
        self.advance()
        next_obs = self.observe()
        for env in range(self.n_envs):
            if ends[env] != "goes_on":
                self.start(env, how)
        action, reward = self.rng.uniform(-1, 1, (self.n_envs, 2)).astype(np.float32), self.rng.normal(size=self.n_envs)
        done = np.array([end != "goes_on" for end in ends])
        return Transition(obs, next_obs, action, reward, done, [{"TimeLimit.truncated": end == "truncated"} for end in ends])

    def advance(self) -> None:
        """Change what is beside the image."""

    def episodes(self, steps: int, length: int = 5) -> list[Transition]:
        """Episodes of that length, each second one truncated, environments out of step with each other."""
        transitions = []
        for step in range(steps):
            at = [step + env + 1 for env in range(self.n_envs)]
            ends = ["goes_on" if t % length else ENDS[1 + t // length % 2] for t in at]
            transitions.append(self.step(ends, STARTS[step // length % 3]))
        return transitions

    def buffer(self, rows: int, **kwargs: Any) -> FrameReplayBuffer:
        kwargs = {"frame_channels": self.c, **kwargs}
        return FrameReplayBuffer(rows * self.n_envs, self.space, ACTIONS, "cpu", self.n_envs, **kwargs)

    def twin(self, rows: int, n_steps: int = 1, gamma: float = 0.99) -> ReplayBuffer:
        """SB3's buffer."""
        if n_steps == 1:
            return ReplayBuffer(rows * self.n_envs, self.space, ACTIONS, "cpu", self.n_envs)
        arguments = (rows * self.n_envs, self.space, ACTIONS, "cpu", self.n_envs)
        return NStepReplayBuffer(*arguments, n_steps=n_steps, gamma=gamma)


class DictWorld(World):
    """As World, and proprioception: a vector, one number, a name of one of four, and a double."""

    def __init__(self, n_envs: int = 1, k: int = 3, c: int = 1, seed: int = 0):
        super().__init__(n_envs, k, c, seed=seed)
        self.image_space = self.space
        self.dict_space = spaces.Dict(
            {
                "state": spaces.Box(-np.inf, np.inf, (3,), np.float32),
                "camera": self.image_space,
                "height": spaces.Box(-1, 1, (1,), np.float64),
                "mode": spaces.Discrete(4),
            }
        )
        self.advance()

    def advance(self) -> None:
        self.state = self.rng.normal(size=(self.n_envs, 3)).astype(np.float32)
        self.height = self.rng.uniform(-1, 1, (self.n_envs, 1))
        self.mode = self.rng.integers(0, 4, self.n_envs)

    def observe(self) -> dict[str, np.ndarray]:
        vectors = {"state": self.state.copy(), "height": self.height.copy(), "mode": self.mode.copy()}
        return {"camera": super().observe(), **vectors}

    def buffer(self, rows: int, **kwargs: Any) -> DictFrameReplayBuffer:
        kwargs = {"frame_channels": self.c, **kwargs}
        return DictFrameReplayBuffer(rows * self.n_envs, self.dict_space, ACTIONS, "cpu", self.n_envs, **kwargs)

    def twin(self, rows: int, n_steps: int = 1, gamma: float = 0.99) -> DictReplayBuffer:
        assert n_steps == 1  # SB3 has no other for Dict observations
        return DictReplayBuffer(rows * self.n_envs, self.dict_space, ACTIONS, "cpu", self.n_envs)


def fill(transitions: Sequence[Transition], *buffers: ReplayBuffer) -> None:
    for transition in transitions:
        for buffer in buffers:
            obs, next_obs = ({**part} if isinstance(part, dict) else part for part in transition[:2])  # SB3 writes to these
            buffer.add(obs, next_obs, *transition[2:])


def drawn(buffer: ReplayBuffer, env: Any = None, seed: int = 7) -> Any:
    """Each row three times, of environments that are drawn."""
    np.random.seed(seed)
    return buffer._get_samples(np.repeat(np.arange(buffer.size()), 3), env=env)


def drawn_envs(buffer: ReplayBuffer, seed: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """Rows and environments of ``drawn``."""
    np.random.seed(seed)
    rows = np.repeat(np.arange(buffer.size()), 3)
    return rows, np.random.randint(0, buffer.n_envs, size=rows.shape)


def assert_same(one: Any, other: Any, what: str = "") -> None:
    """Same type, shape and bytes."""
    if isinstance(other, Mapping):
        assert one.keys() == other.keys(), what
        for key in other:
            assert_same(one[key], other[key], f"{what}/{key}")
        return
    if other is None:
        assert one is None, what
        return
    assert type(one) is type(other) and one.dtype == other.dtype and one.shape == other.shape, what
    one, other = (x.numpy() if isinstance(x, th.Tensor) else x for x in (one, other))
    assert np.ascontiguousarray(one).tobytes() == np.ascontiguousarray(other).tobytes(), what


def assert_equal_buffers(buffer: FrameReplayBuffer, twin: ReplayBuffer, env: Any = None) -> None:
    assert (buffer.pos, buffer.full, buffer.size()) == (twin.pos, twin.full, twin.size())
    if not twin.size():
        return
    one, other = drawn(buffer, env), drawn(twin, env)
    for field in FIELDS:
        assert_same(getattr(one, field), getattr(other, field), field)
    for field in ("observations", "next_observations"):
        assert_same(getattr(buffer, field), first_rows(getattr(twin, field), twin.size()), field)


def first_rows(observations: Any, size: int) -> Any:
    if isinstance(observations, Mapping):
        return {key: values[:size] for key, values in observations.items()}
    return observations[:size]


def files_of(folder: Path) -> dict[str, tuple[int, int]]:
    """Inode and time of change of each file."""
    return {file.name: (file.stat().st_ino, file.stat().st_mtime_ns) for file in folder.iterdir()}
