"""Settings -> the CSI source they name."""

from __future__ import annotations

from pathlib import Path

from vad.config import ConnectorCsi, FollowCsi
from vad.csi.attribution import Attribution
from vad.csi.connector import Connector
from vad.csi.follow import FollowLog
from vad.csi.packets import CsiSource


def open_source(source: ConnectorCsi | FollowCsi, base: Path, transmitter: int | None = None) -> CsiSource:
    """The card; relative paths are taken from `base`.

    Args:
        transmitter: whose every packet is; None: frames tell.
    """
    attribution = Attribution(transmitter)
    if isinstance(source, ConnectorCsi):
        return Connector(source.group, attribution=attribution, allow_user_space=source.allow_user_space)
    return FollowLog(base / source.path, attribution=attribution)
