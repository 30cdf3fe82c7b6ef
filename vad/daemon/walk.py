"""One walk, recorded for one or several devices: leads the handshake, writes the session folders."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from vad.capture.enough import GONE_S, LATE_S, Ground, Judgement, Progress, judge
from vad.capture.handshake import CameraSide, Message, WifiSide
from vad.capture.schedule import MIN_PACKETS_PER_S
from vad.capture.walk_writer import WalkWriter
from vad.config import CaptureSettings
from vad.csi.packets import CsiBatch
from vad.daemon.agents import Agents, Line, RemoteCard
from vad.daemon.ears import Ears
from vad.daemon.eyes import Eyes
from vad.daemon.findings import DeviceGoneError, Findings
from vad.daemon.registry import Registry
from vad.daemon.solver import Solver
from vad.errors import SessionError
from vad.finish import to_the_end
from vad.mapping.walk import WalkTrack

_log = logging.getLogger(__name__)

TICK_S = 0.1
SAVE_WALK_NS = 2_000_000_000
"""How often the walk so far is written down, so that a crash leaves it."""
LOOK_AHEAD_S = 3.0
"""Between two looks whether the walk is enough already."""
MARGIN_NS = 30_000_000_000
"""The camera gives up by itself so long after the longest walk."""
JPEG_QUALITY = 85
PICTURES_AT_ONCE = 20
"""Pictures that wait to be written; more are left out."""

TOO_FEW_FRAMES = "the walker was seen in too few frames"


@dataclass(frozen=True, slots=True)
class Recorded:
    """How a record ended. complete: the folders hold a whole walk; its_fault: the devices'."""

    complete: bool
    reason: str
    its_fault: bool = False


