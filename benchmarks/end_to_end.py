"""Where the time of learn() goes, in CRCSAC and in stock SB3 SAC, on cartpole-swingup from pixels."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from functools import partial, wraps
from typing import Any
from unittest.mock import patch

import stable_baselines3.sac.sac as sb3_sac
import torch as th
from stable_baselines3 import SAC

from benchmarks.interleave import in_fresh_process
from benchmarks.networks import Networks, NoiseFrames
from benchmarks.peers import stock_sac
from benchmarks.report import Target, judged, spread
from sb3_crc import CRCSAC, make_dmc
from sb3_crc.memory import memory_kept

TASK = "cartpole-swingup"
STOCK = "SB3 SAC"
#: What a decision and its update consist of. Frames are read from our buffer where they are augmented, hence there;
#: "forward" is all of train() that is not another part, "polyak" the target networks' step, "rest" all of learn() that is
#: not another part: wrappers, the buffer's add, logging
PARTS = ("physics", "render", "predict", "sample", "augment", "forward", "backward", "optimizer", "polyak", "rest")
#: Decisions with an update that are not timed
WARM_UP = 10
TARGETS = [Target("rest %", 3)]
ACTING_TARGETS = {"paper": [Target("ms", 4)]}


def measure(
    *,
    networks: Networks,
    presets: tuple[str, ...],
    decisions: int,
    batch_size: int = 128,
    render_quality: str = "benchmark",
    on_method: Callable[[str], object] = lambda method: None,
) -> list[dict[str, Any]]:
    """
    Let each method learn in a process of its own, one update per decision.

    Stock SAC sees pictures of the size that our encoder sees after cropping, and updates its actor every time.

    :param networks: e.g. of :data:`~benchmarks.networks.NETWORKS`
    :param presets: of ours; the peer comes last
    :param decisions: that are timed
    :param batch_size: B
    :param render_quality: of :func:`~sb3_crc.make_dmc`
    :param on_method: told which method is next
    :return: two rows per method: milliseconds per decision, and shares of the whole in percent
    """
    rows: list[dict[str, Any]] = []
    for method in (*presets, STOCK):
        on_method(method)
        seconds = in_fresh_process(partial(learn, method, networks, decisions, batch_size, render_quality))
        rows += rows_of(seconds, decisions, {"networks": networks.name, "method": method}, judge=method != STOCK)
    return rows


def rows_of(seconds: dict[str, float], decisions: int, labels: dict[str, Any], *, judge: bool) -> list[dict[str, Any]]:
    """
    :param seconds: of each part
    :param decisions: in that time
    :param labels: columns that come first
    :param judge: against the target
    :return: a row in milliseconds per decision and one in percent
    """
    total = sum(seconds.values())
    milliseconds = {part: 1e3 * seconds[part] / decisions for part in PARTS}
    shares = {f"{part} %": 100 * seconds[part] / total for part in PARTS}
    return [
        {**labels, "unit": "ms per decision", "total": 1e3 * total / decisions, **milliseconds},
        judged({**labels, "unit": "share", **shares}, TARGETS if judge else []),
    ]


def learn(method: str, networks: Networks, decisions: int, batch_size: int, render_quality: str) -> dict[str, float]:
    """
    :param method: a preset, or :data:`STOCK`
    :return: seconds of each part of so many decisions, after random ones that fill the buffer and a few updates
    """
    model, size = make_model(method, networks, batch_size)
    env = make_dmc(TASK, seed=0, image_size=size, render_quality=render_quality)
    model.set_env(env)
    stopwatch = Stopwatch(PARTS)
    with memory_kept() if method != STOCK else nullcontext():  # from the warm-up on
        model.learn(model.learning_starts + WARM_UP)
        with instrumented(model, stopwatch), stopwatch.running("rest"):
            model.learn(decisions, reset_num_timesteps=False)
    env.close()
    return stopwatch.seconds


def acting(networks: Networks, *, repeats: int = 50) -> list[dict[str, Any]]:
    """
    :param networks: of the agents
    :param repeats: observations
    :return: a row for CRCSAC and one for stock SAC: milliseconds of ``predict`` on one observation, without exploration
    """
    rows = []
    for method in ("crc", STOCK):
        seconds = in_fresh_process(partial(predict, method, networks, repeats))
        targets = ACTING_TARGETS.get(networks.name, []) if method != STOCK else []
        rows.append(judged({"networks": networks.name, "method": method, **spread(seconds)}, targets))
    return rows


def predict(method: str, networks: Networks, repeats: int) -> list[float]:
    """:return: seconds of each call"""
    model, size = make_model(method, networks, batch_size=2)
    world = NoiseFrames(size)
    observation, _ = world.reset()
    action = world.action_space.sample()
    seconds = []
    for _ in range(WARM_UP + repeats):
        start = time.perf_counter()
        model.predict(observation, deterministic=True)
        seconds.append(time.perf_counter() - start)
        observation = world.step(action)[0]
    return seconds[WARM_UP:]


def make_model(method: str, networks: Networks, batch_size: int) -> tuple[SAC, int]:
    """:return: the model, and the side of its pictures in pixels"""
    if method == STOCK:
        return stock_sac(networks, batch_size), networks.input_size
    return networks.crc_sac(method, batch_size), networks.frame_size


class Stopwatch:
    """
    Each moment counts for one part: where parts are nested, for the innermost.

    :param parts: their names
    :param clock: seconds
    """

    def __init__(self, parts: tuple[str, ...], clock: Callable[[], float] = time.perf_counter) -> None:
        self.seconds = dict.fromkeys(parts, 0.0)
        self._clock = clock
        self._nested: list[str] = []
        self._since = 0.0

    @contextmanager
    def running(self, part: str) -> Iterator[None]:
        """Count for ``part`` what no part within it counts."""
        self._count()
        self._nested.append(part)
        try:
            yield
        finally:
            self._count()
            self._nested.pop()

    def timed(self, function: Callable[..., Any], part: str) -> Callable[..., Any]:
        """:return: ``function``, whose calls count for ``part``"""

        @wraps(function)
        def timed_function(*args: Any, **kwargs: Any) -> Any:
            with self.running(part):
                return function(*args, **kwargs)

        return timed_function

    def _count(self) -> None:
        now = self._clock()
        if self._nested:
            self.seconds[self._nested[-1]] += now - self._since
        self._since = now


@contextmanager
def instrumented(model: SAC, stopwatch: Stopwatch) -> Iterator[None]:
    """Within it, the functions that do the work of ``model.learn`` on an environment of dm_control are timed."""
    from dm_control.mujoco.engine import Camera  # not before make_dmc has chosen a back end
    from dm_control.rl.control import Environment

    functions: list[tuple[Any, str, str]] = [
        (Environment, "reset", "physics"),
        (Environment, "step", "physics"),
        (Camera, "render", "render"),
        (model, "predict", "predict"),
        (model.replay_buffer, "sample", "sample"),
        (model, "train", "forward"),
        (th.autograd, "grad", "backward"),
        (th.Tensor, "backward", "backward"),
        (sb3_sac, "polyak_update", "polyak"),
        *((optimizer, "step", "optimizer") for optimizer in _optimizers(model)),
    ]
    if isinstance(model, CRCSAC):
        functions += [
            (model.replay_buffer, "sample_frames", "sample"),
            (model, "_augment", "augment"),
            (model, "_update_targets", "polyak"),
        ]
    with ExitStack() as patches:
        for owner, name, part in functions:
            patches.enter_context(patch.object(owner, name, stopwatch.timed(getattr(owner, name), part)))
        yield


def _optimizers(model: SAC) -> list[th.optim.Optimizer]:
    optimizers = [model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer]
    if isinstance(model, CRCSAC):
        optimizers.append(model.policy.encoder_optimizer)
    return [optimizer for optimizer in optimizers if optimizer is not None]
