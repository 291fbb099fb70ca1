"""A film of a known flight, its frames read back."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from companion.errors import InputError
from companion.geometry.camera import Camera
from companion.messages import Bytes
from companion.products.film.first_seen import first_seen_ns
from companion.products.film.flight_film import FilmSize, film_frames
from companion.products.film.scene_drawing import Viewpoint, draw_points
from companion.products.flight_result import FlightResult
from companion.products.run_folder import FinishedRun
from drivers.images.film_file import write_film
from tests.support.flights import flown

SIZE = FilmSize(320, 180, 10, 4.0)
CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


@pytest.fixture(scope="module")
def run() -> FinishedRun:
    result = FlightResult()
    for message in flown.messages():
        result.take(message)
    said = {
        "width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5,
        "distortion": "none", "coefficients": [],
    }  # fmt: skip
    return FinishedRun(Path("run"), result.poses(), result.cloud(0.5), {"camera": said}, True, None)


def pictures() -> Iterator[tuple[int, Bytes]]:
    """Each frame of a grey of its own, brighter and brighter."""
    for seq in range(flown.N_FRAMES):
        yield flown.time_ns(seq), np.full((48, 64, 3), seq, np.uint8)


def test_points_come_when_the_camera_has_them_before_it(run: FinishedRun) -> None:
    seen_ns = first_seen_ns(run.cloud, run.poses, CAMERA)
    assert np.isfinite(seen_ns).mean() > 0.5
    first = run.poses[0]
    at_once = seen_ns == first.t_ns
    points = run.cloud.points.astype(np.float64)
    pixels = CAMERA.project(first.world_from_camera.inverse().apply(points[at_once]))
    assert ((pixels >= 0) & (pixels <= [64, 48])).all()
    never = np.isinf(seen_ns)
    for pose in run.poses[::10]:
        seen = CAMERA.project(pose.world_from_camera.inverse().apply(points[never]))
        inside = ((seen >= 0) & (seen < [63, 47])).all(1)
        facing = pose.world_from_camera.translation - points[never]
        assert not (inside & ((facing * run.cloud.normals[never]).sum(1) > 4)).any()


def test_the_nearest_point_hides_the_others() -> None:
    view = Viewpoint(np.zeros(3), 10.0, 0.0, 0.0)  # looks north, from 10 m south
    points = np.array([[0.0, 0, 0], [-5, 0, 0], [5, 0, 0], [0, 2, 0]])
    rgb = np.array([[0, 255, 0], [255, 0, 0], [0, 0, 255], [0, 255, 0]], np.uint8)
    picture = draw_points(view, points, rgb, 0.05, 101, 101)
    assert picture[50, 50].tolist() == [255, 0, 0]
    east = round(50 + 1.2 * 101 * 2 / 10)
    assert picture[50, east].tolist() == [0, 255, 0]
    assert picture[10, 10].max() < 40  # the background
    assert (draw_points(view, points[:0], rgb[:0], 0.05, 101, 101).max(-1) < 40).all()


def test_film_grows(run: FinishedRun) -> None:
    frames = list(film_frames(run, pictures(), SIZE))
    assert len(frames) == 40
    assert frames[0].shape == (180, 320, 3)
    coloured = [(np.ptp(frame[20:, :200].astype(int), axis=2) > 25).mean() for frame in frames]
    assert coloured[-1] > 1.5 * coloured[2] > 0
    inset = [int(frame[40, 290, 0]) for frame in frames]
    assert inset == sorted(inset)
    assert inset[0] < 15 < 220 < inset[-1]
    # the same bytes each time
    assert (list(film_frames(run, pictures(), SIZE))[20] == frames[20]).all()


@pytest.mark.parametrize("kind", ["mp4", "webp"])
def test_files_read_back(run: FinishedRun, tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"film.{kind}"
    frames = list(film_frames(run, pictures(), SIZE))
    assert write_film(path, frames, 10) == 40
    if kind == "mp4":
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            assert stream.codec_context.name == "h264"
            assert stream.average_rate == Fraction(10)
            back = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    else:
        with Image.open(path) as image:
            assert image.info["loop"] == 0
            back = []
            for n in range(image.n_frames):  # type: ignore[attr-defined]
                image.seek(n)
                back.append(np.asarray(image.convert("RGB")))
    assert len(back) == 40
    assert np.abs(back[30].astype(int) - frames[30]).mean() < 6
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_what_cannot_be_filmed_is_said(run: FinishedRun, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"FILE\.mp4 or FILE\.webp"):
        write_film(tmp_path / "film.avi", [], 10)
    empty = FinishedRun(Path("run"), [], run.cloud, run.report, True, None)
    with pytest.raises(InputError, match="no path or no cloud"):
        next(film_frames(empty, iter(()), SIZE))
    with pytest.raises(InputError, match="cannot be written"):
        write_film(tmp_path / "no" / "film.mp4", [np.zeros((16, 16, 3), np.uint8)], 10)
