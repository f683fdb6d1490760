"""n-step returns against a loop over the stored steps, and against SB3's NStepReplayBuffer where the two agree."""

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_crc.buffers import FrameReplayBuffer
from sb3_crc.buffers.rows import n_step_returns
from tests.buffers.worlds import ENDS, Transition, World, assert_equal_buffers, assert_same, drawn, drawn_envs, fill

GAMMA = 0.9
REPEATABLE: dict[str, Any] = {"deadline": None, "derandomize": True, "suppress_health_check": list(HealthCheck)}


def returns_of(episode: list[tuple[Transition, str]], env: int, start: int, n_steps: int) -> dict[str, Any]:
    """What is to be sampled for one step, from the steps of one environment that are still stored, oldest first."""
    rewards, discount = 0.0, 1.0
    for transition, end in episode[start : start + n_steps]:
        rewards += discount * transition.reward[env]
        discount *= GAMMA
        if end != "goes_on":
            break
    return {
        "observations": episode[start][0].obs[env],
        "actions": episode[start][0].action[env],
        "one_step_observations": episode[start][0].next_obs[env],
        "next_observations": transition.next_obs[env],
        "dones": [float(end == "terminated")],
        "rewards": [rewards],
        "discounts": [discount],
    }


@settings(max_examples=60, **REPEATABLE)
@given(
    n_envs=st.integers(1, 2),
    rows=st.integers(1, 12),
    n_steps=st.integers(2, 6),
    events=st.lists(st.sampled_from([*ENDS, *["goes_on"] * 5, "reset early"]), min_size=1, max_size=30),
)
def test_sums_end_where_an_episode_does_and_at_early_resets(n_envs: int, rows: int, n_steps: int, events: list[str]) -> None:
    world = World(n_envs)
    buffer = world.buffer(rows, n_steps=n_steps, gamma=GAMMA)
    history: list[list[tuple[Transition, str]]] = [[] for _ in range(n_envs)]
    for step, event in enumerate(events):
        end = event if event in ENDS else "goes_on"
        ends = [end if env == step % n_envs else "goes_on" for env in range(n_envs)]
        transition = world.step(ends)
        if event == "reset early":
            world.start(step % n_envs, "arbitrary")
            ends[step % n_envs] = event
        buffer.add(*transition)
        for env in range(n_envs):
            history[env] = [*history[env], (transition, ends[env])][-rows:]

    samples, (at, envs) = drawn(buffer), drawn_envs(buffer)
    oldest = buffer.pos if buffer.full else 0
    for index, (row, env) in enumerate(zip(at, envs, strict=True)):
        expected = returns_of(history[env], env, (row - oldest) % rows, n_steps)
        for field, value in expected.items():
            sampled = getattr(samples, field)[index].numpy()
            if field in ("rewards", "discounts"):
                assert sampled == pytest.approx(np.float32(value), abs=1e-6), field
            else:
                assert np.array_equal(sampled, value), field


def interrupted(n_steps: int, how: str) -> FrameReplayBuffer:
    """Five steps without an end, then an interruption, then five more."""
    world = World(k=1)
    buffer = world.buffer(20, n_steps=n_steps, gamma=GAMMA)
    fill([world.step() for _ in range(5)], buffer)
    if how == "interrupt":
        buffer.interrupt()
        buffer.interrupt()
    elif how == "reset early":
        world.start(0)
    fill([world.step() for _ in range(5)], buffer)
    return buffer


@pytest.mark.parametrize("how", ["", "interrupt", "reset early"])
def test_an_interruption_ends_the_sum_and_bootstraps(how: str) -> None:
    buffer = interrupted(3, how)
    rows, _ = drawn_envs(buffer)
    steps = np.minimum(3, np.array([10 - row for row in range(10)]))  # the newest is the last
    if how:
        steps[:5] = np.minimum(3, 5 - np.arange(5))
    samples = drawn(buffer)
    assert np.allclose(samples.discounts[:, 0], GAMMA ** steps[rows])
    assert not samples.dones.any()
    assert_same(samples.next_observations.numpy(), buffer.next_observations[rows + steps[rows] - 1, 0])
    assert list(np.flatnonzero(buffer.interrupted)) == [4] * bool(how)


def test_an_interruption_after_an_end_changes_nothing() -> None:
    world = World(2)
    buffer, twin = world.buffer(9, n_steps=3), world.twin(9, 3)
    buffer.interrupt()
    fill([world.step(["truncated", "terminated"])], buffer, twin)
    buffer.interrupt()
    fill(world.episodes(5), buffer, twin)
    assert not buffer.interrupted.any()
    assert_equal_buffers(buffer, twin)


def test_a_row_that_is_written_again_is_not_interrupted_any_more() -> None:
    buffer = interrupted(3, "interrupt")
    world = World(k=1, seed=1)
    fill([world.step() for _ in range(15)], buffer)
    assert list(np.flatnonzero(buffer.interrupted)) == [9]  # where the other world began


def test_a_truncation_bootstraps_at_its_frame_and_a_termination_does_not() -> None:
    world = World(2, k=2)
    buffer = world.buffer(9, n_steps=4, gamma=GAMMA)
    first = world.step()
    last = world.step(["truncated", "terminated"])
    fill([first, last, *(world.step() for _ in range(4))], buffer)
    _, envs = drawn_envs(buffer)
    samples = drawn(buffer)
    for index in range(3):  # of row 0
        env = envs[index]
        assert samples.dones[index].item() == env
        assert samples.discounts[index].item() == pytest.approx(GAMMA**2)
        assert np.array_equal(samples.next_observations[index], last.next_obs[env])
        assert np.array_equal(samples.one_step_observations[index], first.next_obs[env])
        assert samples.rewards[index].item() == pytest.approx(first.reward[env] + GAMMA * last.reward[env], abs=1e-6)


def test_one_step_samples_have_one_following_observation() -> None:
    buffer = interrupted(1, "")
    frames = buffer.sample_frames(4)
    assert frames.one_step_observations is frames.next_observations and frames.discounts is None
    samples = frames.whole()
    assert samples.one_step_observations is samples.next_observations


def test_more_steps_than_rows() -> None:
    """The sum goes once round the ring at most."""
    world = World()
    buffer, twin = world.buffer(3, n_steps=7), world.twin(3, 7)
    for transition in [world.step() for _ in range(8)]:
        fill([transition], buffer, twin)
        assert_equal_buffers(buffer, twin)
    assert drawn(buffer).discounts.min() == pytest.approx(0.99**3)


def test_returns_of_rewards_and_ends() -> None:
    rewards = np.array([[1, 2, 4], [1, 2, 4], [1, 2, 4], [1, 2, 4]], np.float32)
    ends = np.array([[0, 0, 0], [0, 0, 1], [0, 1, 0], [1, 1, 0]], bool)
    taken, returns, discounts = n_step_returns(rewards, ends, 0.5)
    assert taken.tolist() == [3, 3, 2, 1]
    assert returns[:, 0].tolist() == [3, 3, 2, 1]
    assert discounts[:, 0].tolist() == [0.125, 0.125, 0.25, 0.5]
    assert returns.dtype == discounts.dtype == np.float32
