"""Boards: description, detection, identification, printing."""

from __future__ import annotations

import re
import zlib

import cv2
import numpy as np
import pytest

from companion.calibration.chart import parse_chart
from companion.errors import InputError
from companion.messages import Bytes
from companion.products.board_print import board_page
from tests.support.cameras.board_pictures import CHARUCO, CHESSBOARD, RADTAN, BoardPictures, Placing


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "charuco:"),
        ("board", "charuco:"),
        ("charuco:7x5", "charuco:"),
        ("charuco:7x5:0.04:0.03:DICT_9X9_1", "DICT_5X5_100"),
        ("charuco:7x5:0.04:0.05:DICT_5X5_100", "0.95"),
        ("charuco:7x5:0.04:nan:DICT_5X5_100", "nan"),
        ("charuco:40x40:0.04:0.03:DICT_5X5_50", "800 markers"),
        ("charuco:7x5:0.04:0.03:DICT_5X5_100:old", "charuco:"),
        ("chessboard:9x6", "charuco:"),
        ("chessboard:9x6:40", "40"),
        ("chessboard:9x2:0.02", "3 to 50"),
    ],
)
def test_invalid_board_description(text: str, named: str) -> None:
    with pytest.raises(InputError, match=re.escape(named)) as refused:
        parse_chart(text)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("board", [CHARUCO, CHESSBOARD])
def test_corners_are_accurate(board: str) -> None:
    pictures = BoardPictures(RADTAN, board)
    placing = Placing(0.45, 0.55, 0.6, 20, -15, 10)
    detection = parse_chart(board).find(pictures.picture(placing))
    assert detection is not None
    chart = parse_chart(board)
    assert len(detection.ids) == chart.columns * chart.rows
    # a board half a turn round is the same chessboard; each corner must be at one of these
    margin = 0.4 * chart.square_m
    rotation, shift = pictures.pose(placing)
    true = RADTAN.project((detection.board_m + [margin, margin, 0]) @ rotation.T + shift)
    distance_px = np.minimum(
        np.linalg.norm(true - detection.image_px, axis=1),
        np.linalg.norm(true[::-1] - detection.image_px, axis=1),
    )
    assert distance_px.max() < 0.3 and distance_px.mean() < 0.1


def test_part_of_a_charuco_board_is_enough() -> None:
    picture = BoardPictures(RADTAN).picture(Placing(0.1, 0.4, 0.7))
    detection = parse_chart(CHARUCO).find(picture)
    assert detection is not None
    assert 8 <= len(detection.ids) < 24
    assert (detection.board_m[:, 0] >= 0.08).all()  # the left part is out of the picture


@pytest.mark.parametrize(
    ("shown", "given", "said"),
    [
        (CHARUCO, "charuco:7x5:0.04:0.03:DICT_4X4_50", "DICT_5X5_50"),
        (CHARUCO, "charuco:5x7:0.04:0.03:DICT_5X5_100", f"--board {CHARUCO}"),
        (CHARUCO, "charuco:6x4:0.04:0.03:DICT_5X5_100", "up to number 16"),
        (CHESSBOARD, "chessboard:8x6:0.025", "9x6"),
    ],
)
def test_another_board_is_identified(shown: str, given: str, said: str) -> None:
    picture = BoardPictures(RADTAN, shown).picture(Placing(0.5, 0.5, 0.6, 10, 10))
    chart = parse_chart(given)
    assert chart.find(picture) is None
    explained = chart.explain([picture])
    assert explained is not None and said in explained


def test_blank_images_are_not_explained() -> None:
    empty = BoardPictures(RADTAN).picture(None)
    for board in (CHARUCO, CHESSBOARD):
        assert parse_chart(board).find(empty) is None
        assert parse_chart(board).explain([empty]) is None


@pytest.mark.parametrize(
    "board",
    [CHARUCO, "charuco:5x6:0.03:0.02:DICT_APRILTAG_36H11:legacy", CHESSBOARD],
)  # fmt: skip
def test_printed_board_is_detected_and_to_scale(board: str) -> None:
    page, paper = board_page(parse_chart(board), "png")
    assert paper == "A4"
    grey = np.asarray(cv2.imdecode(np.frombuffer(page, np.uint8), cv2.IMREAD_GRAYSCALE), np.uint8)
    per_m = dots_per_m(page)
    assert sorted(round(n / per_m, 3) for n in grey.shape) == [0.21, 0.297]
    half: Bytes = np.asarray(cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    chart = parse_chart(board)
    detection = chart.find(half)
    assert detection is not None
    assert len(detection.ids) == chart.columns * chart.rows
    step = np.linalg.norm(np.diff(detection.image_px[: chart.columns], axis=0), axis=1)
    assert np.allclose(2 * step / per_m, chart.square_m, rtol=2e-3)


def test_printed_pdf_is_to_scale() -> None:
    page, paper = board_page(parse_chart("charuco:12x9:0.06:0.045:DICT_4X4_100"), "pdf")
    assert paper == "A1"
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", page)
    assert box is not None
    assert [round(float(n) / 72 * 25.4) for n in box.groups()] == [841, 594]


def dots_per_m(png: bytes) -> int:
    at = png.index(b"pHYs")
    body = png[at + 4 : at + 13]
    assert body[8] == 1  # the unit is the metre
    assert zlib.crc32(png[at : at + 13]) == int.from_bytes(png[at + 13 : at + 17], "big")
    return int.from_bytes(body[:4], "big")
