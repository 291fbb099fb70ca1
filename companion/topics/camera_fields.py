"""Camera model as JSON fields, and back."""

from __future__ import annotations

from typing import Any

from companion.errors import StreamError
from companion.geometry.camera import COEFFICIENTS, Camera, Distortion
from companion.topics.envelope import Envelope
from companion.topics.pose_rows import POSE_NUMBERS, pose_of, pose_row

LEAST_SIDE, MOST_SIDE = 16, 8192
MOST_PIXELS = 20_000_000
MOST_FOCAL_PX = 1e6
MOST_READOUT_MS = 1000.0


def camera_fields(camera: Camera) -> dict[str, Any]:
    """Fields of the JSON object `camera`."""
    body = camera.body_from_camera
    return {
        **camera.lens, "distortion": camera.distortion.value,
        "coefficients": list(camera.coefficients),
        "body_from_camera": pose_row(body) if body is not None else None,
        "assumed": camera.assumed, "readout_ms": camera.readout_ms,
    }  # fmt: skip


def camera_of(part: Envelope) -> Camera:
    """Camera of such an object; StreamError for an invalid one."""
    width = part.integer("width", LEAST_SIDE, MOST_SIDE)
    height = part.integer("height", LEAST_SIDE, MOST_SIDE)
    if width * height > MOST_PIXELS:
        raise StreamError(f"a camera of {width} x {height} pixels")
    focal = [part.number(name, 1.0, MOST_FOCAL_PX) for name in ("fx", "fy")]
    centre = [part.number(name, -MOST_FOCAL_PX, MOST_FOCAL_PX) for name in ("cx", "cy")]
    try:
        distortion = Distortion(part.text("distortion"))
    except ValueError as error:
        raise StreamError(f"{part.kind}: {error}") from error
    coefficients = part.numbers("coefficients", len(COEFFICIENTS[distortion]), MOST_FOCAL_PX)
    body = None
    if part.known("body_from_camera"):
        body = pose_of(part.numbers("body_from_camera", POSE_NUMBERS, MOST_FOCAL_PX))
    readout_ms = None
    if part.known("readout_ms"):
        readout_ms = part.number("readout_ms", 0.0, MOST_READOUT_MS)
    return Camera(
        width, height, focal[0], focal[1], centre[0], centre[1], distortion,
        tuple(coefficients), body, part.flag("assumed"), readout_ms,
    )  # fmt: skip
