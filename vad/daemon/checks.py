"""What can be told of the settings without starting: the files they name."""

from __future__ import annotations

from pathlib import Path

from vad.bus.session import check_endpoint, local_endpoints, tls_endpoints
from vad.camera.lens_file import camera_lens
from vad.config import Settings, pki_folder, resolve
from vad.daemon.adapters import camera_source, robot_finder
from vad.daemon.page import page_access
from vad.errors import ConfigError
from vad.homeassistant.broker import check_settings
from vad.pki.folder import PkiFolder
from vad.robot.map_server import load_floor_plan, load_rooms


def check_files(settings: Settings, config_file: Path) -> None:
    """VadError for the first setting whose file or address cannot be used."""
    if settings.map.file is not None:
        load_floor_plan(resolve(settings.map.file, config_file), epoch=settings.map.epoch)
    if settings.map.rooms is not None:
        load_rooms(resolve(settings.map.rooms, config_file))
    if settings.vision.model and not resolve(settings.vision.model, config_file).is_file():
        raise ConfigError("no such file", where=f"{config_file}: $.vision.model")
    robot_finder(settings.vision, config_file.parent)
    camera_source(settings.camera, config_file.parent)
    camera_lens(settings.camera, config_file.parent)
    page_access(settings, config_file.parent)
    check_bus(settings, config_file)
    check_settings(settings.mqtt, config_file.parent)


def check_bus(settings: Settings, config_file: Path) -> None:
    """VadError where the bus cannot listen as the settings say."""
    check_listen(settings, config_file)
    if tls_endpoints(settings.bus.listen):
        PkiFolder(pki_folder(settings, config_file)).hub_files()


def check_listen(settings: Settings, config_file: Path) -> None:
    """VadError where an endpoint is not allowed, or nothing listens on the hub itself: its commands and the
    gate go through that."""
    for endpoint in settings.bus.listen:
        check_endpoint(endpoint)
    if not local_endpoints(settings.bus.listen):
        raise ConfigError(
            "there is no endpoint for the hub itself",
            where=f"{config_file}: $.bus.listen",
            remedy="Add tcp/127.0.0.1:7447",
        )
