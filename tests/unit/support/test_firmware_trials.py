"""What the trials with firmwares are judged by: cable, logs, figures, page. Needs no firmware."""

from __future__ import annotations

import io
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.firmware.faulty_cable import FaultyCable, packets
from tests.firmware.figures import Figures, append_to, strayed_m
from tests.firmware.ground import messages_heard
from tests.firmware.page import write_page
from tests.firmware.sent_poses import add_poses
from tests.firmware.serial_cable import OneWay, opened
from tests.firmware.true_state import State
from tests.support.autopilot.fake_wire import free_port

NORTH_M_S, RATE_HZ, N = 2.0, 20.0, 100
OFF_M = 0.25


def odometry(codec: mavlink.MAVLink, t_s: float, north_m: float, resets: int) -> bytes:
    message = mavlink.MAVLink_odometry_message(
        round(t_s * 1e6), 20, 12, north_m, -7.0, -3.0, [1.0, 0.0, 0.0, 0.0],
        0, 0, 0, 0, 0, 0, [0.0] * 21, [0.0] * 21, resets, 0, 90,
    )  # fmt: skip
    return bytes(message.pack(codec))


@pytest.fixture
def flown(tmp_path: Path) -> tuple[Path, list[State]]:
    """A tlog of poses that leap by OFF_M half-way, and the truth, which is elsewhere by metres."""
    ours, autopilot = mavlink.MAVLink(None, 1, 197), mavlink.MAVLink(None, 1, 1)
    log, true = io.BytesIO(), []
    for k in range(N):
        t_s = 1000.0 + k / RATE_HZ
        north_m = NORTH_M_S * (t_s - 1000.0)
        place_m, north = np.array([north_m + 5.0, 1.0, -3.5]), np.array([1.0, 0.0, 0.0])
        level = np.array([1.0, 0.0, 0.0, 0.0])
        true.append(State(t_s, place_m, NORTH_M_S * north, level, np.zeros(3)))
        off_m = OFF_M * (k >= N // 2)
        stamp = struct.pack(">Q", round((t_s + 0.06) * 1e6))
        log.write(stamp + odometry(ours, t_s, north_m + off_m, int(k >= N // 2)))
        beat = mavlink.MAVLink_heartbeat_message(2, 3, 0, 4, 3, 3)
        log.write(stamp + bytes(beat.pack(autopilot)))
    (tmp_path / "cable.tlog").write_bytes(log.getvalue())
    return tmp_path, true


def test_a_datagram_is_taken_apart_into_packets() -> None:
    codec = mavlink.MAVLink(None, 1, 197)
    parts = [odometry(codec, 1.0, 2.0, 0), odometry(codec, 2.0, 3.0, 1)]
    assert packets(b"".join(parts) + b"rest of nothing") == parts


def test_poses_are_judged_by_how_they_move(flown: tuple[Path, list[State]]) -> None:
    folder, true = flown
    figures = Figures()
    add_poses(figures, folder / "cable.tlog", true)
    values = {each.name: each.value for each in figures.rows}
    assert values["poses sent"] == N
    assert values["pose, place off, at most"] == pytest.approx(OFF_M, abs=1e-3)
    assert values["pose, place off, median"] == pytest.approx(OFF_M / 2, abs=OFF_M / 2)
    assert values["longest time without a pose"] == pytest.approx(1 / RATE_HZ, abs=1e-3)
    assert (values["reset counter, first"], values["reset counter, last"]) == (0, 1)


def test_messages_are_found_by_who_said_them(flown: tuple[Path, list[State]]) -> None:
    log = flown[0] / "cable.tlog"
    assert len(list(messages_heard(log, "COMPANION/ODOMETRY"))) == N
    assert len(list(messages_heard(log, "HEARTBEAT"))) == N
    assert not list(messages_heard(log, "ODOMETRY"))


def test_what_is_not_as_asked_is_a_miss(tmp_path: Path) -> None:
    figures = Figures()
    figures.add("told", 9.0, "m")
    figures.add("as asked", 0.1, "m", 0.1)
    assert figures.hold
    figures.add("never came", None, "s", 30.0)
    assert not figures.hold
    level_m, down_m = strayed_m(np.array([[3.0, 4.0, -2.0]]), np.zeros(3))
    assert (level_m[0], down_m[0]) == (5.0, 2.0)


def test_runs_add_up_in_one_page(tmp_path: Path) -> None:
    told = {"folder": "none", "version": "x", "seed": 1, "wind_m_s": 3.0, "look": "day"}
    for value in (0.1, 0.4):
        figures = Figures()
        figures.add("corner <worst>", value, "m", 0.3)
        append_to(tmp_path / "runs.json", "square", "arducopter", told, figures.rows)
    runs = json.loads((tmp_path / "runs.json").read_text())
    assert [run["figures"][0]["holds"] for run in runs] == [True, False]
    page = write_page(tmp_path).read_text()
    assert "1 of 2" in page and "corner &lt;worst&gt;" in page


def test_a_cable_that_is_cut_lets_nothing_through() -> None:
    log = io.BytesIO()
    cable = FaultyCable(free_port(), [free_port()], log)
    try:
        data = odometry(mavlink.MAVLink(None, 1, 197), 1.0, 2.0, 0)
        cable.take(data, up=True)
        cable.order("cut 60")
        cable.take(data, up=True)
        cable.order("cut 0")
        cable.order("lose 1.0 60")
        cable.take(data, up=True)
        assert len(log.getvalue()) == 8 + len(data)
    finally:
        cable.close()


def test_a_serial_cable_passes_what_its_baud_allows(tmp_path: Path) -> None:
    source, far = opened(tmp_path / "source")
    sink, end = opened(tmp_path / "sink")
    log = io.BytesIO()
    try:
        way = OneWay(source, sink, 11520.0, log)
        way.step(60.0)  # idle: nothing is saved up
        data = odometry(mavlink.MAVLink(None, 1, 197), 1.0, 2.0, 0)
        os.write(far, data)
        way.step(0.01)
        assert len(os.read(end, 1000)) == 116
        assert not log.getvalue()
        way.step(0.02)
        assert len(os.read(end, 1000)) == len(data) - 116
        assert log.getvalue()[8:] == data
    finally:
        for each in (source, far, sink, end):
            os.close(each)
