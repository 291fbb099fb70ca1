"""Where tracking begins to fail, one condition at a time, over drawn ground with exact truth.

    python -m tests.bench.envelope [height speed turn contrast noise texture]

A camera of 320 x 240 pixels that looks straight down, at 15 frames/s with exposures of 5 ms, flies
15 m over ground with roofs in weaves at 4 m/s, with the telemetry of an autopilot; of this one
thing is changed at a time. The ground's detail is the same at all scales, and is scaled with the
height. Of each flight: frames that are tracked after the first second, the error of all poses over
the way flown, after the best similarity alignment, the median quality of the poses, and the share
that would be sent.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, rotation_from_vector, yaw_rotation
from companion.messages import Bytes, TrackState
from tests.support.flights.rendered_flight import CAMERA_DOWN, Flown, PathOf, Terrain, fly
from tests.support.flights.scene import leaves

CAMERA = Camera(320, 240, 260.0, 258.0, 161.0, 118.0, body_from_camera=CAMERA_DOWN)
SECONDS, RATE_HZ, EXPOSURE_S = 5.0, 15.0, 0.005
HEIGHT_M, SPEED_M_S, SIGMA_GREY = 15.0, 4.0, 1.0
FIRST_NS = 1_000_000_000
LEAST_TRACKED, MOST_OFF = 0.95, 0.02
"""Beyond, tracking fails."""


@dataclass(frozen=True)
class Condition:
    """What is changed, and what else is as always."""

    height_m: float = HEIGHT_M
    speed_m_s: float = SPEED_M_S
    turn_deg_s: float = 10.0
    contrast: float = 1.0
    noise_grey: float = SIGMA_GREY
    blur_texels: float = 0.0


SWEEPS: dict[str, tuple[str, str, Sequence[float]]] = {
    "height": ("height_m", "m", (1, 2, 5, 15, 50, 150)),
    "speed": ("speed_m_s", "m/s", (2, 8, 16, 24, 32)),
    "turn": ("turn_deg_s", "degrees/s", (30, 60, 120, 180, 240)),
    "contrast": ("contrast", "of full contrast", (0.5, 0.2, 0.1, 0.05, 0.025)),
    "noise": ("noise_grey", "grey levels of noise", (4, 8, 16, 32)),
    "texture": ("blur_texels", "texels of blur", (1, 2, 4, 8, 16)),
}


class Seen(Terrain):
    """Ground as a camera sees it under a condition."""

    def __init__(self, condition: Condition, seed: int = 3) -> None:
        def pattern(rng: np.random.Generator) -> Bytes:
            drawn = leaves(rng)
            blur = condition.blur_texels
            return np.asarray(cv2.GaussianBlur(drawn, (0, 0), blur)) if blur else drawn

        super().__init__(seed, pattern=pattern, scale=condition.height_m / HEIGHT_M)
        self._condition, self._noise = condition, np.random.default_rng(8)
        self.contrast = condition.contrast

    def picture(self, camera: Camera, ned_from_camera: Pose) -> Bytes:
        grey = super().picture(camera, ned_from_camera).astype(np.float32)
        grey = 128.0 + self.contrast * (grey - 128.0)
        # six of these are one exposure
        grey += self._noise.normal(scale=6**0.5 * self._condition.noise_grey, size=grey.shape)
        return np.asarray(np.clip(np.rint(grey), 0, 255), np.uint8)


def path_of(condition: Condition) -> PathOf:
    """Northward in weaves, the nose swinging by the rate of turn."""
    turn_rad_s, swing_hz = np.radians(condition.turn_deg_s), 0.25

    def ned_from_body(after_s: float) -> Pose:
        way_m = condition.speed_m_s * (after_s - 0.5 * SECONDS)
        east_m = 0.2 * condition.speed_m_s * np.sin(1.5 * after_s)
        swing = turn_rad_s / (2 * np.pi * swing_hz) * np.sin(2 * np.pi * swing_hz * after_s)
        lean = rotation_from_vector(0.04 * np.sin(np.array([1.3, 1.7, 0.0]) * after_s))
        return Pose(yaw_rotation(swing) @ lean, np.array([way_m, east_m, -condition.height_m]))

    return ned_from_body


def row(value: float, unit: str, flown: Flown, way_m: float) -> str:
    """A line of the table."""
    first_ns = flown.frames_ns[0] + FIRST_NS
    late = [o for o in flown.odometry if o.t_ns >= first_ns]
    tracked = float(np.mean([o.state is TrackState.TRACKING for o in late])) if late else 0.0
    quality = float(np.median([max(o.quality, 0) for o in late])) if late else 0.0
    sent = sum(not p.predicted for p in flown.sent.poses) / len(flown.frames_ns)
    off = flown.errors().ate_sim3_m / way_m if len(flown.result.poses()) > 3 else float("inf")
    holds = tracked >= LEAST_TRACKED and off <= MOST_OFF
    said = ", ".join(sorted(set(flown.warnings))) or "-"
    told = (
        f"{100 * tracked:.0f} % | {100 * off:.2f} % | {quality:.0f} | {100 * sent:.0f} % | {said}"
    )
    return f"| {value:g} {unit} | {told} | {'' if holds else 'fails'} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("sweeps", nargs="*", default=list(SWEEPS))
    given = parser.parse_args()
    print("| | tracked | off, of the way | quality | sent | warned of | |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for name in given.sweeps:
        field, unit, values = SWEEPS[name]
        for value in values:
            condition = Condition(**{field: value})
            flown = fly(
                CAMERA, path_of(condition), Seen(condition), SECONDS, RATE_HZ,
                exposure_s=EXPOSURE_S,
            )  # fmt: skip
            print(row(value, unit, flown, condition.speed_m_s * SECONDS), flush=True)


if __name__ == "__main__":
    main()
