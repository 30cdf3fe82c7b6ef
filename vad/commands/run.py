"""`vad run`, `vad check-config`: the daemon and its settings."""

from __future__ import annotations

import asyncio
import faulthandler
import logging
from pathlib import Path
from typing import Annotated

import typer

from vad.commands.console import complain, out, reported_errors
from vad.commands.signals import until_ended
from vad.config import load_settings
from vad.errors import VadError

ConfigOption = Annotated[
    Path, typer.Option("--config", "-c", help="The settings file.", envvar="VAD_CONFIG", show_default=True)
]
DEFAULT_CONFIG = Path("/etc/vad/vad.yaml")
EXIT_ANOTHER_TIME = 1
"""The settings are usable; systemd tries again."""


def run(
    config: ConfigOption = DEFAULT_CONFIG,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log details.")] = False,
) -> None:
    """Run the daemon until Ctrl-C or SIGTERM. As a service of systemd: vad install.

    SIGHUP (systemctl reload vad) reads the settings anew: capture limits, names and ignored devices change at
    once, for all else it begins anew within seconds. Settings that cannot be used are refused, the old go on.

    Example:  vad run --config config/vad.yaml

    Exit code 0: stopped as asked; 1: something failed that may go another time (the port is taken, the disk
    cannot be used); 2: the settings cannot be used. One line says which and why.
    """
    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.INFO,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
    )
    faulthandler.enable()  # systemd's watchdog ends with SIGABRT: the journal gets every thread's stack
    with reported_errors():
        settings = load_settings(config)
        from vad.daemon.app import run_daemon  # cv2, onnxruntime and zenoh take a second to import
        from vad.daemon.service import Supervision, serve

        supervision = Supervision()
        try:
            asyncio.run(until_ended(serve(settings, config.resolve(), run_daemon, supervision)))
        except VadError as error:
            if not supervision.may_go:
                raise
            complain(str(error))
            raise typer.Exit(EXIT_ANOTHER_TIME) from error


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
