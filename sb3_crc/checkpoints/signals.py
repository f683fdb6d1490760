"""SIGINT and SIGTERM as a request to stop where nothing is lost."""

import os
import signal
import threading
import time
from types import FrameType
from typing import Any

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
    """Remembers the first signal; a second one ends the process at once, which harms no checkpoint."""

    def __init__(self) -> None:
        #: The signal; None: there was none
        self.signum: int | None = None
        self._since = 0.0
        self._before: dict[int, Any] = {}

    @property
    def overdue(self) -> bool:
        """Whether the request has waited for longer than :data:`GRACE`."""
        return self.signum is not None and time.monotonic() - self._since > GRACE

    def listen(self) -> None:
        """Handle the signals from now on; without effect in other threads than the main one, to which Python delivers them."""
        if threading.current_thread() is threading.main_thread():
            self._before = {signum: signal.signal(signum, self._handle) for signum in SIGNALS}

    def ignore(self) -> None:
        """Handle signals as before :meth:`listen`."""
        for signum, handler in self._before.items():
            signal.signal(signum, handler)
        self._before = {}

    def _handle(self, signum: int, frame: FrameType | None) -> None:
        if self.signum is not None:
            os._exit(128 + signum)
        self.signum, self._since = signum, time.monotonic()
