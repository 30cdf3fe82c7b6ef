"""When and where the network looks: at nothing while nothing moves, at people it knows, now and then at all.

The network on a whole picture costs 45 ms of one core, on the piece of it where somebody is known to be 10 to
20 ms, and there it sees the person larger.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vad.vision.people import SAME_IOU, Box, Image, MotionGate, Person, PoseNetwork, distinct
from vad.vision.pose_format import overlap

# Whole pictures: for the first person often enough that nobody's walk begins much later than it did; for
# more people while some are followed.
SEARCH_EVERY_NS = 200_000_000
SEARCH_AGAIN_NS = 500_000_000
# Pieces for one person and for each of two or three; for more the whole picture is cheaper.
_PIECE_FOR_ONE, _PIECE_FOR_FEW = (256, 192), (192, 128)
_FOLLOW_AT_MOST = 3
# Pieces looked at besides a whole picture that does not show all who are known.
_SEARCH_PIECES = 1
_CROWD_EVERY_NS = 120_000_000
# Stamps jitter: what is due within this is done.
_SLACK_NS = 10_000_000


@dataclass(frozen=True, slots=True)
class Look:
    """What came of one picture. looked: whether all who are known were looked for; else `people` is empty
    and says nothing. boxes: where people are as far as is known, in either case. still: nothing has moved for
    a while."""

    people: list[Person]
    looked: bool
    boxes: list[Box]
    still: bool = False


class PeopleWatch:
    """Finds people in a stream of pictures at little cost; one object a camera, every picture in turn."""

    def __init__(self, network: PoseNetwork, gate: MotionGate | None = None) -> None:
        self._network = network
        self._gate = gate or MotionGate()
        self._known: list[Box] = []
        self._searched_ns: int | None = None

    def look(self, image: Image, t_ns: int) -> Look:
        """Take the next picture, (height, width, 3) uint8 BGR, exposed at t_ns. Blocks for 1-45 ms."""
        if not self._gate.update(image):
            self._known, self._searched_ns = [], None
            return Look([], True, [], still=True)
        since_ns = None if self._searched_ns is None else t_ns - self._searched_ns + _SLACK_NS
        known = len(self._known)
        follow = 0 < known <= _FOLLOW_AT_MOST and self._network.takes_any_size
        every_ns = SEARCH_AGAIN_NS if follow else _CROWD_EVERY_NS if known else SEARCH_EVERY_NS
        if since_ns is None or since_ns >= every_ns:
            return self._search(image, t_ns)
        if not follow:
            return Look([], False, list(self._known))
        size = _PIECE_FOR_ONE if known == 1 else _PIECE_FOR_FEW
        found = [self._network.follow(image, box, size) for box in self._known]
        people = distinct([person for person in found if person is not None])
        if len(people) < known:
            self._searched_ns = None  # somebody is lost: the next picture is looked at as a whole
        self._known = [person.box for person in people]
        return Look(people, True, list(self._known))

    def _search(self, image: Image, t_ns: int) -> Look:
        people = self._network.infer(image)
        self._searched_ns = t_ns
        boxes = np.array([person.box for person in people]).reshape(-1, 4)
        # Who is small or half hidden is seen in a piece of the picture sooner than in all of it.
        missed = [box for box in self._known if not np.any(overlap(np.array(box), boxes) >= SAME_IOU)]
        if self._network.takes_any_size:
            again = [self._network.follow(image, box, _PIECE_FOR_FEW) for box in missed[:_SEARCH_PIECES]]
            people = distinct(people + [person for person in again if person is not None])
        self._known = [person.box for person in people]
        return Look(people, True, list(self._known))
