"""Displacement factors between keyframes of a map, by the autopilot's velocity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from companion.estimation.georeference.georeferencer import Georeferencer
from companion.estimation.georeference.trajectory_alignment import (
    MAX_STEP_S,
    SIGMA_VELOCITY_M_S,
    VELOCITY_TAU_S,
)
from companion.geometry.transforms import Array
from companion.messages import Georeference
from companion.slam.map.sparse_map import Keyframe
from companion.slam.optimisation.displacement_factor import DisplacementFactor, typical_error

CORRELATION_INFLATION = 3.0
"""Inflation of sigmas: each adjustment window reuses the same displacements."""
MAX_SIGMA_SCALE = 0.05
"""Displacement factors require a scale at least this certain."""


def displacement_factor(
    georeferencer: Georeferencer, placed: Georeference, everywhere: list[Keyframe],
    keyframes: list[Keyframe],
) -> DisplacementFactor | None:  # fmt: skip
    """Displacement factor between consecutive keyframes of a map so placed.

    Sigmas are scaled by the residuals over all its keyframes, `everywhere`; None where they do not
    fit, and where the scale is too uncertain.
    """
    if placed.sigma_scale > MAX_SIGMA_SCALE:
        return None
    rotation, translation = _poses(everywhere)
    whole = _displacements(georeferencer, placed, everywhere, rotation)
    if whole is None:
        return None
    error = typical_error(whole, rotation, translation)
    if error is None:
        return None
    factor = _displacements(georeferencer, placed, keyframes, _poses(keyframes)[0])
    if factor is None:
        return None
    return replace(factor, sigma_m=CORRELATION_INFLATION * factor.sigma_m * max(error, 1.0))


def _displacements(
    georeferencer: Georeferencer, placed: Georeference, keyframes: list[Keyframe], rotation: Array
) -> DisplacementFactor | None:
    t_ns = np.array([k.t_ns for k in keyframes])
    travelled_m = georeferencer.path.integrated_velocity(t_ns)
    if travelled_m is None:
        return None
    to_world = placed.world_from_map
    ned_from_camera = to_world.rotation @ rotation.transpose(0, 2, 1)
    where_m = travelled_m + georeferencer.lever_ned(ned_from_camera)
    order = np.argsort(t_ns, kind="stable")
    first, second = order[:-1], order[1:]
    displacement_m, dt_s = where_m[second] - where_m[first], (t_ns[second] - t_ns[first]) * 1e-9
    use = np.isfinite(displacement_m[:, :2]).all(1) & (dt_s < MAX_STEP_S)
    if not use.any():
        return None
    relative_sigma = np.hypot(placed.sigma_scale, placed.sigma_yaw_rad)
    sigma_m = np.hypot(
        SIGMA_VELOCITY_M_S * np.sqrt(dt_s * np.maximum(dt_s, VELOCITY_TAU_S)),
        relative_sigma * np.linalg.norm(np.nan_to_num(displacement_m), axis=1),
    )
    return DisplacementFactor(
        first[use],
        second[use],
        displacement_m[use],
        sigma_m[use],
        to_world.scale * to_world.rotation,
    )


def _poses(keyframes: list[Keyframe]) -> tuple[Array, Array]:
    """Rotations (K, 3, 3) and translations (K, 3), `camera_from_map`."""
    poses = [k.camera_from_map for k in keyframes]
    return np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses])
