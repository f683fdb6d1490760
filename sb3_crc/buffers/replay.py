"""Replay buffers for stacks of frames, in which each frame is stored once.

B batch, k frames in a stack, C channels of a frame, H, W height and width, A action, N ``n_envs``.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize
from typing_extensions import Self

from sb3_crc.buffers.placement import PlacedReplayBuffer
from sb3_crc.buffers.rows import as_row, n_step_returns, same_bytes
from sb3_crc.buffers.samples import FrameSamples, whole
from sb3_crc.buffers.store import SLACK, FrameStacks, FrameStore


class Latest(NamedTuple):
    """The last next_obs of an environment and the numbers of its frames; nothing before the first and after a reset."""

    stack: np.ndarray | None = None
    numbers: list[int] = []  # noqa: RUF012  # never written to


class FrameReplayBuffer(PlacedReplayBuffer):
    """
    SB3's ReplayBuffer, and its NStepReplayBuffer, in a sixth of the memory for stacks of three frames: each frame is stored
    once, and a transition keeps the numbers of its frames. The same transitions are sampled with the same random numbers.

    The frames lie on ``frame_device``. They take memory as they come, not before; on a GPU all of it with the first.

    A transition whose observation is not the one that the previous transition led to starts a new trajectory, whether the
    previous one was done or the environment was reset early; n-step returns end there and bootstrap.

    :param buffer_size: capacity in transitions
    :param observation_space: a Box
    :param action_space: as in SB3
    :param device: where samples are returned
    :param n_envs: number N of environments
    :param optimize_memory_usage: must be False: there is nothing left to optimise
    :param handle_timeout_termination: as in SB3: a time limit is no termination
    :param frame_channels: channels C of one frame, where an observation is a stack of k frames along its first axis, newest
        last; None: observations are stored whole (and once, not as both obs and next_obs)
    :param n_steps: rewards that are summed before the return is bootstrapped
    :param gamma: discount in that sum
    :param frame_device: where frames are stored; None: on ``device``
    :raises ValueError: for arguments that cannot work, naming the value and what is allowed
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        *,
        frame_channels: int | None = None,
        n_steps: int = 1,
        gamma: float = 0.99,
        frame_device: th.device | str | None = None,
    ):
        self._frame_device = None if frame_device is None else th.device(frame_device)
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs)
        if optimize_memory_usage:
            raise ValueError(f"optimize_memory_usage=True is not supported by {type(self).__name__}: frames are stored once")
        if n_steps < 1:
            raise ValueError(f"n_steps={n_steps} must be at least 1")
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.n_steps = n_steps
        self.gamma = gamma

        space = self._stacked_space()
        assert space.shape is not None
        self.frame_channels = frame_channels
        self.stack_size, frame_shape = _frames_of(space.shape, frame_channels)
        transitions = self.buffer_size * n_envs
        capacity = transitions + round(SLACK * transitions) + n_envs * (self.stack_size + 1)
        self.store = FrameStore(frame_shape, space.dtype, capacity, self.frame_device)

        rows = self.buffer_size, n_envs
        #: Numbers of the frames of each transition: o_t is all but the last, o_{t+1} all but the first
        self.frame_numbers = np.zeros((*rows, self.stack_size + 1), np.int64)
        self.actions = np.zeros((*rows, self.action_dim), self._maybe_cast_dtype(action_space.dtype))
        self.rewards = np.zeros(rows, np.float32)
        self.dones = np.zeros(rows, np.float32)
        self.timeouts = np.zeros(rows, np.float32)
        #: Where a trajectory ends that is not done: the next transition of this environment starts elsewhere
        self.interrupted = np.zeros(rows, np.bool_)
        #: The last next_obs of each environment
        self.latest = [Latest()] * n_envs
        #: Files of :mod:`~sb3_crc.buffers.files` that hold frames of this buffer
        self.segments: tuple[Any, ...] = ()
        self._ahead = 0

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_warned": False}

    # -- Saving --------------------------------------------------------------------------------------------------------

    def arrays(self) -> dict[str, np.ndarray]:
        """:return: everything but the frames, by name, each of shape ``(buffer_size, N, ...)``"""
        names = ("frame_numbers", "actions", "rewards", "dones", "timeouts", "interrupted")
        return {name: getattr(self, name) for name in names}

    def vector_shapes(self) -> dict[str, tuple[int, ...]]:
        """:return: shapes of what is stored beside the image, by key"""
        return {}

    def empty_copy(self, buffer_size: int, frame_channels: int | None) -> Self:
        """
        :param buffer_size: capacity in transitions
        :param frame_channels: channels of a frame
        :return: an empty buffer with otherwise the same settings
        """
        return type(self)(
            buffer_size,
            self.observation_space,
            self.action_space,
            self.device,
            self.n_envs,
            handle_timeout_termination=self.handle_timeout_termination,
            frame_channels=frame_channels,
            n_steps=self.n_steps,
            gamma=self.gamma,
            frame_device=self._frame_device,
        )

    def restore(self, arrays: Mapping[str, np.ndarray], pos: int, *, full: bool, latest: list[list[int]]) -> None:
        """
        Fill an empty buffer whose store has its frames already.

        :param arrays: what :meth:`arrays` returned, its first ``size`` rows
        :param pos: row that is written next
        :param full: whether all rows have been written
        :param latest: numbers of the frames of each environment's last next_obs
        :raises ValueError: if an array is missing or does not fit
        """
        self.pos, self.full = pos, full
        for name, values in self.arrays().items():
            room, stored = values[: self.size()], arrays[name]
            if (stored.shape, stored.dtype) != (room.shape, room.dtype):
                raise ValueError(f"{name} is {stored.dtype} {stored.shape} there and {room.dtype} {room.shape} here")
            room[:] = stored
        self.latest = [Latest(self._stack(numbers), numbers) if numbers else Latest() for numbers in latest]

    def _stack(self, numbers: list[int]) -> np.ndarray:
        return np.concatenate([self.store.read(number, number + 1) for number in numbers])

    # -- Writing -------------------------------------------------------------------------------------------------------

    def add(
        self,
        obs: Any,
        next_obs: Any,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one transition of each environment.

        :param obs: ``(N, k C, H, W)``
        :param next_obs: the same; where ``done``, the last observation of the episode
        :param action: ``(N, A)``
        :param reward: ``(N,)``
        :param done: ``(N,)``
        :param infos: N dicts; ``TimeLimit.truncated`` is read
        :raises ValueError: for arguments of other shapes, or if ``next_obs`` is not ``obs`` shifted by one frame; the buffer
            stays as it was
        """
        stacks, next_stacks = self._stacks(obs), self._stacks(next_obs)  # (N, k, C, H, W)
        row = self._vectors(obs, next_obs) | self._scalars(action, reward, done, infos)
        self._check_overlap(stacks, next_stacks)
        self.warn_if_too_large()
        numbers = [self._append(env, stacks[env], next_stacks[env, -1], row) for env in range(self.n_envs)]
        arrays = self.arrays()
        for name, values in {**row, "frame_numbers": numbers, "interrupted": False}.items():
            arrays[name][self.pos] = values
        self.latest = [Latest(next_stacks[env].copy(), numbers[env][1:]) for env in range(self.n_envs)]
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full = True
            self.pos = 0
        if self.full:  # numbers only rise: what the oldest row does not use, none uses
            self.store.drop_before(int(self.frame_numbers[self.pos].min()))

    def interrupt(self) -> None:
        """Say that the environments were reset: what is added next does not continue what was added last."""
        for env in range(self.n_envs):
            self._interrupt(env)

    def reset(self) -> None:
        """Forget all transitions."""
        super().reset()
        self.store.clear()
        self.interrupted[:] = False
        self.latest = [Latest()] * self.n_envs
        self.segments = ()

    def _stacks(self, obs: Any) -> np.ndarray:
        """:return: the images as frames, ``(N, k, C, H, W)``"""
        images = np.asarray(self._images(obs))
        shape = self.n_envs, *self._stacked_space().shape
        if images.shape != shape:
            hint = "; VecNormalize belongs around VecTransposeImage" * (images.ndim == 4 and images.shape[3] == shape[1])
            raise ValueError(f"observations of shape {images.shape} do not fit the buffer, which stores {shape}{hint}")
        stacks = np.ascontiguousarray(images, self.store.dtype)
        return stacks.reshape(self.n_envs, self.stack_size, *self.store.shape)

    def _scalars(
        self, action: np.ndarray, reward: np.ndarray, done: np.ndarray, infos: list[dict[str, Any]]
    ) -> dict[str, np.ndarray]:
        """:return: one row of each of these arrays"""
        row: dict[str, Any] = {"rewards": reward, "dones": done, "timeouts": False}
        row["actions"] = np.asarray(action).reshape(self.n_envs, self.action_dim)
        if self.handle_timeout_termination:
            row["timeouts"] = [info.get("TimeLimit.truncated", False) for info in infos]
        return {name: as_row(getattr(self, name), values) for name, values in row.items()}

    def _check_overlap(self, stacks: np.ndarray, next_stacks: np.ndarray) -> None:
        if same_bytes(stacks[:, 1:], next_stacks[:, :-1]):
            return
        env = next(e for e in range(self.n_envs) if not same_bytes(stacks[e, 1:], next_stacks[e, :-1]))
        raise ValueError(
            f"transition {self.pos} of environment {env}: next_obs is not obs shifted by one frame of frame_channels="
            f"{self.frame_channels} channels. If observations are not stacks of frames, or something changes them after "
            "they are stacked, store them whole: replay_buffer_kwargs={'frame_channels': None}"
        )

    def _continues(self, env: int, stack: np.ndarray, row: dict[str, np.ndarray]) -> bool:
        latest = self.latest[env].stack
        return latest is not None and same_bytes(latest, stack)

    def _interrupt(self, env: int) -> None:
        if self.latest[env].stack is not None:
            self.interrupted[self.pos - 1, env] = not self.dones[self.pos - 1, env]
        self.latest[env] = Latest()

    def _append(self, env: int, stack: np.ndarray, newest: np.ndarray, row: dict[str, np.ndarray]) -> list[int]:
        """
        Store what is new of a transition.

        :return: numbers of its frames
        """
        if self._continues(env, stack, row):
            return [*self.latest[env].numbers, self.store.append(newest)]
        self._interrupt(env)
        numbers: list[int] = []
        for index, frame in enumerate(stack):  # in an episode's first observation, the first picture may stand k times
            same = index > 0 and same_bytes(frame, stack[index - 1])
            numbers.append(numbers[-1] if same else self.store.append(frame))
        return [*numbers, self.store.append(newest)]

    # -- Reading -------------------------------------------------------------------------------------------------------

    def sample_frames(self, batch_size: int, env: VecNormalize | None = None) -> FrameSamples:
        """
        As ``sample``, but the observations stay in the store: read them before anything is added.

        :param batch_size: B
        :param env: normalises rewards, and observations if it does so; these are gathered at once
        :return: B transitions, drawn with replacement
        """
        rows = np.random.randint(0, self._rows_to_sample(), size=batch_size)
        return self._frame_samples(rows, env)

    @contextmanager
    def one_ahead(self) -> Iterator[None]:
        """Within it batches are drawn as if the next transition of each environment were stored already."""
        self._ahead = 1
        try:
            yield
        finally:
            self._ahead = 0

    def next_batch_is_there(self, batch_size: int) -> bool:
        """
        Look ahead; the batch can still be drawn.

        :param batch_size: B
        :return: whether no return of it reaches a row that is to be written
        """
        state = np.random.get_state()
        rows = np.random.randint(0, self._rows_to_sample(), size=batch_size)
        np.random.set_state(state)
        return self._ahead == 0 or bool(((self.pos - rows) % self.buffer_size >= self.n_steps).all())

    def _rows_to_sample(self) -> int:
        return min(self.size() + self._ahead, self.buffer_size)

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> Any:
        return self._frame_samples(batch_inds, env).whole()

    def _frame_samples(self, rows: np.ndarray, env: VecNormalize | None) -> FrameSamples:
        envs = np.random.randint(0, self.n_envs, size=rows.shape)  # as in SB3, also for a single one
        steps = (rows[:, None] + np.arange(self.n_steps)) % self.buffer_size, envs[:, None]  # (B, n)
        rewards = self._normalize_reward(self.rewards[steps], env)
        last, discounts = rows, None
        if self.n_steps > 1:
            taken, rewards, discounts = n_step_returns(rewards, self._ends(steps), self.gamma)
            last = steps[0][np.arange(len(rows)), taken - 1]
        one_step = self._observations(rows, envs, env, following=True)
        return FrameSamples(
            self._observations(rows, envs, env, following=False),
            self.to_torch(self.actions[rows, envs]),
            one_step if self.n_steps == 1 else self._observations(last, envs, env, following=True),
            self.to_torch((self.dones[last, envs] * (1 - self.timeouts[last, envs]))[:, None]),
            self.to_torch(rewards),
            None if discounts is None else self.to_torch(discounts),
            one_step,
        )

    def _ends(self, steps: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """:return: whether what is stored after each of these steps is not what followed it"""
        newest = steps[0] == (self.pos - 1) % self.buffer_size  # the oldest transition comes after it
        ends: np.ndarray = (self.dones[steps] > 0) | (self.timeouts[steps] > 0) | self.interrupted[steps] | newest
        return ends

    @property
    def observations(self) -> Any:  # type: ignore[override]
        """o_t of all stored transitions, gathered: ``(size, N, k C, H, W)``, as much memory as SB3 needs for them."""
        return self._all_observations(following=False)

    @property
    def next_observations(self) -> Any:  # type: ignore[override]
        """o_{t+1} of all stored transitions, like ``observations``."""
        return self._all_observations(following=True)

    def _all_observations(self, *, following: bool) -> Any:
        rows, envs = (index.flatten() for index in np.indices((self.size(), self.n_envs)))
        shape = self.size(), self.n_envs
        everything = whole(self._observations(rows, envs, None, following=following))
        if isinstance(everything, Mapping):
            return {key: values.cpu().numpy().reshape(*shape, *values.shape[1:]) for key, values in everything.items()}
        return everything.cpu().numpy().reshape(*shape, *everything.shape[1:])

    def _frame_stacks(self, rows: np.ndarray, envs: np.ndarray, following: bool) -> FrameStacks:
        numbers = self.frame_numbers[rows, envs]
        return FrameStacks(self.store, numbers[:, 1:] if following else numbers[:, :-1], self.device)

    # -- What DictFrameReplayBuffer does otherwise ---------------------------------------------------------------------

    def _stacked_space(self) -> spaces.Box:
        if not isinstance(self.observation_space, spaces.Box):
            hint = "; for Dict observations there is DictFrameReplayBuffer" * isinstance(self.observation_space, spaces.Dict)
            raise ValueError(f"{type(self).__name__} stores Box observations, got {self.observation_space}{hint}")
        return self.observation_space

    def _images(self, obs: Any) -> Any:
        return obs

    def _vectors(self, obs: Any, next_obs: Any) -> dict[str, np.ndarray]:
        return {}

    def _observations(self, rows: np.ndarray, envs: np.ndarray, env: VecNormalize | None, *, following: bool) -> Any:
        stacks = self._frame_stacks(rows, envs, following)
        if env is None or not env.norm_obs:
            return stacks
        normalized = self._normalize_obs(stacks.whole().cpu().numpy(), env)
        assert isinstance(normalized, np.ndarray)
        return self.to_torch(normalized)


def _frames_of(shape: tuple[int, ...], frame_channels: int | None) -> tuple[int, tuple[int, ...]]:
    """:return: k and the shape of a frame"""
    if frame_channels is None:
        return 1, shape
    if frame_channels < 1 or shape[0] % frame_channels != 0:
        divisors = [str(c) for c in range(1, shape[0] + 1) if shape[0] % c == 0]
        raise ValueError(
            f"frame_channels={frame_channels} must divide the {shape[0]} channels of observations {shape}: "
            f"{', '.join(divisors)}, or None to store them whole"
        )
    return shape[0] // frame_channels, (frame_channels, *shape[1:])
