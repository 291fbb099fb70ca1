"""Camera path as a TUM file."""

from __future__ import annotations

from collections.abc import Sequence

from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import quaternion_from_rotation
from companion.products.flight_result import WorldPose


def trajectory_tum(poses: Sequence[WorldPose], unit: str, origin: GeoOrigin | None) -> bytes:
    """Lines `unix_s x y z qx qy qz qw`, `world_from_camera`, seconds exact to the nanosecond."""
    lines = [
        "# unix_s x y z qx qy qz qw",
        "# pose of the camera (right, down, forward) in the world, world_from_camera",
        *("# " + line for line in frame_lines(unit, origin)),
    ]
    for _, t_ns, pose in poses:
        w, x, y, z = quaternion_from_rotation(pose.rotation)
        place = " ".join(f"{v + 0.0:.6f}" for v in pose.translation)
        turn = " ".join(f"{v + 0.0:.9f}" for v in (x, y, z, w))
        lines.append(f"{exact_seconds(t_ns)} {place} {turn}")
    return ("\n".join(lines) + "\n").encode("ascii")


def frame_lines(unit: str, origin: GeoOrigin | None) -> list[str]:
    """Description of the world frame, in ASCII, for file headers."""
    if unit == "m":
        lines = ["world: local NED (x north, y east, z down), metres"]
    else:
        lines = ["world: the map's own axes and units; no metric scale was found"]
    if origin is not None and unit == "m":
        lines.append(
            f"origin: latitude {origin.latitude_deg:.8f} deg, longitude "
            f"{origin.longitude_deg:.8f} deg, altitude {origin.altitude_m:.3f} m above sea level"
        )
    return lines


def exact_seconds(t_ns: int) -> str:
    """Seconds with nine decimals, without a float that would lose them.

    >>> exact_seconds(1_700_000_000_123_456_789)
    '1700000000.123456789'
    """
    sign, ns = ("-", -t_ns) if t_ns < 0 else ("", t_ns)
    return f"{sign}{ns // 1_000_000_000}.{ns % 1_000_000_000:09d}"
