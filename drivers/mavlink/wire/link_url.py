"""URLs of links and router clients."""

from __future__ import annotations

from dataclasses import dataclass

from companion.errors import ConfigError

LOOPBACK = "127.0.0.1"
LINK_KINDS = ("serial", "udpin", "udpout", "tcp")
CLIENT_KINDS = ("udpin", "udpout", "tcpin")
BAUDS = range(1200, 12_000_001)


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Endpoint of a MAVLink connection; `baud` is 0 for automatic."""

    kind: str
    host: str = ""
    port: int = 0
    device: str = ""
    baud: int = 0

    def __str__(self) -> str:
        if self.kind == "serial":
            return f"serial:{self.device}:{self.baud or 'auto'}"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.kind}:{host}:{self.port}"


def link_endpoint(url: str) -> Endpoint:
    """Endpoint of `link.url`; ConfigError if invalid."""
    return _endpoint("link.url", url, LINK_KINDS)


def client_endpoint(url: str) -> Endpoint:
    """Endpoint of one of `router.clients`; ConfigError if invalid."""
    return _endpoint("router.clients", url, CLIENT_KINDS)


def _endpoint(key: str, url: str, kinds: tuple[str, ...]) -> Endpoint:
    kind, colon, rest = url.strip().partition(":")
    if kind not in kinds or not colon:
        words = ", ".join(f"{kind}:" for kind in kinds)
        raise ConfigError(f'{key}: "{url}" must begin with one of {words}')
    if kind == "serial":
        return _serial(key, url, rest)
    return _network(key, url, kind, rest)


def _serial(key: str, url: str, rest: str) -> Endpoint:
    # the last colon: stable names of devices (/dev/serial/by-path/…) have colons of their own
    device, _, baud = rest.rpartition(":")
    if not device.startswith("/"):
        raise ConfigError(
            f'{key}: "{url}" must be serial:DEVICE:BAUD, such as serial:/dev/ttyACM0:115200 or '
            "serial:/dev/ttyACM0:auto"
        )
    if baud == "auto":
        return Endpoint(kind="serial", device=device)
    if not (baud.isascii() and baud.isdigit() and len(baud) < 9 and int(baud) in BAUDS):
        raise ConfigError(f'{key}: "{url}": the baud must be a number or "auto", not "{baud}"')
    return Endpoint(kind="serial", device=device, baud=int(baud))


def _network(key: str, url: str, kind: str, rest: str) -> Endpoint:
    host, _, port = rest.rpartition(":")
    host = host.removeprefix("//")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        raise ConfigError(f'{key}: "{url}": an IPv6 address stands in brackets, [::1] for example')
    if not (port.isascii() and port.isdigit() and len(port) < 6 and 0 < int(port) < 65536):
        raise ConfigError(f'{key}: "{url}" must be {kind}:HOST:PORT with a port from 1 to 65535')
    if not host and kind not in ("udpin", "tcpin"):
        raise ConfigError(f'{key}: "{url}" says no host: {kind}:HOST:{port}')
    return Endpoint(kind=kind, host=host or LOOPBACK, port=int(port))
