"""One update of CRCSAC beside one of stock SB3 SAC with the same networks, and beside CRC-RL as a textbook would write it."""

import statistics
from collections.abc import Callable
from functools import partial
from typing import Any

from benchmarks.flops import matrix_peak, operations
from benchmarks.interleave import Work, in_fresh_process, interleave, keep_memory
from benchmarks.networks import NETWORKS
from benchmarks.peers import TextbookCRC, stock_sac
from benchmarks.report import Target, judged, spread

#: Name -> preset and what is changed of it
OURS: dict[str, tuple[str, dict[str, Any]]] = {
    "crc": ("crc", {}),
    "crc joint_update *": ("crc", {"joint_update": True}),
    "crc_release": ("crc_release", {}),
    "curl": ("curl", {}),
    "rad": ("rad", {}),
    "pixel_sac": ("pixel_sac", {}),
}
STOCK, LAYOUT, TEXTBOOK = "SB3 SAC", "SB3 SAC, equal layout", "textbook CRC"
#: (method, networks, batch) -> what is to be reached, with policy_delay 2
TARGETS: dict[tuple[str, str, int], list[Target]] = {
    ("crc", "paper", 128): [Target("/ stock", 0.5), Target("/ textbook", 0.3), Target("peak %", 60, at_least=True)],
    ("crc", "paper", 512): [Target("/ stock", 0.35), Target("/ textbook", 0.3), Target("peak %", 70, at_least=True)],
    ("rad", "paper", 128): [Target("/ stock", 0.35)],
    ("rad", "paper", 512): [Target("/ stock", 0.35)],
    ("pixel_sac", "paper", 128): [Target("/ stock", 0.25)],
    ("pixel_sac", "paper", 512): [Target("/ stock", 0.25)],
    ("rad", "laptop", 128): [Target("ms", 60)],
}


def measure(
    networks: str,
    batch_size: int,
    policy_delay: int,
    *,
    repeats: int,
    methods: tuple[str, ...] = tuple(OURS),
    peers: tuple[str, ...] = (STOCK, LAYOUT, TEXTBOOK),
    on_round: Callable[[int], object] = lambda done: None,
) -> list[dict[str, Any]]:
    """
    :param networks: in :data:`~benchmarks.networks.NETWORKS`
    :param batch_size: B
    :param policy_delay: of ours and the textbook's; stock SAC updates its actor every time
    :param repeats: rounds, in each of which every method is timed once
    :param methods: of :data:`OURS`
    :param peers: what they are compared with
    :param on_round: told how many rounds are done
    :return: a row per method and peer; * marks what changes the mathematics
    """
    setting = networks, batch_size, policy_delay
    programs: dict[str, Callable[[], Work]] = {name: partial(ours, name, *setting) for name in methods}
    theirs = {
        STOCK: partial(stock, *setting, equal=False),
        LAYOUT: partial(stock, *setting, equal=True),
        TEXTBOOK: partial(textbook, *setting),
    }
    programs |= {name: theirs[name] for name in peers}
    seconds = interleave(programs, repeats=repeats, on_round=on_round)
    peak = in_fresh_process(matrix_peak)
    rows = []
    for name, program in programs.items():
        needed = in_fresh_process(partial(count, program)) / policy_delay if name in methods else None
        per_update = [value / policy_delay for value in seconds[name]]
        median = statistics.median(per_update)
        row: dict[str, Any] = {"networks": networks, "batch": batch_size, "policy_delay": policy_delay, "method": name}
        row |= spread(per_update)
        for column, peer in (("/ stock", STOCK), ("/ equal layout", LAYOUT), ("/ textbook", TEXTBOOK)):
            if peer in peers:
                pairs = zip(seconds[name], seconds[peer], strict=True)
                row[column] = statistics.median(mine / their for mine, their in pairs)
        if needed is not None:
            row |= {"needed GFLOP": needed / 1e9, "peak %": 100 * needed / median / peak}
        targets = TARGETS.get((name, networks, batch_size), []) if policy_delay == 2 else []
        rows.append(judged(row, [target for target in targets if target.figure in row]))
    return rows


def ours(name: str, networks: str, batch_size: int, policy_delay: int) -> Work:
    """:return: ``policy_delay`` updates of CRCSAC, as within :meth:`learn`"""
    preset, changes = OURS[name]
    model = NETWORKS[networks].crc_sac(preset, batch_size, policy_delay=policy_delay, **changes)
    keep_memory()
    return lambda: model.train(policy_delay, batch_size)


def stock(networks: str, batch_size: int, policy_delay: int, *, equal: bool) -> Work:
    """:return: ``policy_delay`` updates of SB3's SAC; ``equal``: in our layout and with our allocator's settings"""
    model = stock_sac(NETWORKS[networks], batch_size, channels_last=equal)
    if equal:
        keep_memory()
    return lambda: model.train(policy_delay, batch_size)


def textbook(networks: str, batch_size: int, policy_delay: int) -> Work:
    """:return: ``policy_delay`` updates of the textbook's CRC-RL"""
    agent = TextbookCRC(NETWORKS[networks], batch_size)

    def work() -> None:
        for _ in range(policy_delay):
            agent.update(policy_delay)

    return work


def count(program: Callable[[], Work]) -> int:
    """:return: operations of one call of the program's work"""
    work = program()
    work()
    return operations(work)
