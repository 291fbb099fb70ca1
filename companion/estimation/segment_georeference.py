"""Where the map's segments lie: each in the world, and all in the frame of the main one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from companion.estimation.camera_attitude import CameraAttitude
from companion.estimation.georeference import Georeferencer, Place
from companion.estimation.height_above_ground import GroundBelow
from companion.estimation.trajectory_alignment import (
    DISAGREE,
    MAX_STEP_S,
    SIGMA_VELOCITY_M_S,
    VELOCITY_TAU_S,
)
from companion.geometry.transforms import Array, Pose, Similarity
from companion.messages import Georeference, MapUpdate
from companion.slam.loop.loop_closure import LoopClosure
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.optimisation.displacement_factor import DisplacementFactor, typical_error

MAX_LOOP_ERROR_M = 6.0
"""What the autopilot's own positions may be wrong by between two times."""
ALIKE = 3.0
"""Each window takes the same ways anew, and their errors are alike: sigmas are so much larger."""
MAX_SIGMA_SCALE_TOLD = 0.05
"""A map whose scale is known no better is not told how far its cameras are apart."""
MOST_PLACES, MOST_PLACES_FINAL = 120, 400


class SegmentPlaces:
    """Georeferences of segments, told anew as they grow.

    A segment is known by its first keyframe. `body_from_camera` is the mount, None where it is not
    known.
    """

    def __init__(
        self, georeferencer: Georeferencer, attitude: CameraAttitude, body_from_camera: Pose | None
    ) -> None:
        self.main_from_newest = Similarity.identity()
        self._georeferencer = georeferencer
        self._attitude = attitude
        self._body_from_camera = body_from_camera
        self._known: dict[int, Georeference] = {}
        self._kept: tuple[int, Georeference] | None = None
        """A segment from before, and how it was known to lie."""
        self._main: int | None = None
        self._revision = 0

    def of(self, segment: SlamMap) -> Georeference | None:
        """How a segment lies in the world; None until that is known."""
        return self._known.get(segment.first_keyframe_id)

    def take_up(self, segment: SlamMap, kept: Georeference) -> None:
        """Place a segment as it was known to lie before this process began."""
        self._known[segment.first_keyframe_id] = kept
        self._kept = segment.first_keyframe_id, kept

    def _surer(self, segment: SlamMap, found: Georeference) -> Georeference:
        """What was found of a segment, or what was known of it before, if that is surer.

        What it was found by is not kept: it takes as long again until as much is known. A scale
        that both cannot have is the newly measured one. A place in the world is not given up for
        a map that begins at its first camera: poses would be led from the one to the other; where
        scales disagree it is as uncertain as they are apart.
        """
        if self._kept is None or self._kept[0] != segment.first_keyframe_id:
            return found
        kept = self._kept[1]
        apart = abs(float(np.log(found.world_from_map.scale / kept.world_from_map.scale)))
        disagree = apart > DISAGREE * float(np.hypot(found.sigma_scale, kept.sigma_scale))
        if kept.has_origin and not found.has_origin:
            return replace(kept, sigma_scale=apart) if disagree else kept
        if (
            found.sigma_scale <= kept.sigma_scale
            or found.n_positions >= kept.n_positions
            or found.has_origin > kept.has_origin
            or disagree
        ):
            self._kept = None
            return found
        return kept

    def update(self, segments: Sequence[SlamMap], t_ns: int, final: bool) -> MapUpdate:
        """The map, all segments in the frame of the main one."""
        self._revision += 1
        for segment in segments:
            if final or (segment is segments[-1] and _due(segment)):
                found = self._georeferencer.solve(self._placed(segment, _spread(segment, final)))
                if found is not None:
                    self._known[segment.first_keyframe_id] = self._surer(segment, found)
        main = self._main_of(segments, final)
        anchor = self.of(main)
        poses: dict[int, Pose] = {}
        scales: dict[int, float] = {}
        points: list[Array] = []
        n_retired = 0
        for segment in segments:
            own = self.of(segment)
            if own is not None and not own.has_origin:
                own = self._begun(segment, segments, own)
            elif own is None and segment is segments[-1] and not final:
                own = self._begun(segment, segments, None)
            if segment is main:
                main_from_own = Similarity.identity()
            elif anchor is not None and own is not None:
                main_from_own = anchor.world_from_map.inverse() @ own.world_from_map
            else:
                continue  # nothing says how this segment lies to the main one
            if segment is segments[-1]:
                self.main_from_newest = main_from_own
            n_retired += len(segment.retired)
            for key, map_from_camera in segment.poses():
                poses[key] = main_from_own.apply_to_pose(map_from_camera)
                unit = main_from_own.scale * segment.unit_of.get(key, 1.0)
                if unit != 1.0:
                    scales[key] = unit
            points.append(main_from_own.apply(segment.point_positions()))
        return MapUpdate(
            self._revision, t_ns, poses, np.concatenate(points), anchor, scales, n_retired
        )

    def displacements_of(
        self, segment: SlamMap, keyframes: list[Keyframe]
    ) -> DisplacementFactor | None:
        """DisplacementFactor between keyframes of a segment that follow each other, by the autopilot's velocity.

        As wrong as they are found to be all over the segment; None where they do not fit it.
        """
        placed = self.of(segment)
        if placed is None or placed.sigma_scale > MAX_SIGMA_SCALE_TOLD:
            return None
        everywhere = list(segment.keyframes.values())
        whole = self._ways(placed, everywhere)
        if whole is None:
            return None
        error = typical_error(whole, *_poses(everywhere))
        ways = None if error is None else self._ways(placed, keyframes)
        if ways is None or error is None:
            return None
        return replace(ways, sigma_m=ALIKE * ways.sigma_m * max(error, 1.0))

    def _ways(self, placed: Georeference, keyframes: list[Keyframe]) -> DisplacementFactor | None:
        t_ns = np.array([k.t_ns for k in keyframes])
        travelled_m = self._georeferencer.travelled(t_ns)
        if travelled_m is None:
            return None
        to_world, (rotation, _) = placed.world_from_map, _poses(keyframes)
        ned_from_camera = to_world.rotation @ rotation.transpose(0, 2, 1)
        where_m = travelled_m + self._georeferencer.lever_ned(ned_from_camera)
        order = np.argsort(t_ns, kind="stable")
        first, second = order[:-1], order[1:]
        displacement_m, dt_s = where_m[second] - where_m[first], (t_ns[second] - t_ns[first]) * 1e-9
        use = np.isfinite(displacement_m[:, :2]).all(1) & (dt_s < MAX_STEP_S)
        if not use.any():
            return None
        placing = np.hypot(placed.sigma_scale, placed.sigma_yaw_rad)
        sigma_m = np.hypot(
            SIGMA_VELOCITY_M_S * np.sqrt(dt_s * np.maximum(dt_s, VELOCITY_TAU_S)),
            placing * np.linalg.norm(np.nan_to_num(displacement_m), axis=1),
        )
        return DisplacementFactor(
            first[use],
            second[use],
            displacement_m[use],
            sigma_m[use],
            to_world.scale * to_world.rotation,
        )

    def _main_of(self, segments: Sequence[SlamMap], final: bool) -> SlamMap:
        """The segment with most keyframes; in flight the one before, while its place is known."""
        main = max(segments, key=lambda s: len(s.keyframes))
        kept = next((s for s in segments if s.first_keyframe_id == self._main), None)
        if not final and kept is not None and self._anchors(kept) >= self._anchors(main):
            main = kept  # what is told in its frame does not jump
        self._main = main.first_keyframe_id
        return main

    def _anchors(self, segment: SlamMap) -> int:
        """Whether others can be placed by a segment: 0 not at all, 1 by the way, 2 in the world."""
        placed = self.of(segment)
        return 0 if placed is None else 1 + placed.has_origin

    def _begun(
        self, segment: SlamMap, segments: Sequence[SlamMap], own: Georeference | None
    ) -> Georeference | None:
        """How a segment lies that is too young to tell: by the way since the last keyframe left.

        `own` is what tells its scale, without an origin, or None.
        """
        first = next(iter(segment.keyframes.values()))
        before = [
            (k.t_ns, placed.world_from_map.apply(k.centre))
            for s in segments
            if s is not segment and (placed := self.of(s)) is not None
            for k in s.keyframes.values()
            if k.t_ns < first.t_ns
        ]
        if not before:
            return None
        since_ns, from_ned_m = max(before, key=lambda place: place[0])
        moved_m = self._georeferencer.moved(since_ns, first.t_ns)
        if moved_m is None:
            return None
        start_ned_m = from_ned_m + moved_m
        if own is None:
            places = self._placed(segment, list(segment.keyframes.values()))
            return self._georeferencer.begin(places, start_ned_m)
        to_world = own.world_from_map
        origin = start_ned_m - to_world.scale * to_world.rotation @ first.centre
        return replace(own, world_from_map=replace(to_world, translation=origin))

    def allowed(
        self, segment: SlamMap, keyframe: Keyframe, other: Keyframe, found: LoopClosure
    ) -> bool:
        """Whether the autopilot can have been where a reunion would have it been.

        `keyframe` is of `segment`, where that is the map in use.
        """
        here = keyframe.keyframe_id in segment.keyframes
        placed = self.of(segment) if here else None
        if placed is None:
            return True
        way = found.here_from_there.apply(other.centre) - keyframe.centre
        displacement_m = placed.world_from_map.scale * placed.world_from_map.rotation @ way
        flown_m = self._georeferencer.way_between(keyframe.t_ns, other.t_ns)
        if flown_m is None:
            return True
        off_m = float(np.linalg.norm(displacement_m - flown_m))
        return off_m < MAX_LOOP_ERROR_M + 3.0 * placed.sigma_scale * float(
            np.linalg.norm(displacement_m)
        )

    def _placed(self, segment: SlamMap, keyframes: list[Keyframe]) -> list[Place]:
        poses = [k.camera_from_map.inverse() for k in keyframes]
        grounds = self._grounds_below(segment, poses)
        return [
            Place(k.t_ns, pose, self._attitude.of_keyframe(k.keyframe_id, k.t_ns), ground)
            for k, pose, ground in zip(keyframes, poses, grounds, strict=True)
        ]

    def _grounds_below(self, segment: SlamMap, poses: list[Pose]) -> list[float | None]:
        """Distances from cameras, `map_from_camera`, down the body's axis to the map, in its units.

        None where they are not known: no rangefinder asks for them, or a gimbal turns the camera.
        """
        mount = self._body_from_camera
        asked = self._georeferencer.has_ranges and self._attitude.used
        if mount is None or not poses or not asked:
            return [None] * len(poses)
        beams = [pose.rotation @ mount.rotation[2] for pose in poses]
        down = np.sum(beams, axis=0)
        ground = GroundBelow(segment.point_positions(), down / np.linalg.norm(down))
        return [
            ground.distance(pose.translation, beam) for pose, beam in zip(poses, beams, strict=True)
        ]


def _poses(keyframes: list[Keyframe]) -> tuple[Array, Array]:
    """Rotations (K, 3, 3) and translations (K, 3), `camera_from_map`."""
    poses = [k.camera_from_map for k in keyframes]
    return np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses])


def _due(segment: SlamMap) -> bool:
    n = len(segment.keyframes)
    return n < 40 or n % 5 == 0


def _spread(segment: SlamMap, final: bool) -> list[Keyframe]:
    keyframes = list(segment.keyframes.values())
    most = MOST_PLACES_FINAL if final else MOST_PLACES
    if len(keyframes) <= most:
        return keyframes
    return [keyframes[int(i)] for i in np.linspace(0, len(keyframes) - 1, most).astype(int)]
