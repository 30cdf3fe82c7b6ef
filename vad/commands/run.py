"""`vad run`, `vad check-config`: the daemon and its settings."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path
from typing import Annotated

import typer

from vad.commands.console import EXIT_BAD_INPUT, err, out
from vad.config import load_settings
from vad.errors import ConfigError, VadError

ConfigOption = Annotated[
    Path, typer.Option("--config", "-c", help="The settings file.", envvar="VAD_CONFIG", show_default=True)
]
DEFAULT_CONFIG = Path("/etc/vad/vad.yaml")


def run(
    config: ConfigOption = DEFAULT_CONFIG,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log details.")] = False,
) -> None:
    """Run the daemon until Ctrl-C or SIGTERM.

    Example:  vad run --config config/vad.yaml

    Exit code 0: stopped as asked; 2: the settings cannot be used (one line says which).
    """
    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.INFO,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
    )
    try:
        settings = load_settings(config)
        from vad.daemon.app import run_daemon  # cv2, onnxruntime and zenoh take a second to import

        asyncio.run(run_daemon(settings, config.resolve()))
    except VadError as error:
        err.print(str(error), style="red", markup=False, highlight=False, soft_wrap=True)
        raise typer.Exit(EXIT_BAD_INPUT) from None
    except KeyboardInterrupt:  # Ctrl-C before the daemon's own handlers were in place
        raise typer.Exit(0) from None


def check_config(config: ConfigOption = DEFAULT_CONFIG) -> None:
    """Check the settings without starting anything.

    Example:  vad check-config --config config/vad.yaml

    Exit code 0: usable; 2: not, and the line on standard error says which setting and why.
    """
    try:
        settings = load_settings(config)
        from vad.daemon.checks import check_files

        check_files(settings, config.resolve())
    except ConfigError as error:
        err.print(str(error), style="red", markup=False, highlight=False, soft_wrap=True)
        raise typer.Exit(EXIT_BAD_INPUT) from None
    out.print(f"{config}: the settings are usable (hub {settings.hub!r}, source {settings.source})")
