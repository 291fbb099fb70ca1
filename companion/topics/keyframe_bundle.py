"""Bundle: input of the depth stage from one keyframe to the next, as one message.

Frames come first, then their tracks, the keyframes, and the changes of the map since the bundle
before: in that order the depth stage takes them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from companion.errors import StreamError
from companion.geometry.camera import Camera
from companion.geometry.transforms import Similarity
from companion.messages import (
    Frame,
    KeyframeAdded,
    MapUpdate,
    Track,
    TrackRefined,
    TrackState,
)
from companion.topics.envelope import Envelope
from companion.topics.image_jpeg import image_of
from companion.topics.message_codec import (
    MOST_ID,
    georeference_fields,
    georeference_of,
    map_update,
    places_arrays,
    places_of,
    points_of,
)
from companion.topics.pose_rows import known_pose_of, pose_of, pose_rows

STATES = list(TrackState)
MOST_FRAMES, MOST_TRACKS, MOST_KEYFRAMES = 256, 4096, 64
MOST_MOTION = 1e4
"""Of a camera's angular rate in rad/s, its velocity, and one over the distance of a scene."""


NO_COLOUR = np.zeros((0, 0, 3), np.uint8)


@dataclass(frozen=True, slots=True)
class Picture:
    """A frame as JPEG; in colour if it is a keyframe's."""

    seq: int
    t_ns: int
    jpeg: bytes
    in_colour: bool


@dataclass(frozen=True, slots=True, eq=False)
class MapChange:
    """Changes of the map with a bundle: poses new or changed, and keyframes removed.

    With `whole` it is all of the map.
    """

    update: MapUpdate
    removed: Sequence[int] = ()
    whole: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """Bundle `number` of process `run`; `over`: it is the flight's last."""

    run: str
    number: int
    pictures: Sequence[Picture] = ()
    tracks: Sequence[Track] = ()
    refined: Sequence[TrackRefined] = ()
    keyframes: Sequence[KeyframeAdded] = ()
    change: MapChange | None = None
    over: bool = False

    def pack(self) -> bytes:
        """Encoded bytes."""
        fields: dict[str, object] = {"run": self.run, "number": self.number, "over": self.over}
        arrays = {
            **_pictures(self.pictures), **_tracks(self.tracks), **_refined(self.refined),
            **_keyframes(self.keyframes),
        }  # fmt: skip
        fields["map"] = None
        if self.change is not None:
            update = self.change.update
            fields["map"] = {
                "revision": update.revision, "t_ns": update.t_ns, "whole": self.change.whole,
                "n_retired": update.n_retired,
                "georeference": georeference_fields(update.georeference),
            }  # fmt: skip
            arrays |= places_arrays(update, list(update.map_from_camera))
            arrays["removed"] = np.array(self.change.removed, np.int32)
        return Envelope("bundle", fields, arrays).pack()


def bundle_of(envelope: Envelope) -> Bundle:
    """Bundle of an envelope; StreamError if invalid."""
    if envelope.kind != "bundle":
        raise StreamError(f"wanted a bundle, and {envelope.kind!r} came")
    change = None
    if envelope.known("map"):
        part = envelope.part("map")
        places = places_of(envelope)
        removed = [int(k) for k in envelope.array("removed", "<i4", -1)]
        update = map_update(
            part.integer("revision"), part.integer("t_ns"), places, georeference_of(part),
            part.integer("n_retired", 0, MOST_ID),
        )  # fmt: skip
        change = MapChange(update, removed, part.flag("whole"))
    return Bundle(
        envelope.text("run"), envelope.integer("number", -1), _pictures_of(envelope),
        _tracks_of(envelope), _refined_of(envelope), _keyframes_of(envelope), change,
        envelope.flag("over"),
    )  # fmt: skip


def frame_of(picture: Picture, camera: Camera) -> Frame:
    """Frame of the camera's size, without colours if grey; StreamError if invalid."""
    image = image_of(picture.jpeg, camera.width, camera.height, picture.in_colour)
    if not picture.in_colour:
        return Frame(picture.seq, picture.t_ns, image, NO_COLOUR)
    grey = image_of(picture.jpeg, camera.width, camera.height, False)
    return Frame(picture.seq, picture.t_ns, grey, image)


