"""The feed: whoever reads, at whatever pace and with whatever breaks, ends with what is there."""

from __future__ import annotations

import asyncio
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vad.web import feed as feed_module
from vad.web.feed import GONE_KEPT, ROLLING, Feed

keys = st.sampled_from(["status", "map", "devices/a", "devices/b", "devices/c"])
steps = st.lists(
    st.one_of(
        st.tuples(st.just("put"), keys, st.integers(0, 9)),
        st.tuples(st.just("drop"), keys, st.just(0)),
        st.tuples(st.just("read"), st.just(""), st.just(0)),
        st.tuples(st.just("come back"), st.just(""), st.just(0)),
    ),
    max_size=60,
)


class Reader:
    """What a browser keeps."""

    def __init__(self, feed: Feed) -> None:
        self.feed, self.told, self.known = feed, 0, dict[str, int]()

    def read(self) -> None:
        numbers = []
        for item in self.feed.since(self.told):
            numbers.append(item.number)
            if item.gone:
                self.known.pop(item.key, None)
            else:
                self.known[item.key] = json.loads(item.value)
        assert numbers == sorted(numbers), "ids go up"
        assert all(number > self.told for number in numbers)
        self.told = max([self.told, *numbers])

    def come_back(self) -> None:
        """As with Last-Event-ID; anew where the feed says so."""
        position = self.feed.position(self.feed.event_id(self.told))
        if position is None:
            self.known.clear()
        self.told = position or 0
        self.read()


@given(steps)
def test_a_reader_ends_with_what_is_there(script: list[tuple[str, str, int]]) -> None:
    feed, truth = Feed(), dict[str, int]()
    reader = Reader(feed)
    for act, key, value in script:
        if act == "put":
            feed.put(key, json.dumps(value).encode())
            truth[key] = value
        elif act == "drop":
            feed.drop(key)
            truth.pop(key, None)
        elif act == "read":
            reader.read()
        else:
            reader.come_back()
    reader.read()
    assert reader.known == truth
    assert {item.key for item in feed.since(0)} == set(truth), "a new reader hears of nothing that is gone"


def test_only_the_newest_of_a_key_is_told() -> None:
    feed = Feed()
    feed.put("map", b"1")
    reader = Reader(feed)
    reader.read()
    for i in range(1000):
        feed.put("status", b"%d" % i)
    assert [(item.key, item.value) for item in feed.since(reader.told)] == [("status", b"999")]


def test_a_log_keeps_its_last_lines_only() -> None:
    feed = Feed()
    most = ROLLING["events/"]
    for i in range(most + 20):
        feed.put(f"events/{i}", b"{}")
    assert [item.key for item in feed.since(0)] == [f"events/{i}" for i in range(20, most + 20)]


def test_what_was_taken_back_long_ago_makes_a_late_reader_begin_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feed_module, "GONE_KEPT", 3)
    assert GONE_KEPT >= 100
    feed = Feed()
    for i in range(5):
        feed.put(f"devices/{i}", b"1")
    before = feed.event_id(feed.number)
    for i in range(3):
        feed.drop(f"devices/{i}")
    assert feed.position(before) is not None
    feed.drop("devices/3")
    assert feed.position(before) is None
    assert len(feed.since(0)) == 1
    assert feed.position(feed.event_id(feed.number)) == feed.number


@pytest.mark.parametrize(
    "text", [None, "", "-", "x", "{life}-", "{life}--1", "{life}-x", "{life}-99", "{life}-²"]
)
def test_an_id_of_elsewhere_begins_anew(text: str | None) -> None:
    feed = Feed()
    feed.put("map", b"1")
    assert feed.position(text and text.format(life=feed.life)) is None
    assert feed.position(Feed().event_id(1)) is None


async def test_watchers_hear_of_changes_until_they_leave() -> None:
    feed = Feed()
    with feed.watching() as changed:
        assert not changed.is_set()
        feed.put("map", b"1")
        async with asyncio.timeout(40):
            await changed.wait()
        changed.clear()
        feed.drop("nothing")
        assert not changed.is_set(), "nothing happened"
    feed.put("map", b"2")
    assert not changed.is_set()