class WalkRecorder:
    """Records one walk.

    Args:
        macs: the devices, as the registry names them; in the order of the writer's folders.
        cards: those of them that are remote cards, by their agent.
        track: the walker.
        session: the handshake's id.

    Attributes:
        wifi: the handshake's leading side; its state is the session's.
        lost: packets of remote cards that were given up on their way, by agent.
    """

    def __init__(
        self,
        limits: CaptureSettings,
        eyes: Eyes,
        ears: Ears,
        registry: Registry,
        findings: Findings,
        solver: Solver,
        agents: Agents,
        *,
        session: str,
        macs: tuple[str, ...],
        cards: Mapping[str, RemoteCard],
        track: int,
        writer: WalkWriter,
    ) -> None:
        self.wifi = WifiSide(session, tuple(card.id for card in cards.values()))
        self.lost: Counter[str] = Counter()
        self.macs = macs
        self.track = track
        self.writer = writer
        self._camera = CameraSide(session, max_record_ns=int(limits.max_s * 1e9) + MARGIN_NS)
        self._limits = limits
        self._eyes = eyes
        self._ears = ears
        self._registry = registry
        self._findings = findings
        self._solver = solver
        self._agents = agents
        self._cards = cards
        self._lines: list[Line] = []
        self._ground = Ground()
        self._begun_ns = self._heard_ns = self._saved_ns = time.monotonic_ns()
        self._ended_ns: int | None = None
        self._use_until_ns: int | None = None
        self._judgement = Judgement("go on")
        self._to_wifi: list[Message] = []
        self._pictures: list[tuple[int, NDArray[np.uint8]]] = []
        self._sharp: set[str] = set()

    @property
    def seconds(self) -> float:
        """From its begin to its end, or till now."""
        return ((self._ended_ns or time.monotonic_ns()) - self._begun_ns) / 1e9

    async def record(self, on_progress: Callable[[], None]) -> Recorded:
        """Record until it is enough. Raises OSError where the folders cannot be written."""
        self._ears.start_recording()
        forget = self._eyes.listen(self._frame_seen)
        looking = asyncio.create_task(self._look_ahead(), name="look ahead")
        lines = contextlib.ExitStack()
        try:
            for card in self._cards.values():
                self._lines.append(lines.enter_context(self._agents.leading(card, self.wifi.session)))
            self._say(self.wifi.arm(time.monotonic_ns()))
            while self.wifi.state in ("armed", "recording", "stopping"):
                await asyncio.sleep(TICK_S)
                self._exchange()
                await self._ears.drain(self.writer)
                await self._save_remote()
                await self._save_pictures()
                await self._save_walk()
                on_progress()
        finally:
            self._ended_ns = time.monotonic_ns()
            forget()
            lines.close()
            self._ears.stop_recording()
            looking.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await looking
        if self.wifi.state == "solving":
            walk = await self._walk(self.wifi.last_frame_ns)
            if walk is not None:
                close = partial(self.writer.close, walk.t_ns, walk.xy_m, walk.sigma_m, self.track)
                await to_the_end(close)
                return Recorded(True, self._judgement.reason)
            self.wifi.abort(TOO_FEW_FRAMES)
        await to_the_end(partial(self.writer.abort, self.wifi.reason))
        return Recorded(False, self.wifi.reason, self._judgement.its_fault)

    def _exchange(self) -> None:
        """One round of the handshake: deliver, let time pass, decide whether the record is long enough."""
        now_ns = time.monotonic_ns()
        arrived, self._to_wifi = self._to_wifi, []
        for message in arrived:
            self._say(self.wifi.receive(message, now_ns))
        for line in self._lines:
            for answer in line.heard():
                self._say(self.wifi.receive(answer, now_ns, line.card.id))
        self._say(self.wifi.tick(now_ns))
        self._to_wifi += self._camera.tick(now_ns)
        if self.wifi.state != "recording":
            return
        progress = self._progress(now_ns)
        self._judgement = judge(progress, min_s=self._limits.min_s, max_s=self._limits.max_s)
        if self._judgement.act == "abort":
            self._say(self.wifi.abort(self._judgement.reason))
        elif self._judgement.act == "finish":
            if not progress.alone:
                self._use_until_ns = self._eyes.last_frame_ns - int(LATE_S * 1e9)
            self._say(self.wifi.finish(now_ns))

    def _progress(self, now_ns: int) -> Progress:
        frame_ns = self._eyes.last_frame_ns
        heard = [self._heard_per_s(mac, now_ns) for mac in self.macs]
        if max(heard) >= MIN_PACKETS_PER_S:
            self._heard_ns = now_ns
        place = self._eyes.place_of(self.track)
        if place is not None:
            self._ground.add(frame_ns, *place)
        return Progress(
            self.seconds,
            (frame_ns - self._eyes.seen_last_ns(self.track)) / 1e9,
            self._eyes.others_moving(self.track, frame_ns) == 0,
            (now_ns - self._heard_ns) / 1e9,
            len(self._sharp) == len(self.macs),
            self._ground.covered(frame_ns),
        )

    def _heard_per_s(self, mac: str, now_ns: int) -> float:
        card = self._cards.get(mac)
        if card is not None:
            return card.heard_per_s(now_ns)
        return self._ears.heard_per_s(self._registry.sends_as(mac), now_ns)

    def _say(self, messages: list[Message]) -> None:
        """To the camera and to every remote card."""
        for message in messages:
            self._to_wifi += self._camera.receive(message, time.monotonic_ns())
        for line in self._lines:
            line.say(messages)

    async def _save_remote(self) -> None:
        for line in self._lines:
            batches, lost = line.batches(), line.lost()
            self.lost[line.card.id] += lost
            if batches or lost:
                await to_the_end(partial(_write_remote, self.writer, line.card.id, batches, lost))

    def _frame_seen(self, t_ns: int) -> None:
        self._to_wifi += self._camera.frame(t_ns, time.monotonic_ns())
        image = self._eyes.last_image
        if self._limits.keep_frames and image is not None and len(self._pictures) < PICTURES_AT_ONCE:
            self._pictures.append((t_ns, image))

    async def _walk(self, to_ns: int | None) -> WalkTrack | None:
        """The walk so far; None where it is too short to be smoothed."""
        first_ns = self.wifi.first_frame_ns
        if first_ns is None or to_ns is None:
            return None
        if self._use_until_ns is not None:
            to_ns = min(to_ns, self._use_until_ns)
        return await self._eyes.walk(self.track, first_ns, to_ns)

    async def _save_walk(self) -> None:
        now_ns = time.monotonic_ns()
        if self.wifi.state != "recording" or now_ns - self._saved_ns < SAVE_WALK_NS:
            return
        self._saved_ns = now_ns
        walk = await self._walk(self._eyes.last_frame_ns)
        if walk is not None:
            await to_the_end(partial(self.writer.walk, walk.t_ns, walk.xy_m, walk.sigma_m, self.track))

    async def _save_pictures(self) -> None:
        if self._pictures:
            pictures, self._pictures = self._pictures, []
            await to_the_end(partial(_write_pictures, self.writer, pictures))

    async def _look_ahead(self) -> None:
        """Work out now and then which devices this walk would make sharp already."""
        needed = self._limits.min_walks
        known = filter(self._registry.knows, self.macs)
        if any(self._registry.get(mac).walks + 1 < needed for mac in known):
            return  # one more walk is needed, however sharp this one is
        await asyncio.sleep(self._limits.min_s + GONE_S)
        while True:
            for mac, folder in zip(self.macs, self.writer.folders, strict=True):
                try:
                    solved = await self._solver.solve(folder)
                    sharp = solved.terms is not None and await self._findings.enough(mac, solved.terms)
                except (SessionError, DeviceGoneError) as error:
                    _log.debug("%s is not ready yet: %s", folder, error)
                    sharp = False
                if sharp:
                    self._sharp.add(mac)
                else:
                    self._sharp.discard(mac)
            await asyncio.sleep(LOOK_AHEAD_S)


def _write_remote(writer: WalkWriter, card: str, batches: list[CsiBatch], lost: int) -> None:
    if lost:
        writer.lost(lost, card)
    for batch in batches:
        writer.append(batch, card)


def _write_pictures(writer: WalkWriter, pictures: list[tuple[int, NDArray[np.uint8]]]) -> None:
    for t_ns, image in pictures:
        ok, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if ok:
            writer.frame(t_ns, jpeg.tobytes())
