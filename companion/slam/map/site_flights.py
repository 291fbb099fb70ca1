"""The keyframes of single flights in a site map: what each observes, and how far they agree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from companion.geometry.transforms import Array
from companion.slam.features.orb_features import Bools, Ints
from companion.slam.map.site_map import SiteMap
from companion.slam.map.sparse_map import Keyframe

ROBUST = 1.4826
"""Standard deviation by the median of absolute values, of normal errors."""

MIN_SHARED = 10
"""Points on which a disagreement is told: of thirty numbers the median absolute value is certain to
a fifth."""


class SiteFlight:
    """Some keyframes of a site map, and by how many of them each point is observed."""

    def __init__(self, site: SiteMap, chosen: Bools) -> None:
        self.keyframes = [site.keyframes[n] for n in np.flatnonzero(chosen)]
        self.n_observers: Ints = np.zeros(len(site.points.positions), np.int64)
        """(P,) by point."""
        for keyframe in self.keyframes:
            self.n_observers[np.unique(keyframe.point_ids[keyframe.point_ids >= 0])] += 1

    @property
    def path_m(self) -> Array:
        """Places of the keyframes (N, 3)."""
        return np.stack([k.centre for k in self.keyframes])


def pixel_m(site: SiteMap) -> float:
    """Size of a pixel on the points of a site map, metres, median of all observations."""
    sizes = []
    for keyframe, part in zip(site.keyframes, site.part_of.tolist(), strict=True):
        seen = site.points.positions[keyframe.point_ids[keyframe.point_ids >= 0]]
        away_m = np.linalg.norm(seen - keyframe.centre, axis=1)
        sizes.append(away_m / site.parts[part].camera.focal_px)
    return float(np.median(np.concatenate(sizes)))


def disagreement_m(site: SiteMap, a: SiteFlight, b: SiteFlight) -> tuple[float | None, int]:
    """Standard deviation, of one axis, by which two flights disagree, and on how many points.

    Of each point that both observe, the place by the keyframes of each flight alone is compared.
    None where there are too few of them to tell.
    """
    shared = np.flatnonzero((a.n_observers >= 2) & (b.n_observers >= 2))
    off = _shifts_alone(site, a.keyframes, shared) - _shifts_alone(site, b.keyframes, shared)
    off = off[np.isfinite(off).all(1)]
    told = len(off) >= MIN_SHARED
    return float(ROBUST * np.median(np.abs(off))) if told else None, len(off)


def _shifts_alone(site: SiteMap, keyframes: Sequence[Keyframe], ids: Ints) -> Array:
    """Shifts (N, 3) of points to where some keyframes alone have them; nan where unknown.

    One step of Gauss-Newton, with all poses known: residuals are those of an adjusted map.
    """
    row = np.full(len(site.points.positions), -1)
    row[ids] = np.arange(len(ids))
    information, gradient = np.zeros((len(ids), 3, 3)), np.zeros((len(ids), 3))
    for keyframe in keyframes:
        features = np.flatnonzero(keyframe.point_ids >= 0)
        at = row[keyframe.point_ids[features]]
        features, at = features[at >= 0], at[at >= 0]
        pose = keyframe.camera_from_map
        seen = pose.apply(site.points.positions[ids[at]])
        depth = np.where(seen[:, 2] > 0, seen[:, 2], np.inf)
        flat = seen[:, :2] / depth[:, None]
        projection = np.zeros((len(at), 2, 3))
        projection[:, 0, 0] = projection[:, 1, 1] = 1.0 / depth
        projection[:, :, 2] = -flat / depth[:, None]
        white = keyframe.whitening[features]
        jacobian = white @ projection @ pose.rotation
        residual = np.einsum("nij,nj->ni", white, keyframe.normalised[features] - flat)
        np.add.at(information, at, jacobian.transpose(0, 2, 1) @ jacobian)
        np.add.at(gradient, at, np.einsum("nji,nj->ni", jacobian, residual))
    out = np.full((len(ids), 3), np.nan)
    known = np.flatnonzero(np.linalg.det(information) > 0)
    out[known] = np.linalg.solve(information[known], gradient[known][..., None])[..., 0]
    return out
