"""Zenoh session: the only module that knows it. Connects to configured endpoints only.

No multicast, no gossip: a node listens and connects as configured. Each node routes, so that the
traffic of two others may pass through it, and reconnects by itself.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

from companion.config import DistributedConfig
from companion.errors import InputError

LOOPBACK = "tcp/127.0.0.1:7447"
MOST_MESSAGE_BYTES = 64 << 20
LISTEN_MS = 15_000
"""Timeout for a port that the process before still holds."""
NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
ENDPOINT = re.compile(r"(tcp|udp|tls|quic|ws)/\S+:\d{1,5}(#\S*|\?\S*)?")
PRIORITIES = ("INTERACTIVE_HIGH", "DATA", "BACKGROUND")
URGENT, USUAL, LAST = PRIORITIES


class ZenohBus:
    """A session. Raises InputError where it is impossible as configured."""

    def __init__(self, config: DistributedConfig) -> None:
        self._prefix = key_prefix(config)
        self._zenoh = _library()
        self._publishers: dict[str, Any] = {}
        self._declared: list[Any] = []
        settings = _settings(config)
        try:
            chosen = self._zenoh.Config()
            for name, value in settings.items():
                chosen.insert_json5(name, json.dumps(value))
            self._session = self._zenoh.open(chosen)
        except self._zenoh.ZError as error:
            where = ", ".join([*settings["listen/endpoints"], *settings["connect/endpoints"]])
            raise InputError(f"[distributed]: {where}: {_brief(error)}") from error

    @property
    def session_id(self) -> str:
        """Name of the session on the network."""
        return str(self._session.info.zid())

    def declare_token(self, key: str) -> None:
        """Tell others that something of this key is there while the session is."""
        self._declared.append(self._session.liveliness().declare_token(key))

    def declare_publisher(self, topic: str, priority: str, key: str = "") -> None:
        """Declare a publisher of a topic; `key` is another than that of the topic."""
        self._publishers[topic] = self._session.declare_publisher(
            key or f"{self._prefix}/{topic}",
            priority=getattr(self._zenoh.Priority, priority),
            congestion_control=self._zenoh.CongestionControl.DROP,
        )

    def has_subscribers(self, topic: str) -> bool:
        """True if a declared topic has subscribers."""
        return bool(self._publishers[topic].matching_status.matching)

    def publish(self, topic: str, data: bytes, attachment: bytes | None = None) -> None:
        """Send to all subscribers; dropped where the network does not take it."""
        self._publishers[topic].put(data, attachment=attachment)

    def serve(self, topic: str, answer: Callable[[bytes], bytes | None]) -> None:
        """Answer queries of a topic; called in a thread of its own, None for no answer."""
        key = f"{self._prefix}/{topic}"

        def take(query: Any) -> None:
            with query:
                payload = query.payload
                answered = answer(payload.to_bytes() if payload is not None else b"")
                if answered is not None:
                    query.reply(key, answered)

        self._declared.append(self._session.declare_queryable(key, take))

    def ask(self, topic: str, data: bytes, timeout_s: float) -> bytes | None:
        """First answer to a query; None without one."""
        replies = self._session.get(
            f"{self._prefix}/{topic}", payload=data, timeout=timeout_s,
            priority=self._zenoh.Priority.BACKGROUND,
            congestion_control=self._zenoh.CongestionControl.BLOCK,
        )  # fmt: skip
        for reply in replies:
            if reply.ok is not None:
                found: bytes = reply.ok.payload.to_bytes()
                return found
        return None

    def close(self) -> None:
        """Close the session."""
        self._session.close()


def check_distributed(config: DistributedConfig) -> None:
    """Raise InputError where no session is possible as configured, as far as it shows without one.

    So that a daemon says so as it starts, before it begins a flight.
    """
    if config.enabled:
        _library()
        key_prefix(config)
        _settings(config)


def key_prefix(config: DistributedConfig) -> str:
    """Prefix of all keys of a vehicle; InputError for an invalid name."""
    if not NAME.fullmatch(config.vehicle):
        raise InputError(
            f"expert.distributed.vehicle = {config.vehicle!r}: wanted letters, digits, _ . - only"
        )
    return f"companion/{config.vehicle}"


def _settings(config: DistributedConfig) -> dict[str, Any]:
    listen = list(config.listen)
    if not listen and "tracking" in config.stages:
        listen = [LOOPBACK]
    for key, endpoints in (("listen", listen), ("connect", config.connect)):
        for endpoint in endpoints:
            if not ENDPOINT.fullmatch(endpoint):
                raise InputError(
                    f"distributed.{key}: {endpoint!r}: wanted tcp/HOST:PORT, or udp, tls, quic, ws"
                )
    return {
        "mode": "router",
        "listen/endpoints": listen,
        "listen/timeout_ms": LISTEN_MS,
        "listen/exit_on_failure": True,
        "connect/endpoints": list(config.connect),
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 500, "period_max_ms": 2000},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # no shared memory: any peer may connect, and traffic on the link would not show
        "transport/shared_memory/enabled": False,
        "transport/link/rx/max_message_size": MOST_MESSAGE_BYTES,
    }


def _library() -> Any:
    try:
        import zenoh
    except ImportError as error:
        text = "[distributed] needs Zenoh: pip install '.[distributed]' in a clone"
        raise InputError(text) from error
    return zenoh


def _brief(error: Exception) -> str:
    """Error message of Zenoh, without places in its source."""
    return re.sub(r" at /\S+", "", str(error)).split("\n")[0].rstrip(".")
