from __future__ import annotations

import errno
import threading
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader

from companion.config import ViewerConfig
from companion.geometry.camera import Camera
from companion.messages import Message, ObstaclesSeen, TrackState
from companion.streaming.viewer import FileViewer, rrd_files
from tests.support.flights import flown

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
Rows = dict[tuple[str, str], list[tuple[int, Any]]]
STATIC = -1


def record(path: Path, messages: list[Message], config: ViewerConfig | None = None) -> Rows:
    """What a recording of the messages holds: by entity and component, (t_ns, values) by time."""
    with FileViewer(config or ViewerConfig(), CAMERA, path) as viewer:
        for message in messages:
            viewer.take(message)
    rows: Rows = defaultdict(list)
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        times = (
            batch.column("flight").cast("int64").to_pylist()
            if "flight" in batch.schema.names
            else [STATIC] * batch.num_rows
        )
        for name in batch.schema.names:
            if ":" in name:
                values = batch.column(name).to_pylist()
                pairs = zip(times, values, strict=True)
                rows[str(chunk.entity_path), name] += [(t, v) for t, v in pairs if v is not None]
    for found in rows.values():
        found.sort(key=lambda row: row[0])
    return rows


NEAR = np.array([[[9, 1, -5], [9, 2, -5]], [[3, 1, -5], [3, 2, -5]]], np.float32)
NO_EDGES = NEAR[:0]
EYE = np.array([1, 1, -5], np.float32)
OBSTACLES = [
    ObstaclesSeen(flown.time_ns(flown.N_FRAMES), EYE, NEAR, NEAR[:1] + 20),
    ObstaclesSeen(flown.time_ns(flown.N_FRAMES + 1), EYE, NO_EDGES, NO_EDGES),
]


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Rows:
    first: list[Message] = [flown.update()]  # metric from the start
    messages = [*flown.messages(), *OBSTACLES]
    return record(tmp_path_factory.mktemp("rrd") / "flight.rrd", first + messages)


def transform(rows: Rows, entity: str, k: int = -1) -> tuple[int, np.ndarray, np.ndarray]:
    """Time, matrix and translation of a transform; Rerun holds matrices by columns."""
    t_ns, matrix = rows[entity, "Transform3D:mat3x3"][k]
    _, translation = rows[entity, "Transform3D:translation"][k]
    return t_ns, np.array(matrix).reshape(3, 3).T, np.array(translation).ravel()


def pieces(rows: Rows, entity: str) -> list[np.ndarray]:
    """The pieces of a path as they ended, in order."""
    names = {
        e for e, c in rows
        if e.startswith(entity + "/") and c == "LineStrips3D:strips" and rows[e, c]
    }  # fmt: skip
    by_number = sorted(names, key=lambda name: int(name.rsplit("/", 1)[1]))
    return [np.array(s) for name in by_number for s in rows[name, "LineStrips3D:strips"][-1][1]]


def path_in_map(rows: Rows) -> list[np.ndarray]:
    """The same of the camera's path, whose pieces lie in the frames of keyframes."""
    out = []
    below = "/world/map/keyframes/"
    entities = {e for e, c in rows if c == "LineStrips3D:strips" and rows[e, c]}
    names = [name for name in entities if name.startswith(below)]
    for name in sorted(names, key=lambda name: int(name.rsplit("/", 1)[1])):
        _, matrix, translation = transform(rows, name)
        strips = rows[name, "LineStrips3D:strips"][-1][1]
        out += [np.array(strip) @ matrix.T + translation for strip in strips]
    return out


def test_the_map_lies_where_the_georeference_says(flight: Rows) -> None:
    _, matrix, translation = transform(flight, "/world/map")
    true = flown.WORLD_FROM_MAP
    assert np.allclose(matrix, true.scale * true.rotation, atol=1e-5)
    assert np.allclose(translation, true.translation, atol=1e-5)


def test_obstacles_are_drawn_the_nearer_the_redder_and_go_again(flight: Rows) -> None:
    shown, gone = flight["/world/obstacles", "LineStrips3D:strips"]
    assert np.array(shown[1]) == pytest.approx(NEAR)
    assert gone[1] in ([], None)
    far, near = (c >> 8 & 0xFFFFFF for c in flight["/world/obstacles", "LineStrips3D:colors"][0][1])
    assert (near >> 16) > (near >> 8 & 255) and (far >> 8 & 255) > (near >> 8 & 255)
    (free, _) = flight["/world/free", "LineStrips3D:strips"]
    assert np.array(free[1]) == pytest.approx(NEAR[:1] + 20)


def test_no_static_transform_hides_one_that_changes(flight: Rows) -> None:
    static = [e for (e, c), r in flight.items() if "Transform3D" in c and r[0][0] == STATIC]
    assert static == []


