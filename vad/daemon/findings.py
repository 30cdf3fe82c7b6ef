"""What a solved walk changes of what is known: it sharpens a place, or says that the device was moved.

A walk that contradicts the map changes nothing at first: the device is measured again, and only when the next
walk contradicts the map, too, is what was known before dropped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vad.capture.moved import contradicts
from vad.daemon.registry import Registry
from vad.daemon.solver_child import SolvedWalk
from vad.errors import VadError
from vad.mapping.device_stage import PlaceEstimate, place_from_posterior
from vad.mapping.evidence import Terms


class DeviceGoneError(VadError):
    """The device is not known any more."""

    code = "gone"


Verdict = Literal["sharper", "contradicts", "moved", "begun anew"]


@dataclass(frozen=True, slots=True)
class Finding:
    """What became of a walk. place: where the device is now believed to be; text: one sentence."""

    verdict: Verdict
    place: PlaceEstimate
    text: str


@dataclass(frozen=True, slots=True)
class _Doubt:
    walk: SolvedWalk
    epoch: int


class Findings:
    """Takes solved walks, one after the other; what contradicts the map is held back here."""

    def __init__(self, registry: Registry) -> None:
        self._registry = registry
        self._doubts: dict[str, _Doubt] = {}

    def doubted(self, mac: str) -> bool:
        """Whether the device's last walk contradicts its map."""
        return mac in self._doubts

    def _still_known(self, mac: str) -> None:
        if not self._registry.knows(mac):
            self._doubts.pop(mac, None)
            raise DeviceGoneError("the device was forgotten meanwhile", where=mac)

    async def enough(self, mac: str, walk: Terms) -> bool:
        """Whether this much of a walk would leave the device mapped; not where it contradicts the map: what
        it says had better be sure."""
        self._still_known(mac)
        before = await self._registry.known_posterior(mac, walk.grid)
        if before is None or contradicts(before, walk.posterior(walk.grid)):
            return False
        self._still_known(mac)
        return await self._registry.would_be_mapped(mac, walk)

    async def take(self, mac: str, walk: SolvedWalk) -> Finding:
        """Judge a walk that has a posterior, and tell the registry.

        Raises DeviceGoneError where the device was forgotten, or found to be another one, meanwhile.
        """
        posterior = walk.posterior
        assert posterior is not None
        self._still_known(mac)
        name = self._registry.get(mac).name or mac
        before = await self._registry.known_posterior(mac, posterior.grid)
        self._still_known(mac)
        doubt = self._doubts.pop(mac, None)
        if before is None or not contradicts(before, posterior):
            place = await self._add(mac, walk)
            await self._doubt(mac, on=False)
            passed = "; the walk before that said otherwise is left out" if doubt and before else ""
            return Finding("sharper", place, f"{name}: {self._where(mac, place)}{passed}")
        if doubt is None or doubt.epoch != walk.epoch:
            self._doubts[mac] = _Doubt(walk, walk.epoch)
            await self._doubt(mac, on=True)
            place = place_from_posterior(posterior)
            text = f"{name}: this walk says {self._spot(place)}, the map says {self._spot_of(mac)}: "
            return Finding("contradicts", place, text + "it is measured again before anything is changed")
        return await self._begin_anew(mac, name, doubt.walk, walk)

    async def _begin_anew(self, mac: str, name: str, first: SolvedWalk, second: SolvedWalk) -> Finding:
        """Two walks in a row say that it is not where it was."""
        before, now = first.posterior, second.posterior
        assert before is not None
        assert now is not None
        was, mapped = self._spot_of(mac), self._registry.get(mac).state == "mapped"
        agree = before.grid == now.grid and not contradicts(before, now)
        place = await self._add(mac, first if agree else second, anew=True)
        if agree:
            place = await self._add(mac, second)
        await self._doubt(mac, on=False)
        if not mapped:
            return Finding(
                "begun anew", place, f"{name}: its first walks were wrong; {self._where(mac, place)}"
            )
        text = f"{name} was moved, from {was} to {self._spot_of(mac)}"
        self._registry.say_moved(mac, text)
        return Finding("moved", place, f"{text}; what was known of the old place is dropped")

    async def _add(self, mac: str, walk: SolvedWalk, *, anew: bool = False) -> PlaceEstimate:
        assert walk.terms is not None
        place = await self._registry.add_evidence(mac, walk.terms, walk.packets, walk.walk_s, anew=anew)
        self._still_known(mac)
        return place

    async def _doubt(self, mac: str, *, on: bool) -> None:
        await self._registry.doubt(mac, on=on)
        self._still_known(mac)

    def _where(self, mac: str, place: PlaceEstimate) -> str:
        record = self._registry.get(mac)
        walks = f"{record.walks} walk{'s' if record.walks != 1 else ''}"
        return f"{record.state}, {self._spot_of(mac)}, ±{place.radius90_m:.1f} m after {walks}"

    def _spot_of(self, mac: str) -> str:
        """The room where the map has the device, else its coordinates."""
        estimate = self._registry.get(mac).estimate
        if estimate is None:
            return "nowhere yet"
        return estimate.room or f"({estimate.x_m:.1f}, {estimate.y_m:.1f}) m"

    def _spot(self, place: PlaceEstimate) -> str:
        x_m, y_m = float(place.xy_m[0]), float(place.xy_m[1])
        return self._registry.room_at(x_m, y_m) or f"({x_m:.1f}, {y_m:.1f}) m"