class MapMirror:
    """Map rebuilt from changes."""

    def __init__(self) -> None:
        self._places: dict[int, Similarity] = {}

    def take(self, change: MapChange) -> MapUpdate:
        """Map after a change."""
        update = change.update
        if change.whole:
            self._places = {}
        for keyframe_id in change.removed:
            self._places.pop(keyframe_id, None)
        for keyframe_id in update.map_from_camera:
            place = update.place_of(keyframe_id)
            assert place is not None
            self._places[keyframe_id] = place
        return map_update(
            update.revision, update.t_ns, self._places, update.georeference, update.n_retired
        )


class MapChanges:
    """Changes from one state of the map to the next."""

    def __init__(self) -> None:
        self._given: dict[int, tuple[object, ...]] = {}
        self._is_first = True

    def since_last(self, update: MapUpdate) -> MapChange:
        """Poses that differ from those given before; the first time the whole map."""
        now = {k: _state(update, k) for k in update.map_from_camera}
        changed = {
            k: pose for k, pose in update.map_from_camera.items() if now[k] != self._given.get(k)
        }
        removed = [k for k in self._given if k not in now]
        units = {k: unit for k, unit in update.scale_of.items() if k in changed}
        whole, self._is_first, self._given = self._is_first, False, now
        part = replace(update, map_from_camera=changed, scale_of=units, points_map=np.zeros((0, 3)))
        return MapChange(part, removed, whole)


def _state(update: MapUpdate, keyframe_id: int) -> tuple[object, ...]:
    pose = update.map_from_camera[keyframe_id]
    unit = update.scale_of.get(keyframe_id, 1.0)
    return unit, pose.rotation.tobytes(), pose.translation.tobytes()


def _pictures(pictures: Sequence[Picture]) -> dict[str, np.ndarray]:
    sizes = [len(p.jpeg) for p in pictures]
    return {
        "picture_seq_t": _pairs([(p.seq, p.t_ns) for p in pictures]),
        "picture_in_colour": np.array([p.in_colour for p in pictures], np.uint8),
        "picture_sizes": np.array(sizes, np.int64),
        "jpegs": np.frombuffer(b"".join(p.jpeg for p in pictures), np.uint8),
    }


def _pictures_of(envelope: Envelope) -> list[Picture]:
    sizes = envelope.array("picture_sizes", "<i8", -1)
    n = len(sizes)
    data = envelope.array("jpegs", "|u1", -1).tobytes()
    if n > MOST_FRAMES or (n and (sizes.min() < 0 or sizes.max() > len(data))):
        raise StreamError("bundle: no sizes of pictures")
    if int(sizes.sum()) != len(data):
        raise StreamError("bundle: pictures of other sizes")
    pairs, colour = _pairs_of(envelope, "picture", n), envelope.array("picture_in_colour", "|u1", n)
    ends = np.cumsum(sizes)
    return [
        Picture(seq, t_ns, data[end - size : end], bool(flag))
        for (seq, t_ns), size, end, flag in zip(pairs, sizes, ends, colour, strict=True)
    ]


def _tracks(tracks: Sequence[Track]) -> dict[str, np.ndarray]:
    known = [t.keyframe_id if t.keyframe_id is not None else -1 for t in tracks]
    arrays = {
        "track_seq_t": _pairs([(t.seq, t.t_ns) for t in tracks]),
        "track_state": np.array([STATES.index(t.state) for t in tracks], np.uint8),
        "track_backfilled": np.array([t.backfilled for t in tracks], np.uint8),
        "track_keyframe": np.array(known, np.int32),
        "track_found": _pairs([(t.n_inliers, t.n_matches) for t in tracks]),
        "track_sigmas": np.array(
            [(t.sigma_position, t.sigma_rotation_rad) for t in tracks], np.float64
        ).reshape(-1, 2),
        "track_map_from_camera": pose_rows([t.map_from_camera for t in tracks]),
        "track_keyframe_from_camera": pose_rows([t.keyframe_from_camera for t in tracks]),
    }
    motions = [t.shutter_motion for t in tracks]
    if any(motion is not None for motion in motions):  # of a rolling shutter only
        unknown = np.full((3, 3), np.nan)
        arrays["track_shutter"] = np.stack([unknown if m is None else m for m in motions])
    return arrays


