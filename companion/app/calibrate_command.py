"""`companion calibrate`: a camera's calibration file from views of a calibration board.

A calibration that is not fit for flight is refused with the reason, and nothing is written.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from companion.app.progress import Progress
from companion.calibration.board_readout import (
    BoardReadout,
    TimedView,
    fastest_moved,
)
from companion.calibration.board_views import Coverage, View, choose
from companion.calibration.calibration_verdict import advice, faults, too_few_views
from companion.calibration.chart import parse_chart
from companion.calibration.gathered_views import GatheredViews
from companion.calibration.lens_calibration import MODELS, Calibration, calibrate_lens
from companion.calibration.rolling_calibration import calibrate_rolling
from companion.errors import InputError
from companion.messages import Bytes
from companion.products.atomic_file import write_atomically
from companion.products.board_print import board_page
from companion.products.calibration_picture import calibration_png
from companion.products.calibration_toml import calibration_toml
from drivers.camera.camera_source import CameraSource, EndOfPictures
from drivers.images.frame_source import FrameSource, Video, find_frames

MAX_SEARCHED = 400
"""Images of a recording that are searched for the board, the sharpest of each interval."""
MAX_VIEWS = 40
"""Views for the lens fit; more make it slower and hardly better."""
MAX_MOVED = 60
"""Images about which the readout is measured, besides those of the lens fit."""
MAX_LIVE_VIEWS = 80
LEAST_FITTED, LIVE_FIT_EVERY = 8, 5
"""Views of a live camera before the first lens fit, and between two fits."""
READ_S = 0.25
"""Longest read of a live camera, so that Ctrl-C is noticed."""
SHOWN_ACROSS, SHOWN_DOWN = 16, 12
"""Cells of the coverage that is shown."""
MIN_FOUND = 0.05
"""Least share of images with the board; below it other boards are tried."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationReport:
    """Result of a calibration, and where it was written."""

    name: str
    calibration: Calibration
    readout: BoardReadout | None
    """None where no images with known times show the board in motion."""
    n_pictures: int
    """Images searched for the board."""
    n_found: int
    n_blurred: int
    toml: Path
    picture: Path

    def __str__(self) -> str:
        """Text for the terminal."""
        made = self.calibration
        fx, fy, cx, cy = (
            f"{key} {value:.2f} ± {sigma:.2f}"
            for key, value, sigma in zip(
                ("fx", "fy", "cx", "cy"), made.lens.parameters, made.sigmas, strict=False
            )
        )
        left_out = f", {len(made.rejected)} left out" if made.rejected else ""
        return (
            f"{self.name}: {made.camera.distortion.value}, "
            f"{made.camera.width} x {made.camera.height}\n"
            f"  {fx}, {fy}, {cx}, {cy} px\n"
            f"  error {made.rms_px:.3f} px, in views held out {made.holdout_px:.3f} px\n"
            f"  {len(made.views)} views{left_out}; the board was found in {self.n_found} of "
            f"{self.n_pictures} pictures, {self.n_blurred} of them blurred; "
            f"{made.coverage.share:.0%} of the picture covered\n"
            f"  the board is flat to {made.sag_m * 1000:.1f} mm\n"
            f"  {_shutter(self.readout)}\n"
            f"calibration: {self.toml}\n"
            f"picture: {self.picture}"
        )


def calibrate(
    source: Path | CameraSource, board: str, name: str, out: Path, model: str, progress: Progress
) -> CalibrationReport:
    """Calibrate from a video, a folder of images, or a live camera, into `out`.

    InputError without a board, or when the result is not fit for use; then no file is touched. A
    KeyboardInterrupt raised by `progress` ends the views of a live camera; those taken must
    suffice.
    """
    chart = parse_chart(board)
    if model not in ("auto", *MODELS):
        raise InputError(f"--model {model}: wanted auto, {' or '.join(MODELS)}")
    if not name or name != Path(name).name or name.startswith("."):
        raise InputError(f"--name {name}: wanted a name for a file, without folders")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; --out wants a folder")
    gathered, called = GatheredViews(chart), source.name
    frames: FrameSource | None = None
    if isinstance(source, Path):
        frames = _frames(source)
        _search(frames, gathered, progress)
    else:
        _watch(source, gathered, model, progress)
    views = _distinct_views(gathered, called)
    if isinstance(frames, Video):
        _see_motion(frames, views, gathered, progress)
    calibration, readout = _judged(views, gathered, called, model)
    try:
        out.mkdir(parents=True, exist_ok=True)
        toml, picture = out / f"{name}.toml", out / f"{name}.png"
        drawn = calibration_png(calibration, name, board)
        write_atomically(toml, calibration_toml(calibration, readout, name, board, called))
        write_atomically(picture, drawn)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror or error}") from error
    return CalibrationReport(
        name,
        calibration,
        readout,
        gathered.n_searched,
        gathered.n_found,
        gathered.n_blurred,
        toml,
        picture,
    )


