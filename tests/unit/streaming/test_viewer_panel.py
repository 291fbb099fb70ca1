from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Similarity
from companion.streaming.items import Shown
from companion.streaming.viewer.colours import HEIGHT_PERIOD_M, Colours
from companion.streaming.viewer.status_panel import MEANINGS, status_text


def test_the_state_is_the_headline_and_what_to_do_follows() -> None:
    for state, meaning in MEANINGS.items():
        lines = status_text({"state": state}, "").splitlines()
        assert lines[0] == f"# {state}" and lines[1] == meaning
    assert {state.value for state in Shown} <= MEANINGS.keys()
    assert "go back" in MEANINGS["Lost"].lower()


def test_what_is_known_is_said_with_its_unit_and_the_rest_is_left_out() -> None:
    text = status_text(
        {
            "state": "Tracking", "quality": 87, "rate_hz": 29.7, "latency_ms": 41.0,
            "height_m": 12.34, "speed_m_s": 3.21, "scale": "GPS", "sigma_scale": 0.012,
            "n_keyframes": 40, "n_points": 1_250_000, "feedback": "odometry", "sending": True,
            "cpu_share": 0.62, "temperature_c": 84.0, "disk_free_gib": 7.2,
            "link_kbit_s": 480, "round_trip_ms": 310, "budget_kbit_s": 500, "waiting": 12,
            "skipped": {"poses": 3, "pictures": 4},
            "given_up": {}, "gone": ["camera silent"], "warnings": ["late telemetry"],
        },
        "2026-11-21T08-00-00Z",
    )  # fmt: skip
    for wanted in (
        "quality 87 %, 30/s, 41 ms late", "12.3 m above home, 3.2 m/s", "metres ± 1.2 %, by GPS",
        "40 views, 1.2 million points", "gets our pose", "processor 62 %, 84 °C",
        "480 kbit/s of 500, 310 ms there and back, 12 pieces of the map to come",
        "7 older poses and pictures passed over", "**⚠ camera silent**",
        "**⚠ the computer is hot**", "**⚠ late telemetry**", "7 GiB free on disk",
        "2026-11-21T08-00-00Z",
    ):  # fmt: skip
        assert wanted in text, wanted
    bare = status_text({"state": "Waiting"}, "")
    for absent in ("None", "Link", "Autopilot", "Computer", "⚠", "nan"):
        assert absent not in bare
    assert "not metres" in bare


def test_a_pose_that_the_autopilot_does_not_get_is_explained() -> None:
    held = {"feedback": "odometry", "sending": False, "why_not": "no metric scale"}
    assert "gets no pose: no metric scale" in status_text(held, "")


def test_colours_tell_what_they_are_to_tell() -> None:
    points = np.array([[0, 0, 1], [0, -HEIGHT_PERIOD_M, 1], [0, 0, 5]], np.float32)
    rgb = np.array([[1, 2, 3]] * 3, np.uint8)
    sure = np.array([0.0, 1.0, 0.0], np.float32)
    upright = Similarity(1.0, np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0.0]]), np.zeros(3))
    assert np.array_equal(Colours.PICTURE.of(points, rgb, sure, upright), rgb)
    height = Colours.HEIGHT.of(points, rgb, sure, upright)
    assert np.array_equal(height[0], height[2]) and not np.array_equal(height[0], height[1])
    confidence = Colours.CONFIDENCE.of(points, rgb, sure, None)
    assert np.array_equal(confidence[0], confidence[2])
    assert not np.array_equal(confidence[0], confidence[1])
    assert np.array_equal(Colours.HEIGHT.of(points, rgb, sure, None), rgb)
    assert Colours.CONFIDENCE.of(points[:0], rgb[:0], sure[:0], None).shape == (0, 3)
