"""Camera model as JSON, exact: camera.json of a flight folder, and of a recording."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from companion.geometry.camera import COEFFICIENTS, Camera, Distortion
from companion.geometry.gimbal import Gimbal
from companion.geometry.transforms import Pose


def camera_document(camera: Camera) -> bytes:
    """JSON of a camera; numbers are read back unchanged."""
    document: dict[str, Any] = {
        **camera.lens, "distortion_model": camera.distortion.value,
        "D": [float(each) for each in camera.coefficients],
        "assumed": camera.assumed,
    }  # fmt: skip
    if camera.readout_ms is not None:
        document["readout_ms"] = camera.readout_ms
    mount = camera.body_from_camera
    if mount is not None:
        document["body_from_camera"] = mount.matrix().tolist()
    if camera.gimbal is not None:
        document["gimbal"] = camera.gimbal.document()
    return (json.dumps(document, indent=1) + "\n").encode()


def camera_of(document: bytes) -> Camera:
    """Camera of such a document; ValueError if invalid."""
    given = json.loads(document)
    try:
        width, height = int(given["width"]), int(given["height"])
        fx, fy, cx, cy = (float(given[key]) for key in ("fx", "fy", "cx", "cy"))
        model = Distortion(given["distortion_model"])
        matrix = given.get("body_from_camera")
        mount = None if matrix is None else Pose.from_matrix(np.array(matrix, np.float64))
        coefficients = tuple(map(float, given["D"]))
        assumed = bool(given["assumed"])
        readout_ms = None if given.get("readout_ms") is None else float(given["readout_ms"])
        gimbal = None if given.get("gimbal") is None else Gimbal.of_document(given["gimbal"])
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise ValueError(f"not a camera: {error}") from error
    if len(coefficients) != len(COEFFICIENTS[model]) or min(width, height, fx, fy) <= 0:
        raise ValueError("not a camera: numbers are missing")
    if readout_ms is not None and not 0 <= readout_ms < 1e3:
        raise ValueError(f"not a camera: a readout of {readout_ms} ms")
    return Camera(
        width, height, fx, fy, cx, cy, model, coefficients, mount, assumed, readout_ms, gimbal
    )