def print_board(board: str, path: Path) -> str:
    """Write the board as a page to print, .pdf or .png; return the paper size."""
    form = path.suffix.lower().lstrip(".")
    if form not in ("pdf", "png"):
        raise InputError(f"--print-board {path}: wanted a name that ends in .pdf or .png")
    page, paper = board_page(parse_chart(board), form)
    try:
        write_atomically(path, page)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    return paper


def _frames(source: Path) -> FrameSource:
    if not source.exists():
        raise InputError(f"{source}: there is no such file or folder")
    return find_frames(source) if source.is_dir() else Video(source)


def _search(frames: FrameSource, gathered: GatheredViews, progress: Progress) -> None:
    """Views of a recording."""
    progress.start(frames.n_frames)
    try:
        interval = math.ceil(frames.n_frames / MAX_SEARCHED)
        for number, grey, done in _sharpest(frames, interval):
            gathered.look(number, grey, only_new=False)
            progress.update(done, "looking for the board", len(gathered.views))
    finally:
        progress.finish()
    if not gathered.n_searched:
        raise InputError(f"{frames.path}: none of its {frames.n_frames} pictures can be decoded")


def _see_motion(
    video: Video, views: Sequence[View], gathered: GatheredViews, progress: Progress
) -> None:
    """Gather timed views, which a video's first search has left out in between."""
    wanted = sorted(_timed_numbers(views, gathered))
    if not wanted:
        return
    times_ns = video.own_times_ns()
    progress.start(len(wanted))
    try:
        for number, rgb in video.pictures(wanted[0], min(wanted[-1], video.n_frames - 1)):
            if rgb is None or number not in wanted:
                continue
            grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
            detection = gathered.chart.find(grey)
            if detection is not None:
                view = View(number, detection, *gathered.size)
                gathered.timed.append(TimedView(times_ns[number], view))
            progress.update(wanted.index(number) + 1, "measuring the readout", len(gathered.timed))
    finally:
        progress.finish()


def _timed_numbers(views: Sequence[View], gathered: GatheredViews) -> set[int]:
    """Images that measure the readout: of the lens fit, of quick motion, and those beside them."""
    numbers = [view.number for view in views] + fastest_moved(gathered.middles_px, MAX_MOVED)
    return {number + k for number in numbers for k in (-1, 0, 1) if number + k >= 0}


def _shutter(readout: BoardReadout | None) -> str:
    if readout is None:
        return "readout not measured: for a rolling shutter, film the board in quick motion, too"
    measured = f"{readout.measured_ms:.2f} ± {readout.sigma_ms:.2f} ms"
    if readout.is_upward:
        return f"readout {measured}: the bottom row is read first, which cannot be undone"
    if readout.readout_ms is None:
        return f"readout {measured}, too uncertain to be used: film the board in quick motion, too"
    shutter = "rolling" if readout.readout_ms else "global"
    return f"{shutter} shutter: {measured} from the top row to the bottom row"


def _sharpest(frames: FrameSource, interval: int) -> Iterator[tuple[int, Bytes, int]]:
    """Number and grey image of the sharpest of each interval, and how many are decoded so far."""
    best: tuple[float, int, Bytes] | None = None
    for number, rgb in frames.pictures(0, frames.n_frames - 1):
        if rgb is not None:
            grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
            sharpness = float(cv2.Laplacian(grey, cv2.CV_16S).std()) if interval > 1 else 0.0
            if best is None or sharpness > best[0]:
                best = sharpness, number, grey
        if best is not None and ((number + 1) % interval == 0 or number + 1 == frames.n_frames):
            yield best[1], best[2], number + 1
            best = None


