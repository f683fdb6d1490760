"""What an update spends its time on, by torch's profiler."""

from collections.abc import Callable
from functools import partial
from typing import Any

from torch.profiler import ProfilerActivity, profile

from benchmarks.interleave import Work, in_fresh_process
from benchmarks.update import ours

#: Updates of each call of the work
POLICY_DELAY = 2
REST = "all others"


def measure(method: str, networks: str, batch_size: int, *, repeats: int, operators: int = 15) -> list[dict[str, Any]]:
    """
    :param method: of :data:`~benchmarks.update.OURS`
    :param networks: "paper" or "laptop"
    :param batch_size: B
    :param repeats: pairs of updates that are profiled
    :param operators: that have a row of their own, the longest first
    :return: a row per operator of torch: the time within it and not within another, per update
    """
    return in_fresh_process(partial(table, partial(ours, method, networks, batch_size, POLICY_DELAY), repeats, operators))


def table(program: Callable[[], Work], repeats: int, operators: int) -> list[dict[str, Any]]:
    """:return: see :func:`measure`"""
    work = program()
    work()
    with profile(activities=[ProfilerActivity.CPU]) as profiler:
        for _ in range(repeats):
            work()
    updates = repeats * POLICY_DELAY
    averages = sorted(profiler.key_averages(), key=lambda average: average.self_cpu_time_total, reverse=True)
    total = sum(average.self_cpu_time_total for average in averages)
    longest = [(one.key, one.self_cpu_time_total, one.count) for one in averages[:operators]]
    others = averages[operators:]
    longest.append((REST, sum(one.self_cpu_time_total for one in others), sum(one.count for one in others)))
    return [
        {"operator": name, "ms": time / 1e3 / updates, "%": 100 * time / total, "calls": calls / updates}
        for name, time, calls in longest
    ]
