"""The errors a user may meet: what happened, where, and what to do about it."""

from __future__ import annotations


class VadError(Exception):
    """An error with a place and a remedy.

    Args:
        what: what is wrong, one sentence without a full stop.
        where: the file, key, device or setting concerned; empty when there is none.
        remedy: what the user can do; empty when nothing can be done.
    """

    code = "error"

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        self.what = what
        self.where = where
        self.remedy = remedy
        super().__init__(what)

    def __str__(self) -> str:
        head = f"{self.where}: {self.what}" if self.where else self.what
        return f"{head}. {self.remedy}" if self.remedy else head


class ConfigError(VadError):
    """A setting that cannot be used; `where` is its path, e.g. `vad.yaml: $.robot.port`."""

    code = "config"


class ProtocolError(VadError):
    """Bytes that do not follow their protocol."""

    code = "protocol"


class SourceError(VadError):
    """A device, port or file that cannot be opened or has gone away."""

    code = "source"


class SessionError(VadError):
    """A session folder that cannot be solved."""

    code = "session"
