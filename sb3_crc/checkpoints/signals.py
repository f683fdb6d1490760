"""SIGINT and SIGTERM as a request to stop where nothing is lost."""

import os
import signal
import threading
import time
import weakref
from types import FrameType
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

SIGNALS = (signal.SIGINT, signal.SIGTERM)
#: Seconds after which a request no longer waits for the next start of a rollout
GRACE = 5.0


class TrainingStopped(KeyboardInterrupt):  # SB3's scripts expect a KeyboardInterrupt
    """
    Training ends because a signal asked for it.

    :param signum: the signal
    """

    def __init__(self, signum: int):
        super().__init__(f"stopped by {signal.Signals(signum).name}")
        self.signum = signum


class StopRequest:
    """
    Remembers the first signal of a training; a second one ends the process at once, which harms no checkpoint.

    Where the training has ended without :meth:`ignore`, by an error of which SB3 tells no callback, signals are handled as
    before it from the first one on.
    """

    def __init__(self) -> None:
        #: The signal; None: there was none
        self.signum: int | None = None
        self._since = 0.0
        self._before: dict[int, Any] = {}
        self._model: weakref.ref[BaseAlgorithm] | None = None  # the table of signals must not keep its replay buffer

    @property
    def overdue(self) -> bool:
        """Whether the request has waited for longer than :data:`GRACE`."""
        return self.signum is not None and time.monotonic() - self._since > GRACE

    def listen(self, model: BaseAlgorithm) -> None:
        """
        Handle the signals from now on; without effect in other threads than the main one, to which Python delivers them.

        :param model: that is learning
        """
        self._model = weakref.ref(model)
        if threading.current_thread() is threading.main_thread():
            self._before = {signum: signal.signal(signum, self._handle) for signum in SIGNALS}

    def ignore(self) -> None:
        """Handle signals as before :meth:`listen`."""
        for signum, handler in self._before.items():
            signal.signal(signum, handler)
        self._before = {}

    def _handle(self, signum: int, frame: FrameType | None) -> None:
        if self._model is None or not _learns(self._model(), frame):
            self.ignore()
            signal.raise_signal(signum)
            return
        if self.signum is not None:
            os._exit(128 + signum)
        self.signum, self._since = signum, time.monotonic()


def _learns(model: BaseAlgorithm | None, frame: FrameType | None) -> bool:
    """:return: whether ``frame`` was called, directly or not, by ``learn`` of the model"""
    while model is not None and frame is not None:
        if frame.f_code.co_name == "learn" and frame.f_locals.get("self") is model:
            return True
        frame = frame.f_back
    return False
