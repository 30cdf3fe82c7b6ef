"""Where a ROS 2 topic is found on zenoh (formats.md, section 3). Pure."""

from __future__ import annotations

import re
from typing import Literal

from vad.errors import ConfigError

Style = Literal["rmw_zenoh", "bridge"]

_TOPIC = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


def topic_name(topic: str, namespace: str) -> str:
    """The topic's full name without the slash in front; one that begins with a slash ignores the namespace.

    ConfigError for what cannot be a ROS 2 name.
    """
    if not _TOPIC.fullmatch(topic) or (namespace and not _TOPIC.fullmatch(namespace)):
        raise ConfigError(
            f"{namespace!r} and {topic!r} do not make a ROS 2 topic",
            remedy="Use letters, digits, _ and /, e.g. namespace: robot1, map_topic: map",
        )
    if topic.startswith("/") or not namespace:
        return topic.lstrip("/")
    return f"{namespace.strip('/')}/{topic}"


def key_expression(topic: str, ros_type: str, *, style: Style, domain: int) -> str:
    """The key of a full topic name.

    ros_type: e.g. `nav_msgs/msg/OccupancyGrid`. rmw_zenoh: domain, topic, type and any type hash;
    zenoh-bridge-ros2dds: the topic alone.
    """
    if style == "bridge":
        return topic
    package, _, name = ros_type.split("/")
    return f"{domain}/{topic}/{package}::msg::dds_::{name}_/*"
