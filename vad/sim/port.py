"""The pty that an emulated robot stands behind."""

from __future__ import annotations

import os
import pty
import tty
from pathlib import Path


class VirtualPort:
    """A serial port from construction until `close`.

    Args:
        link: a stable name: a symbolic link to the pty, replaced if it is there.

    Attributes:
        master: the robot's end, non-blocking.
    """

    def __init__(self, link: Path | None) -> None:
        self._link = link
        self.master, self._slave = pty.openpty()
        # Our own descriptor of the slave keeps the line up while clients come and go.
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self._tty = os.ttyname(self._slave)
        self._open = True
        if link is not None:
            link.unlink(missing_ok=True)
            link.symlink_to(self._tty)

    @property
    def path(self) -> str:
        """What a client opens."""
        return self._tty if self._link is None else str(self._link)

    def close(self) -> None:
        """Unplug the port; a second time does nothing."""
        if not self._open:
            return
        self._open = False
        # The link first: once the port is closed its number may be given to another program.
        if self._link is not None and self._link.is_symlink() and str(self._link.readlink()) == self._tty:
            self._link.unlink()
        os.close(self.master)
        os.close(self._slave)
