"""What the store remembers, as messages: how a device was, and how it came to be where it is."""

from __future__ import annotations

from vad.bus import messages as m
from vad.bus.answers import HistoryError
from vad.bus.selectors import HistoryQuestion
from vad.store.records import HistoryRecord, PastRecord
from vad.store.worker import StoreWorker


class StoredPast:
    """Answers the bus from the store (`vad.bus.answers.Past`)."""

    def __init__(self, store: StoreWorker, source: m.Source) -> None:
        self._store = store
        self._source = source

    async def devices_at(self, at: str, mac: str | None) -> list[m.DeviceMessage]:
        """Devices as they were at `at`; HistoryError for one whose history does not reach back so far.

        Among all devices such a one is stale, without a place, and its reason says so.
        """
        found = await self._store.past(at, mac)
        if mac is not None and found and found[0].said is None:
            raise HistoryError(_gone(found[0]), remedy="Ask for a later time")
        return [self._message(past) for past in found]

    async def history(self, mac: str, question: HistoryQuestion) -> m.HistoryMessage | None:
        """What was said of a device; None for one that is not known."""
        if await self._store.device(mac) is None:
            return None
        entries = await self._store.history(mac, question.limit, since=question.since, until=question.until)
        return m.HistoryMessage(source=self._source, mac=mac, entries=tuple(_entry(one) for one in entries))

    def _message(self, past: PastRecord) -> m.DeviceMessage:
        said = past.said
        if said is None:
            return m.DeviceMessage(source=self._source, mac=past.mac, state="stale", reason=_gone(past))
        return m.DeviceMessage(
            source=self._source,
            mac=said.mac,
            name=said.name,
            state=said.state,  # type: ignore[arg-type]  # the store keeps text
            x_m=said.x_m,
            y_m=said.y_m,
            covariance_m2=said.covariance_m2,
            radius90_m=said.radius90_m,
            room=said.room,
            epoch=said.epoch,
            walks=said.walks,
            updated_at=said.at,
        )


def _gone(past: PastRecord) -> str:
    since = f"begins at {past.kept_since}" if past.kept_since else "is empty"
    return f"the history of {past.mac} that is kept {since}"


def _entry(said: HistoryRecord) -> m.HistoryEntry:
    return m.HistoryEntry(
        at=said.at,
        state=said.state,  # type: ignore[arg-type]  # the store keeps text
        epoch=said.epoch,
        x_m=said.x_m,
        y_m=said.y_m,
        covariance_m2=said.covariance_m2,
        radius90_m=said.radius90_m,
        room=said.room,
        name=said.name,
        walks=said.walks,
    )
