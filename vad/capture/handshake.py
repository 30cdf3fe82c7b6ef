"""The Wi-Fi - camera handshake as sans-IO state machines: transition tables and who acts on them.

The Wi-Fi side leads: it starts a session, keeps it going and stops it. Who records for it follows: the
camera, and the node with the CSI card where that is another machine. A follower acknowledges with its clock
and the first thing that it recorded. Both take messages and the time, and return what is to be said. Messages
carry the session's id: a repeated one is answered again, a late one ignored, none is acted on twice.

    leader    idle -> armed -> recording -> stopping -> solving -> done
    follower  idle -> armed -> recording -> stopped
    any state before the last -> aborted, with a reason

What holds whatever is lost, repeated, reordered, and whoever dies (tests/capture): the verdict, done or
aborted, is the leader's alone and final; done means that every follower's record is complete and is the same
one that it began with; a follower that hears nobody stops by itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import msgspec

WifiState = Literal["idle", "armed", "recording", "stopping", "solving", "done", "aborted"]
FollowerState = Literal["idle", "armed", "recording", "stopped", "aborted"]

REPEAT_NS = 500_000_000
"""A request is sent again after this long; while it records, the leader shows this often that it lives."""

GIVE_UP_NS = 3_000_000_000
"""A follower on this machine that says nothing for this long has died."""

REMOTE_GIVE_UP_NS = 10_000_000_000
"""The same for one behind a network, which may break for some seconds and catch up."""

STALL_NS = 2_000_000_000
"""A follower that has had nothing to record for this long says so."""


class Start(msgspec.Struct, frozen=True, tag=True):
    """Leader -> followers: record from now on. sent_ns: the sender's clock."""

    session: str
    sent_ns: int


class Going(msgspec.Struct, frozen=True, tag=True):
    """Leader -> followers: the session goes on, go on recording."""

    session: str


class Started(msgspec.Struct, frozen=True, tag=True):
    """Follower -> leader: recording. camera_ns: its clock now; first_frame_ns: the first thing of its record,
    which tells one record from another."""

    session: str
    camera_ns: int
    first_frame_ns: int


class Stop(msgspec.Struct, frozen=True, tag=True):
    """Leader -> followers: the record is long enough."""

    session: str


class Stopped(msgspec.Struct, frozen=True, tag=True):
    """Follower -> leader: the record that began with first_frame_ns ended with last_frame_ns and holds
    `frames` frames, or packets."""

    session: str
    last_frame_ns: int
    frames: int
    first_frame_ns: int


class Abort(msgspec.Struct, frozen=True, tag=True):
    """Either side: this session is void."""

    session: str
    reason: str


Request = Start | Going | Stop | Abort
Answer = Started | Stopped | Abort
Message = Start | Going | Started | Stop | Stopped | Abort

CAMERA = "camera"
NOT_KNOWN = "it does not know this session: it was started anew in between"

LeaderEvent = Literal["arm", "all started", "finish", "all stopped", "solved", "give up"]
Say = Literal["", "start", "going", "stop", "abort", "started", "stopped"]

LEADER: Mapping[tuple[WifiState, LeaderEvent], tuple[WifiState, Say]] = {
    ("idle", "arm"): ("armed", "start"),
    ("armed", "all started"): ("recording", ""),
    ("recording", "finish"): ("stopping", "stop"),
    ("stopping", "all stopped"): ("solving", ""),
    ("solving", "solved"): ("done", ""),
    ("idle", "give up"): ("aborted", ""),
    ("armed", "give up"): ("aborted", "abort"),
    ("recording", "give up"): ("aborted", "abort"),
    ("stopping", "give up"): ("aborted", "abort"),
    ("solving", "give up"): ("aborted", ""),
}
"""What the leader does; an event that is not listed for a state changes nothing in it."""

_REPEATED: Mapping[WifiState, Say] = {"armed": "start", "recording": "going", "stopping": "stop"}

FollowerEvent = Literal["start", "going", "stop", "told to abort", "first", "give up"]

FOLLOWER: Mapping[tuple[FollowerState, FollowerEvent], tuple[FollowerState, Say]] = {
    ("idle", "start"): ("armed", ""),
    # Nobody asks for a record that was not begun, unless whoever began it has died.
    ("idle", "going"): ("aborted", "abort"),
    ("idle", "stop"): ("aborted", "abort"),
    ("idle", "told to abort"): ("aborted", ""),
    ("armed", "first"): ("recording", "started"),
    ("armed", "stop"): ("aborted", "abort"),
    ("armed", "told to abort"): ("aborted", ""),
    ("armed", "give up"): ("aborted", "abort"),
    ("recording", "start"): ("recording", "started"),
    ("recording", "going"): ("recording", "started"),
    ("recording", "stop"): ("stopped", "stopped"),
    ("recording", "told to abort"): ("aborted", ""),
    ("recording", "give up"): ("aborted", "abort"),
    ("stopped", "stop"): ("stopped", "stopped"),
    ("aborted", "start"): ("aborted", "abort"),
    ("aborted", "going"): ("aborted", "abort"),
    ("aborted", "stop"): ("aborted", "abort"),
}
"""What a follower does; an event that is not listed for a state changes nothing in it."""


