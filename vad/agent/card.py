"""Which card this machine hears with: its address is the device's on the hub."""

from __future__ import annotations

from pathlib import Path

from vad.errors import ConfigError
from vad.mac import normal_mac

NETWORK = Path("/sys/class/net")


def own_mac(interface: str | None, network: Path = NETWORK) -> str:
    """The address of the interface, or of the only wireless one; ConfigError where that cannot be told."""
    name = interface or _only_wireless(network)
    try:
        return normal_mac((network / name / "address").read_text().strip())
    except OSError as error:
        raise ConfigError(
            f"no such network interface: {name!r}",
            where="interface",
            remedy=f"Here are {', '.join(sorted(p.name for p in network.glob('*'))) or 'none'}",
        ) from error


def _only_wireless(network: Path) -> str:
    names = sorted(path.parent.name for path in network.glob("*/phy80211"))
    if len(names) == 1:
        return names[0]
    raise ConfigError(
        f"the CSI card cannot be told: there are {len(names)} wireless interfaces"
        if names
        else "the CSI card cannot be told: there is no wireless interface",
        where="interface",
        remedy=f"Give --interface, one of {', '.join(names)}" if names else "Give its address with --mac",
    )
