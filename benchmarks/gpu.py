"""Updates and whole decisions on a GPU beside those of stock SB3 SAC on the same GPU, and the memory that each takes."""

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.end_to_end import TASK
from benchmarks.flops import finish, matrix_peak, operations
from benchmarks.interleave import Work, in_fresh_process, interleave
from benchmarks.networks import NETWORKS
from benchmarks.peers import stock_sac
from benchmarks.report import Target, judged, spread
from sb3_crc import WatchedSubprocVecEnv, make_dmc

METHODS = ("crc", "crc_release", "curl", "rad", "drq")
#: Name -> how updates are made
FORMS: dict[str, dict[str, Any]] = {
    "float32": {},
    "float32, recorded": {"compile": True},
    "bfloat16": {"precision": "bfloat16"},
    "bfloat16, recorded": {"precision": "bfloat16", "compile": True},
}
STOCK, LAYOUT = "SB3 SAC", "SB3 SAC, channels_last"
#: Of the paper's networks with batch 512
TARGETS = {("crc", "bfloat16, recorded"): [Target("ms", 6)]}
#: Updates per turn, the actor's and the targets' among them, so that what the host does besides is a small part
UPDATES = 20


def measure(
    networks: str,
    batch_size: int,
    *,
    repeats: int,
    methods: tuple[str, ...] = METHODS,
    forms: tuple[str, ...] = tuple(FORMS),
    on_round: Callable[[int], object] = lambda done: None,
) -> list[dict[str, Any]]:
    """
    :param networks: in :data:`~benchmarks.networks.NETWORKS`
    :param batch_size: B
    :param repeats: rounds, in each of which every method is timed once
    :param methods: presets
    :param forms: of :data:`FORMS`
    :param on_round: told how many rounds are done
    :return: a row per method and form, and per peer
    """
    setting = networks, batch_size
    programs: dict[tuple[str, str], Callable[[], Work]] = {
        (method, form): partial(ours, method, form, *setting) for method in methods for form in forms
    }
    programs[STOCK, "float32"] = partial(stock, *setting, channels_last=False)
    programs[LAYOUT, "float32"] = partial(stock, *setting, channels_last=True)
    named = {" ".join(name): program for name, program in programs.items()}
    seconds = interleave(named, repeats=repeats, on_round=on_round)
    peak = in_fresh_process(partial(matrix_peak, 8192, 20, th.bfloat16, "cuda"))
    rows = []
    for (method, form), program in programs.items():
        name = f"{method} {form}"
        per_update = [value / UPDATES for value in seconds[name]]
        row: dict[str, Any] = {"networks": networks, "batch": batch_size, "method": method, "form": form} | spread(per_update)
        for column, peer in (("/ stock", STOCK), ("/ channels_last", LAYOUT)):
            row[column] = statistics.median(a / b for a, b in zip(seconds[name], seconds[f"{peer} float32"], strict=True))
        gigabytes, needed = in_fresh_process(partial(memory_and_operations, program))
        row["GB"] = gigabytes
        if method in methods:
            row |= {"needed GFLOP": needed / 1e9, "bf16 peak %": 100 * needed / statistics.median(per_update) / peak}
        targets = TARGETS.get((method, form), []) if setting == ("paper", 512) else []
        rows.append(judged(row, targets))
    return rows


#: Of learn(): decisions before those that are timed, with updates, so that everything is recorded
WARM_UP = 60
#: Name -> where the environment lives, and how updates are made
WAYS: dict[str, tuple[str, dict[str, Any]]] = {
    "float32": ("this process", {}),
    "bfloat16, recorded": ("this process", FORMS["bfloat16, recorded"]),
    "bfloat16, recorded, overlap": ("its own process", {**FORMS["bfloat16, recorded"], "overlap": True}),
}


def end_to_end(
    networks: str,
    batch_size: int,
    *,
    decisions: int,
    methods: tuple[str, ...] = ("crc", "rad"),
    device: str = "cuda",
    render_quality: str = "benchmark",
) -> list[dict[str, Any]]:
    """
    :param networks: in :data:`~benchmarks.networks.NETWORKS`
    :param batch_size: B
    :param decisions: that are timed, with one update each
    :param methods: presets; stock SAC comes last
    :param device: of the networks
    :param render_quality: of :func:`~sb3_crc.make_dmc`
    :return: a row per method and way: milliseconds per decision of learn() on cartpole-swingup, and minutes that 12 500 take
    """
    rows = []
    for method, ways in (*((name, tuple(WAYS)) for name in methods), (STOCK, ("float32",))):
        for way in ways:
            arguments = (method, way, networks, batch_size, decisions, device, render_quality)
            milliseconds = 1e3 * in_fresh_process(partial(seconds_per_decision, *arguments))
            about = {"networks": networks, "batch": batch_size, "method": method, "form": way, "environment in": WAYS[way][0]}
            rows.append({**about, "ms per decision": milliseconds, "minutes for 12 500": 12_500 * milliseconds / 6e4})
    return rows


def seconds_per_decision(
    method: str, way: str, networks: str, batch_size: int, decisions: int, device: str, render_quality: str
) -> float:
    """:return: of learn(), after random decisions that fill the buffer and :data:`WARM_UP` with updates"""
    where, settings = WAYS[way]
    world = NETWORKS[networks]
    if method == STOCK:
        model: SAC = stock_sac(world, batch_size, device=device)
    else:
        model = world.crc_sac(method, batch_size, device=device, seed=None, **settings)
    size = world.input_size if method == STOCK else world.frame_size
    make = partial(make_dmc, TASK, seed=0, image_size=size, render_quality=render_quality)
    env = WatchedSubprocVecEnv([make]) if where == "its own process" else DummyVecEnv([make])
    model.set_env(env)
    model.learn(model.learning_starts + WARM_UP)
    start = time.perf_counter()
    model.learn(decisions, reset_num_timesteps=False)
    finish(None)
    seconds = time.perf_counter() - start
    env.close()
    return seconds / decisions


def ours(method: str, form: str, networks: str, batch_size: int, device: str = "cuda") -> Work:
    """:return: :data:`UPDATES` updates of CRCSAC, with cuDNN's fastest algorithms as within :meth:`learn`"""
    model = NETWORKS[networks].crc_sac(method, batch_size, device=device, **FORMS[form])
    th.backends.cudnn.deterministic, th.backends.cudnn.benchmark = False, True
    return lambda: finish(model.train(UPDATES, batch_size))


def stock(networks: str, batch_size: int, *, channels_last: bool, device: str = "cuda") -> Work:
    """:return: as many of SB3's SAC, with the same settings of cuDNN"""
    model = stock_sac(NETWORKS[networks], batch_size, channels_last=channels_last, device=device)
    th.backends.cudnn.deterministic, th.backends.cudnn.benchmark = False, True
    return lambda: finish(model.train(UPDATES, batch_size))


def memory_and_operations(program: Callable[[], Work]) -> tuple[float, float]:
    """:return: gigabytes that torch took for the program, and operations of one update that is launched piece by piece"""
    work = program()
    work()
    gigabytes = th.cuda.max_memory_reserved() / 1e9 if th.cuda.is_available() else 0.0
    return gigabytes, operations(work) / UPDATES
