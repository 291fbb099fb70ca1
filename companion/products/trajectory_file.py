"""Camera path, and poses as given out, as TUM files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Pose, quaternion_from_rotation
from companion.products.flight_result import WorldPose


def trajectory_tum(poses: Sequence[WorldPose], unit: str, origin: GeoOrigin | None) -> bytes:
    """Lines `unix_s x y z qx qy qz qw`, `world_from_camera`, seconds exact to the nanosecond."""
    lines = [
        "# unix_s x y z qx qy qz qw",
        "# pose of the camera (right, down, forward) in the world, world_from_camera",
        *("# " + line for line in frame_lines(unit, origin)),
    ]
    lines += [tum_line(t_ns, pose) for _, t_ns, pose in poses]
    return ("\n".join(lines) + "\n").encode("ascii")


def sent_poses_tum(poses: Iterable[tuple[int, Pose]]) -> bytes:
    """Lines likewise, `world_from_body`, of poses as they were given out."""
    lines = [
        "# unix_s x y z qx qy qz qw",
        "# pose of the body (forward, right, down) as given out in flight, world_from_body",
        "# world: level, metres, and north as the autopilot's attitude has it; its origin is free",
    ]
    lines += [tum_line(t_ns, pose) for t_ns, pose in poses]
    return ("\n".join(lines) + "\n").encode("ascii")


def tum_line(t_ns: int, pose: Pose) -> str:
    """A pose at a time in the format of TUM's benchmark (Sturm et al. 2012)."""
    w, x, y, z = quaternion_from_rotation(pose.rotation)
    place = " ".join(f"{v + 0.0:.6f}" for v in pose.translation)
    turn = " ".join(f"{v + 0.0:.9f}" for v in (x, y, z, w))
    return f"{exact_seconds(t_ns)} {place} {turn}"


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
