"""A calibration as TOML, for `camera.calibration` of a live run."""

from __future__ import annotations

from collections.abc import Mapping

from companion.calibration.board_readout import BoardReadout
from companion.calibration.lens_calibration import Calibration
from companion.config_file import toml_value
from companion.geometry.camera import COEFFICIENTS


def calibration_toml(
    calibration: Calibration, readout: BoardReadout | None, name: str, board: str, source: str
) -> bytes:
    """The file: lens parameters, readout where it is known, and quality under [quality]."""
    camera = calibration.camera
    lens: dict[str, object] = {
        "name": name,
        "width": camera.width, "height": camera.height,
        "fx": round(camera.fx, 4), "fy": round(camera.fy, 4),
        "cx": round(camera.cx, 4), "cy": round(camera.cy, 4),
        "distortion_model": camera.distortion.value,
    }  # fmt: skip
    keys = COEFFICIENTS[camera.distortion]
    for key, value in zip(keys, camera.coefficients, strict=True):
        lens[key] = round(value, 8)
    if readout is not None and readout.readout_ms is not None:
        lens["readout_ms"] = round(readout.readout_ms, 2)
    sigmas = zip(("fx", "fy", "cx", "cy"), calibration.sigmas[:4], strict=True)
    quality: dict[str, object] = {
        "rms_px": round(calibration.rms_px, 4),
        "holdout_px": round(calibration.holdout_px, 4),
        "n_views": len(calibration.views),
        "n_views_rejected": len(calibration.rejected),
        "n_corners": sum(view.n_corners for view in calibration.views),
        "n_corners_rejected": calibration.n_corners_rejected,
        "coverage": round(calibration.coverage.share, 3),
        **{f"sigma_{key}": round(float(sigma), 4) for key, sigma in sigmas},
        **({} if readout is None else {"sigma_readout_ms": round(readout.sigma_ms, 3)}),
        "board_sag_mm": round(calibration.sag_m * 1000, 2),
        "board": board,
        "source": source,
    }
    text = (
        "# Lens of a camera, written by `companion calibrate`; pixel centres are at integers.\n"
        f"{_lines(lens)}\n"
        "# Errors and standard deviations in pixels; holdout_px is in views left out of the fit,\n"
        "# coverage the share of the picture in which the board was, board_sag_mm how far from\n"
        "# flat it is, which was allowed for.\n"
        f"[quality]\n{_lines(quality)}"
    )
    return text.encode("utf-8")


def _lines(values: Mapping[str, object]) -> str:
    return "".join(f"{key} = {toml_value(value)}\n" for key, value in values.items())
