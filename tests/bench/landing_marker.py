"""Error of a landing marker by distance and angle, rendered: the table of docs/landing.md.

`python -m tests.bench.landing_marker [SIZE_M]`: 640x480, 520 pixels of focal length, some blur of
the lens, noise of two grey values, the marker anywhere about the middle of the image.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from companion.config import LandingConfig
from companion.estimation.landing.marker_detector import MarkerDetector
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Pose
from companion.messages import Frame
from tests.support.flights.marker_ground import MarkerGround, looking_at_marker

CAMERA = Camera(
    640, 480, 520.0, 520.0, 320.0, 240.0, Distortion.RADTAN, (-0.1, 0.02, 0.001, -0.001, 0.0),
    body_from_camera=Pose.identity(),
)  # fmt: skip
DISTANCES_M, OFF_VERTICAL_DEG, N = (1, 2, 4, 8, 12, 16, 20), (0, 15, 30, 50, 65), 8


def main() -> None:
    """Print a row for each distance and angle."""
    size_m = float(sys.argv[1]) if len(sys.argv) > 1 else 0.5
    config = LandingConfig("apriltag_36h11", 7, size_m)
    ground, detector = (
        MarkerGround(config.marker, config.id, size_m),
        MarkerDetector(config, CAMERA),
    )
    rng = np.random.default_rng(1)
    print("| distance m | off vertical | found | edge px | across mm RMS | along mm RMS | ms |")
    for distance_m in DISTANCES_M:
        for angle_deg in OFF_VERTICAL_DEG:
            errors, edges, spent_ms = [], [], []
            for _ in range(N):
                pose = looking_at_marker(
                    distance_m, angle_deg, rng.uniform(0, 360), rng.uniform(0, 360),
                    rng.uniform(-0.25, 0.25, 2),
                )  # fmt: skip
                frame = Frame(0, 0, ground.picture(CAMERA, pose), np.zeros((0, 0, 3), np.uint8))
                began_s = time.perf_counter()
                target = detector.step(frame)
                spent_ms.append(1e3 * (time.perf_counter() - began_s))
                if target.position_body_m is not None:
                    errors.append(target.position_body_m - pose.inverse().translation)
                    edges.append(target.size_px)
            if errors:
                rms_mm = 1e3 * np.sqrt((np.array(errors) ** 2).mean(0))
                print(
                    f"| {distance_m} | {angle_deg} | {len(errors)}/{N} | {np.mean(edges):.0f} | "
                    f"{np.hypot(*rms_mm[:2]):.1f} | {rms_mm[2]:.0f} | {np.median(spent_ms):.1f} |"
                )


if __name__ == "__main__":
    main()
