"""Pruning of a site map: keyframes that others make redundant, as flights over a site pile up."""

from __future__ import annotations

from companion.geometry.transforms import Similarity
from companion.slam.map.site_map import SiteMap, site_map_of, slam_map_of
from companion.slam.mapping.culling import cull_keyframes

N_OBSERVERS = 2
"""Others that observe the points of a redundant keyframe: in flight a third is needed, by which
wrong observations are found, and those of a saved map have been."""


def prune_site(site: SiteMap, spacing_deg: float) -> SiteMap:
    """The map without redundant keyframes within an angle of another, as seen from their points.

    Only those go whose points nearly all are observed by two others as well.
    """
    slam_map = slam_map_of(site, site.parts[-1].camera)
    slam_map.held = frozenset()
    for keyframe in list(slam_map.keyframes.values()):
        if keyframe.keyframe_id in slam_map.keyframes:
            cull_keyframes(slam_map, keyframe, spacing_deg, N_OBSERVERS)
    part_of_id = {
        k.keyframe_id: part for k, part in zip(site.keyframes, site.part_of.tolist(), strict=True)
    }
    return site_map_of(
        slam_map, Similarity.identity(), site.parts, part_of_id, site.georeference,
        site.revision + 1,
    )  # fmt: skip
