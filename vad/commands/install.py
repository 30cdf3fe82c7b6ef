"""`vad install`, `vad uninstall`: the services of systemd."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vad.commands.console import out, reported_errors
from vad.commands.service_files import write_packaged


def install(
    root: Annotated[
        Path | None, typer.Option(help="Only put the files below DIR, as a package has them.", metavar="DIR")
    ] = None,
) -> None:
    """Install the services."""
    with reported_errors():
        if root is not None:
            for path in write_packaged(root):
                out.print(f"wrote {path}", markup=False, soft_wrap=True)
