"""The services' files: units, user, folders, device rules; where a package and `vad install` have them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import vad

PROGRAM = "/usr/bin/vad"
"""What the units as shipped start."""
MARK = "# Written by `vad install`; `vad uninstall` takes it away.\n"
"""First line of what is written outside a package; a file without it is somebody's own and stays."""
HUB_UNIT, AGENT_UNIT = "vad.service", "vad-agent.service"


@dataclass(frozen=True, slots=True)
class ServiceFile:
    """name: in the folder systemd/; packaged, local: where it goes, from the root folder."""

    name: str
    packaged: str
    local: str

    def text(self) -> str:
        """As shipped."""
        return (shipped_folder() / self.name).read_text(encoding="utf-8")

    def local_text(self, program: Path) -> str:
        """As `vad install` writes it, for a vad that is elsewhere."""
        return MARK + self.text().replace(f"{PROGRAM} ", f"{program} ")


def _unit(name: str) -> ServiceFile:
    return ServiceFile(name, f"usr/lib/systemd/system/{name}", f"etc/systemd/system/{name}")


USERS = ServiceFile("vad.sysusers", "usr/lib/sysusers.d/vad.conf", "etc/sysusers.d/vad.conf")
FOLDERS = ServiceFile("vad.tmpfiles", "usr/lib/tmpfiles.d/vad.conf", "etc/tmpfiles.d/vad.conf")
RULES = ServiceFile("70-vad.rules", "usr/lib/udev/rules.d/70-vad.rules", "etc/udev/rules.d/70-vad.rules")
FILES = (USERS, FOLDERS, RULES, _unit(HUB_UNIT), _unit(AGENT_UNIT))


def shipped_folder() -> Path:
    """systemd/: inside the installed package, beside it in a checkout."""
    package = Path(vad.__file__).parent
    inside = package / "systemd"
    return inside if inside.is_dir() else package.parent / "systemd"


def is_packaged(root: Path = Path("/")) -> bool:
    """Whether a package of the distribution has brought the units."""
    return any(
        (root / folder / HUB_UNIT).exists() for folder in ("usr/lib/systemd/system", "lib/systemd/system")
    )


def write_packaged(root: Path) -> list[Path]:
    """Put every file below `root` where a package has it; the paths that were written."""
    written = []
    for file in FILES:
        path = root / file.packaged
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(file.text(), encoding="utf-8")
        path.chmod(0o644)
        written.append(path)
    return written
