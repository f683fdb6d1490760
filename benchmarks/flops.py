"""What an update has to compute, and what this machine can: the two sides of "how much of the peak is used"."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch as th
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry


def operations(work: Callable[[], object]) -> int:
    """:return: floating-point operations of the convolutions and matrix products in ``work``; an addition is one of its own"""
    with _Counter() as counter:
        work()
    return counter.total


def matrix_peak(size: int = 2048, repeats: int = 10) -> float:
    """
    :param size: of the square float32 matrices
    :param repeats: of which the median counts
    :return: operations per second of the faster of torch's two matrix products, MKL's and oneDNN's
    """
    left, right = th.randn(size, size), th.randn(size, size)
    products: list[Callable[[], object]] = [lambda: left @ right]
    if th.backends.mkldnn.is_available():
        products.append(lambda: th.ops.mkldnn._linear_pointwise(left, right, None, "none", [], ""))
    rates = []
    for product in products:
        product()
        seconds = []
        for _ in range(repeats):
            start = time.perf_counter()
            product()
            seconds.append(time.perf_counter() - start)
        rates.append(2 * size**3 / statistics.median(seconds))
    return max(rates)


class _Counter(TorchDispatchMode):
    """torch's FlopCounterMode without its bookkeeping by modules, which refuses torch.autograd.grad with respect to leaves."""

    def __init__(self) -> None:
        super().__init__()
        self.total = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        count = flop_registry.get(func._overloadpacket)
        if count is not None:
            self.total += count(*args, **(kwargs or {}), out_val=result)
        return result
