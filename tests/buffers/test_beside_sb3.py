"""FrameReplayBuffer beside SB3's buffers: whatever happens, the same is sampled.

N environments, k frames in a stack, C channels of a frame.
"""

import io
import pickle
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from sb3_crc.buffers.files import load_buffer_file, save_buffer_file
from tests.buffers.worlds import ENDS, STARTS, World, assert_equal_buffers, assert_same, drawn, drawn_envs, fill

REPEATABLE: dict[str, Any] = {"deadline": None, "derandomize": True, "suppress_health_check": list(HealthCheck)}


class BesideSB3(RuleBasedStateMachine):
    """One buffer of each kind gets the same transitions; an early reset is a truncation to SB3's, which knows none."""

    @initialize(
        n_envs=st.integers(1, 3),
        k=st.integers(1, 4),
        c=st.sampled_from([1, 3]),
        rows=st.sampled_from([1, 2, 3, 5, 8, 20]),
        n_steps=st.sampled_from([1, 1, 2, 3, 5]),
        seed=st.integers(0, 99),
    )
    def make(self, n_envs: int, k: int, c: int, rows: int, n_steps: int, seed: int) -> None:
        self.world = World(n_envs, k, c, seed=seed)
        self.fresh = lambda: self.world.buffer(rows, n_steps=n_steps, gamma=0.9)
        self.buffer, self.twin = self.fresh(), self.world.twin(rows, n_steps, 0.9)
        self.last: list[np.ndarray | None] = [None] * n_envs
        self.folder = tempfile.TemporaryDirectory()

    def teardown(self) -> None:
        self.folder.cleanup()

    def add(self, ends: list[str], how: str) -> None:
        transition = self.world.step(ends, how)
        for env, last in enumerate(self.last):
            if last is not None and not np.array_equal(last, transition.obs[env]):
                self.interrupted(env)
        fill([transition], self.buffer, self.twin)
        self.last = list(transition.next_obs)

    def interrupted(self, env: int) -> None:
        if not self.twin.dones[self.twin.pos - 1, env]:
            self.twin.timeouts[self.twin.pos - 1, env] = True

    @rule(steps=st.integers(1, 6))
    def go_on(self, steps: int) -> None:
        for _ in range(steps):
            self.add([], "repeated")

    @rule(ends=st.lists(st.sampled_from(ENDS), max_size=3), how=st.sampled_from(STARTS))
    def end(self, ends: list[str], how: str) -> None:
        self.add(ends[: self.world.n_envs], how)

    @rule(env=st.integers(0, 2), how=st.sampled_from(STARTS))
    def reset_early(self, env: int, how: str) -> None:
        self.world.start(env % self.world.n_envs, how)

    @rule()
    def interrupt(self) -> None:
        """What comes next looks like a continuation, and is none."""
        self.buffer.interrupt()
        for env, last in enumerate(self.last):
            if last is not None:
                self.interrupted(env)
        self.last = [None] * self.world.n_envs

    @rule()
    def forget(self) -> None:
        self.buffer.reset()
        self.twin.reset()
        self.last = [None] * self.world.n_envs

    @rule(go_on=st.booleans())
    def save_to_folder(self, go_on: bool) -> None:
        """Again and again to the same; sometimes training goes on with what was saved, sometimes with what was loaded."""
        path = Path(self.folder.name) / "buffer"
        save_buffer_file(self.buffer, path)
        loaded = self.fresh()
        load_buffer_file(loaded, path)
        if go_on:
            assert_equal_buffers(loaded, self.twin)
        else:
            self.buffer = loaded

    @rule()
    def save_to_stream(self) -> None:
        stream = io.BytesIO()
        save_buffer_file(self.buffer, stream)
        self.buffer = self.fresh()
        stream.seek(0)
        load_buffer_file(self.buffer, stream)

    @rule()
    def save_as_pickle(self) -> None:
        self.buffer = pickle.loads(pickle.dumps(self.buffer))

    @invariant()
    def the_same_is_sampled(self) -> None:
        if not hasattr(self, "buffer"):
            return
        assert_equal_buffers(self.buffer, self.twin)
        if self.twin.size():
            rows, envs = drawn_envs(self.twin)
            assert_same(drawn(self.buffer).one_step_observations.numpy(), self.twin.next_observations[rows, envs])

    @invariant()
    def no_frame_is_kept_for_nothing(self) -> None:
        if not hasattr(self, "buffer"):
            return
        used = np.unique(self.buffer.frame_numbers[: self.buffer.size()])
        n_envs, k = self.world.n_envs, self.world.k
        # While one environment shows a frame, others may have been reset k times
        assert len(used) <= len(self.buffer.store) <= len(used) + (n_envs - 1) * k * (k + 1)
        assert not len(used) or (self.buffer.store.first <= used[0] and used[-1] < self.buffer.store.end)


TestBesideSB3 = BesideSB3.TestCase
TestBesideSB3.settings = settings(max_examples=40, stateful_step_count=30, **REPEATABLE)
