"""Random interleavings of one session: a hub, its camera, a remote node; links that lose, repeat and delay.

`explore(seed)` plays one course to its end and raises `ViolationError`, with the course, where something
holds that must not.
"""

from __future__ import annotations

import random
from collections import Counter
from heapq import heappop, heappush
from itertools import count

from vad.capture.handshake import (
    CAMERA,
    REMOTE_GIVE_UP_NS,
    Follower,
    Message,
    WifiSide,
    no_such_session,
)

NODE = "node"
SESSION = "s"
MAX_RECORD_NS = 30_000_000_000
SETTLE_STEPS = 90
SETTLE_STEP_NS = 500_000_000
HUB = "hub"


class ViolationError(AssertionError):
    """What must not be, and the course that led there."""


def _follower(name: str) -> Follower:
    silent_ns = REMOTE_GIVE_UP_NS
    return Follower(SESSION, thing="frame", max_record_ns=MAX_RECORD_NS, silent_ns=silent_ns)


class _World:
    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.now_ns = 1_000_000_000
        self.course: list[str] = []
        self.verdicts: set[str] = set()
        self.wifi: WifiSide | None = WifiSide(SESSION, (NODE,))
        self.hub_lives = True
        self.alive = {CAMERA: True, NODE: True}
        # None: it has not heard of the session, or has died and knows nothing any more.
        self.followers: dict[str, Follower | None] = {CAMERA: None, NODE: None}
        self.records: dict[tuple[str, int], Follower] = {}  # by who and its first frame
        self.taken: dict[str, int | None] = {CAMERA: None, NODE: None}  # the record that the hub knows
        self.wanted = False
        self._flying: list[tuple[int, int, str, str, Message]] = []
        self._order = count()
        kind = self.random.random()
        self.loss = 0.0 if kind < 0.2 else self.random.uniform(0, 0.6)
        self.doubling = self.random.uniform(0, 0.3)
        self.delay_ns = 0 if kind < 0.1 else int(self.random.choice([1e7, 1e8, 1e9, 4e9]))
        self.crashes = 0.0 if kind < 0.4 else self.random.uniform(0, 0.1)
        self.frames = {name: self.random.choice([1.0, 1.0, 1.0, 0.5, 0.0]) for name in (CAMERA, NODE)}

    def send(self, source: str, messages: list[Message], to: str | None = None) -> None:
        """Put messages on the links: the hub's go to every follower."""
        for message in messages:
            for target in [to] if to else [CAMERA, NODE] if source == HUB else [HUB]:
                for _ in range(1 + (self.random.random() < self.doubling)):
                    if self.random.random() >= self.loss:
                        due_ns = self.now_ns + int(self.random.random() * self.delay_ns)
                        heappush(self._flying, (due_ns, next(self._order), source, target, message))

    def deliver(self) -> None:
        """Everything that is due."""
        while self._flying and self._flying[0][0] <= self.now_ns:
            _, _, source, target, message = heappop(self._flying)
            self.course.append(f"{self.now_ns / 1e9:.2f} {source}->{target} {message}")
            if target == HUB:
                self._to_hub(source, message)
            elif self.alive[target]:
                follower = self.followers[target]
                if follower is None:
                    follower = self.followers[target] = _follower(target)
                was = follower.state, follower.over
                self.send(target, follower.receive(message, self.now_ns))
                self._check_follower(target, follower, was)

    def _to_hub(self, source: str, message: Message) -> None:
        if not self.hub_lives:
            return
        if self.wifi is None:
            self.send(HUB, no_such_session(message), source)
            return
        self.send(HUB, self.wifi.receive(message, self.now_ns, source))
        self.note()

    def _check_follower(self, name: str, follower: Follower, was: tuple[str, bool]) -> None:
        if was[1] and follower.state != was[0]:
            raise self.violation(f"the {name} left {was[0]} for {follower.state}")
        if follower.state == "aborted" and not follower.reason:
            raise self.violation(f"the {name} aborted without a reason")

    def frame(self, name: str) -> None:
        """The follower takes something."""
        follower = self.followers[name]
        if not self.alive[name] or follower is None:
            return
        was = follower.state, follower.over
        self.send(name, follower.took(self.now_ns, self.now_ns, 1, self.now_ns))
        if was[0] == "armed" and follower.state == "recording":
            self.records[name, self.now_ns] = follower
        self._check_follower(name, follower, was)

    def tick(self) -> None:
        """Everybody who lives looks at the clock."""
        if self.hub_lives and self.wifi is not None:
            self.send(HUB, self.wifi.tick(self.now_ns))
            if self.wanted:
                self.send(HUB, self.wifi.finish(self.now_ns))
            self.note()
        for name, follower in self.followers.items():
            if self.alive[name] and follower is not None:
                was = follower.state, follower.over
                self.send(name, follower.tick(self.now_ns))
                self._check_follower(name, follower, was)

    def note(self) -> None:
        """Write the verdict down, as the session folder does; it is checked against what was before."""
        if self.wifi is None or not self.wifi.over:
            return
        self.verdicts.add(self.wifi.state)
        if self.wifi.state == "aborted" and not self.wifi.reason:
            raise self.violation("aborted without a reason")
        if len(self.verdicts) > 1:
            raise self.violation("the session is both done and aborted")
        if self.wifi.state == "done":
            for name in (CAMERA, NODE):
                record = self.records.get((name, self.wifi.first_ns(name) or 0))
                if record is None or record.state != "stopped":
                    raise self.violation(f"done, but the {name}'s record is not complete")
                if record.frames != self.wifi.recorded(name):
                    raise self.violation(f"done with another number of frames than the {name}'s")

    def crash(self) -> None:
        """Somebody dies, or comes back and knows nothing any more."""
        who = self.random.choice([HUB, CAMERA, NODE])
        self.course.append(f"{self.now_ns / 1e9:.2f} {who} dies or comes back")
        if who != HUB:
            self.alive[who] = not self.alive[who]
            self.followers[who] = None
        elif self.hub_lives:
            self.hub_lives, self.wifi = False, None
        else:
            self.hub_lives = True
            # What the folder of a session says that was still being recorded when the hub died.
            self.verdicts |= set() if self.verdicts else {"aborted"}

    def violation(self, what: str) -> ViolationError:
        return ViolationError("\n".join([what, *self.course]))


