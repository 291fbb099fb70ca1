"""Topics for ROS 2 over Zenoh, as its `rmw_zenoh` names and finds them.

A publisher puts CDR at DOMAIN/TOPIC/TYPE/HASH with an attachment (number, time, publisher), and a
liveliness token tells the ROS graph that it is there (the design page of rmw_zenoh).
"""

from __future__ import annotations

import hashlib
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass

from companion.errors import InputError
from drivers.system.ros_messages import IMAGE, ODOMETRY, POINTS, type_hash
from drivers.system.zenoh_bus import LAST, URGENT, USUAL, ZenohBus

TOPICS = {
    "odometry": (ODOMETRY, URGENT), "image/compressed": (IMAGE, USUAL), "points": (POINTS, LAST),
}  # fmt: skip
"""Kind and priority of each."""
NODE = "companion"
QUALITY = "2::,10:,:,:,,"
"""Best effort, the last ten; all else as by default."""
GID_BYTES = 16
NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


@dataclass(slots=True)
class _Publisher:
    gid: bytes
    n: int = 0


class RosTopics:
    """Publishers of a vehicle in a ROS domain, through an open session; InputError for its name."""

    def __init__(self, bus: ZenohBus, domain: int, vehicle: str) -> None:
        if not NAME.fullmatch(vehicle):
            raise InputError(
                f"expert.distributed.vehicle = {vehicle!r}: in a name of ROS are letters, digits "
                "and _ only, no digit first"
            )
        self._bus = bus
        self._publishers: dict[str, _Publisher] = {}
        alive = f"@ros2_lv/{domain}/{bus.session_id}/0"
        bus.declare_token(f"{alive}/0/NN/%/%/{NODE}")
        for number, (topic, (kind, priority)) in enumerate(TOPICS.items(), 1):
            name = f"{NODE}/{vehicle}/{topic}"
            package, _, message = kind.split("/")
            typed = f"{package}::msg::dds_::{message}_/{type_hash(kind)}"
            bus.declare_publisher(_own(topic), priority, f"{domain}/{name}/{typed}")
            mangled = "%" + name.replace("/", "%")
            token = f"{alive}/{number}/MP/%/%/{NODE}/{mangled}/{typed}/{QUALITY}"
            bus.declare_token(token)
            gid = hashlib.blake2b(token.encode(), digest_size=GID_BYTES).digest()
            self._publishers[topic] = _Publisher(gid)

    def publish(self, topic: str, t_ns: int, made: Callable[[], bytes | None]) -> None:
        """Publish what `made` gives, if anybody listens; it may be None."""
        if not self._bus.has_subscribers(_own(topic)):
            return
        cdr = made()
        if cdr is None:
            return
        publisher = self._publishers[topic]
        publisher.n += 1
        attachment = struct.pack("<qqB", publisher.n, t_ns, GID_BYTES) + publisher.gid
        self._bus.publish(_own(topic), cdr, attachment)


def _own(topic: str) -> str:
    return f"ros/{topic}"
