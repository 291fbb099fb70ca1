"""Georeferences of map segments, and their placement in the frame of the main one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.georeference.begun_segments import BegunSegments
from companion.estimation.georeference.carried_rotation import carried_level
from companion.estimation.georeference.depth_scales import DepthScales
from companion.estimation.georeference.displacement_by_velocity import displacement_factor
from companion.estimation.georeference.georeferencer import Georeferencer, begun_at, place_new_map
from companion.estimation.georeference.inertial_scale import InertialScale, settled
from companion.estimation.georeference.segment_samples import SegmentSamples
from companion.estimation.georeference.tracked_places import TrackedPlaces
from companion.estimation.georeference.trajectory_alignment import DISAGREE, Scale
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.estimation.inertial.judged_acceleration import ByAcceleration
from companion.geometry.pose_table import PoseTable
from companion.geometry.transforms import Array, Pose, Similarity
from companion.messages import Georeference, MapUpdate, Track
from companion.slam.loop.loop_closure import LoopClosure
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.optimisation.displacement_factor import DisplacementFactor

MAX_LOOP_ERROR_M = 6.0
"""Error of measured positions between two times."""
MAX_SAMPLES, MAX_SAMPLES_FINAL = 120, 400
MAX_TOLD_WHOLE, N_TOLD = 1000, 400
"""Keyframes up to which all points of a map are told in flight; of a larger one those that so many
about the newest observe: each keyframe tells them again, to all who listen."""
MAX_COMPARED = 2000
"""Newest keyframes whose displacements say how well the velocity fits."""
SETTLED_AFTER, SETTLED_NS = 2, 1_000_000_000
"""Keyframes after which one has been adjusted, and so the frames before it are placed well; and so
are all frames that old: in a hover no keyframe comes."""


class SegmentGeoreferences:
    """Georeferences of segments, updated as they grow.

    A segment is identified by its first keyframe. `body_from_camera` is the mount, None where
    unknown.
    """

    def __init__(
        self, georeferencer: Georeferencer, attitude: CameraAttitude,
        acceleration: AccelerationIntegral, body_from_camera: Pose | None,
    ) -> None:  # fmt: skip
        self.main_from_newest = Similarity.identity()
        self._georeferencer = georeferencer
        self._attitude = attitude
        self._body_from_camera = body_from_camera
        self._known: dict[int, Georeference] = {}
        self._kept: tuple[int, Georeference] | None = None
        """A resumed segment and its stored georeference."""
        self._held: dict[int, Georeference] = {}
        """Of maps that are, or have taken over, that of an earlier flight; nothing moves them."""
        self.scale_of_held: Scale | None = None
        """Of the newest segment, where it is held, by accelerometers."""
        self._main: int | None = None
        self._revision = self._solved_ns = 0
        self._acceleration = acceleration
        self._by_acceleration = ByAcceleration()
        self._inertial: dict[int, InertialScale] = {}
        """By first keyframe of a segment."""
        self._places = TrackedPlaces()
        self.depths = DepthScales()
        self._samples = SegmentSamples(georeferencer, attitude, body_from_camera)
        self.begun = BegunSegments(georeferencer, self._samples)

    def stale(self, t_ns: int) -> bool:
        """True where they wait for a keyframe, and frames have told more meanwhile."""
        return t_ns - self._solved_ns > SETTLED_NS and self._places.newest_ns > self._solved_ns

    def of(self, segment: SlamMap) -> Georeference | None:
        """Georeference of a segment; None until known."""
        return self._known.get(segment.first_keyframe_id)

    def resume(self, segment: SlamMap, kept: Georeference) -> None:
        """Georeference a resumed segment as stored."""
        self._known[segment.first_keyframe_id] = kept
        self._kept = segment.first_keyframe_id, kept

    def hold(self, segment: SlamMap, kept: Georeference) -> None:
        """Georeference the map of an earlier flight."""
        self._held[segment.first_keyframe_id] = kept

    def merged(self, here: SlamMap, there: SlamMap, here_from_there: Similarity) -> None:
        """A map has taken over another: it lies where that of an earlier flight does."""
        kept = self._held.pop(there.first_keyframe_id, None)
        if kept is not None:
            world_from_here = kept.world_from_map @ here_from_there.inverse()
            placed = replace(kept, world_from_map=world_from_here)
            self._held[here.first_keyframe_id] = self._known[here.first_keyframe_id] = placed

    def move_held(self, by: Similarity) -> None:
        """The origin of the world has come: maps of an earlier flight lie in that from now on."""
        for key, kept in self._held.items():
            self._held[key] = replace(
                kept, world_from_map=by @ kept.world_from_map, has_origin=True
            )
            if key in self._known:
                self._known[key] = self._held[key]

    def give_up_place(self) -> None:
        """Maps of an earlier flight have no place on the globe: satellites contradict it."""
        for key, kept in self._held.items():
            self._held[key] = replace(kept, has_origin=False)
            if key in self._known:
                self._known[key] = self._held[key]

    def release(self) -> None:
        """Maps of an earlier flight lie where this flight's measurements say, if they say."""
        for key in self._held:
            self._known.pop(key, None)
        self._held.clear()

    def _more_certain(self, segment: SlamMap, found: Georeference) -> Georeference:
        """The found or the stored georeference of a segment, whichever is more certain.

        Stored measurements are not available, so it takes as long again to reach the same
        certainty. Where scales contradict, the measured one is used. A position in the world is not
        given up for a frame at the first camera, to avoid a jump; where scales contradict, sigma is
        their difference.
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
        """The map with all segments in the frame of the main one."""
        self._revision += 1
        due = self.stale(t_ns) or any(map(_due, segments[-1:]))
        if due:  # of a map that is held, too, which nothing is to be solved for
            self._solved_ns = t_ns
        for segment in segments:
            if segment.first_keyframe_id in self._held:
                if due and not final and segment is segments[-1]:
                    self.scale_of_held = self._inertial_scale(segment, t_ns, final=False)
                continue
            if final or (segment is segments[-1] and due):
                found = self._georeferencer.solve(
                    self._samples.of(
                        segment,
                        segment.spread_keyframes(MAX_SAMPLES_FINAL if final else MAX_SAMPLES),
                    ),
                    self._inertial_scale(segment, t_ns, final),
                    self.depths.of(segment),
                )
                if found is not None:
                    self._by_acceleration.note(t_ns, segment.first_keyframe_id, self._known, found)
                    self._known[segment.first_keyframe_id] = self._more_certain(segment, found)
        if final:
            self._place_by_carried_rotation(segments)
        main = self._main_of(segments, final)
        anchor = self.of(main)
        poses: list[PoseTable] = []
        scales: dict[int, float] = {}
        points: list[Array] = []
        n_retired = 0
        for segment in segments:
            own = self.of(segment)
            if own is not None and not own.has_origin:
                own = self._placed_by_dead_reckoning(segment, segments, own)
            elif own is None and segment is segments[-1] and not final:
                own = self._placed_by_dead_reckoning(segment, segments, None)
            if segment is main:
                main_from_own = Similarity.identity()
            elif anchor is not None and own is not None:
                main_from_own = anchor.world_from_map.inverse() @ own.world_from_map
            else:
                continue  # its pose relative to the main segment is unknown
            if segment is segments[-1]:
                self.main_from_newest = main_from_own
            n_retired += len(segment.retired)
            table = segment.poses()
            if final or len(segment.keyframes) <= MAX_TOLD_WHOLE:
                positions = segment.point_positions()
            else:
                positions = segment.positions_about_newest(N_TOLD)
            if segment is not main:
                table, positions = table.placed(main_from_own), main_from_own.apply(positions)
            poses.append(table)
            points.append(positions)
            for key in table:
                unit = main_from_own.scale * segment.unit_of.get(key, 1.0)
                if unit != 1.0:
                    scales[key] = unit
        return MapUpdate(
            self._revision, t_ns, PoseTable.joined(poses), np.concatenate(points), anchor, scales,
            n_retired,
        )  # fmt: skip

    def _place_by_carried_rotation(self, segments: Sequence[SlamMap]) -> None:
        placed = [(s, g.world_from_map) for s in segments if (g := self.of(s)) and g.has_origin]
        for segment in segments:
            carried = None if self.of(segment) else carried_level(segment, placed)
            if carried is None:
                continue
            samples = self._samples.of(segment, segment.spread_keyframes(MAX_SAMPLES_FINAL))
            found = self._georeferencer.solve_carried(samples, carried)
            if found is not None:
                self._known[segment.first_keyframe_id] = found

    def _inertial_scale(self, segment: SlamMap, t_ns: int, final: bool) -> Scale | None:
        """Scale of a segment by accelerometers; None while it is unknown."""
        mount = self._body_from_camera
        if mount is None or not self._attitude.used or not self._acceleration.has_samples:
            return None
        key, table = segment.first_keyframe_id, segment.poses()
        first = next(iter(segment.keyframes.values()))
        begun = self.begun.of(segment, first)
        start = None if begun is None else begun[0].start
        lever_m = mount.rotation.T @ mount.translation
        turned, delay_ns = self._attitude.correction[0], self._attitude.imu_delay_ns
        estimate = self._inertial.get(key)
        if estimate is None:
            estimate = self._inertial[key] = InertialScale(lever_m, start)
        newest = sorted(k.t_ns for k in segment.keyframes.values())
        whole = final and self._acceleration.believed
        settled_ns = max(newest[-min(SETTLED_AFTER, len(newest))], t_ns - SETTLED_NS)
        until_ns = newest[-1] + 1 if whole else settled_ns
        since_ns = 0 if whole else self._places.since_ns(until_ns, estimate.window_ns)
        places = self._places.of(table, segment.unit_of, turned, since_ns, until_ns)
        if whole:
            return settled(places, self._acceleration, lever_m, turned, delay_ns, start)
        found = estimate.update(places, self._acceleration, turned, delay_ns)
        return found if self._acceleration.believed else None

    def take(self, track: Track, ned_from_body: Array | None) -> None:
        """Add a tracked frame with its attitude (3, 3) by the autopilot."""
        relative, keyframe_id = track.keyframe_from_camera, track.keyframe_id
        if relative is not None and keyframe_id is not None and ned_from_body is not None:
            self._places.add(track.t_ns, keyframe_id, relative, ned_from_body)

    def withdraw_accelerations(self, since_ns: int) -> None:
        """Take back what accelerations since a time gave; scales begin anew with those before."""
        self._by_acceleration.withdraw(since_ns, self._known)
        self._inertial.clear()
        self.begun.withdraw(since_ns)

    def displacements_of(
        self, segment: SlamMap, keyframes: list[Keyframe]
    ) -> DisplacementFactor | None:
        """Displacement factor between consecutive keyframes of a segment, by velocity."""
        placed = self.of(segment)
        if placed is None:
            return None
        everywhere = list(islice(reversed(segment.keyframes.values()), MAX_COMPARED))[::-1]
        return displacement_factor(self._georeferencer, placed, everywhere, keyframes)

    def _main_of(self, segments: Sequence[SlamMap], final: bool) -> SlamMap:
        """The segment with most keyframes.

        In flight the previous one while its georeference is as good.
        """
        main = max(segments, key=lambda s: len(s.keyframes))
        kept = next((s for s in segments if s.first_keyframe_id == self._main), None)
        if not final and kept is not None and self._anchor_rank(kept) >= self._anchor_rank(main):
            main = kept  # poses published in its frame do not jump
        self._main = main.first_keyframe_id
        return main

    def _anchor_rank(self, segment: SlamMap) -> int:
        """Ability to place others: 0 none, 1 by dead reckoning, 2 in the world."""
        placed = self.of(segment)
        return 0 if placed is None else 1 + placed.has_origin

    def _placed_by_dead_reckoning(
        self, segment: SlamMap, segments: Sequence[SlamMap], own: Georeference | None
    ) -> Georeference | None:
        """Georeference of a young segment, by dead reckoning from the last keyframe before.

        `own` gives its scale without an origin, or None.
        """
        first = next(iter(segment.keyframes.values()))
        begun = self.begun.of(segment, first)
        if begun is not None:
            body, placed = begun
            own = own or placed
            if own is None:
                return None
            (lever_m,) = self._georeferencer.levers_of(self._samples.of(segment, [first]))
            start_ned_m = body.place_world_m + lever_m
            return begun_at(own, first.centre, start_ned_m)
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
        displacement_m = self._georeferencer.path.displacement_by_velocity(since_ns, first.t_ns)
        if displacement_m is None:
            return None
        # an unknown climb is taken as none: it is where the map lies, not how large it is
        start_ned_m = from_ned_m + np.nan_to_num(displacement_m)
        if own is None:
            samples = self._samples.of(segment, list(segment.keyframes.values()))
            travelled = self._georeferencer.travelled(samples)
            return None if travelled is None else place_new_map(samples, start_ned_m, *travelled)
        return begun_at(own, first.centre, start_ned_m)

    def loop_allowed(
        self, segment: SlamMap, keyframe: Keyframe, other: Keyframe, found: LoopClosure
    ) -> bool:
        """True if measured positions are consistent with a loop closure.

        `keyframe` is in `segment`, if that is active.
        """
        here = keyframe.keyframe_id in segment.keyframes
        placed = self.of(segment) if here else None
        if placed is None:
            return True
        displacement = found.here_from_there.apply(other.centre) - keyframe.centre
        displacement_m = placed.world_from_map.scale * placed.world_from_map.rotation @ displacement
        measured_m = self._georeferencer.path.displacement_between(keyframe.t_ns, other.t_ns)
        if measured_m is None:
            return True
        off_m = float(np.linalg.norm(displacement_m - measured_m))
        return off_m < MAX_LOOP_ERROR_M + 3.0 * placed.sigma_scale * float(
            np.linalg.norm(displacement_m)
        )


def _due(segment: SlamMap) -> bool:
    n = len(segment.keyframes)
    return n < 40 or n % 5 == 0
