from __future__ import annotations

import random
import time

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drivers.mavlink.wire.packet_stream import LONGEST, READERS, MavlinkStream, Packet, decode
from tests.support.autopilot.mavlink_link import Speaker, command, heartbeat, unknown

S = 10**9


def packets_of(data: bytes, stream: MavlinkStream | None = None) -> list[Packet]:
    return (stream or MavlinkStream()).feed(data, 0)


def boot_times(packets: list[Packet]) -> list[int]:
    codec = mavlink.MAVLink(None)
    messages = [decode(codec, packet) for packet in packets if packet.message_id == 30]
    return [message.time_boot_ms for message in messages if message is not None]


@pytest.mark.parametrize("v1", [False, True])
@pytest.mark.parametrize("size", [1, 3, 7, 1000, 100000])
def test_packets_come_out_whole_however_the_bytes_come_in(v1: bool, size: int) -> None:
    speaker = Speaker(3, 4)
    sent = [speaker.attitude(i, v1) for i in range(50)]
    stream = MavlinkStream()
    data = b"".join(sent)
    got = [p for i in range(0, len(data), size) for p in stream.feed(data[i : i + size], i)]
    assert [packet.raw for packet in got] == sent
    assert {(packet.system, packet.component) for packet in got} == {(3, 4)}
    assert [packet.seq for packet in got] == list(range(50))
    assert boot_times(got) == list(range(50))
    assert (stream.n_bad_bytes, stream.n_breaks) == (0, 0)


def test_noise_between_packets_costs_no_packet(rng_seed: int = 5) -> None:
    noise = random.Random(rng_seed)
    speaker = Speaker()
    data, n_noise = bytearray(), 0
    for i in range(300):
        junk = noise.randbytes(noise.randrange(1, 400))
        n_noise += len(junk)
        data += junk + speaker.attitude(i)
    stream = MavlinkStream()
    got = packets_of(bytes(data) + bytes(LONGEST), stream)
    assert boot_times(got) == list(range(300))
    assert len(got) == 300
    assert stream.n_bad_bytes >= n_noise
    assert stream.n_breaks == 300 + 1


def test_a_wrong_checksum_costs_that_packet_only() -> None:
    speaker = Speaker()
    sent = [bytearray(speaker.attitude(i)) for i in range(10)]
    sent[4][15] ^= 1
    sent[7][-1] ^= 0x80
    stream = MavlinkStream()
    got = packets_of(b"".join(sent) + bytes(LONGEST), stream)
    assert boot_times(got) == [0, 1, 2, 3, 5, 6, 8, 9]
    assert stream.n_breaks == 3


def test_a_truncated_packet_costs_that_packet_only() -> None:
    speaker = Speaker()
    sent = [speaker.attitude(i) for i in range(10)]
    sent[3] = sent[3][:17]
    stream = MavlinkStream()
    assert boot_times(packets_of(b"".join(sent), stream)) == [0, 1, 2, 4, 5, 6, 7, 8, 9]
    assert stream.n_bad_bytes == 17


def test_a_packet_behind_a_truncated_one_does_not_wait_for_more() -> None:
    speaker = Speaker()
    stream = MavlinkStream()
    long_one = speaker.pack(mavlink.MAVLink_statustext_message(6, b"x" * 50))
    assert stream.feed(long_one[:20], 0) == []
    assert boot_times(stream.feed(speaker.attitude(1), S)) == [1]


def test_a_false_header_does_not_hold_back_what_follows() -> None:
    speaker = Speaker()
    stream = MavlinkStream()
    assert boot_times(stream.feed(b"\x00\xfd\xff\x00" + speaker.attitude(1), 0)) == [1]


def test_a_payload_longer_than_the_dialect_knows_is_read() -> None:
    """A later MAVLink adds fields at a message's end, which the checksum's seed does not cover."""
    from pymavlink.generator.mavcrc import x25crc

    payload = bytes(range(1, 29)) + b"\x07" * 200
    body = bytes([len(payload), 0, 0, 0, 1, 1, 30, 0, 0]) + payload
    crc = x25crc(body + bytes([mavlink.mavlink_map[30].crc_extra])).crc
    (packet,) = packets_of(b"\xfd" + body + crc.to_bytes(2, "little"))
    assert packet.known
    assert boot_times([packet]) == [0x04030201]


def test_flags_that_nobody_knows_yet_are_refused() -> None:
    raw = bytearray(Speaker().attitude(1))
    raw[2] = 0x02
    stream = MavlinkStream()
    assert packets_of(bytes(raw) + bytes(LONGEST), stream) == []
    assert stream.n_bad_bytes == len(raw) + LONGEST


def test_unknown_messages_pass_as_they_are_and_are_not_decoded() -> None:
    sent = [unknown(i) for i in range(20)]
    stream = MavlinkStream()
    got = packets_of(b"".join(sent), stream)
    assert [packet.raw for packet in got] == sent
    assert not any(packet.known for packet in got)
    assert got[0].message_id == 54321
    assert decode(mavlink.MAVLink(None), got[0]) is None
    assert got[0].target is None
    assert stream.n_bad_bytes == 0


def test_damaged_unknown_messages_are_refused_once_their_kind_is_learned() -> None:
    speaker = Speaker()
    stream = MavlinkStream()
    packets_of(b"".join(unknown(i) for i in range(3)), stream)
    n_passed = 0
    for i in range(500):
        raw = bytearray(unknown(i))
        raw[12 + i % 10] ^= 1 << i % 8
        n_passed += len(packets_of(bytes(raw) + speaker.heartbeat(), stream)) - 1
    assert n_passed == 0
    assert len(packets_of(unknown(1), stream)) == 1