def no_such_session(answer: Message) -> list[Message]:
    """What a leader says to whoever records a session that it does not know."""
    if isinstance(answer, Started):
        return [Abort(answer.session, "the hub does not know this session: it was started anew in between")]
    return []


@dataclass(slots=True)
class _Seen:
    """What the leader knows of one follower."""

    give_up_ns: int
    heard_ns: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    count: int = 0


class WifiSide:
    """One session as the side that leads sees it.

    `state` and `reason` (why aborted) are for reading only. Every method returns the messages that are to be
    sent to every follower.

    Args:
        session: its id.
        remote: names of the followers behind a network; the camera is always one, on this machine.
    """

    def __init__(self, session: str, remote: tuple[str, ...] = ()) -> None:
        self.session = session
        self.state: WifiState = "idle"
        self.reason = ""
        self._followers = {CAMERA: _Seen(GIVE_UP_NS)} | {name: _Seen(REMOTE_GIVE_UP_NS) for name in remote}
        self._sent_ns = 0

    @property
    def over(self) -> bool:
        """True once nothing can change any more."""
        return self.state in ("done", "aborted")

    @property
    def first_frame_ns(self) -> int | None:
        """The camera's first frame."""
        return self.first_ns(CAMERA)

    @property
    def last_frame_ns(self) -> int | None:
        """The camera's last frame."""
        return self._followers[CAMERA].last_ns

    def first_ns(self, follower: str) -> int | None:
        """The first thing of this follower's record, which names the record."""
        return self._followers[follower].first_ns

    def recorded(self, follower: str) -> int:
        """How many frames or packets the stopped follower says it has recorded."""
        return self._followers[follower].count

    def arm(self, now_ns: int) -> list[Message]:
        """CSI collection has begun: ask everybody to record."""
        return self._event("arm", now_ns)

    def finish(self, now_ns: int) -> list[Message]:
        """Enough has been recorded: ask everybody to stop."""
        return self._event("finish", now_ns)

    def solved(self) -> list[Message]:
        """The estimate is in."""
        return self._event("solved", self._sent_ns)

    def abort(self, reason: str) -> list[Message]:
        """Give the session up and tell; nothing once it is over."""
        if not self.over:
            self.reason = reason
        return self._event("give up", self._sent_ns)

    def receive(self, message: Message, now_ns: int, follower: str = CAMERA) -> list[Message]:
        """A message from a follower; those of other sessions are not ours."""
        seen = self._followers.get(follower)
        if message.session != self.session or seen is None:
            return []
        if self.state == "aborted":
            # It has not heard of the end, or it would not record.
            return [Abort(self.session, self.reason)] if isinstance(message, Started) else []
        if self.state not in ("armed", "recording", "stopping"):
            return []
        seen.heard_ns = now_ns
        if isinstance(message, Abort):
            return self.abort(message.reason)
        if not isinstance(message, Started | Stopped):
            return []
        if seen.first_ns not in (None, message.first_frame_ns):
            return self.abort(f"the {follower} began a new record in the middle: it was started anew")
        seen.first_ns = message.first_frame_ns
        if isinstance(message, Stopped) and self.state == "stopping":
            seen.last_ns, seen.count = message.last_frame_ns, message.frames
        if self.state == "armed" and all(s.first_ns is not None for s in self._followers.values()):
            return self._event("all started", now_ns)
        if self.state == "stopping" and all(s.last_ns is not None for s in self._followers.values()):
            return self._event("all stopped", now_ns)
        return []

    def tick(self, now_ns: int) -> list[Message]:
        """Time passes: repeat a request, give up on a follower that has died."""
        if self.state not in ("armed", "recording", "stopping"):
            return []
        for name, seen in self._followers.items():
            waits = self.state == "recording" or (
                seen.first_ns is None if self.state == "armed" else seen.last_ns is None
            )
            if waits and now_ns - seen.heard_ns >= seen.give_up_ns:
                return self.abort(f"the {name} did not answer within {seen.give_up_ns / 1e9:.0f} s")
        if now_ns - self._sent_ns >= REPEAT_NS:
            return self._say(_REPEATED[self.state], now_ns)
        return []

    def _event(self, event: LeaderEvent, now_ns: int) -> list[Message]:
        step = LEADER.get((self.state, event))
        if step is None:
            return []
        self.state, say = step
        if event in ("arm", "finish"):  # somebody who records may have been silent for a while until then
            for seen in self._followers.values():
                seen.heard_ns = now_ns
        return self._say(say, now_ns) if say else []

    def _say(self, say: Say, now_ns: int) -> list[Message]:
        self._sent_ns = now_ns
        if say == "start":
            return [Start(self.session, now_ns)]
        if say == "going":
            return [Going(self.session)]
        return [Stop(self.session) if say == "stop" else Abort(self.session, self.reason)]


