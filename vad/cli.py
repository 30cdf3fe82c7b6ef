"""The console script. SIGINT and SIGTERM wait until what the command needs is imported.

That takes about a second; whoever changes his mind then gets an ordinary end, not a traceback out of
somebody's import.
"""

from __future__ import annotations

import os
import signal


def main() -> None:
    """Run the command line; see vad.commands.app."""
    # Small matrices: threads of the linear algebra only wait for each other, and a hub has few cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    from vad.commands.app import app

    app()
