"""A loop that a frame closes itself: the pose given for it goes on, and is slewed after it."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.config_file import load_config
from companion.estimation.localisation import LocalisationStage
from companion.geometry.transforms import Array, Pose
from companion.messages import LoopClosed, Odometry
from companion.runtime.in_order import in_order_of_time
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.atlas import Atlas
from drivers.open_flight import open_flight

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
N_FRAMES, CLOSED_AT, N_AFTER = 180, 12, 8
MOVED_UNITS = np.array([0.02, -0.01, 0.01])
"""Half a metre: what is seen first is 20 m away."""


def moved(segment: SlamMap, by: Array) -> None:
    """Move a map, as closing a loop does."""
    for keyframe in segment.keyframes.values():
        pose = keyframe.camera_from_map
        keyframe.camera_from_map = Pose(pose.rotation, pose.translation - pose.rotation @ by)
    segment.positions[: segment.n_points] += by
    segment.keyframes_moved()


def test_the_pose_of_the_frame_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_config(None, [])
    flight = open_flight(SAMPLE, config.camera, config.telemetry)
    stage = LocalisationStage(config, flight.camera, lambda _: nullcontext())
    insert, closed = Atlas.insert_keyframe, list[int]()

    def closing(self: Atlas, segment: SlamMap, keyframe: Keyframe) -> LoopClosed | None:
        found = insert(self, segment, keyframe)
        if closed or not given or len(segment.keyframes) < CLOSED_AT:
            return found
        closed.append(keyframe.t_ns)
        moved(segment, MOVED_UNITS)
        return LoopClosed(keyframe.t_ns, keyframe.keyframe_id, 0, True, 0.02, 1.0)

    monkeypatch.setattr(Atlas, "insert_keyframe", closing)
    given = list[tuple[int, Array]]()
    messages: Any = in_order_of_time(flight.telemetry().samples, flight.frames())
    n = 0
    for message in messages:
        for out in stage.step(message):
            if isinstance(out, Odometry):
                n += 1
                if out.world_from_body is not None:
                    given.append((out.t_ns, out.world_from_body.translation))
        if n == N_FRAMES or (closed and given[-N_AFTER:][0][0] > closed[0]):
            break
    stage.finish(adjust=False)
    t_ns, places = np.array([t for t, _ in given]), np.array([place for _, place in given])
    assert closed
    at = int(np.searchsorted(t_ns, closed[0]))
    assert 3 < at < len(t_ns) - 3
    bends_m = np.linalg.norm(np.diff(places, 2, axis=0), axis=1)[at - 2 : at + 2]
    print(f"second differences of the places {np.round(bends_m, 3)} m")
    assert bends_m.max() < 0.1
