"""Pilot messages: each fits into one message, is in the table, and is explained."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from companion import pilot_messages
from companion.daemon import link_watch
from companion.daemon.control import armed_settings
from companion.daemon.control.flight_parameters import PARAMETERS
from companion.daemon.flights import live_flight, recording_recovery, viewing
from companion.daemon.pose import pose_sender
from companion.estimation.gate import pose_gate, pose_rules, proof
from companion.estimation.inertial import imu_verdict
from companion.estimation.resumption import map_resumption
from companion.estimation.shutter import shutter_of_frames
from companion.messages import Warned
from companion.pilot_messages import (
    INFO,
    JOURNAL_ONLY,
    NOTICE,
    OF_WARNING,
    OTHER,
    PARTS,
    PREFIX,
    REASONS,
    WARNING,
    PilotMessage,
    of_warning,
    position_lost,
)
from companion.products import flight_result
from companion.stages import localisation_work, topics_work
from drivers.camera import camera_feed
from drivers.mavlink.ground import ground_requests
from drivers.recording import disk_writer
from drivers.telemetry import live_samples

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "pilot_messages.md"
SEVERITIES = {"WARNING": WARNING, "NOTICE": NOTICE, "INFO": INFO}
MOST_BYTES = 50
"""Of the text of a STATUSTEXT (mavlink.io, common.xml)."""
TABLE = {name: row for name, row in vars(pilot_messages).items() if isinstance(row, PilotMessage)}
"""All rows, by name."""


@pytest.mark.parametrize("name", TABLE)
def test_each_fits_into_one_message(name: str) -> None:
    message = TABLE[name]
    fields = set(re.findall(r"{(\w+)}", message.text))
    assert fields == set(message.longest)
    said = message(**dict.fromkeys(fields, "Ωx" * 200))
    assert said.text.startswith(PREFIX) and said.text.isascii() and said.text.isprintable()
    assert len(said.text) <= MOST_BYTES
    assert said.severity == message.severity and said.severity in SEVERITIES.values()
    full = message(**{each: "x" * most for each, most in message.longest.items()})
    assert len(full.text) == len(PREFIX + message.text) + sum(
        most - len(f"{{{each}}}") for each, most in message.longest.items()
    )


def test_what_is_filled_in_is_never_cut() -> None:
    assert all(len(reason) <= pilot_messages.LONGEST_REASON for reason in REASONS.values())
    assert len(pilot_messages.OTHER_REASON) <= pilot_messages.LONGEST_REASON
    assert all(len(part) <= 16 for part in PARTS.values())
    assert all(len(name) <= pilot_messages.LONGEST_NAME for name in PARAMETERS)


def test_the_page_has_exactly_these() -> None:
    rows = re.findall(r"^\| ([^|]+?) \| ([A-Z]+) \| ?(.*?) ?\|$", PAGE.read_text("utf-8"), re.M)
    assert [(text, SEVERITIES[word]) for text, word, _ in rows] == [
        (each.text, each.severity) for each in TABLE.values()
    ]
    explained = [meaning for _, word, meaning in rows if word == "WARNING"]
    assert all(explained)
    listed = re.findall(r"^\| ([^|{]+?) \| ([^|A-Z][^|]*) \|$", PAGE.read_text("utf-8"), re.M)
    assert [reason for reason, _ in listed] == [*REASONS.values(), pilot_messages.OTHER_REASON]
    for page in ("docs/control.md", "docs/troubleshooting.md"):
        assert "pilot_messages.md" in (ROOT / page).read_text("utf-8")


def test_no_two_rows_say_the_same() -> None:
    assert len({each.text for each in TABLE.values()}) == len(TABLE)


def test_nothing_else_is_ever_said() -> None:
    """No other file makes a text or a STATUSTEXT; mypy sees to it that `say` takes no other."""
    makers: dict[str, set[str]] = {"PilotText": set(), "PilotMessage": set(), "STATUSTEXT": set()}
    for path in [*ROOT.glob("companion/**/*.py"), *ROOT.glob("drivers/**/*.py")]:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            called = getattr(node.func, "id", getattr(node.func, "attr", ""))
            if called in makers:
                makers[called].add(path.name)
            if "statustext" in called.lower():
                makers["STATUSTEXT"].add(path.name)
    assert makers == {
        "PilotText": {"pilot_messages.py"}, "PilotMessage": {"pilot_messages.py"},
        "STATUSTEXT": {"status_text.py"},
    }  # fmt: skip


def phrases(module: object) -> set[str]:
    """Constants of a module that are words for people."""
    return {
        value
        for name, value in vars(module).items()
        if name.isupper() and isinstance(value, str) and value and value != "off"
    }


def test_every_reason_has_its_words() -> None:
    known = {*REASONS, *pilot_messages.SWITCHED_OFF}
    assert phrases(pose_gate) | phrases(pose_rules) <= known
    assert {pose_sender.UNHEARD, pose_sender.SWITCHED_OFF} <= known
    assert position_lost("quality too low").text == "Companion: vision position lost: low quality"
    assert position_lost("switched off").text == "Companion: vision position off: ground command"
    assert position_lost("anything new").text == "Companion: vision position lost: see its log"


def test_every_warning_has_its_words() -> None:
    whats = {
        *phrases(camera_feed), *phrases(disk_writer), *phrases(live_samples),
        link_watch.DAMAGED, link_watch.REFUSED, link_watch.FLOODS, link_watch.SLOW,
        proof.MAP_RESUMED, map_resumption.MAP_NOT_RECOGNISED, localisation_work.NOT_KEPT,
        localisation_work.IN_MEMORY,
        link_watch.NO_MAVLINK, live_flight.RESTARTED, live_flight.LOCALISATION_DIED,
        live_flight.NOT_FINISHED,
        imu_verdict.NOT_USED, imu_verdict.USED_AGAIN,
        shutter_of_frames.BY_IMAGES, shutter_of_frames.ROLLING, shutter_of_frames.OTHER_READOUT,
        viewing.SHOWN, viewing.NO_VIEWER, viewing.GONE, viewing.BEHIND, viewing.CLOSED,
        recording_recovery.CUT_SHORT, recording_recovery.NOT_REPAIRED,
        recording_recovery.NOT_WRITABLE, ground_requests.TOO_MANY,
        topics_work.MALFORMED, topics_work.TAKEN,
        topics_work.NOT_TAKEN, flight_result.GIVEN_UP, armed_settings.NOT_KEPT,
        proof.MAP_RESUMED, map_resumption.MAP_NOT_RECOGNISED, localisation_work.NOT_KEPT,
    }  # fmt: skip
    for module in (
        "drivers/mavlink/autopilot_link.py",
        "companion/estimation/attitude/camera_attitude.py",
    ):
        for node in ast.walk(ast.parse((ROOT / module).read_text("utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == Warned.__name__:
                whats |= {arg.value for arg in node.args[1:2] if isinstance(arg, ast.Constant)}  # type: ignore[misc]
    assert whats <= {*OF_WARNING, *JOURNAL_ONLY}


def test_what_a_warning_becomes() -> None:
    died = of_warning("localisation has died: the flight ends, and another begins", "SIGKILL")
    assert died is not None
    assert (died.severity, died.text) == (WARNING, "Companion: visual tracking failed: restarting")
    restarted = of_warning(live_flight.RESTARTED, "depth: killed by SIGKILL")
    assert restarted is not None and restarted.text == "Companion: dense map restarted"
    unknown = of_warning(live_flight.RESTARTED, "another: killed")
    assert unknown is not None and unknown.text == "Companion: a process restarted"
    assert of_warning("ValueError: something at /home/me") == OTHER()
    assert of_warning("good news", good=True) is None
    assert of_warning(viewing.GONE) is None
    back = of_warning(camera_feed.BACK, good=True)
    assert back is not None and back.severity == INFO


def test_nobody_reads_of_an_end_that_is_none() -> None:
    for each in TABLE.values():
        assert "flight ends" not in each.text and "begins" not in each.text
