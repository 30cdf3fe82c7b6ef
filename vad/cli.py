"""The console script; the commands are put together in vad.commands.app."""

from __future__ import annotations

import io
import os
import sys

from vad.commands import loading


def main() -> None:
    """Run the command line."""
    loading.begin()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a locale without ✓ or ± shows a ?, it breaks nothing off
    # Small matrices: threads of the linear algebra only wait for each other, and a hub has few cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from vad.commands.app import app

    app()
