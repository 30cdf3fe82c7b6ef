"""Settings files read and checked: every error names the file and the key's path."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import msgspec
import yaml

from vad.config.agent import AgentSettings
from vad.config.hub import Settings
from vad.config.robot import Ros2Robot, ValetudoRobot, brings_map
from vad.errors import ConfigError

T = TypeVar("T")


def agent_settings(plain: dict[str, Any], *, where: str) -> AgentSettings:
    """Plain values as AgentSettings; ConfigError names `where` and the key's path."""
    return _typed(plain, AgentSettings, where)


def parse_settings(text: str, *, where: str) -> Settings:
    """YAML text as Settings; ConfigError names `where` and the key's path."""
    settings = _typed(parse_yaml(text, where=where), Settings, where)
    _check_robot(settings, where)
    return settings


def parse_yaml(text: str, *, where: str) -> dict[str, Any]:
    """YAML text as plain values; ConfigError where it is none."""
    try:
        raw: Any = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark else ""
        raise ConfigError(f"not YAML{line}", where=where, remedy="Check the indentation") from error
    if not isinstance(raw, dict):
        raise ConfigError("the file holds no settings", where=where, remedy="See config/vad.yaml")
    return raw


def _typed(raw: dict[str, Any], kind: type[T], where: str) -> T:
    # A section of which every line is a comment reads as null: everything in it is the default.
    filled = {key: {} if value is None and _is_section(kind, key) else value for key, value in raw.items()}
    try:
        return msgspec.convert(filled, type=kind, strict=False)  # YAML 1.1 reads 5.24e9 as text
    except msgspec.ValidationError as error:
        what, _, path = str(error).partition(" - at ")
        raise ConfigError(what, where=f"{where}: {path.strip('`') or '$'}") from error


def _is_section(kind: type[Any], key: str) -> bool:
    types = {field.encode_name: field.type for field in msgspec.structs.fields(kind)}
    found = types.get(key)
    return isinstance(found, type) and issubclass(found, msgspec.Struct)


def _check_robot(settings: Settings, where: str) -> None:
    robot = settings.robot
    if settings.camera.intrinsics is not None and settings.camera.focal_px is not None:
        raise ConfigError("give either intrinsics or focal_px", where=f"{where}: $.camera")
    if settings.map.file is None and not brings_map(robot):
        raise ConfigError(
            "there is no floor plan: this robot brings none",
            where=f"{where}: $.map.file",
            remedy="Name a map_server YAML; `vad map import` makes one from other maps",
        )
    if isinstance(robot, ValetudoRobot) and (robot.url is None) == (robot.key is None):
        raise ConfigError("give either url or key", where=f"{where}: $.robot")
    if isinstance(robot, Ros2Robot) and (robot.pose == "tf") != (not robot.pose_topic):
        raise ConfigError(
            "pose_topic goes with pose: pose, pose_covariance or odometry",
            where=f"{where}: $.robot.pose_topic",
        )


def load_settings(path: Path) -> Settings:
    """Read and check a settings file; relative paths inside it are taken from its folder."""
    return parse_settings(read_text(path), where=str(path))


def read_text(path: Path) -> str:
    """The text of a settings file; ConfigError where it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"cannot be read ({error.strerror})", where=str(path), remedy="Give the file with --config"
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigError("not UTF-8 text", where=str(path)) from error


def pki_folder(settings: Settings, config_file: Path) -> Path:
    """The folder of certificates (vad.pki.folder)."""
    if settings.bus.pki is not None:
        return resolve(settings.bus.pki, config_file)
    return resolve(settings.state_dir, config_file) / "pki"


def resolve(path: str, config_file: Path) -> Path:
    """A path from the settings, relative ones from the settings file's folder."""
    return (config_file.parent / path).resolve()
