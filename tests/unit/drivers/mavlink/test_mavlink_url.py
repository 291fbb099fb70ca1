from __future__ import annotations

import pytest

from companion.errors import ConfigError
from drivers.mavlink.wire.link_url import Endpoint, client_endpoint, link_endpoint

PATH = "/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0-port0"


@pytest.mark.parametrize(
    ("url", "wanted"),
    [
        ("serial:/dev/ttyACM0:115200", Endpoint("serial", device="/dev/ttyACM0", baud=115200)),
        ("serial:/dev/ttyTHS1:auto", Endpoint("serial", device="/dev/ttyTHS1")),
        (f"serial:{PATH}:921600", Endpoint("serial", device=PATH, baud=921600)),
        ("udpin:0.0.0.0:14550", Endpoint("udpin", "0.0.0.0", 14550)),
        ("udpin::14550", Endpoint("udpin", "127.0.0.1", 14550)),
        ("udpin:14550", None),
        ("udpout:10.0.0.2:14550", Endpoint("udpout", "10.0.0.2", 14550)),
        ("udpout:drone.local:14550", Endpoint("udpout", "drone.local", 14550)),
        ("udpout:[::1]:14550", Endpoint("udpout", "::1", 14550)),
        ("tcp://10.0.0.2:5760", Endpoint("tcp", "10.0.0.2", 5760)),
        ("tcp:localhost:5760", Endpoint("tcp", "localhost", 5760)),
    ],
)
def test_links(url: str, wanted: Endpoint | None) -> None:
    assert link_endpoint(url) == (wanted or Endpoint("udpin", "127.0.0.1", 14550))


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("", "must begin with one of serial:, udpin:"),
        ("/dev/ttyACM0", "must begin with one of serial:"),
        ("udp:1.2.3.4:14550", "must begin with one of"),
        ("tcpin::5760", "must begin with one of"),
        ("serial:/dev/ttyACM0", "serial:/dev/ttyACM0:auto"),
        ("serial:ttyACM0:115200", "must be serial:DEVICE:BAUD"),
        ("serial:/dev/ttyACM0:fast", 'a number or "auto", not "fast"'),
        ("serial:/dev/ttyACM0:0", "baud"),
        ("serial:/dev/ttyACM0:99999999999", "baud"),
        ("udpin:0.0.0.0:99999", "port from 1 to 65535"),
        ("udpin:0.0.0.0:²", "port from 1 to 65535"),
        ("udpout::14550", "says no host"),
        ("udpout:14550", "says no host"),
        ("tcp::5760", "says no host"),
        ("udpout:::1:14550", "stands in brackets"),
    ],
)
def test_links_that_are_none(url: str, says: str) -> None:
    with pytest.raises(ConfigError, match=r"^link\.url: ") as error:
        link_endpoint(url)
    assert says in str(error.value)


def test_clients_are_on_this_machine_unless_said_otherwise() -> None:
    assert client_endpoint("tcpin::5760") == Endpoint("tcpin", "127.0.0.1", 5760)
    assert client_endpoint("udpin:14550") == Endpoint("udpin", "127.0.0.1", 14550)
    assert client_endpoint("tcpin:0.0.0.0:5760").host == "0.0.0.0"
    with pytest.raises(ConfigError, match=r"^router\.clients: "):
        client_endpoint("serial:/dev/ttyUSB0:57600")


@pytest.mark.parametrize(
    "url", ["serial:/dev/ttyACM0:auto", "serial:/dev/x:9600", "udpin:[::1]:1", "tcp:a:2"]
)
def test_an_endpoint_reads_as_it_was_written(url: str) -> None:
    assert str(link_endpoint(url)) == url
