"""What is sent when: in the end the broker retains what is wanted, and no topic changed too often."""

from __future__ import annotations

from collections import defaultdict

from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from vad.homeassistant.retained import GONE, Retained

EVERY_NS = 100
topics = st.sampled_from(["a", "b", "c"])
payloads = st.sampled_from([b"1", b"2", b"3"])


class Broker(RuleBasedStateMachine):
    """A broker that may forget everything, be asked what it has, and lose what is on its way."""

    def __init__(self) -> None:
        super().__init__()
        self.retained = Retained(lambda _: EVERY_NS)
        self.wanted: dict[str, bytes] = {}
        self.has: dict[str, bytes] = {}
        self.changed_ns: dict[str, list[int]] = defaultdict(list)
        self.now_ns = 0

    @rule(topic=topics, payload=payloads)
    def want(self, topic: str, payload: bytes) -> None:
        self.retained.want(topic, payload)
        self.wanted[topic] = payload

    @rule(topic=topics)
    def drop(self, topic: str) -> None:
        self.retained.drop(topic)
        self.wanted.pop(topic, None)

    @rule(passed_ns=st.integers(0, 60))
    def send(self, passed_ns: int) -> None:
        self.now_ns += passed_ns
        for topic, payload in self.retained.due(self.now_ns):
            if payload == GONE:
                self.has.pop(topic, None)
            else:
                if self.changed_ns[topic]:
                    assert self.now_ns - self.changed_ns[topic][-1] >= EVERY_NS
                self.changed_ns[topic].append(self.now_ns)
                self.has[topic] = payload
            if payload == GONE:
                self.changed_ns[topic].clear()
            self.retained.sent(topic, payload, self.now_ns)

    @rule(passed_ns=st.integers(0, 60), lost=st.booleans())
    def send_one_and_break(self, passed_ns: int, lost: bool) -> None:
        """The connection ends in the midst; the broker took the last one, or did not."""
        self.now_ns += passed_ns
        for topic, payload in self.retained.due(self.now_ns):
            if not lost:
                if payload == GONE:
                    self.has.pop(topic, None)
                else:
                    self.has[topic] = payload
            break
        self.connect_again()

    @rule()
    def connect_again(self) -> None:
        self.changed_ns.clear()
        self.retained.again()
        for topic in list(self.has):
            to_be_forgotten = self.retained.found(topic)
            assert not (to_be_forgotten and topic in self.wanted)

    @rule(topic=st.sampled_from(["old", "a"]))
    def another_broker(self, topic: str) -> None:
        """It has something of an earlier run, and nothing else."""
        self.has = {topic: b"0"}
        self.connect_again()

    @invariant()
    def settles(self) -> None:
        """Left alone for a moment, the broker would have what is wanted: a wait is told of what waits."""
        waits = self.retained.next_ns()
        differs = {t for t in {*self.has, *self.wanted} if self.has.get(t) != self.wanted.get(t)}
        if differs:
            assert waits is not None
        elif waits is None:
            assert self.has == self.wanted

    def teardown(self) -> None:
        for _ in range(4):
            self.send(60)
        assert self.has == self.wanted
        assert self.retained.next_ns() is None


TestBroker = Broker.TestCase


def test_what_is_wanted_already_is_no_news() -> None:
    retained = Retained(lambda _: EVERY_NS)
    assert retained.want("a", b"1")
    assert not retained.want("a", b"1")
    assert retained.want("a", b"2")
