"""`vad run`, `vad check-config`: the daemon and its settings."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path
from typing import Annotated

import typer

from vad.commands.console import out, reported_errors
from vad.commands.signals import until_ended
from vad.config import load_settings

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
    with reported_errors():
        settings = load_settings(config)
        from vad.daemon.app import run_daemon  # cv2, onnxruntime and zenoh take a second to import

        asyncio.run(until_ended(run_daemon(settings, config.resolve())))


def check_config(config: ConfigOption = DEFAULT_CONFIG) -> None:
    """Check the settings without starting anything.

    Example:  vad check-config --config config/vad.yaml

    Exit code 0: usable; 2: not, and the line on standard error says which setting and why.
    """
    with reported_errors():
        settings = load_settings(config)
        from vad.daemon.checks import check_files

        check_files(settings, config.resolve())
    out.print(
        f"{config}: the settings are usable (hub {settings.hub!r}, source {settings.source})",
        markup=False,
        soft_wrap=True,
    )
