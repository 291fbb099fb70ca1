"""The scene that a simulated vehicle's camera sees."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.config import MountConfig
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, quaternion_from_euler, rotation_from_quaternion
from companion.messages import Bytes
from drivers.camera.live_calibration import body_from_camera
from tests.firmware import scene
from tests.firmware.boxes import BOX_MAX_M, FREE_M, boxes_of
from tests.firmware.camera_faults import Faults, Order, parse
from tests.firmware.ground_texture import grain_texture, ground_texture
from tests.firmware.landmarks import BOARD_M, FAMILY, MARKER_ID, landmarks_of
from tests.firmware.scene import GROUND_M, SUN_UP, Scene

CAMERA = Camera(320, 240, 210.0, 205.0, 150.5, 126.5)
"""Its optical axis is not in the middle, nor are its pixels square."""

Make = Callable[[str], Scene]


@pytest.fixture(scope="module")
def make() -> Make:
    """Scenes of one seed, whose textures are made once."""
    moderngl = pytest.importorskip("moderngl")
    try:
        moderngl.create_context(standalone=True, backend="egl").release()
    except Exception as error:  # of no kind in particular
        pytest.skip(f"OpenGL draws nothing here: {error}")
    ground, grain = functools.cache(ground_texture), functools.cache(grain_texture)
    patch = pytest.MonkeyPatch()
    patch.setattr(scene, "ground_texture", ground)
    patch.setattr(scene, "grain_texture", grain)
    made = functools.cache(lambda look: Scene(3, look, CAMERA))
    return made


def seen_from(
    north: float, east: float, height: float, yaw_deg: float = 0.0, pitch_deg: float = -45.0
) -> Pose:
    """World from camera of a vehicle that leans somewhat."""
    lean = quaternion_from_euler(np.radians(4.0), np.radians(-3.0), np.radians(yaw_deg))
    body = Pose(rotation_from_quaternion(lean), np.array([north, east, -height]))
    return body @ body_from_camera(MountConfig(known=True, pitch_deg=pitch_deg))


def grey(picture: Bytes) -> Bytes:
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)


def test_boxes_leave_the_middle_and_the_sky_free() -> None:
    for seed in range(20):
        boxes = boxes_of(seed)
        assert len(boxes) == 10
        for box in boxes:
            nearest = np.abs([box.north, box.east]) - [box.half_north, box.half_east]
            assert nearest.max() >= FREE_M
            assert box.height <= BOX_MAX_M


def test_a_marker_lies_where_the_camera_projects_it(make: Make) -> None:
    make("day")  # so that it is skipped where that cannot be
    scene = Scene(3, "day", CAMERA, landmarks=landmarks_of("marker:1.5:1.0,wall:16"))
    pose = seen_from(0.5, 0.5, 3.0, yaw_deg=20.0, pitch_deg=-75.0)
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILY)
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(
        grey(scene.draw(pose, 0.0))
    )
    assert np.ravel(numbers).tolist() == [MARKER_ID]
    middle = CAMERA.project(pose.inverse().apply(np.array([1.5, 1.0, -BOARD_M])))
    assert np.linalg.norm(corners[0][0].mean(axis=0) - middle) < 1.0
    assert scene.boxes[-1].north - scene.boxes[-1].half_north == 16.0


def test_a_box_is_where_the_camera_projects_it(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    make("day")  # so that it is skipped where that cannot be
    (box, *_) = boxes_of(3)
    pictures = []
    pose = seen_from(box.north - 7.0, box.east - 2.0, 9.0, yaw_deg=10.0)
    for boxes in ([box], []):
        monkeypatch.setattr(scene, "boxes_of", lambda _, boxes=boxes: boxes)
        pictures.append(Scene(3, "day", CAMERA).seen(pose, 0.0))
    found = (pictures[0] != pictures[1]).any(-1)
    corners = np.concatenate([np.c_[box.corners(), np.full(4, down)] for down in (0, -box.height)])
    pixels = CAMERA.project(pose.inverse().apply(corners))
    assert (pixels > 5).all() and (pixels < [CAMERA.width - 5, CAMERA.height - 5]).all()
    wanted = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    cv2.fillConvexPoly(wanted, cv2.convexHull(np.round(pixels).astype(np.int32)), (1,))
    assert wanted.sum() > 3000
    assert (found & (wanted == 1)).sum() > 0.97 * (found | (wanted == 1)).sum()


def test_two_views_of_the_ground_are_a_homography_apart(make: Make) -> None:
    day = make("day")
    one, other = seen_from(0.0, 0.0, 3.0), seen_from(0.15, -0.1, 3.1, yaw_deg=5.0)
    marks = np.array([(60.0, 80.0), (260.0, 90.0), (250.0, 220.0), (50.0, 210.0)])
    rays = np.c_[CAMERA.normalise(marks), np.ones(4)] @ one.rotation.T
    on_ground = one.translation - rays * (one.translation[2] / rays[:, 2])[:, None]
    there = CAMERA.project(other.inverse().apply(on_ground))
    matrix = cv2.getPerspectiveTransform(there.astype(np.float32), marks.astype(np.float32))
    size = CAMERA.width, CAMERA.height
    a, b = (grey(day.seen(each, 0.0)).astype(np.float32) for each in (one, other))
    back = np.asarray(cv2.warpPerspective(b, matrix, size, borderValue=(-1,)))
    for row, column in ((60, 90), (60, 190), (140, 90), (140, 190)):
        window = np.s_[row : row + 60, column : column + 60]
        assert (back[window] >= 0).all()
        (right, down), alike = cv2.phaseCorrelate(a[window], back[window])
        assert np.hypot(right, down) < 0.15
        assert alike > 0.9


@pytest.mark.parametrize("height", [0.1, 0.3, 1.0, 5.0, 15.0])
def test_the_ground_has_detail_from_any_height(make: Make, height: float) -> None:
    picture = grey(make("day").seen(seen_from(0.3, -0.2, height, pitch_deg=-90.0), 0.0))
    corners = cv2.goodFeaturesToTrack(picture, 500, 0.02, 5)
    assert picture.std() > 10
    assert corners is not None and len(corners) > 200


def test_waves_move_and_ground_does_not(make: Make) -> None:
    pose = seen_from(0.0, 0.0, 2.0)
    for look, moves in (("day", False), ("water", True)):
        first, later = (make(look).seen(pose, t_s).astype(int) for t_s in (1.0, 2.0))
        assert (np.abs(first - later).mean() > 2.0) == moves, look


def test_a_shadow_lies_away_from_the_sun_and_follows(make: Make) -> None:
    for north in (0.0, 2.0):
        pose = seen_from(north, 1.0, 1.5)
        lit, dark = (
            make(look).seen(pose, 0.0).astype(float).mean(-1) for look in ("day", "shadow")
        )
        rows, columns = np.nonzero(dark < 0.75 * lit)
        away = np.array([north + 1.5 / np.tan(SUN_UP), 1.0, 0.0])
        u, v = CAMERA.project(pose.inverse().apply(away))
        assert np.hypot(np.median(columns) - u, np.median(rows) - v) < 3.0


def test_noise_differs_from_picture_to_picture(make: Make) -> None:
    pose = seen_from(0.0, 0.0, 2.0)
    clean = make("day").seen(pose, 0.0).astype(int)
    first, second = (make("day").draw(pose, 0.0) - clean for _ in range(2))
    assert 1.5 < first.std() < 2.5
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.02


def test_a_long_exposure_blurs_along_the_motion(make: Make) -> None:
    dusk = make("dusk")
    for k in range(2):  # to the east: along rows, a pixel and a half in 20 ms
        last = dusk.draw(seen_from(0.0, 0.05 * k, 3.0, pitch_deg=-90.0), 0.05 * k)
    still = dusk.seen(seen_from(0.0, 0.05, 3.0, pitch_deg=-90.0), 0.05)
    smooth = [cv2.GaussianBlur(grey(each), (0, 0), 1.0).astype(float) for each in (last, still)]
    kept = [np.diff(smooth[0], axis=a).std() / np.diff(smooth[1], axis=a).std() for a in (0, 1)]
    assert kept[1] < kept[0]


def test_the_ground_is_seamless() -> None:
    for texture in (ground_texture(3).mean(-1), grain_texture(3).astype(float)):
        inside = np.abs(np.diff(texture, axis=0)).mean()
        seam = np.abs(texture[0] - texture[-1]).mean()
        assert seam < 1.3 * inside
    assert GROUND_M >= 2 * 34.0


def test_photographs_become_the_ground(tmp_path: Path) -> None:
    red, blue = (np.full((300, 400, 3), colour, np.uint8) for colour in ((0, 0, 200), (200, 0, 0)))
    for name, photo in (("a.jpg", red), ("b.png", blue)):
        cv2.imwrite(str(tmp_path / name), photo)
    ground = ground_texture(1, tmp_path)
    # each as bright as the other, and each on about half
    assert 0.4 < (ground[..., 0] > ground[..., 2]).mean() < 0.6
    with pytest.raises(FileNotFoundError):
        ground_texture(1, tmp_path / "none")


@pytest.mark.parametrize(
    ("line", "order"),
    [
        ("freeze 3", Order("freeze", 3.0)),
        ("sun 0.5\n", Order("sun", 0.5)),
        ("drop 0.25 10", Order("drop", 10.0, 0.25)),
        ("latency 200 4", Order("latency", 4.0, 200.0)),
    ],
)
def test_a_line_orders_a_fault(line: str, order: Order) -> None:
    assert parse(line) == order


@pytest.mark.parametrize(
    "line", ["", "melt 3", "freeze", "freeze soon", "freeze -1", "freeze nan", "drop 0.5",
             "drop 2 5", "latency 1 2 3"],
)  # fmt: skip
def test_other_lines_order_nothing(line: str) -> None:
    with pytest.raises(ValueError, match=r"wanted|is no fault|cannot last"):
        parse(line)


def test_several_faults_hold_each_for_its_time() -> None:
    faults = Faults()
    faults.take(parse("drop 0.5 2"), 100.0)
    faults.take(parse("sun 5"), 101.0)
    assert faults.value("drop", 101.9, 0.0) == 0.5
    assert faults.value("drop", 102.0, 0.0) == 0.0
    assert faults.holds("sun", 105.9) and not faults.holds("sun", 106.0)
    assert not faults.holds("gone", 101.5)


def test_pictures_of_a_blinded_camera() -> None:
    rng = np.random.default_rng(1)
    picture = rng.integers(40, 200, (60, 80, 3)).astype(np.uint8)
    seen = {}
    for fault in ("black", "sun", "exposure", "freeze"):
        faults = Faults()
        faults.take(Order(fault, 5.0), 10.0)
        seen[fault] = [faults.seen(picture, t_s) for t_s in (10.2, 10.7)]
    assert max(each.max() for each in seen["black"]) < 20
    assert min(each.mean() for each in seen["sun"]) > 235
    assert np.array_equal(seen["exposure"][0], picture)
    assert np.allclose(seen["exposure"][1], picture / 2, atol=1)
    assert np.array_equal(seen["freeze"][0], picture)
