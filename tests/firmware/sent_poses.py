"""Poses that passed over the cable, against the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from companion.geometry.transforms import Array
from tests.firmware.figures import Figures, percentile
from tests.firmware.ground import messages_heard
from tests.firmware.true_state import State

POSES = "ODOMETRY", "VISION_POSITION_ESTIMATE"
"""ArduPilot gets the second of accelerometers alone."""
LEAST = 30


def add_poses(figures: Figures, cable: Path, true: list[State]) -> None:
    """What was wrong with the poses: place after the first is put where it was, heading, scale."""
    rows = [
        (t_s, m.time_usec * 1e-6, m.x, m.y, m.z, *m.q, m.reset_counter)
        for t_s, m in messages_heard(cable, "COMPANION/ODOMETRY")
    ]
    figures.add("poses sent", len(rows))
    if len(rows) < LEAST:
        return
    sent = np.array(rows)
    came_s = [t_s for kind in POSES for t_s, _ in messages_heard(cable, f"COMPANION/{kind}")]
    figures.add("longest time without a pose", np.diff(np.sort(came_s)).max(), "s")
    figures.add("reset counter, first", sent[0, 9], "", 0.0)
    figures.add("reset counter, last", sent[-1, 9])
    if not np.isfinite(sent).all():  # the velocity alone
        return
    t_s = np.array([each.t_s for each in true])
    places = np.array([each.place_m for each in true])
    delay_s = sent[:, 0] - sent[:, 1]
    # the autopilot's own clock or the epoch: the offset between the two is no fault
    shown_s = sent[:, 1] + (np.median(delay_s) if abs(np.median(delay_s)) > 1e6 else 0.0)
    truth = np.stack([np.interp(shown_s, t_s, column) for column in places.T], axis=1)
    off = (sent[:, 2:5] - truth) - np.median((sent[:, 2:5] - truth)[:LEAST], axis=0)
    away_m = np.linalg.norm(off, axis=1)
    yaw = np.unwrap(_yaws(sent[:, 5:9]))
    true_yaw = np.interp(shown_s, t_s, np.unwrap(_yaws(np.array([e.quaternion for e in true]))))
    turned_deg = np.degrees(np.abs((yaw - true_yaw + np.pi) % (2 * np.pi) - np.pi))
    figures.add("pose, place off, median", percentile(away_m, 50), "m")
    figures.add("pose, place off, 95 %", percentile(away_m, 95), "m")
    figures.add("pose, place off, at most", away_m.max(), "m")
    figures.add("pose, heading off, median", percentile(turned_deg, 50), "deg")


def _yaws(quaternions: Array) -> Array:
    w, x, y, z = quaternions.T
    yaw: Array = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return yaw