def test_points_are_the_ground_through_keyframe_and_map(flight: Rows) -> None:
    _, map_matrix, map_translation = transform(flight, "/world/map")
    _, matrix, translation = transform(flight, "/world/map/keyframes/3")
    points = np.array(flight["/world/map/keyframes/3", "Points3D:positions"][-1][1])
    world = (points @ matrix.T + translation) @ map_matrix.T + map_translation
    height = 6 * np.exp(-((world[:, :2] - [12, 18]) ** 2).sum(1) / 60)
    assert np.abs(world[:, 2] + height).max() < 1e-3


def test_the_camera_is_in_the_world_without_a_scale_above_its_pinhole(flight: Rows) -> None:
    pinholes = {e for e, c in flight if c == "Pinhole:image_from_camera"}
    assert pinholes == {"/world/camera/image"}
    seqs = [s for s in range(flown.N_FRAMES) if flown.track(s).state is TrackState.TRACKING]
    rows = flight["/world/camera", "Transform3D:mat3x3"]
    assert [t for t, _ in rows] == [flown.time_ns(s) for s in seqs]
    for k in (0, 57, len(seqs) - 1):
        _, matrix, translation = transform(flight, "/world/camera", k)
        true = flown.world_from_camera(seqs[k])
        assert np.allclose(matrix, true.rotation, atol=1e-5)  # an isometry, and not its inverse
        assert np.allclose(translation, true.translation, atol=1e-4)


def test_up_is_up(flight: Rows) -> None:
    assert flight["/world", "ViewCoordinates:xyz"][0][1] == [[5, 3, 2]]  # forward, right, down


def test_the_path_is_all_of_it_and_breaks_where_the_camera_was_lost(flight: Rows) -> None:
    found = path_in_map(flight)
    steps = np.concatenate([np.linalg.norm(np.diff(p, axis=0), axis=1) for p in found])
    assert steps.max() < 3 * np.median(steps)
    n_tracked = flown.N_FRAMES - flown.N_INITIALISING - len(flown.LOST)
    assert len(np.unique(np.concatenate(found).round(4), axis=0)) == n_tracked
    places = np.array([flown.map_from_camera(s).translation for s in range(flown.N_FRAMES)])
    apart = np.linalg.norm(np.concatenate(found)[:, None] - places, axis=2).min(axis=1)
    assert apart.max() < 1e-4
    assert np.allclose(
        found[-1][-1], flown.map_from_camera(flown.N_FRAMES - 1).translation, atol=1e-4
    )


def test_a_long_path_costs_no_more_than_a_short_one_for_each_pose(tmp_path: Path) -> None:
    def floats_for_each(n: int) -> float:
        tracks: list[Message] = [
            replace(flown.track(20), seq=k, t_ns=flown.time_ns(k), keypoints_px=None)
            for k in range(n)
        ]
        rows = record(tmp_path / f"{n}.rrd", tracks)
        strips = [r for (e, c), r in rows.items() if c == "LineStrips3D:strips"]
        return sum(np.size(s) for found in strips for _, value in found for s in value) / n

    assert floats_for_each(4000) < 1.2 * floats_for_each(400)


def test_a_keyframe_is_logged_again_only_when_it_moves(tmp_path: Path) -> None:
    update = flown.update()
    poses = dict(update.map_from_camera)
    poses[5] = replace(poses[5], translation=poses[5].translation + 0.5)
    moved = replace(update, t_ns=update.t_ns + 1, map_from_camera=poses)
    rows = record(tmp_path / "f.rrd", [update, update, moved])
    times = {k: len(rows[f"/world/map/keyframes/{k}", "Transform3D:mat3x3"]) for k in poses}
    assert times == {k: 2 if k == 5 else 1 for k in poses}


def test_images_and_key_points_shrink_together(tmp_path: Path) -> None:
    px = np.array([[0.0, 0.0], [63.0, 47.0]], np.float32)
    track = replace(flown.track(30), keypoints_px=px)
    rows = record(tmp_path / "f.rrd", [flown.frame(30), track], ViewerConfig(image_width=32))
    ((_, blob),) = rows["/world/camera/image", "EncodedImage:blob"]
    image = cv2.imdecode(np.array(blob[0], np.uint8), cv2.IMREAD_COLOR)
    assert image is not None and image.shape == (24, 32, 3)
    found = rows["/world/camera/image/found", "Points2D:positions"][0][1]
    assert np.allclose(found, [[0.25, 0.25], [31.75, 23.75]])
    ((_, resolution),) = rows["/world/camera/image", "Pinhole:resolution"]
    assert np.allclose(resolution, [[32, 24]])


