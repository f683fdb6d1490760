import numpy as np
import pytest

from benchmarks.env import NAIVE, NAIVE_EVERY, OURS, RAW, WARM_UP, Program, compare, in_turn, make_actions, measure, naive
from sb3_crc import make_dmc
from sb3_crc.envs.tasks import PAPER_TASKS


def test_a_task_is_measured() -> None:
    (row,) = measure(PAPER_TASKS[:1], ("fast",), repeats=12, image_size=36)
    assert (row["task"], row["quality"]) == ("cartpole-swingup", "fast")
    numbers = [value for value in row.values() if isinstance(value, float)]
    assert len(numbers) >= 8 and np.isfinite(numbers).all() and min(numbers) > 0
    assert row["x naive"] > 1.5  # it draws eight pictures
    assert set(row["targets"]) == {"% of raw"}


@pytest.mark.parametrize("task", ["cartpole-swingup", "quadruped-walk"])  # the latter's actions have bounds of their own
def test_the_naive_chain_is_the_same_environment(task: str) -> None:
    env, other = make_dmc(task, image_size=36, render_quality="fast"), naive(task, "fast", 36)
    np.testing.assert_array_equal(env.reset(seed=0)[0], other.reset(seed=0)[0])
    for action in make_actions(task, 3):
        ours, theirs = env.step(action), other.step(action)
        np.testing.assert_array_equal(ours[0], theirs[0])
        assert ours[1:4] == pytest.approx(theirs[1:4])
    env.close(), other.close()


def test_programs_take_turns_and_start_over() -> None:
    calls: list[tuple[str, float]] = []
    resets: list[str] = []

    def program(name: str) -> Program:
        def decide(action: np.ndarray) -> bool:
            calls.append((name, float(action[0])))
            return name == OURS

        return Program(lambda: resets.append(name), decide, lambda: None)

    actions = np.arange(10 + WARM_UP)[:, None]
    seconds = in_turn({name: program(name) for name in (OURS, RAW, NAIVE)}, actions, 10)
    assert set(seconds[OURS]) == set(seconds[RAW]) == set(range(10)) and set(seconds[NAIVE]) == {0, NAIVE_EVERY}
    assert resets.count(OURS) == 1 + WARM_UP + 10 and resets.count(RAW) == resets.count(NAIVE) == 1
    assert [name for name, _ in calls[-4:]] == [RAW, OURS, OURS, RAW]
    assert [action for _, action in calls[-4:]] == [8, 8, 9, 9]


def test_ratios_are_of_the_same_turn() -> None:
    row = compare({OURS: {0: 1.0, 1: 2.0, 2: 4.0}, RAW: {0: 1.0, 1: 2.0, 2: 4.0}, NAIVE: {0: 8.0, 2: 16.0}})
    assert row["ms"] == 2_000 and row["decisions/s"] == 0.5
    assert row["% of raw"] == 100 and row["x naive"] == 6
