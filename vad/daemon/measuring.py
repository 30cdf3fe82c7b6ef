"""Schedule, registry and log of decisions put together: all of measuring that needs neither camera nor radio.

Time is an argument, so that a simulated week takes minutes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from vad.capture.airtime import Airtime
from vad.capture.schedule import (
    MIN_PACKETS_PER_S,
    NO_CALIBRATION,
    Candidate,
    Decision,
    Limits,
    Schedule,
    View,
)
from vad.config import CaptureSettings
from vad.daemon.decisions import DecisionLog
from vad.daemon.findings import DeviceGoneError, Finding, Findings
from vad.daemon.registry import Registry
from vad.daemon.solver_child import SolvedWalk
from vad.store.records import DeviceRecord
from vad.wall import now_rfc3339, seconds_between

_WAITING = ("discovered", "waiting", "stale", "capturing")
"""States in which a device says what it waits for; a mapped or a failed one keeps what it says."""
AWAY = "it is not in the network now"


@dataclass(frozen=True, slots=True)
class Hearing:
    """How a device is heard. per_s: CSI packets; reaches: it can be made to send; why: it gives none."""

    per_s: float
    reaches: bool
    why: str = ""


class Measuring:
    """Decides who is measured, and takes what became of it.

    Args:
        provoked_per_s: the rate at which devices are made to send, all together.
    """

    def __init__(
        self,
        limits: CaptureSettings,
        registry: Registry,
        log: DecisionLog,
        *,
        provoked_per_s: float,
        now_ns: int,
    ) -> None:
        self.findings = Findings(registry)
        self.airtime = Airtime(limits.airtime_percent / 100, now_ns)
        self._limits = limits
        self._registry = registry
        self._log = log
        self._provoked_per_s = provoked_per_s
        self._schedule = Schedule(Limits(limits.together, int(limits.recheck_h * 3600e9)))

    def use_limits(self, limits: CaptureSettings) -> None:
        """Go on with other limits; schedule and airtime stay as they began."""
        self._limits = limits

    def joined(self, mac: str, now_ns: int) -> None:
        """The device joined the network, for the first time or again."""
        self._schedule.look_again(now_ns, mac)

    async def decide(self, now_ns: int, view: View, hearing: Callable[[str], Hearing]) -> Decision:
        """What to do now. Registry and log hear what every device waits for, and why."""
        decision = self._schedule.decide(
            now_ns,
            [self._candidate(record, hearing(record.mac)) for record in self._registry.all()],
            view,
            airtime=self.airtime.allows(now_ns, self._provoked_per_s, self._limits.max_s),
        )
        step = NO_CALIBRATION if view.calibrating else decision.step  # without its many percentages
        self._log.tell(step, lasts=not decision.record)
        for mac, reason in decision.waits.items():
            if not self._registry.knows(mac):
                continue
            if self._registry.get(mac).state in _WAITING:
                await self._registry.wait(mac, reason)
            if not self._registry.knows(mac):
                continue
            common = reason in (decision.step, NO_CALIBRATION) or reason.endswith(self._registry.wish(mac))
            if not common:
                self._log.tell(f"{self.name(mac)} waits: {reason}", mac, lasts=True)
        return decision

    async def capturing(self, macs: Sequence[str]) -> None:
        """A walk for these devices begins; one that is only looked at again stays what it is meanwhile."""
        for mac in macs:
            if self._registry.knows(mac) and self._registry.get(mac).state in _WAITING:
                await self._registry.capturing(mac)

    async def void(self, now_ns: int, macs: Sequence[str], reason: str, *, its_fault: bool) -> None:
        """A walk told nothing of these devices."""
        for mac in filter(self._registry.knows, macs):
            self._schedule.failed(now_ns, mac, reason, its_fault=its_fault)
            self._log.tell(f"{self.name(mac)}: the walk is void: {reason}", mac)
            if self._registry.get(mac).state in _WAITING:
                await self._registry.wait(mac, f"{reason}; {self._registry.wish(mac)}")

    async def take(self, now_ns: int, mac: str, walk: SolvedWalk, epoch: int) -> tuple[Finding | None, str]:
        """A walk was solved on the map of `epoch`: what it says, or None and why it says nothing."""
        reason, its_fault = useless(walk, epoch)
        if reason:
            await self.void(now_ns, (mac,), reason, its_fault=its_fault)
            return None, reason
        try:
            finding = await self.findings.take(mac, walk)
        except DeviceGoneError as error:
            return None, error.what
        self._schedule.measured(now_ns, mac, blurred=self._registry.get(mac).state == "failed")
        self._log.tell(finding.text, mac)
        self._log.health.counters[finding.verdict.replace(" ", "_")] += 1
        return finding, ""

    def name(self, mac: str) -> str:
        """What people call the device."""
        return (self._registry.knows(mac) and self._registry.get(mac).name) or mac

    def _candidate(self, record: DeviceRecord, hearing: Hearing) -> Candidate:
        if hearing.per_s < MIN_PACKETS_PER_S and self._registry.away(record.mac):
            # Guests come once and are never heard again: nobody's walk is spent on asking after them.
            hearing = Hearing(hearing.per_s, False, AWAY)
        return Candidate(
            record.mac,
            record.name or record.mac,
            record.state,
            record.walks,
            self.findings.doubted(record.mac),
            hearing.per_s,
            hearing.reaches,
            hearing.why,
            self._registry.wish(record.mac),
            _ago_ns(record),
        )


def _ago_ns(record: DeviceRecord) -> int:
    """How long the last walk is past; a wall clock that was set meanwhile tells nothing worse than `now`."""
    if not record.walks:
        return 0
    return max(0, int(seconds_between(record.updated_at, now_rfc3339()) * 1e9))


def useless(walk: SolvedWalk, epoch: int) -> tuple[str, bool]:
    """Why a solved walk tells nothing, and whether that is the device's fault; empty where it does."""
    if walk.epoch != epoch:
        return "the robot's map changed during the walk", False
    if walk.posterior is None or walk.status == "refused":
        return walk.reason, walk.packets < MIN_PACKETS_PER_S * walk.walk_s
    return "", False
