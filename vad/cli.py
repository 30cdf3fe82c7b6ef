"""The console script; the commands are put together in vad.commands.app."""

from __future__ import annotations

import os

from vad.commands import loading


def main() -> None:
    """Run the command line."""
    loading.begin()
    # Small matrices: threads of the linear algebra only wait for each other, and a hub has few cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from vad.commands.app import app

    app()
