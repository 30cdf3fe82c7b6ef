"""The paper's Wi-Fi - camera handshake as two sans-IO state machines.

The Wi-Fi side starts collecting CSI and asks the camera to record; the camera answers with its clock and
its first frame; when the Wi-Fi side has enough it asks the camera to stop and gets the track's extent.
Both sides take events and the time, and return what to do. Messages carry the session's id: a repeated
or late one is answered again or ignored, never acted on twice.

    Wi-Fi    idle -> armed -> recording -> stopping -> solving -> done
    camera   idle -> armed -> recording -> stopped
    any state but done and stopped -> aborted, with a reason
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

WifiState = Literal["idle", "armed", "recording", "stopping", "solving", "done", "aborted"]
CameraState = Literal["idle", "armed", "recording", "stopped", "aborted"]

REPEAT_NS = 500_000_000
"""An unanswered request is sent again after this long."""

GIVE_UP_NS = 3_000_000_000
"""A request without an answer for this long ends the session."""


@dataclass(frozen=True, slots=True)
class Start:
    """Wi-Fi -> camera: record, the Wi-Fi side has begun. sent_ns: the sender's clock."""

    session: str
    sent_ns: int


@dataclass(frozen=True, slots=True)
class Started:
    """Camera -> Wi-Fi: recording. camera_ns: the camera side's clock now; first_frame_ns: its first frame."""

    session: str
    camera_ns: int
    first_frame_ns: int


@dataclass(frozen=True, slots=True)
class Stop:
    """Wi-Fi -> camera: the record is long enough."""

    session: str


@dataclass(frozen=True, slots=True)
class Stopped:
    """Camera -> Wi-Fi: the record ended with last_frame_ns, it holds `frames` frames."""

    session: str
    last_frame_ns: int
    frames: int


@dataclass(frozen=True, slots=True)
class Abort:
    """Either side: this session is void."""

    session: str
    reason: str


Message = Start | Started | Stop | Stopped | Abort


class WifiSide:
    """One session as the side that collects CSI sees it; it leads.

    `state`, `reason` (why aborted), `first_frame_ns`, `last_frame_ns` are for reading only. Every method
    returns the messages to be sent to the camera side.
    """

    def __init__(self, session: str) -> None:
        self.session = session
        self.state: WifiState = "idle"
        self.reason = ""
        self.first_frame_ns: int | None = None
        self.last_frame_ns: int | None = None
        self._asked_ns = 0
        self._sent_ns = 0

    @property
    def over(self) -> bool:
        """True once nothing can change any more."""
        return self.state in ("done", "aborted")

    def arm(self, now_ns: int) -> list[Message]:
        """CSI collection has begun: ask the camera to record."""
        if self.state != "idle":
            return []
        self.state = "armed"
        return self._ask(now_ns)

    def finish(self, now_ns: int) -> list[Message]:
        """Enough has been recorded: ask the camera to stop."""
        if self.state != "recording":
            return []
        self.state = "stopping"
        return self._ask(now_ns)

    def solved(self) -> list[Message]:
        """The estimate is in."""
        if self.state == "solving":
            self.state = "done"
        return []

    def abort(self, reason: str) -> list[Message]:
        """Give the session up and tell the camera; nothing once it is over."""
        if self.over:
            return []
        told = self.state not in ("idle", "solving")
        self.state = "aborted"
        self.reason = reason
        return [Abort(self.session, reason)] if told else []

    def receive(self, message: Message, now_ns: int) -> list[Message]:
        """A message from the camera side; those of other sessions are not ours."""
        if message.session != self.session or self.over:
            return []
        if isinstance(message, Started) and self.state == "armed":
            self.state = "recording"
            self.first_frame_ns = message.first_frame_ns
        elif isinstance(message, Stopped) and self.state == "stopping":
            self.state = "solving"
            self.last_frame_ns = message.last_frame_ns
        elif isinstance(message, Abort):
            self.state = "aborted"
            self.reason = message.reason
        return []

    def tick(self, now_ns: int) -> list[Message]:
        """Time passes: repeat an unanswered request, give up after GIVE_UP_NS."""
        if self.state not in ("armed", "stopping"):
            return []
        if now_ns - self._asked_ns >= GIVE_UP_NS:
            return self.abort(f"the camera did not answer within {GIVE_UP_NS / 1e9:.0f} s")
        if now_ns - self._sent_ns >= REPEAT_NS:
            return self._send(now_ns)
        return []

    def _ask(self, now_ns: int) -> list[Message]:
        self._asked_ns = now_ns
        return self._send(now_ns)

    def _send(self, now_ns: int) -> list[Message]:
        self._sent_ns = now_ns
        return [Start(self.session, now_ns) if self.state == "armed" else Stop(self.session)]


class CameraSide:
    """One session as the side that records the walker sees it; it follows.

    A camera that hears nothing more for `max_record_ns` ends the record by itself, so that a Wi-Fi side
    that died leaves nothing running.
    """

    def __init__(self, session: str, *, max_record_ns: int) -> None:
        self.session = session
        self.state: CameraState = "idle"
        self.reason = ""
        self.frames = 0
        self._max_record_ns = max_record_ns
        self._since_ns = 0
        self._first_frame_ns = 0
        self._last_frame_ns = 0

    @property
    def over(self) -> bool:
        """True once nothing is recorded any more."""
        return self.state in ("stopped", "aborted")

    def receive(self, message: Message, now_ns: int) -> list[Message]:
        """A message from the Wi-Fi side; answers to repeated requests are repeated."""
        if message.session != self.session:
            return []
        if isinstance(message, Start):
            if self.state == "idle":
                self.state = "armed"
                self._since_ns = now_ns
            elif self.state == "recording":
                return [self._started(now_ns)]
        elif isinstance(message, Stop):
            if self.state == "recording":
                self.state = "stopped"
            if self.state == "stopped":
                return [Stopped(self.session, self._last_frame_ns, self.frames)]
            if self.state == "armed":
                return self._abort("stopped before the first frame")
        elif isinstance(message, Abort) and not self.over:
            self.state = "aborted"
            self.reason = message.reason
        if self.state == "aborted" and not isinstance(message, Abort):
            return [Abort(self.session, self.reason)]
        return []

    def frame(self, frame_ns: int, now_ns: int) -> list[Message]:
        """A frame was taken; the first one answers the start."""
        if self.state == "recording":
            self.frames += 1
            self._last_frame_ns = frame_ns
        elif self.state == "armed" and frame_ns >= self._since_ns:
            self.state = "recording"
            self.frames = 1
            self._first_frame_ns = self._last_frame_ns = frame_ns
            return [self._started(now_ns)]
        return []

    def tick(self, now_ns: int) -> list[Message]:
        """Time passes: a record without an end is ended."""
        if self.state in ("armed", "recording") and now_ns - self._since_ns > self._max_record_ns:
            return self._abort("no stop came from the Wi-Fi side")
        return []

    def _started(self, now_ns: int) -> Started:
        return Started(self.session, now_ns, self._first_frame_ns)

    def _abort(self, reason: str) -> list[Message]:
        self.state = "aborted"
        self.reason = reason
        return [Abort(self.session, reason)]
