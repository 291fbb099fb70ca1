from __future__ import annotations

from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.errors import ConfigError
from drivers.mavlink.wire.packet_stream import Packet
from drivers.mavlink.wire.signing import EPOCH_UNIX_NS, UNIT_NS, MavlinkSigning, read_key
from tests.support.autopilot.mavlink_link import Speaker, split

KEY = bytes(range(32))
NOW_NS = 1_800_000_000 * 10**9
NOW = (NOW_NS - EPOCH_UNIX_NS) // UNIT_NS
MINUTE = 60 * 100_000


def signed(stamp: int, system: int = 1, key: bytes = KEY) -> Packet:
    speaker = Speaker(system, 1, key)
    (packet,) = split(speaker.pack(mavlink.MAVLink_system_time_message(1, 2), stamp))
    return packet


def test_what_is_signed_with_the_key_is_accepted_once() -> None:
    signing = MavlinkSigning(KEY)
    packet = signed(NOW)
    assert packet.signed
    assert signing.accepts(packet, NOW_NS)
    assert not signing.accepts(packet, NOW_NS)
    assert not signing.accepts(signed(NOW - 1), NOW_NS)
    assert signing.accepts(signed(NOW + 1), NOW_NS)
    assert signing.accepts(signed(NOW, system=2), NOW_NS)


def test_what_is_not_signed_or_with_another_key_is_refused() -> None:
    signing = MavlinkSigning(KEY)
    (unsigned,) = split(Speaker().heartbeat())
    assert not signing.accepts(unsigned, NOW_NS)
    assert not signing.accepts(signed(NOW, key=bytes(32)), NOW_NS)
    changed = signed(NOW)
    raw = bytearray(changed.raw)
    raw[11] ^= 1
    assert not signing.accepts(changed._replace(raw=bytes(raw)), NOW_NS)


def test_a_forged_stamp_shuts_nobody_out() -> None:
    signing = MavlinkSigning(KEY)
    assert not signing.accepts(signed(NOW + 10**12, key=bytes(32)), NOW_NS)
    assert signing.accepts(signed(NOW), NOW_NS)


def test_an_old_recording_is_refused() -> None:
    signing = MavlinkSigning(KEY)
    assert not signing.accepts(signed(NOW - MINUTE - 1), NOW_NS)
    assert signing.accepts(signed(NOW - MINUTE + 1), NOW_NS)


def test_stamps_follow_the_clock_and_never_stand_still() -> None:
    signing = MavlinkSigning(KEY)
    assert signing.next_stamp(NOW_NS) == NOW
    assert signing.next_stamp(NOW_NS) == NOW + 1
    assert signing.next_stamp(NOW_NS - 10**9) == NOW + 2
    assert signing.next_stamp(NOW_NS + 10**9) == NOW + 100_000


def test_a_clock_that_was_never_set_is_put_right_by_the_autopilot() -> None:
    signing = MavlinkSigning(KEY)
    assert signing.next_stamp(0) == 1  # 1970
    assert signing.accepts(signed(NOW), 0)
    assert signing.next_stamp(0) == NOW + 1


def test_key_files(tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.write_text(KEY.hex().upper() + "\n")
    assert read_key(path) == KEY
    for text in ("", KEY.hex()[:-2], KEY.hex() + "00", "xy" * 32, " ".join(["00"] * 32)):
        path.write_text(text)
        with pytest.raises(ConfigError, match="must hold 64 hexadecimal digits"):
            read_key(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_key(path)
    with pytest.raises(ConfigError, match=r"link\.signing_key_file: .*No such file"):
        read_key(tmp_path / "none")