def explore(seed: int) -> str:
    """Play one course; the verdict: done, aborted, or dead where the hub did not come back."""
    world = _World(seed)
    choose = world.random.random
    assert world.wifi is not None
    world.send(HUB, world.wifi.arm(world.now_ns))
    finish_at = world.random.randrange(5, 60)
    for k in range(world.random.randrange(10, 60)):
        world.now_ns += int(choose() * world.random.choice([1e7, 1e8, 6e8]))
        world.deliver()
        for name in (CAMERA, NODE):
            if choose() < world.frames[name]:
                world.frame(name)
        if k >= finish_at:
            world.wanted = True
        if choose() < 0.7:
            world.tick()
        if world.wifi is not None and choose() < 0.3:
            world.wifi.solved()  # a no-op unless it solves
            world.note()
        if choose() < 0.01 and world.wifi is not None:
            world.send(HUB, world.wifi.abort("somebody else moved in the picture"))
            world.note()
        if choose() < world.crashes:
            world.crash()
    # From here on the links are good and nobody dies: everything must come to its end.
    world.loss = world.doubling = 0.0
    world.delay_ns = min(world.delay_ns, 100_000_000)
    world.wanted = True
    for _ in range(SETTLE_STEPS):
        world.now_ns += SETTLE_STEP_NS
        world.deliver()
        world.tick()
        for name in (CAMERA, NODE):
            if world.frames[name]:
                world.frame(name)
        if world.wifi is not None:
            world.wifi.solved()
            world.note()
        if world.wifi is None or world.wifi.over:
            running = [n for n, f in world.followers.items() if f is not None and f.recording]
            if not running and not world._flying:
                break
    if world.wifi is not None and not world.wifi.over:
        raise world.violation(f"the hub waits for ever in {world.wifi.state}")
    for name, follower in world.followers.items():
        if world.alive[name] and follower is not None and follower.recording:
            raise world.violation(f"the {name}'s recording was left running")
    return next(iter(world.verdicts), "dead")


def explore_many(seeds: range) -> Counter[str]:
    """How often each verdict came."""
    return Counter(explore(seed) for seed in seeds)
