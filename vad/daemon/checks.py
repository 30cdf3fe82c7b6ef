"""What can be told of the settings without starting: the files they name."""

from __future__ import annotations

from pathlib import Path

from vad.bus.session import check_endpoint
from vad.config import Settings, resolve
from vad.daemon.adapters import camera_source
from vad.errors import ConfigError
from vad.robot.map_server import load_floor_plan, load_rooms


def check_files(settings: Settings, config_file: Path) -> None:
    """VadError for the first setting whose file or address cannot be used."""
    if settings.map.file is not None:
        load_floor_plan(resolve(settings.map.file, config_file), epoch=settings.map.epoch)
    if settings.map.rooms is not None:
        load_rooms(resolve(settings.map.rooms, config_file))
    if settings.vision.model and not resolve(settings.vision.model, config_file).is_file():
        raise ConfigError("no such file", where=f"{config_file}: $.vision.model")
    camera_source(settings.camera, config_file.parent)
    for endpoint in settings.bus.listen:
        check_endpoint(endpoint)
