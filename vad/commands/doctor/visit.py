"""What a check is given, and what it says."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vad.bus.messages import Part, StatusMessage
from vad.commands.doctor.identity import Identity
from vad.config import Settings, resolve
from vad.errors import VadError
from vad.health import Health

Verdict = Literal["ok", "warning", "bad"]


@dataclass(frozen=True, slots=True)
class Finding:
    """What one check found; the remedy, a command or a setting, where something is wrong."""

    check: str
    verdict: Verdict
    text: str
    remedy: str = ""

    @classmethod
    def of_error(cls, check: str, error: VadError, otherwise: str = "Correct it, or the settings") -> Finding:
        """An error as a finding; `otherwise` is the remedy of one that has none."""
        what = f"{error.where}: {error.what}" if error.where else error.what
        return cls(check, "bad", what, error.remedy or otherwise)

    @classmethod
    def of_health(
        cls, check: str, health: Health | Part, otherwise: str = "The log says more: journalctl -u vad"
    ) -> Finding:
        """What a part says of itself: `What is wrong. What to do about it`."""
        if health.state == "ok":
            return cls(check, "ok", health.detail)
        what, _, remedy = (health.detail or "it has not begun").partition(". ")
        return cls(check, "bad", what, remedy or otherwise)


@dataclass(frozen=True, slots=True)
class Visit:
    """What every check is given.

    listen_s: how long it may listen to hardware. root: where /sys, /proc, /lib and /etc are. status: of the
    daemon that runs, which then has the hardware; None where none does. service: as whom the daemon runs
    where that is not who asks; None where it is, or is not known.
    """

    settings: Settings
    config_file: Path
    listen_s: float
    root: Path = Path("/")
    status: StatusMessage | None = None
    service: Identity | None = None

    def resolve(self, path: str) -> Path:
        """A path from the settings."""
        return resolve(path, self.config_file)

    @property
    def state_dir(self) -> Path:
        """Where the database and the sessions are."""
        return self.resolve(self.settings.state_dir)

    def part(self, name: str) -> Part | None:
        """What the running daemon says of the part whose name begins so."""
        parts = () if self.status is None else self.status.parts
        return next((part for part in parts if part.part.startswith(name)), None)

    def refused(self, check: str, path: Path, wanted: str) -> list[Finding]:
        """A finding where the service may not use a file. wanted: of `rw`."""
        if self.service is None or not (why := self.service.refusal(path, wanted)):
            return []
        return [Finding(check, "bad", why, self.service.remedy(path))]


Check = Callable[[Visit], Awaitable[list[Finding]]]
