"""Processor time of localisation by its parts, for frames and keyframes; tables of performance.md.

    python -m tests.bench.frame_parts FLIGHT... [--frames N] [--size 1280x720]

In lockstep, without dense mapping; time of the one thread that does it all, so that other work on
the computer hardly shows. Parts lie within each other as they are indented. With --size images are
scaled to its width and cropped to its height: figures of cost, as they have no finer detail.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import os
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ[variable] = "1"  # as the program does, before numpy loads

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from companion.config import Config  # noqa: E402
from companion.estimation.localisation import LocalisationStage  # noqa: E402
from companion.geometry.camera import Camera  # noqa: E402
from companion.messages import Frame, KeyframeAdded, Odometry  # noqa: E402
from companion.runtime.in_order import in_order_of_time  # noqa: E402
from companion.timing.clock import StageTimes  # noqa: E402
from drivers.open_flight import open_flight  # noqa: E402

LEAD_NS = 10_000_000_000
SLAM, ESTIMATION = "companion.slam.", "companion.estimation."
OF_FRAME = {
    "features": SLAM + "features.orb_features:FeatureExtractor.extract",
    "  FAST, Harris, angles": SLAM + "features.orb_features:FeatureExtractor._detect",
    "tracking": SLAM + "tracking.tracker:Tracker._track",
    "  projecting": SLAM + "map.local_map:Projector.visible",
    "  search by projection": SLAM + "map.local_map:Projector.search",
    "  pose optimisation": SLAM + "tracking.frame_tracker:refine_pose",
    "  patch alignment": SLAM + "tracking.frame_tracker:refine_features",
    "  local map": SLAM + "tracking.frame_tracker:FrameTracker.update_local_map",
    "keyframe decision": SLAM + "tracking.tracked_keyframes:TrackedKeyframes.needed",
    "telemetry": ESTIMATION + "localisation:LocalisationStage._take_samples",
    "attitude, checked": ESTIMATION + "attitude_checks:AttitudeChecks.check",
    "odometry": ESTIMATION + "body_odometry:BodyOdometry.of_track",
    "motion filter": ESTIMATION + "body.body_filter:BodyFilter.at",
    "corrections of the map": ESTIMATION + "body_odometry:BodyOdometry.apply_map_correction",
    "shutter": ESTIMATION + "shutter.shutter_of_frames:ShutterOfFrames.end",
    "site map": ESTIMATION + "site.site_in_flight:SiteInFlight.frame",
}
OF_KEYFRAME = {
    "mapping": SLAM + "mapping.atlas:Atlas.insert_keyframe",
    "  triangulation": SLAM + "mapping.mapper:Mapper._triangulate",
    "    epipolar search": SLAM + "mapping.mapper:match_epipolar",
    "  fusion": SLAM + "mapping.point_fusion:PointFusion.extend",
    "    merging": SLAM + "mapping.point_fusion:PointFusion._merge",
    "  patch alignment": SLAM + "mapping.mapper:Mapper._refine",
    "  bundle adjustment": SLAM + "mapping.mapper:Mapper.adjust_locally",
    "georeference": ESTIMATION + "localisation:LocalisationStage._map_update",
}
Times = dict[str, float]


def watch(name: str, place: str, spent_ms: Times) -> None:
    """Let a function add its processor time to `spent_ms`."""
    module, _, path = place.partition(":")
    *owners, last = path.split(".")
    owner: Any = importlib.import_module(module)
    for each in owners:
        owner = getattr(owner, each)
    function = getattr(owner, last)

    @functools.wraps(function)
    def timed(*values: Any, **named: Any) -> Any:
        began_ns = time.thread_time_ns()
        try:
            return function(*values, **named)
        finally:
            spent_ms[name] += (time.thread_time_ns() - began_ns) * 1e-6

    setattr(owner, last, timed)


Size = tuple[int, int]


def resized(camera: Camera, size: Size) -> Camera:
    """The camera of images that are scaled to a width and cropped to a height."""
    width, height = size
    grow = width / camera.width
    above = 0.5 * (round(camera.height * grow) - height)
    return replace(
        camera, width=width, height=height, fx=grow * camera.fx, fy=grow * camera.fy,
        cx=grow * (camera.cx + 0.5) - 0.5, cy=grow * (camera.cy + 0.5) - 0.5 - int(above),
    )  # fmt: skip


def frames_of(frames: Iterable[Frame], size: Size | None) -> Iterator[Frame]:
    """The frames, of this size."""
    for frame in frames:
        if size is None:
            yield frame
            continue
        width, height = size
        whole = round(frame.grey.shape[0] * width / frame.grey.shape[1])
        above = int(0.5 * (whole - height))
        grey = cv2.resize(frame.grey, (width, whole), interpolation=cv2.INTER_CUBIC)
        yield replace(frame, grey=np.asarray(grey[above : above + height], np.uint8))


def measured(
    path: Path, n_frames: int | None, size: Size | None, spent_ms: Times
) -> tuple[list[Times], list[Times]]:
    """Times by part, of frames that are no keyframes and of those that are.

    "all" is the whole frame, "pose" until its odometry is there.
    """
    config = Config()
    flight = open_flight(path, config.camera, config.telemetry)
    samples = [s for s in flight.telemetry().samples if s.t_ns >= flight.start_ns - LEAD_NS]
    camera = flight.camera if size is None else resized(flight.camera, size)
    stage = LocalisationStage(config, camera, StageTimes())
    frames: list[Times] = []
    keyframes: list[Times] = []
    shown = (each for each in flight.frames() if isinstance(each, Frame))
    for message in in_order_of_time(samples, frames_of(islice(shown, n_frames), size)):
        began_ns, is_keyframe = time.thread_time_ns(), False
        for out in stage.step(message):
            is_keyframe |= isinstance(out, KeyframeAdded)
            if isinstance(out, Odometry):
                spent_ms["pose"] = (time.thread_time_ns() - began_ns) * 1e-6
        if isinstance(message, Frame):
            spent_ms["all"] = (time.thread_time_ns() - began_ns) * 1e-6
            (keyframes if is_keyframe else frames).append(dict(spent_ms))
            spent_ms.clear()
    return frames, keyframes


def table(rows: list[Times], names: list[str]) -> str:
    """Mean, median and 95th percentile of each part, milliseconds."""
    out = []
    for name in names:
        ms = np.array([row.get(name, 0.0) for row in rows])
        out.append(f"{name:26s}{ms.mean():8.2f}{np.median(ms):8.2f}{np.percentile(ms, 95):8.2f}")
    return "\n".join(out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("flight", nargs="+", type=Path)
    parser.add_argument("--frames", type=int, help="of each flight, the first ones")
    parser.add_argument("--size", help="WIDTHxHEIGHT that images are scaled and cropped to")
    options = parser.parse_args()
    width, _, height = (options.size or "").partition("x")
    size = (int(width), int(height)) if options.size else None
    spent_ms: Times = defaultdict(float)
    for name, place in (
        OF_FRAME | {"of keyframe: " + k: v for k, v in OF_KEYFRAME.items()}
    ).items():
        watch(name, place, spent_ms)
    for path in options.flight:
        frames, keyframes = measured(path, options.frames, size, spent_ms)
        print(f"\n{path.name}: {len(frames)} frames, mean, median, 95th percentile, ms of a core")
        print(table(frames, ["all", "pose", *OF_FRAME]))
        print(f"{len(keyframes)} keyframes")
        names = [*OF_KEYFRAME]
        print(table([{k.removeprefix("of keyframe: "): v for k, v in row.items()
                      if k == "all" or k.startswith("of keyframe: ")} for row in keyframes],
                    ["all", *names]), flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
