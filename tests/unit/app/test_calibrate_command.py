"""`companion calibrate`: a calibration file, or a reason without loss of an old file."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from companion.app.calibrate_command import calibrate, print_board
from companion.app.progress import Progress
from companion.errors import InputError
from companion.messages import Bytes
from drivers.camera.camera_source import EndOfPictures, Picture
from drivers.images.calibration_file import read_calibration
from tests.support.cameras.board_pictures import (
    CHARUCO,
    RADTAN,
    BoardPictures,
    Placing,
    placings,
    well_shown,
)

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def companion(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "companion", "calibrate", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def folder_of(pictures: Sequence[Bytes], path: Path) -> Path:
    path.mkdir()
    for number, grey in enumerate(pictures):
        assert cv2.imwrite(str(path / f"{number:03}.png"), grey)
    return path


def video_of(pictures: Sequence[Bytes], path: Path) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 640, 480, "yuv420p"
        stream.time_base = Fraction(1, 10)
        stream.options = {"crf": "12", "preset": "ultrafast"}
        for number, grey in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(grey, format="gray").reformat(format="yuv420p")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


class Ended(Progress):
    """Its user presses Ctrl-C after so many updates, and reads what is said until then."""

    def __init__(self, after: int) -> None:
        self._left = after
        self.said: list[str] = []

    def update(self, done: int, state: str, n_points: int) -> None:
        self.said.append(state)
        self._left -= 1
        if self._left == 0:
            raise KeyboardInterrupt


class BoardBeforeCamera:
    """A camera that shows pictures, one after the other, then nothing more."""

    name = "/dev/v4l/by-id/test"
    live = True
    start_s = silent_s = 1.0
    n_dropped = 0

    def __init__(self, pictures: Sequence[Bytes], *, goes_on: bool = False) -> None:
        self._pictures = pictures
        self._goes_on = goes_on
        self.remarks: list[str] = []
        self.n_read = 0
        self.opened = self.closed = False

    def open(self) -> None:
        self.opened = True

    def read(self, timeout_s: float) -> Picture | None:
        at, self.n_read = self.n_read, self.n_read + 1
        if at == 1:
            return None
        if at >= len(self._pictures) and not self._goes_on:
            raise EndOfPictures("at its end")
        grey = self._pictures[at % len(self._pictures)]
        return Picture(at, grey, np.repeat(grey[..., None], 3, axis=2))

    def close(self) -> None:
        self.closed = True


def test_video_becomes_a_calibration_that_is_read_back(tmp_path: Path) -> None:
    empty = BoardPictures(RADTAN).picture(None)
    frames = [frame for grey in well_shown(RADTAN, CHARUCO, 0.0) for frame in (grey, empty)]
    video = video_of(frames, tmp_path / "board.mp4")
    out = tmp_path / "cameras"
    run = companion(video, "--name", "front", "--out", out)
    assert (run.returncode, run.stderr) == (0, "")
    assert "radtan, 640 x 480" in run.stdout and "19 of 38 pictures" in run.stdout
    assert "readout not measured" in run.stdout  # of boards that stand still
    assert sorted(path.name for path in out.iterdir()) == ["front.png", "front.toml"]
    camera = read_calibration(out / "front.toml", 640, 480)
    assert camera.distortion is RADTAN.distortion
    assert camera.fx == pytest.approx(520, rel=0.003)
    assert camera.fy == pytest.approx(505, rel=0.003)
    assert (camera.cx, camera.cy) == pytest.approx((331, 228), abs=1)
    written = tomllib.loads((out / "front.toml").read_text("utf-8"))
    quality = written["quality"]
    assert 0 < quality["rms_px"] < 0.2 and 0 < quality["holdout_px"] < 0.2
    assert quality["n_views"] >= 12 and 0.6 < quality["coverage"] < 1
    assert 0 < quality["sigma_fx"] < 1 and quality["source"] == "board.mp4"
    picture = cv2.imread(str(out / "front.png"))
    assert picture is not None and picture.shape[1] > 1000


def test_refusal_is_one_line_and_keeps_what_was_there(tmp_path: Path) -> None:
    source = folder_of(well_shown(RADTAN, CHARUCO, 0.0)[:6], tmp_path / "views")
    good = tmp_path / "cameras" / "front.toml"
    good.parent.mkdir()
    good.write_text("fx = 1\n")
    run = companion(source, "--name", "front", "--out", good.parent)
    assert (run.returncode, run.stdout) == (2, "")
    (line,) = run.stderr.splitlines()
    assert line.startswith("companion: error: views: not calibrated: only 6 views")
    assert good.read_text() == "fx = 1\n"
    assert [path.name for path in good.parent.iterdir()] == ["front.toml"]


def test_board_to_print(tmp_path: Path) -> None:
    assert print_board("chessboard:9x6:0.025", tmp_path / "board.pdf") == "A4"
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    with pytest.raises(InputError, match=r"\.pdf or \.png"):
        print_board("chessboard:9x6:0.025", tmp_path / "board.svg")
    with pytest.raises(InputError, match="cannot be written"):
        print_board("chessboard:9x6:0.025", tmp_path / "none" / "board.pdf")


def changed(**values: float) -> list[Bytes]:
    pictures = BoardPictures(RADTAN)
    return pictures.pictures([replace(placing, **values) for placing in placings(9)])  # type: ignore[arg-type]


def blurred() -> list[Bytes]:
    pictures = BoardPictures(RADTAN)
    return [pictures.picture(placing, blur_px=5) for placing in placings(8)]


def far_away() -> list[Bytes]:
    pictures = BoardPictures(RADTAN, "chessboard:9x6:0.025")
    return [pictures.picture(Placing(0.1 * n, 0.5, 0.13)) for n in range(2, 9)]


@pytest.mark.parametrize(
    ("shown", "board", "said"),
    [
        (lambda: [well_shown(RADTAN, CHARUCO, 0.0)[0]] * 5, CHARUCO, "only 1 view of the board"),
        (lambda: changed(u=0.3), CHARUCO, "never in the upper right and lower right corner"),
        (lambda: changed(parallel=True), CHARUCO, "faced the camera squarely"),
        (blurred, CHARUCO, "blurred in 8 of the 8 pictures"),
        (far_away, "chessboard:9x6:0.025", "too small in"),
        (lambda: [BoardPictures(RADTAN).picture(None)] * 2, CHARUCO, "is it in view, lit"),
        (
            lambda: well_shown(RADTAN, CHARUCO, 0.0)[:3],
            "charuco:5x7:0.04:0.03:DICT_5X5_100",
            "what is to be seen is --board charuco:7x5",
        ),
    ],
)
def test_bad_views_are_refused(shown, board: str, said: str, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    source = folder_of(shown(), tmp_path / "views")
    out = tmp_path / "cameras"
    with pytest.raises(InputError) as refused:
        calibrate(source, board, "front", out, "radtan", Progress())
    assert said in str(refused.value) and "\n" not in str(refused.value)
    assert not out.exists()


@pytest.mark.parametrize(
    ("name", "board", "model", "said"),
    [
        ("../front", CHARUCO, "auto", "--name"),
        ("", CHARUCO, "auto", "--name"),
        ("front", "paper", "auto", "--board"),
        ("front", CHARUCO, "pinhole", "--model"),
        ("front", CHARUCO, "auto", "no such"),
    ],
)
def test_usage(name: str, board: str, model: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said):
        calibrate(tmp_path / "none.mp4", board, name, tmp_path / "out", model, Progress())


def test_out_that_is_a_file(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.write_text("")
    camera = BoardBeforeCamera([])
    with pytest.raises(InputError, match="is a file"):
        calibrate(camera, CHARUCO, "front", out, "radtan", Progress())
    assert not camera.opened  # nobody holds a board before a camera for nothing


def test_live_camera_until_there_are_enough_views(tmp_path: Path) -> None:
    # the end of the board's round first: what is lacking must be told, and then be there
    camera = BoardBeforeCamera(well_shown(RADTAN, CHARUCO, 0.0), goes_on=True)
    progress = Ended(60)
    report = calibrate(camera, CHARUCO, "front", tmp_path, "radtan", progress)
    assert camera.opened and camera.closed
    assert camera.n_read < 40  # it ended by itself
    assert report.calibration.camera.fx == pytest.approx(520, rel=0.004)
    assert "no picture comes" in progress.said
    assert any("corner" in said for said in progress.said)
    assert (tmp_path / "front.toml").exists()


def test_live_camera_stopped_before_there_is_enough(tmp_path: Path) -> None:
    camera = BoardBeforeCamera(well_shown(RADTAN, CHARUCO, 0.0))
    with pytest.raises(InputError, match="only 5 views"):
        calibrate(camera, CHARUCO, "front", tmp_path / "out", "radtan", Ended(6))
    assert camera.closed
    assert not (tmp_path / "out").exists()


def test_live_camera_at_its_end(tmp_path: Path) -> None:
    camera = BoardBeforeCamera(well_shown(RADTAN, CHARUCO, 0.0)[:1])
    with pytest.raises(InputError, match="only 1 view"):
        calibrate(camera, CHARUCO, "front", tmp_path / "out", "radtan", Progress())
    assert camera.closed


def test_live_camera_that_changes_its_size(tmp_path: Path) -> None:
    first, second, third, *_ = well_shown(RADTAN, CHARUCO, 0.0)
    camera = BoardBeforeCamera([first, second, third[:240]])
    with pytest.raises(InputError, match="640 x 240, those before were 640 x 480"):
        calibrate(camera, CHARUCO, "front", tmp_path / "out", "radtan", Progress())
    assert camera.closed
