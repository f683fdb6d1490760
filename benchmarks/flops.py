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


def matrix_peak(size: int = 2048, repeats: int = 10, dtype: th.dtype = th.float32, device: str = "cpu") -> float:
    """
    :param size: of the square matrices
    :param repeats: of which the median counts
    :param dtype: of their numbers
    :param device: that multiplies them
    :return: operations per second; on a CPU, for float32, of the faster of torch's two matrix products, MKL's and oneDNN's
    """
    left, right = (th.randn(size, size, device=device).to(dtype) for _ in range(2))
    products: list[Callable[[], object]] = [lambda: left @ right]
    if device == "cpu" and dtype == th.float32 and th.backends.mkldnn.is_available():
        products.append(lambda: th.ops.mkldnn._linear_pointwise(left, right, None, "none", [], ""))
    rates = []
    for product in products:
        finish(product())
        seconds = []
        for _ in range(repeats):
            start = time.perf_counter()
            finish(product())
            seconds.append(time.perf_counter() - start)
        rates.append(2 * size**3 / statistics.median(seconds))
    return max(rates)


def finish(result: object) -> object:
    """Wait until a GPU, if there is one, has done what was asked of it. :return: ``result``"""
    if th.cuda.is_available():
        th.cuda.synchronize()
    return result


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
