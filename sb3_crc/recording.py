"""Updates whose work on a GPU is recorded once and then replayed as a whole (CUDA graphs).

An update launches some thousand small pieces of work, each of which costs the host about as long as it takes a fast GPU. A
recording launches all of them at once. It reads and writes the memory that it was made with: weights, optimizer states and
moving averages, which change in place anyway, and a copy of what an update is given, into which each batch is copied.
"""

from collections import Counter
from collections.abc import Callable, Hashable, Iterable
from typing import NamedTuple

import torch as th

from sb3_crc.views import Views

Metrics = dict[str, th.Tensor]
Replay = Callable[[], None]
#: Records some work instead of doing it; returns what does it, and where its results will lie
Recorder = Callable[[Callable[[], Metrics]], tuple[Replay, Metrics]]

#: Updates of each kind that are made as ever before one is recorded: optimizer states and workspaces are there then, and the
#: fastest convolutions are chosen
WARM_UP = 3


class Recording(NamedTuple):
    """
    :param inputs: what the update reads, by name
    :param replay: makes the update
    :param metrics: where its results lie
    """

    inputs: dict[str, th.Tensor]
    replay: Replay
    metrics: Metrics


class RecordedUpdates:
    """
    Makes updates by replaying recordings, one for each kind of update.

    Numbers that the update reads from Python are those of the first updates for ever: learning rates must be tensors, which
    :meth:`prepare` makes of them.

    :param update: makes an update of views of one batch, without waiting for the device, and returns scalars
    :param optimizers: that step in it
    :param record: of the device
    """

    def __init__(
        self,
        update: Callable[[Views], Metrics],
        optimizers: Iterable[th.optim.Optimizer],
        record: Recorder | None = None,
    ):
        self._update = update
        self._optimizers = list(optimizers)
        self._record = CUDARecorder() if record is None else record
        self.forget()

    def forget(self) -> None:
        """Make updates as ever at first, and record them anew: what they write to has moved."""
        self._made: Counter[Hashable] = Counter()
        self._names: dict[Hashable, list[str]] = {}
        self._recordings: dict[Hashable, Recording] = {}

    def __call__(self, views: Views, kind: Hashable) -> Metrics:
        """
        Make one update.

        :param views: of its batch
        :param kind: what it does, apart from the shapes of its batch; updates of one kind are the same work
        :return: its metrics
        """
        if self._made[kind] < WARM_UP:
            self._made[kind] += 1
            metrics = self._update(views)
            self._names[kind] = list(views.drawn)
            return metrics
        views.draw(self._names[kind])
        given = views.tensors()
        key = kind, tuple((name, tensor.shape) for name, tensor in given.items())
        if key not in self._recordings:
            self.prepare()
            inputs = {name: tensor.clone() for name, tensor in given.items()}
            self._recordings[key] = Recording(inputs, *self._record(lambda: self._update(views.of(inputs))))
        recording = self._recordings[key]
        for name, tensor in given.items():
            recording.inputs[name].copy_(tensor, non_blocking=True)
        recording.replay()
        return {name: value.clone() for name, value in recording.metrics.items()}  # the next replay writes there again

    def prepare(self) -> None:
        """Let what changes about the optimizers lie on the device."""
        for optimizer in self._optimizers:
            parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
            device = parameters[0].device if parameters else th.device("cpu")
            for group in optimizer.param_groups:  # also one without parameters, of an objective that has none
                group["capturable"] = device.type == "cuda"
                if not isinstance(group["lr"], th.Tensor):
                    group["lr"] = th.tensor(group["lr"], device=device)
            for parameter, state in optimizer.state.items():
                state["step"] = th.as_tensor(state["step"], device=parameter.device)


class CUDARecorder:
    """Records CUDA graphs that share their memory: none of it is needed between two replays."""

    def __init__(self) -> None:
        self._pool = th.cuda.graph_pool_handle()

    def __call__(self, work: Callable[[], Metrics]) -> tuple[Replay, Metrics]:
        """:param work: to record; :return: what does it, and where its results will lie"""
        graph = th.cuda.CUDAGraph()
        with th.cuda.graph(graph, pool=self._pool):
            metrics = work()
        return graph.replay, metrics


def unprepare(optimizers: Iterable[th.optim.Optimizer]) -> None:
    """:param optimizers: whose states come from any device, to step on as those do that were never recorded"""
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            group["lr"] = float(group["lr"])
            if "capturable" in group:
                group["capturable"] = bool(optimizer.defaults["capturable"])


def recorded_updates(
    update: Callable[[Views], Metrics], optimizers: Iterable[th.optim.Optimizer], device: th.device
) -> RecordedUpdates | None:
    """
    :param update: see :class:`RecordedUpdates`
    :param optimizers: that step in it
    :param device: on which it works
    :return: None on a CPU, which has nothing of recordings
    :raises ValueError: for an optimizer whose steps cannot be recorded
    """
    own = list(optimizers)
    for optimizer in own:
        if "capturable" not in optimizer.defaults:
            raise ValueError(
                "compile=True needs an optimizer whose steps can be recorded, such as Adam, AdamW or RMSprop: "
                f"{type(optimizer).__name__} has no option 'capturable'"
            )
    return RecordedUpdates(update, own) if device.type == "cuda" else None