def test_one_damaged_unknown_packet_does_not_shut_out_its_kind() -> None:
    speaker = Speaker()
    stream = MavlinkStream()
    packets_of(unknown(1, extra=33), stream)  # as if damage had made another seed of it
    for i in range(5):
        packets_of(speaker.heartbeat() + unknown(i), stream)
    assert len(packets_of(unknown(9), stream)) == 1
    assert packets_of(unknown(9, extra=33) + bytes(LONGEST), stream) == []


def test_noise_is_taken_for_no_packet() -> None:
    noise = random.Random(7)
    stream = MavlinkStream()
    got = sum(len(stream.feed(noise.randbytes(1000), i * S)) for i in range(1000))
    assert got == 0
    assert stream.n_bad_bytes > 1_000_000 - LONGEST


@pytest.mark.parametrize("junk", [b"\xfe", b"\xfd", b"\xfe\xff", b"\xfd\xff\x01", b"\x00"])
def test_the_worst_noise_costs_by_its_length_and_nothing_piles_up(junk: bytes) -> None:
    def cost_s(n_chunks: int) -> float:
        stream, begun_s = MavlinkStream(), time.process_time()
        for i in range(n_chunks):
            stream.feed(junk * (1000 // len(junk)), i)
        assert len(stream._rest) < LONGEST
        return time.process_time() - begun_s

    short_s, long_s = (min(cost_s(n) for _ in range(3)) for n in (20, 160))
    assert long_s < 24 * short_s  # 8 times if linear, 64 if what came before is read again


def test_unknown_messages_cost_no_more_than_known_ones_by_far() -> None:
    def cost_s(sent: list[bytes]) -> float:
        stream, begun_s = MavlinkStream(), time.process_time()
        assert sum(len(stream.feed(raw, i)) for i, raw in enumerate(sent)) == len(sent)
        return time.process_time() - begun_s

    speaker = Speaker()
    heard = [speaker.attitude(i) for i in range(1000)]
    unheard = [unknown(i) for i in range(1000)]
    assert min(cost_s(unheard) for _ in range(3)) < 5 * min(cost_s(heard) for _ in range(3))


def test_kinds_of_unknown_message_do_not_pile_up() -> None:
    stream = MavlinkStream()
    for i in range(10_000):
        stream.feed(unknown(i, message_id=100_000 + i), i)
    assert len(stream._learned) <= 4096


def test_whom_a_message_is_meant_for() -> None:
    speaker = Speaker()
    (to_us,) = packets_of(speaker.pack(command(1, 197)))
    assert to_us.target == (1, 197)
    (v1,) = packets_of(speaker.pack(command(7, 9), v1=True))
    assert v1.target == (7, 9)
    (to_all,) = packets_of(speaker.pack(mavlink.MAVLink_param_request_list_message(0, 0)))
    assert to_all.target == (0, 0)
    (to_none,) = packets_of(speaker.pack(heartbeat()))
    assert to_none.target is None
    (mode,) = packets_of(speaker.pack(mavlink.MAVLink_set_mode_message(5, 0, 0)))
    assert mode.target == (5, 0)


def test_every_message_of_the_dialect_tells_its_target_as_pymavlink_does() -> None:
    speaker = Speaker()
    n_targeted = 0
    for kind in mavlink.mavlink_map.values():
        fields = kind.fieldnames
        if "target_system" not in fields:
            continue
        values = [
            11 if name == "target_system" else 22 if name == "target_component"
            else b"x" if field_type == "char" else [1] * count if count else 1
            for name, field_type, count in (
                (name, kind.fieldtypes[i], kind.array_lengths[kind.ordered_fieldnames.index(name)])
                for i, name in enumerate(fields)
            )
        ]  # fmt: skip
        (packet,) = packets_of(speaker.pack(kind(*values)))
        assert packet.target == (11, 22 if "target_component" in fields else 0), kind.msgname
        n_targeted += 1
    assert n_targeted > 60


def test_the_codec_that_cannot_read_a_payload_gives_nothing() -> None:
    text = mavlink.MAVLink_statustext_message(6, b"hello")
    (packet,) = packets_of(Speaker().pack(text))
    broken = packet._replace(raw=packet.raw[:-1])
    assert decode(mavlink.MAVLink(None), broken) is None


@pytest.mark.parametrize("v1", [False, True])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_messages_are_decoded_as_by_pymavlink(v1: bool, share: float) -> None:
    """Each kind of the dialect, of which a share of the bytes are zeros, with its whole header."""
    chance = random.Random(1)
    codec = mavlink.MAVLink(None, 7, 8)
    codec.robust_parsing = False
    n_read = 0
    for message_id, kind in mavlink.mavlink_map.items():
        if v1 and message_id > 255:
            continue
        payload = bytes(
            0 if chance.random() < share else chance.randrange(256)
            for _ in range(kind.unpacker.size)
        )
        codec.seq = chance.randrange(256)
        message = mavlink.MAVLink_message(message_id, kind.msgname)
        (packet,) = packets_of(bytes(message._pack(codec, kind.crc_extra, payload, v1)))
        whole, read = codec.decode(bytearray(packet.raw)), decode(codec, packet)
        assert read is not None and type(read) is type(whole) is kind
        assert repr(read.to_dict()) == repr(whole.to_dict())  # not a number is as it is
        for part in ("get_msgbuf", "get_msgId", "get_seq", "get_srcSystem", "get_srcComponent"):
            assert getattr(read, part)() == getattr(whole, part)()
        assert read.get_header().mlen == whole.get_header().mlen
        n_read += message_id in READERS
    assert n_read > (100 if v1 else 200)