class Follower:
    """One session as a side that records for the leader sees it.

    It ends by itself, so that a leader that died leaves nothing running: when it has heard nothing for
    `silent_ns`, after `max_record_ns`, and when there was nothing to record for `stall_ns`.

    Args:
        session: its id.
        thing: what it records one after the other.
        max_record_ns, silent_ns, stall_ns: see above.

    Attributes:
        state, reason: for reading only.
        frames: things recorded.
    """

    def __init__(
        self,
        session: str,
        *,
        thing: str,
        max_record_ns: int,
        silent_ns: int = GIVE_UP_NS,
        stall_ns: int = STALL_NS,
    ) -> None:
        self.session = session
        self.state: FollowerState = "idle"
        self.reason = ""
        self.frames = 0
        self._thing = thing
        self._max_record_ns, self._silent_ns, self._stall_ns = max_record_ns, silent_ns, stall_ns
        self._since_ns = 0
        self._took_ns = 0
        self._heard_ns = 0
        self._first_ns = 0
        self._last_ns = 0

    @property
    def recording(self) -> bool:
        """True while it records, or waits for the first thing to record."""
        return self.state in ("armed", "recording")

    @property
    def over(self) -> bool:
        """True once nothing is recorded any more."""
        return self.state in ("stopped", "aborted")

    def receive(self, message: Message, now_ns: int) -> list[Message]:
        """A message from the leader; answers to repeated requests are repeated."""
        if message.session != self.session:
            return []
        self._heard_ns = now_ns
        if isinstance(message, Start):
            if self.state == "idle":
                self._since_ns = self._took_ns = now_ns
            return self._event("start", now_ns)
        if isinstance(message, Going):
            return self._event("going", now_ns, NOT_KNOWN)
        if isinstance(message, Stop):
            never = NOT_KNOWN if self.state == "idle" else f"stopped before the first {self._thing}"
            return self._event("stop", now_ns, never)
        if isinstance(message, Abort):
            return self._event("told to abort", now_ns, message.reason)
        return []

    def took(self, first_ns: int, last_ns: int, count: int, now_ns: int) -> list[Message]:
        """`count` things were taken from first_ns to last_ns; the first ones answer the start."""
        if self.state == "recording" and count:
            self.frames += count
            self._last_ns, self._took_ns = last_ns, now_ns
        elif self.state == "armed" and count and first_ns >= self._since_ns:
            self.frames, self._took_ns = count, now_ns
            self._first_ns, self._last_ns = first_ns, last_ns
            return self._event("first", now_ns)
        return []

    def tick(self, now_ns: int) -> list[Message]:
        """Time passes: a record that nobody ends is ended."""
        if not self.recording:
            return []
        if now_ns - self._took_ns > self._stall_ns:
            return self.give_up(f"no {self._thing} came for {self._stall_ns / 1e9:.0f} s", now_ns)
        if now_ns - self._since_ns > self._max_record_ns:
            return self.give_up("no stop came from the Wi-Fi side", now_ns)
        if now_ns - self._heard_ns > self._silent_ns:
            return self.give_up(f"the Wi-Fi side was silent for {self._silent_ns / 1e9:.0f} s", now_ns)
        return []

    def give_up(self, reason: str, now_ns: int) -> list[Message]:
        """End the record and say why; nothing where none is running."""
        return self._event("give up", now_ns, reason)

    def _event(self, event: FollowerEvent, now_ns: int, reason: str = "") -> list[Message]:
        step = FOLLOWER.get((self.state, event))
        if step is None:
            return []
        before, (self.state, say) = self.state, step
        if self.state == "aborted" != before:
            self.reason = reason
        if say == "started":
            return [Started(self.session, now_ns, self._first_ns)]
        if say == "stopped":
            return [Stopped(self.session, self._last_ns, self.frames, self._first_ns)]
        return [Abort(self.session, self.reason)] if say else []


class CameraSide(Follower):
    """The camera as a follower, on the leader's machine."""

    def __init__(self, session: str, *, max_record_ns: int) -> None:
        super().__init__(session, thing="frame", max_record_ns=max_record_ns)

    def frame(self, frame_ns: int, now_ns: int) -> list[Message]:
        """A frame was taken."""
        return self.took(frame_ns, frame_ns, 1, now_ns)