def _tracks_of(envelope: Envelope) -> list[Track]:
    states = envelope.array("track_state", "|u1", -1)
    n = len(states)
    if n > MOST_TRACKS or (n and states.max() >= len(STATES)):
        raise StreamError("bundle: no states of tracks")
    pairs, found = _pairs_of(envelope, "track", n), envelope.array("track_found", "<i8", n, 2)
    keyframes = envelope.array("track_keyframe", "<i4", n)
    backfilled = envelope.array("track_backfilled", "|u1", n)
    sigmas = envelope.array("track_sigmas", "<f8", n, 2, finite=False)
    poses, relative = (
        envelope.array(name, "<f8", n, 7, finite=False)
        for name in ("track_map_from_camera", "track_keyframe_from_camera")
    )
    motions = np.full((n, 3, 3), np.nan)
    if "track_shutter" in envelope.arrays:
        motions = envelope.array("track_shutter", "<f8", n, 3, 3, finite=False)
    out = []
    for k in range(n):
        track = Track(
            pairs[k][0], pairs[k][1], STATES[states[k]], pose_of(poses[k]),
            int(keyframes[k]) if keyframes[k] >= 0 else None, pose_of(relative[k]),
            int(found[k, 0]), int(found[k, 1]), None, bool(backfilled[k]),
            float(sigmas[k, 0]), float(sigmas[k, 1]),
            motions[k] if np.abs(motions[k]).max() < MOST_MOTION else None,
        )  # fmt: skip
        out.append(track)
    return out


def _refined(refined: Sequence[TrackRefined]) -> dict[str, np.ndarray]:
    if not refined:
        return {}
    return {
        "refined_seq_t": _pairs([(each.seq, each.t_ns) for each in refined]),
        "refined_keyframe": np.array([each.keyframe_id for each in refined], np.int32),
        "refined_from_camera": pose_rows([each.keyframe_from_camera for each in refined]),
    }


def _refined_of(envelope: Envelope) -> list[TrackRefined]:
    if "refined_keyframe" not in envelope.arrays:
        return []
    keyframes = envelope.array("refined_keyframe", "<i4", -1)
    n = len(keyframes)
    if n > MOST_TRACKS or (n and keyframes.min() < 0):
        raise StreamError("bundle: no keyframes of refined frames")
    rows = envelope.array("refined_from_camera", "<f8", n, 7)
    pairs = _pairs_of(envelope, "refined", n)
    return [
        TrackRefined(seq, t_ns, int(keyframe), known_pose_of(row))
        for (seq, t_ns), keyframe, row in zip(pairs, keyframes, rows, strict=True)
    ]


def _keyframes(keyframes: Sequence[KeyframeAdded]) -> dict[str, np.ndarray]:
    points = [k.points_camera.astype(np.float32) for k in keyframes]
    return {
        "keyframe_ids": np.array([k.keyframe_id for k in keyframes], np.int32),
        "keyframe_seq_t": _pairs([(k.seq, k.t_ns) for k in keyframes]),
        "keyframe_map_from_camera": pose_rows([k.map_from_camera for k in keyframes]),
        "keyframe_n_points": np.array([len(p) for p in points], np.int64),
        "points_camera": np.concatenate([*points, np.zeros((0, 3), np.float32)]),
    }


def _keyframes_of(envelope: Envelope) -> list[KeyframeAdded]:
    ids = envelope.array("keyframe_ids", "<i4", -1)
    n = len(ids)
    counts = envelope.array("keyframe_n_points", "<i8", n)
    all_points = envelope.array("points_camera", "<f4", -1, 3)
    if n > MOST_KEYFRAMES or (n and (ids.min() < 0 or counts.min() < 0)):
        raise StreamError("bundle: no numbers of keyframes")
    if (n and counts.max() > len(all_points)) or int(counts.sum()) != len(all_points):
        raise StreamError("bundle: points of no keyframe")
    pairs = _pairs_of(envelope, "keyframe", n)
    poses = envelope.array("keyframe_map_from_camera", "<f8", n, 7)
    ends = np.cumsum(counts)
    out = []
    for k in range(n):
        mine = Envelope("bundle", {}, {"points": all_points[ends[k] - counts[k] : ends[k]]})
        points = points_of(mine, "points").astype(np.float64)
        out.append(
            KeyframeAdded(int(ids[k]), pairs[k][0], pairs[k][1], known_pose_of(poses[k]), points)
        )
    return out


def _pairs(pairs: Sequence[tuple[int, int]]) -> np.ndarray:
    return np.array(pairs, np.int64).reshape(-1, 2)


def _pairs_of(envelope: Envelope, name: str, n: int) -> list[tuple[int, int]]:
    pairs = envelope.array(f"{name}_seq_t", "<i8", n, 2)
    if n and pairs.min() < 0:
        raise StreamError(f"bundle: no numbers and times of {name}s")
    return [(int(seq), int(t_ns)) for seq, t_ns in pairs]