def test_states_warnings_and_timings_are_there(flight: Rows) -> None:
    levels = [v[0] for _, v in flight["/plots/state", "Scalars:scalars"]]
    assert [levels.count(v) for v in (0, 1)] == [len(flown.LOST), flown.N_INITIALISING]
    lines = [v[0] for _, v in flight["/log", "TextLog:text"]]
    assert "22:13:20 late telemetry: by 0.3 s" in lines
    texts = [line[9:] for line in lines]
    assert "late telemetry: by 0.3 s" in texts
    assert [t for t in texts if t.startswith("Tracker")] == [
        "Tracker: initialising", "Tracker: tracking", "Tracker: lost", "Tracker: tracking"
    ]  # fmt: skip
    heights = [v[0] for _, v in flight["/plots/height", "Scalars:scalars"]]
    assert heights[0] == pytest.approx(-flown.place_m(flown.N_INITIALISING)[2])


def test_a_viewer_file_stays_within_its_limit_and_keeps_the_newest(tmp_path: Path) -> None:
    random = np.random.default_rng(4)
    noise = random.integers(0, 255, (480, 640, 3)).astype(np.uint8)
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
    config = ViewerConfig(rrd_mb=12, jpeg_quality=90)
    with FileViewer(config, camera, tmp_path / "flight.rrd") as viewer:
        viewer.take(flown.update())
        for seq in range(400):
            viewer.take(replace(flown.frame(seq), rgb=noise))
            viewer.take(replace(flown.track(30), seq=seq, t_ns=flown.time_ns(seq)))
    paths = sorted(tmp_path.glob("flight*.rrd"), key=lambda path: path.stat().st_mtime)
    assert len(paths) == 4 and not (tmp_path / "flight.rrd").exists()
    assert sum(path.stat().st_size for path in paths) < 24 << 20
    streams = [RrdReader(path).stream().to_chunks() for path in paths]
    last = {str(chunk.entity_path) for chunk in streams[-1]}
    assert {"/world/map", "/world/map/keyframes/3", "/world/camera/image"} <= last


def test_kernel_times_are_plotted(tmp_path: Path) -> None:
    timed = replace(flown.depth_map(2), kernel_ms={"update": 12.5})
    rows = record(tmp_path / "f.rrd", [timed])
    assert rows["/plots/kernels/update", "Scalars:scalars"] == [(timed.t_ns, [12.5])]


def test_without_a_scale_the_camera_is_in_the_map(tmp_path: Path) -> None:
    rows = record(tmp_path / "f.rrd", [flown.update(known=False), flown.track(30)])
    _, _, translation = transform(rows, "/world/camera")
    assert np.allclose(translation, flown.map_from_camera(30).translation, atol=1e-5)
    assert ("/plots/height", "Scalars:scalars") not in rows


def test_a_fault_in_the_recording_neither_blocks_nor_hides(tmp_path: Path) -> None:
    bad = replace(flown.frame(30), rgb=np.zeros((48, 64, 2), np.uint8))
    path = tmp_path / "f.rrd"
    with pytest.raises(cv2.error), FileViewer(ViewerConfig(image_width=32), CAMERA, path) as viewer:
        viewer.take(bad)
        for seq in range(20000):  # more than there is room for
            viewer.take(flown.frame(seq))


@pytest.mark.parametrize("name", ["/dev/full", "gone/f.rrd", "\udcfc.rrd"])
def test_a_file_that_cannot_be_written_is_named(name: str, tmp_path: Path) -> None:
    with pytest.raises(OSError) as caught:
        FileViewer(ViewerConfig(), CAMERA, tmp_path / name)
    assert caught.value.filename == str(tmp_path / name)


def test_it_leaves_room_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The results come after it, and are worth more."""
    monkeypatch.setattr(rrd_files, "LEFT_FREE_BYTES", 1 << 62)
    monkeypatch.setattr(rrd_files, "LOOK_BYTES", 1 << 14)
    path = tmp_path / "f.rrd"
    with pytest.raises(OSError) as caught, FileViewer(ViewerConfig(), CAMERA, path) as viewer:
        for seq in range(100):
            viewer.take(flown.frame(seq))
    assert (caught.value.errno, caught.value.filename) == (errno.ENOSPC, str(path))
    assert RrdReader(path).stream().to_chunks()  # what there was until then can be read


def test_a_disk_that_never_answers_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Rerun's on a full disk: its thread is gone, and what it should write is waited for."""
    monkeypatch.setattr(rrd_files, "FLUSH_S", 0.05)
    monkeypatch.setattr("rerun.unregister_shutdown", lambda: None)
    answer = threading.Event()
    files = rrd_files.RrdFiles(tmp_path / "f.rrd", 0, indexed=False)
    disconnect = files.recording.disconnect
    monkeypatch.setattr(files.recording, "disconnect", answer.wait)
    with pytest.raises(OSError, match="no answer"):
        files.close()
    answer.set()
    disconnect()
