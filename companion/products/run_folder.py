"""Reads a finished run back from its folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from companion.errors import InputError
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Pose, rotation_from_quaternion
from companion.products.cloud import Cloud
from companion.products.cloud_ply import KINDS, VERTEX
from companion.products.flight_result import WorldPose

MAX_HEAD = 4096
PROPERTIES = [f"property {KINDS[VERTEX[name].kind]} {name}" for name in VERTEX.names or ()]


@dataclass(frozen=True, slots=True, eq=False)
class FinishedRun:
    """Results of a run: its poses and cloud in the world, and its report's numbers.

    The world is local NED in metres if `metric`, else the map's own axes and units. `origin` is the
    geodetic origin of NED, None where unknown.
    """

    path: Path
    poses: list[WorldPose]
    cloud: Cloud
    report: Mapping[str, Any]
    metric: bool
    origin: GeoOrigin | None


def read_run(folder: Path) -> FinishedRun:
    """Read the folder of a run; InputError where it is none, or incomplete."""
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder; wanted is the --out of a replay")
    report = _report(folder / "report.json")
    metric = report.get("unit") == "m"
    return FinishedRun(
        folder, _poses(folder / "trajectory.tum"), _cloud(folder / "cloud.ply"), report, metric,
        _origin(folder / "report.json", report) if metric else None,
    )  # fmt: skip


def read_path(folder: Path) -> tuple[list[WorldPose], GeoOrigin | None, Mapping[str, Any]]:
    """Camera poses of a run, the origin of their local NED, and what its report says of the scale.

    The origin is None where they are not on the globe. InputError where it is no run, or
    incomplete.
    """
    report = _report(folder / "report.json")
    origin = _origin(folder / "report.json", report) if report.get("unit") == "m" else None
    scale = report.get("scale")
    return (
        _poses(folder / "trajectory.tum"), origin, scale if isinstance(scale, dict) else {},
    )  # fmt: skip


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path}: missing; wanted is the folder of a finished run") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def _report(path: Path) -> dict[str, Any]:
    try:
        report = json.loads(_bytes(path))
    except ValueError as error:
        raise InputError(f"{path}: cannot be read as JSON: {error}") from error
    if not isinstance(report, dict):
        raise InputError(f"{path}: it is no report of a run")
    return report


def _origin(path: Path, report: Mapping[str, Any]) -> GeoOrigin | None:
    said = report.get("origin")
    if said is None:
        return None
    try:
        origin = GeoOrigin(
            *(float(said[key]) for key in ("latitude_deg", "longitude_deg", "altitude_m"))
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: its origin is no place: {said!r}") from error
    if not (abs(origin.latitude_deg) <= 90 and abs(origin.longitude_deg) <= 180):
        raise InputError(f"{path}: its origin is no place: {said!r}")
    return origin


def _poses(path: Path) -> list[WorldPose]:
    out: list[WorldPose] = []
    for number, line in enumerate(_bytes(path).decode("ascii", "replace").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            seconds, _, rest = words[0].partition(".")
            t_ns = int(seconds) * 1_000_000_000 + int(rest.ljust(9, "0"))
            values = np.array([float(word) for word in words[1:8]])
        except ValueError:
            values = np.empty(0)
        if len(values) != 7 or not np.isfinite(values).all() or not values[3:].any():
            raise InputError(f"{path}, line {number}: wanted a time and seven numbers")
        turn = values[[6, 3, 4, 5]]
        out.append(WorldPose(len(out), t_ns, Pose(rotation_from_quaternion(turn), values[:3])))
    return out


def _cloud(path: Path) -> Cloud:
    data = _bytes(path)
    end = data[:MAX_HEAD].find(b"end_header\n")
    lines = data[: max(end, 0)].decode("ascii", "replace").splitlines()
    counts = [line.split()[-1] for line in lines if line.startswith("element vertex ")]
    if [line for line in lines if line.startswith("property")] != PROPERTIES or len(counts) != 1:
        raise InputError(f"{path}: not a cloud as a run writes it")
    body = data[end + len(b"end_header\n") :]
    if not counts[0].isdigit() or len(body) != int(counts[0]) * VERTEX.itemsize:
        raise InputError(f"{path}: cut short, or longer than it says: {counts[0]} points")
    vertices = np.frombuffer(body, VERTEX)
    points = np.stack([vertices[axis] for axis in "xyz"], 1)
    rgb = np.stack([vertices[channel] for channel in ("red", "green", "blue")], 1)
    normals = np.stack([vertices[axis] for axis in ("nx", "ny", "nz")], 1)
    return Cloud(points, rgb, vertices["confidence"].copy(), normals, vertices["sigma"].copy())
