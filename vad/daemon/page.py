"""The page for browsers, put together from what the daemon has."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from vad.bus.node import Bus
from vad.config import Settings
from vad.daemon.eyes import Eyes
from vad.daemon.wishes import Wishes
from vad.errors import ConfigError
from vad.robot.pose import PoseSource
from vad.web.access import Access, TokenFile, check_address

if TYPE_CHECKING:
    from vad.web.home import Robot
    from vad.web.server import PageServer


def page_access(settings: Settings, base: Path) -> Access | None:
    """Where the page is and who may change something; None where there is none.

    Raises:
        ConfigError: it would be reachable from elsewhere, or the token cannot be trusted.
    """
    web = settings.web
    if web.port is None:
        return None
    check_address(web.address, where="$.web.address")
    token = None
    if web.token_file is not None:
        token = TokenFile((base / web.token_file).resolve())
        try:
            token.read()
        except ConfigError as error:
            raise ConfigError(
                error.what, where=f"$.web.token_file: {error.where}", remedy=error.remedy
            ) from error
    return Access(web.port, web.address, web.names, token)


def web_page(
    settings: Settings, access: Access, bus: Bus, wishes: Wishes, source: PoseSource, eyes: Eyes
) -> PageServer:
    """The page of this daemon, to be run."""
    # not loaded where there is no page: an HTTP server takes memory
    from vad.web.home import HomeFeed, Robot
    from vad.web.server import PageServer

    def robot() -> Robot:
        pose = eyes.robot_pose
        if pose is None or source.status not in ("localised", "docked"):
            return Robot(status=source.status)
        return Robot(
            status=source.status,
            x_m=round(float(pose.x_m), 3),
            y_m=round(float(pose.y_m), 3),
            yaw_rad=round(float(pose.yaw_rad), 3),
            sigma_m=float(pose.sigma_m),
            quality=pose.quality,
            epoch=pose.epoch,
        )

    return PageServer(access, settings.hub, HomeFeed(bus.keys, bus.listen), wishes.answer, robot)
