"""The files in config/ that are written from the types: every setting of the daemon, and of the agent."""

from __future__ import annotations

from typing import Any

from vad.config.agent import AgentSettings
from vad.config.hub import Settings
from vad.config.reference import EXAMPLE, settings_file

HOW_TO_READ = f"""\
A setting behind a # is at its default: take the # away, and change it, to set it. "{EXAMPLE}" beside it
means that what stands there is an example. Relative paths are taken from this file's folder."""

_HUB = f"""\
vad, the Visual Assistant daemon: every setting with its unit, limits and default.
`vad setup` writes such a file for your hub. Without a #: what has to be chosen.
{HOW_TO_READ}
Check it with: vad check-config --config vad.yaml"""

_AGENT = f"""\
vad agent, a remote Wi-Fi node with an Intel 5300 whose own place is wanted: every setting.
{HOW_TO_READ}
Check it with: vad agent --check --config agent.yaml"""

_HUB_CHOSEN: dict[str, Any] = {
    "robot": {"type": "neato", "port": "/dev/ttyACM0", "lidar": True},
    "camera": {"source": {"type": "v4l2", "device": "/dev/video0"}},
    "devices": {"hostapd": ["/run/hostapd/wlan0"]},
    "web": {"port": 9748},
}
_AGENT_CHOSEN: dict[str, Any] = {
    "hub": "tls/192.168.1.10:7448",
    "id": "attic",
    "credentials": "/var/lib/vad-agent/credentials",
}


def hub_reference() -> str:
    """config/vad.yaml."""
    return settings_file(Settings, _HUB_CHOSEN, head=_HUB)


def agent_reference() -> str:
    """config/agent.yaml."""
    return settings_file(AgentSettings, _AGENT_CHOSEN, head=_AGENT)
