"""Camera path in formats of trajectory evaluation tools."""

from __future__ import annotations

from collections.abc import Sequence

from companion.geometry.transforms import quaternion_from_rotation
from companion.products.flight_result import WorldPose


def path_kitti(poses: Sequence[WorldPose]) -> bytes:
    """KITTI: twelve numbers a line, camera poses in the frame of the first camera."""
    if not poses:
        return b""
    first_from_world = poses[0].world_from_camera.inverse()
    rows = [(first_from_world @ pose.world_from_camera).matrix()[:3] for pose in poses]
    return "".join(" ".join(f"{v + 0.0:.9e}" for v in row.ravel()) + "\n" for row in rows).encode()


def times_kitti(poses: Sequence[WorldPose]) -> bytes:
    """KITTI: seconds since the first pose, one a line."""
    return "".join(f"{(pose.t_ns - poses[0].t_ns) * 1e-9:.6e}\n" for pose in poses).encode()


def path_euroc(poses: Sequence[WorldPose]) -> bytes:
    """EuRoC: nanoseconds, position and quaternion w x y z of the camera in the world."""
    head = (
        "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], "
        "q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
    )
    lines = [head]
    for _, t_ns, pose in poses:
        place = ",".join(f"{v + 0.0:.6f}" for v in pose.translation)
        turn = ",".join(f"{v + 0.0:.9f}" for v in quaternion_from_rotation(pose.rotation))
        lines.append(f"{t_ns},{place},{turn}\n")
    return "".join(lines).encode()