def _watch(source: CameraSource, gathered: GatheredViews, model: str, progress: Progress) -> None:
    """Views of a live camera, until there are enough or the user stops."""
    progress.start(0)
    try:
        source.open()
        made: Calibration | None = None
        n_fitted = number = 0
        while len(gathered.views) < MAX_LIVE_VIEWS:
            picture = source.read(READ_S)
            if picture is None:
                progress.update(number, "no picture comes", len(gathered.views))
                continue
            problem = gathered.look(number, picture.grey, only_new=True, t_ns=picture.monotonic_ns)
            number += 1
            covered = gathered.covered()
            wanted = advice(gathered.views, covered, made)
            n_new = len(gathered.views) - n_fitted
            if n_new >= (LIVE_FIT_EVERY if wanted else 1) and len(gathered.views) >= LEAST_FITTED:
                n_fitted = len(gathered.views)
                made = calibrate_lens(choose(gathered.views, MAX_VIEWS), covered.lit, model)
                wanted = advice(gathered.views, covered, made)
            # what to do is said where the board is seen well, else why it is not
            seen_well = problem in ("", "move the board")
            progress.show(**_facts(covered))
            progress.update(number, wanted if seen_well else problem, len(gathered.views))
            if not wanted:
                break
    except (KeyboardInterrupt, EndOfPictures):
        pass  # the views so far must suffice; if they do not, the reason is given
    finally:
        source.close()
        progress.finish()
    if not gathered.n_searched:
        raise InputError(f"{source.name}: no picture came")


def _facts(covered: Coverage) -> dict[str, object]:
    """Coverage of the picture: its share, and rows of it, "#" where the board was."""
    down, across = covered.seen.shape
    rows = np.linspace(0, down, SHOWN_DOWN + 1).astype(int)
    columns = np.linspace(0, across, SHOWN_ACROSS + 1).astype(int)
    cells = [
        "".join(
            "#" if covered.seen[a:b, c:d].mean() > 0.5 else "."
            for c, d in itertools.pairwise(columns)
        )
        for a, b in itertools.pairwise(rows)
    ]
    return {"share": round(covered.share, 3), "covered": cells}


def _distinct_views(gathered: GatheredViews, called: str) -> list[View]:
    """Views for the lens fit; InputError where the board was not seen well."""
    refused = f"{called}: not calibrated: "
    n, found = gathered.n_searched, gathered.n_found
    if found < MIN_FOUND * n:  # perhaps by chance, on a board that is another one
        instead = gathered.chart.explain(gathered.unfound)
        raise InputError(
            f"{refused}--board {gathered.chart.name} was found in {found or 'none'} of {n} "
            "pictures"
            + (f"; {instead}" if instead else ": is it in view, lit, and the board that was given?")
        )
    views = choose(gathered.views, MAX_VIEWS)
    if gathered.n_blurred > found / 2 and too_few_views(len(views)):
        raise InputError(
            f"{refused}the board is blurred in {gathered.n_blurred} of the {found} pictures that "
            "show it: hold it still, give it more light, or focus the lens"
        )
    if gathered.n_small > found / 2 and too_few_views(len(views)):
        raise InputError(
            f"{refused}the board is too small in {gathered.n_small} of the {found} pictures that "
            "show it: bring it nearer"
        )
    return views


def _judged(
    views: Sequence[View], gathered: GatheredViews, called: str, model: str
) -> tuple[Calibration, BoardReadout | None]:
    """The calibration, if it is fit for use, and the readout, if it could be measured."""
    lit = gathered.lit.mask(*gathered.size)
    calibration = calibrate_lens(views, lit, model)
    readout: BoardReadout | None = None
    if calibration is not None:
        numbers = _timed_numbers(views, gathered)
        timed = [each for each in gathered.timed if each.view.number in numbers]
        calibration, readout = calibrate_rolling(views, timed, lit, model, calibration)
    if calibration is None:
        reasons = too_few_views(len(views)) or [
            f"no lens explains the {len(views)} views: is the board flat, and the one given?"
        ]
    else:
        reasons = faults(calibration)
    if reasons or calibration is None:
        raise InputError(f"{called}: not calibrated: " + "; ".join(reasons))
    return calibration, readout
