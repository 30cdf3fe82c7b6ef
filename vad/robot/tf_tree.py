"""ROS 2 transforms: the newest of each frame, composed along the chain (formats.md, section 3). Pure."""

from __future__ import annotations

from dataclasses import dataclass

from vad.robot.cdr import Transform, TransformMessage

MAX_CHAIN = 32
MAX_FRAMES = 1024
"""Frames kept; a robot has some dozens. What comes beyond is not taken."""


@dataclass(frozen=True, slots=True)
class Link:
    """A frame's place in its parent. stamp_ns: the robot's clock; arrival_ns: timeline."""

    parent: str
    transform: Transform
    stamp_ns: int
    arrival_ns: int
    static: bool


def compose(outer: Transform, inner: Transform) -> Transform:
    """Where `inner`'s child is in `outer`'s parent."""
    _, _, _, ax, ay, az, aw = outer
    x, y, z, bx, by, bz, bw = inner
    # v + 2 w (u x v) + 2 u x (u x v): rotation by a unit quaternion (u, w).
    tx, ty, tz = 2 * (ay * z - az * y), 2 * (az * x - ax * z), 2 * (ax * y - ay * x)
    return Transform(
        outer.x + x + aw * tx + ay * tz - az * ty,
        outer.y + y + aw * ty + az * tx - ax * tz,
        outer.z + z + aw * tz + ax * ty - ay * tx,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


class TfTree:
    """The newest transform of every frame. A frame has one parent; a new parent replaces the old one."""

    def __init__(self) -> None:
        self._links: dict[str, Link] = {}

    def put(self, message: TransformMessage, arrival_ns: int, *, static: bool) -> None:
        """Take one transform; leading slashes of frame names, as ROS 1 wrote them, do not count."""
        child = message.child_frame.lstrip("/")
        if child in self._links or len(self._links) < MAX_FRAMES:
            self._links[child] = Link(
                message.frame.lstrip("/"), message.transform, message.stamp_ns, arrival_ns, static
            )

    def chain(self, target: str, source: str) -> list[Link] | None:
        """The links from `source` up to `target`, source first; None where they are not connected."""
        links: list[Link] = []
        frame = source
        while frame != target:
            link = self._links.get(frame)
            if link is None or len(links) == MAX_CHAIN:
                return None
            links.append(link)
            frame = link.parent
        return links


def composed(chain: list[Link]) -> Transform:
    """The pose of the chain's source in its target."""
    total = Transform(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    for link in chain:
        total = compose(link.transform, total)
    return total
