"""The commands put together: `vad COMMAND --help` teaches each."""

from __future__ import annotations

import typer

from vad import __version__
from vad.commands import loading
from vad.commands.agent import agent
from vad.commands.camera import app as camera_app
from vad.commands.config import config_app
from vad.commands.csi import csi_app
from vad.commands.demo import demo
from vad.commands.device import device_app
from vad.commands.device_past import heatmap, history
from vad.commands.devices import devices
from vad.commands.doctor import doctor
from vad.commands.install import install, uninstall
from vad.commands.map import map_app
from vad.commands.pki import app as pki_app
from vad.commands.replay import replay
from vad.commands.robot import app as robot_app
from vad.commands.run import check_config, run
from vad.commands.sessions import sessions_app
from vad.commands.setup import setup
from vad.commands.sim import sim
from vad.commands.status import status
from vad.commands.web import web_app

app = typer.Typer(
    name="vad",
    help="Puts every Wi-Fi device of a home on the robot vacuum's floor plan.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Try it without any hardware:  vad demo",
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _vad(
    context: typer.Context,
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True),
) -> None:
    loading.finish(context.invoked_subcommand)


app.command()(setup)
app.command()(run)
app.command("check-config")(check_config)
app.add_typer(config_app, name="config")
app.command()(agent)
app.command()(devices)
app.add_typer(device_app, name="device")
device_app.command()(history)
device_app.command()(heatmap)
app.add_typer(map_app, name="map")
app.command()(status)
app.add_typer(web_app, name="web")
app.command()(replay)
app.add_typer(sessions_app, name="sessions")
app.command()(demo)
app.command()(sim)
app.command()(doctor)
app.command()(install)
app.command()(uninstall)
app.add_typer(camera_app, name="camera")
app.add_typer(csi_app, name="csi")
app.add_typer(robot_app, name="robot")
app.add_typer(pki_app, name="pki")
