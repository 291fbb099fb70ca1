"""`companion depth`, and its bench, on rendered images in each layout."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.app.cli import main
from companion.dense.depth_range import depth_range
from companion.dense.view_selection import Intrinsics
from companion.errors import FlightError
from companion.geometry.camera import Camera
from companion.geometry.transforms import (
    Array,
    Pose,
    quaternion_from_rotation,
    rotation_from_vector,
)
from companion.messages import Bytes, Floats
from drivers.posed_images import open_posed_images
from tests.bench.accuracy.__main__ import main as bench_main
from tests.bench.accuracy.true_depths import true_depth
from tests.support.flights.scene import DOWN_LOOKING, PlaneWorld

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
N = 9


def at(k: int) -> Pose:
    turn = rotation_from_vector(np.array([0.15, 0.02 * k, 0.01 * k]))
    return Pose(DOWN_LOOKING @ turn, np.array([0.4 * k, 0.25 * k - 1, -12.0]))


@pytest.fixture(scope="module")
def rendered() -> list[tuple[Bytes, Floats]]:
    world = PlaneWorld(np.random.default_rng(8), metres_per_texel=0.15)
    return [world.render(CAMERA, at(k)) for k in range(N)]


def _wxyz_to_xyzw(rotation: Array) -> str:
    w, x, y, z = quaternion_from_rotation(rotation)
    return f"{x:.9f} {y:.9f} {z:.9f} {w:.9f}"


def _camera_json(folder: Path) -> None:
    values = {k: getattr(CAMERA, k) for k in ("width", "height", "fx", "fy", "cx", "cy")}
    (folder / "camera.json").write_text(json.dumps({**values, "distortion_model": "none"}))


def write_remode(folder: Path, rendered: list[tuple[Bytes, Floats]]) -> None:
    up = np.diag([1.0, -1.0, 1.0])
    (folder / "Images").mkdir(parents=True)
    (folder / "truth").mkdir()
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    n = CAMERA.normalise(np.stack([u, v], -1))
    lines = []
    for k, (grey, depth) in enumerate(rendered):
        cv2.imwrite(str(folder / "Images" / f"scene_{k:03d}.png"), grey)
        # in tenths of millimetres, 16 bits hold 6.5 m: the scene is made a tenth as large
        distance = depth / 10 * np.sqrt((n**2).sum(-1) + 1)
        truth = np.rint(distance * 1e4).astype(np.uint16)
        cv2.imwrite(str(folder / "truth" / f"scene_{k:03d}.png"), truth)
        x, y, z = up @ (at(k).translation / 10)
        turn = _wxyz_to_xyzw(up @ at(k).rotation @ up)
        lines.append(f"scene_{k:03d}.png {x:.9f} {y:.9f} {z:.9f} {turn}")
    (folder / "first_200_frames_traj_over_table_input_sequence.txt").write_text("\n".join(lines))
    _camera_json(folder)


def write_tum(folder: Path, rendered: list[tuple[Bytes, Floats]]) -> None:
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    rgb, depths, poses = ["# rgb"], ["# depth"], ["# truth"]
    for k, (grey, depth) in enumerate(rendered):
        t = 1000 + 0.1 * k
        cv2.imwrite(str(folder / "rgb" / f"{t:.4f}.png"), grey)
        near = np.where(depth < 13, np.rint(depth * 5000), 0)  # more than 16 bits cannot hold
        cv2.imwrite(str(folder / "depth" / f"{t:.4f}.png"), near.astype(np.uint16))
        rgb.append(f"{t:.4f} rgb/{t:.4f}.png")
        depths.append(f"{t + 0.004:.4f} depth/{t:.4f}.png")
        x, y, z = at(k).translation
        poses.append(f"{t:.4f} {x} {y} {z} {_wxyz_to_xyzw(at(k).rotation)}")
    for name, lines in (("rgb", rgb), ("depth", depths), ("groundtruth", poses)):
        (folder / f"{name}.txt").write_text("\n".join(lines))
    _camera_json(folder)


def write_posed_video(folder: Path, rendered: list[tuple[Bytes, Floats]]) -> None:
    (folder / "images").mkdir(parents=True)
    (folder / "depth").mkdir()
    for k, (grey, depth) in enumerate(rendered):
        cv2.imwrite(str(folder / "images" / f"{k:05d}.png"), grey)
        cv2.imwrite(str(folder / "depth" / f"{k:05d}.png"), np.rint(depth * 1e3).astype(np.uint16))
    np.savetxt(folder / "poses.txt", [at(k).matrix().ravel() for k in range(N)])
    np.savetxt(folder / "K.txt", CAMERA.matrix())


def write_flight(folder: Path, rendered: list[tuple[Bytes, Floats]]) -> None:
    (folder / "images").mkdir(parents=True)
    (folder / "truth" / "depth").mkdir(parents=True)
    stamps, poses = ["index,unix_ns"], []
    for k, (grey, depth) in enumerate(rendered):
        cv2.imwrite(str(folder / "images" / f"{k:06d}.png"), grey)
        truth = np.rint(depth * 200).astype(np.uint16)
        cv2.imwrite(str(folder / "truth" / "depth" / f"{k:06d}.png"), truth)
        stamps.append(f"{k},{(1000 + k) * 100_000_000}")
        x, y, z = at(k).translation
        poses.append(f"{(1000 + k) / 10:.9f} {x} {y} {z} {_wxyz_to_xyzw(at(k).rotation)}")
    (folder / "frames.csv").write_text("\n".join(stamps) + "\n")
    (folder / "trajectory.tum").write_text("\n".join(poses))
    _camera_json(folder)


LAYOUTS = {
    "REMODE": write_remode,
    "TUM RGB-D": write_tum,
    "posed video": write_posed_video,
    "flight": write_flight,
}


@pytest.mark.parametrize("layout", sorted(LAYOUTS))
def test_layouts_are_read(
    layout: str, rendered: list[tuple[Bytes, Floats]], tmp_path: Path
) -> None:
    LAYOUTS[layout](tmp_path / "set", rendered)
    images = open_posed_images(tmp_path / "set")
    scale = 0.1 if layout == "REMODE" else 1.0
    assert len(images) == N
    assert images.camera.fx == CAMERA.fx
    for k, pose in enumerate(images.poses):
        assert pose is not None
        # REMODE's world is mirrored, so only motion can be compared
        first = images.poses[0]
        assert first is not None
        want, found = at(0).inverse() @ at(k), first.inverse() @ pose
        np.testing.assert_allclose(found.rotation, want.rotation, atol=1e-6)
        np.testing.assert_allclose(found.translation, scale * want.translation, atol=1e-6)
    truth = true_depth(images, 3)
    assert truth is not None
    known = truth > 0
    assert known.mean() > 0.5
    np.testing.assert_allclose(truth[known], scale * rendered[3][1][known], atol=0.004)
    numbers, pictures = zip(*images.pictures([2, 5]), strict=True)
    assert numbers == (2, 5)
    np.testing.assert_array_equal(pictures[1][..., 1], rendered[5][0])


def test_folders_that_are_none_of_these_are_named(
    rendered: list[tuple[Bytes, Floats]], tmp_path: Path
) -> None:
    with pytest.raises(FlightError, match="no such file or folder"):
        open_posed_images(tmp_path / "none")
    write_posed_video(tmp_path / "set", rendered)
    (tmp_path / "set" / "poses.txt").unlink()
    with pytest.raises(FlightError, match="no images with poses"):
        open_posed_images(tmp_path / "set")


def test_poses_between_two_are_interpolated(
    rendered: list[tuple[Bytes, Floats]], tmp_path: Path
) -> None:
    write_flight(tmp_path / "set", rendered)
    file = tmp_path / "set" / "trajectory.tum"
    lines = file.read_text().splitlines()
    file.write_text("\n".join(lines[:3] + lines[4:6]))
    poses = open_posed_images(tmp_path / "set").poses
    assert poses[3] is not None and poses[6] is None
    np.testing.assert_allclose(poses[3].translation, at(3).translation, atol=1e-6)


def test_an_image_that_cannot_be_decoded_is_named(
    rendered: list[tuple[Bytes, Floats]], tmp_path: Path
) -> None:
    write_posed_video(tmp_path / "set", rendered)
    (tmp_path / "set" / "images" / "00004.png").write_bytes(b"no image")
    images = open_posed_images(tmp_path / "set")
    assert [at for at, _ in images.pictures([2, 3, 6])] == [2, 3, 6]
    with pytest.raises(FlightError, match="frame 4 cannot be decoded"):
        list(images.pictures([3, 4, 5]))


def test_a_frame_that_is_not_there_is_told_with_those_that_are(
    rendered: list[tuple[Bytes, Floats]], tmp_path: Path
) -> None:
    write_remode(tmp_path / "images", rendered)
    images = open_posed_images(tmp_path / "images")
    last = images.numbers[-1]
    assert images.position(last) == N - 1
    with pytest.raises(FlightError, match=f"there is no frame 900; they are .* to {last}"):
        images.position(900)


def test_depth_is_written(rendered: list[tuple[Bytes, Floats]], tmp_path: Path) -> None:
    write_posed_video(tmp_path / "set", rendered)
    out = tmp_path / "out"
    command = ["depth", str(tmp_path / "set"), "--out", str(out), "--set", "expert.depth.stride=1"]
    assert main([*command, "--reference", "4"]) == 0
    with np.load(out / "depth_000004.npz") as written:
        depth, state, sigma = written["depth_m"], written["state"], written["sigma_m"]
        assert (written["distance_m"] >= depth).all()
    truth = rendered[4][1]
    converged = state == 1
    assert converged.mean() > 0.6
    error = np.abs(depth - truth) / truth
    assert (error[converged] < 0.04).mean() > 0.95
    assert sigma[converged].min() > 0
    log = json.loads((out / "depth.json").read_text())
    reference = log["references"][0]
    assert reference["reference"] == 4
    assert [f["frame"] for f in reference["frames"]] == [3, 5, 2, 6, 1, 7, 0, 8]
    assert sum(reference["pixels"].values()) == depth.size
    assert reference["kernel_ms"]["costs-coarse"] > 0
    assert not [name for name in reference["kernel_ms"] if " " in name]
    # nine images of 160 x 120, at gigabytes a second; depth, states and more come back
    assert 0.001 < reference["upload_ms"] < 1000
    assert 0.001 < reference["read_back_ms"] < 1000
    assert reference["host_ms"] > 0
    for kind in ("upload_ms", "read_back_ms"):
        assert sum(f[kind] for f in reference["frames"]) <= reference[kind] + 0.02
    assert all(f["upload_ms"] > 0 for f in reference["frames"][:3])
    assert reference["frames"][-1]["converged"] > 0
    assert log["in_all"] == {key: reference[key] for key in log["in_all"]}
    head = (out / "cloud.ply").read_bytes()[:400].split(b"end_header")[0]
    assert f"element vertex {converged.sum()}".encode() in head


def test_all_references_make_one_cloud(
    rendered: list[tuple[Bytes, Floats]], tmp_path: Path
) -> None:
    write_tum(tmp_path / "set", rendered)
    out = tmp_path / "out"
    sets = ["--set", "expert.depth.max_baseline=0.4", "--set", "expert.depth.reference_step=0.05"]
    command = ["depth", str(tmp_path / "set"), "--out", str(out), "--range", "7:16"]
    assert main([*command, *sets, "--frames", "1:9"]) == 0
    maps = sorted(out.glob("depth_*.npz"))
    assert len(maps) >= 3 and maps[0].name == "depth_000001.npz"
    assert b"element vertex 0\n" not in (out / "cloud.ply").read_bytes()[:400]


def test_the_range_of_depths_is_found(rendered: list[tuple[Bytes, Floats]]) -> None:
    others = [(rendered[k][0], at(k).inverse() @ at(0)) for k in range(1, N)]
    found = depth_range(rendered[0][0], others, Intrinsics(130.0, 130.0, 79.5, 59.5))
    assert found is not None
    truth = rendered[0][1]
    assert 0.3 * truth.min() < found[0] < truth.min()
    assert truth.max() < found[1] < 3 * truth.max()
    flat = np.full_like(rendered[0][0], 90)
    still = [(rendered[0][0], Pose.identity())]
    camera = Intrinsics(130.0, 130.0, 79.5, 59.5)
    assert depth_range(flat, still, camera) is None
    assert depth_range(rendered[0][0], still, camera) is None


@pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="no C compiler")
def test_bench(
    rendered: list[tuple[Bytes, Floats]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_remode(tmp_path / "set", rendered)
    out = tmp_path / "out"
    bench_main(["depth", str(tmp_path / "set"), "--out", str(out)])
    printed = capsys.readouterr().out
    assert "REMODE, one core" in printed and "times as fast" in printed
    bench = json.loads((out / "depth_bench.json").read_text())
    assert [run["name"] for run in bench["runs"]] == ["companion", "REMODE, one core"]
    assert bench["frames"] == N - 1 and 0 < bench["searched"] < N
    assert bench["runs"][0]["converged"]["within_2"] > 0.9
    assert [row["frames"] for row in bench["after_frames"]] == [1, 5, 8]
    assert (out / "depth_bench.png").stat().st_size > 1000
    used = bench["as_used"]
    assert used["n_references"] > 1 and used["wall_s"] > 0 and used["refused"] == ""
    # each image of this set has a true depth; the references are those of `companion depth`
    assert main(["depth", str(tmp_path / "set"), "--out", str(tmp_path / "maps")]) == 0
    log = json.loads((tmp_path / "maps" / "depth.json").read_text())["references"]
    assert [r["reference"] for r in used["rows"]] == [r["reference"] for r in log]
    for row in used["rows"]:
        assert row["all_pixels"]["within_5"] >= row["alone_all"]["within_5"] - 0.01
        assert row["converged"]["estimated"] > 0.3
    assert "as a user runs it" in printed and "as written" in printed


def test_bench_says_why_it_cannot_measure_what_a_user_gets(
    rendered: list[tuple[Bytes, Floats]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # two frames of hardly any texture: no point can be followed to tell how far away things are
    faint = [(np.asarray(90 + grey // 200, np.uint8), depth) for grey, depth in rendered]
    write_remode(tmp_path / "set", faint)
    bench_main(["depth", str(tmp_path / "set"), "--no-serial"])
    assert "not measured: " in capsys.readouterr().out
