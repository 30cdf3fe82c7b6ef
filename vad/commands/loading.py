"""SIGINT and SIGTERM while the program loads: it ends at once.

Importing takes a second, on a small hub some; nothing is open yet. Python's own KeyboardInterrupt would come
as a traceback out of somebody's import.
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

ENDINGS = (signal.SIGINT, signal.SIGTERM)
RUN_UNTIL_ENDED = ("run", "sim", "agent")
"""Commands whose proper end is a signal, at every moment; they take the signals over by themselves."""


def begin() -> None:
    """From here on the signals end the program at once."""
    for number in ENDINGS:
        signal.signal(number, _leave)


def finish(command: str | None) -> None:
    """`command` is loaded: from here on the signals are what they always are."""
    if command in RUN_UNTIL_ENDED or signal.getsignal(signal.SIGTERM) is not _leave:
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _leave(number: int, _frame: FrameType | None) -> None:
    as_wanted = sys.argv[1:2] and sys.argv[1] in RUN_UNTIL_ENDED
    os._exit(0 if as_wanted else 128 + number)
