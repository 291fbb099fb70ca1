"""Published sequences of real cameras: fetched from where they are published, tracked, scored.

    python -m tests.bench.real_sequences --work DIR [--only NAME…]

Nothing of them is shipped: git takes each at the commit that is named here. They are tracked in
lockstep without a dense map. Where the true path is known, the error is the ATE after the best
similarity. Where the camera has a gyroscope, the angle by which the camera turns within each second
is compared with the gyroscope's, which needs no mount.
"""

from __future__ import annotations

import argparse
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.app.progress import Progress
from companion.config import Config
from companion.config_file import load_config
from companion.geometry.transforms import Array, vector_from_rotation
from drivers.open_flight import open_flight
from drivers.telemetry.gpmf_gyro import gyro_rotation
from drivers.telemetry.gpmf_track import blocks_of
from tests.bench.accuracy.bench_slam import bench_slam
from tests.support.processes.program import replay_here
from tests.support.reference.scoring import read_tum

WINDOW_S = 1.0


@dataclass(frozen=True, slots=True)
class Source:
    """Files of a repository at a commit."""

    url: str
    commit: str
    paths: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RealSequence:
    """A sequence: where it is published, its licence, what others reach, and how it is laid out."""

    name: str
    sources: tuple[Source, ...]
    licence: str
    others: str
    lay_out: Callable[[Sequence[Path], Path], Path]
    has_truth: bool = True


def _linked(link: Path, to: Path) -> None:
    link.parent.mkdir(parents=True, exist_ok=True)
    if not link.exists():
        link.symlink_to(to.resolve())


def _tum(sources: Sequence[Path], folder: Path) -> Path:
    flight = folder / "rgbd_dataset_freiburg1_rpy"  # the name says which camera it was
    _linked(flight, sources[0] / "data")
    return flight


def _euroc(sources: Sequence[Path], folder: Path) -> Path:
    """Pictures and Vicon of one repository, the IMU of another, whose last line is cut."""
    pictures, mav = sources[0] / "data", folder / "V1_01" / "mav0"
    _linked(mav / "cam0", pictures / "cam0")
    _linked(mav / "vicon0", pictures / "vicon0")
    whole = (sources[1] / KIMERA / "imu0" / "data.csv").read_text().rpartition("\n")[0]
    (mav / "imu0").mkdir(exist_ok=True)
    (mav / "imu0" / "data.csv").write_text(whole + "\n")
    return mav.parent


def _only_one(sources: Sequence[Path], folder: Path) -> Path:
    (found,) = sources[0].rglob("*.mp4")
    return found


def _hololens(sources: Sequence[Path], folder: Path) -> Path:
    return sources[0] / HOLOLENS


KIMERA = "tests/data/MicroEurocDataset/mav0"
HOLOLENS = "sample-data/hololens-dataset/000"
GPMF = "https://github.com/gopro/gpmf-parser", "9a7150632892c7356c91145c889016f07b0ed48d"
SEQUENCES = (
    RealSequence(
        "fr1_rpy", (
            Source(
                "https://github.com/jmstark/gpu_odometry",
                "aec7c853676c7d809d9fd89e728c3f54b725a63e",
                ("data/rgb", "data/rgb.txt", "data/groundtruth.txt"),
            ),
        ),
        "CC BY 4.0 (TUM RGB-D)",
        "DROID-SLAM 0.026, DPV-SLAM 0.030, DeepFactors 0.043 m; ORB-SLAM3: lost", _tum,
    ),
    RealSequence(
        "V1_01", (
            Source(
                "https://github.com/Boscuit/UAV_BackTrack",
                "2cdd711c70f98a6baa71adb41bb367665f8ecf38", ("data",),
            ),
            Source(
                "https://github.com/MIT-SPARK/Kimera-VIO",
                "ce8c59b7b273ab5ac29db7e5572e1623760e19c7", (KIMERA + "/imu0",),
            ),
        ),
        "ASL, ETH Zurich (EuRoC)", "of the whole sequence: ORB-SLAM3 0.033 m", _euroc,
    ),
    RealSequence(
        "hololens", (
            Source(
                "https://github.com/ardaduz/deep-video-mvs",
                "470065a6580a3ccbc6357433a2647eb9c5d4b456", (HOLOLENS,),
            ),
        ),
        "MIT", "", _hololens,
    ),
    RealSequence(
        "gopro_max", (Source(*GPMF, ("samples/max-heromode.mp4",)),),
        "Apache 2.0 or MIT", "", _only_one, has_truth=False,
    ),
    RealSequence(
        "karma_cliff", (Source(*GPMF, ("samples/karma.mp4",)),),
        "Apache 2.0 or MIT", "", _only_one, has_truth=False,
    ),
)  # fmt: skip


def fetched(source: Source, folder: Path) -> Path:
    """A folder with the files of a source, which git brings if they are not there."""
    into = folder / source.url.rpartition("/")[2] / source.paths[0].replace("/", "_")
    if all((into / path).exists() for path in source.paths):
        return into
    into.mkdir(parents=True, exist_ok=True)
    git = "git", "-C", str(into), "-c", "gc.auto=0"
    subprocess.run([*git, "init", "--quiet"], check=True)
    # blobs come when the checkout wants them: the repositories hold much else
    of_it = "--depth", "1", "--filter=blob:none", source.url, source.commit
    subprocess.run([*git, "config", "remote.origin.url", source.url], check=True)
    subprocess.run([*git, "config", "remote.origin.promisor", "true"], check=True)
    subprocess.run([*git, "fetch", "--quiet", *of_it], check=True)
    subprocess.run([*git, "checkout", "--quiet", source.commit, "--", *source.paths], check=True)
    return into


def turns_apart_deg(video: Path, trajectory: Path) -> Array:
    """Differences (N,) of the turns within each WINDOW_S, of the path and of the gyroscope."""
    turned = gyro_rotation(blocks_of(video))
    assert turned is not None, f"{video} has no gyroscope"
    begin_s = open_flight(video, Config().camera).start_ns * 1e-9
    found = read_tum(trajectory)
    path_s, gyro_s = found.t_s - begin_s, turned.t_ns * 1e-9
    out = []
    for i, since_s in enumerate(path_s):
        j = int(np.searchsorted(path_s, since_s + WINDOW_S))
        if j >= len(path_s) or path_s[j] - since_s > 1.1 * WINDOW_S:
            continue
        gyro_rad = [
            np.interp(path_s[j], gyro_s, axis) - np.interp(since_s, gyro_s, axis)
            for axis in turned.angle_rad.T
        ]
        by_path = vector_from_rotation(found.rotations[i].T @ found.rotations[j])
        out.append(np.degrees(np.linalg.norm(by_path) - np.linalg.norm(gyro_rad)))
    return np.array(out)


def measured(sequence: RealSequence, folder: Path) -> str:
    """A line of the table."""
    sources = [fetched(source, folder / "fetched") for source in sequence.sources]
    flight, off = sequence.lay_out(sources, folder), "-"
    if sequence.has_truth:
        config = load_config(None, ["depth.enabled=false"])
        (row,) = bench_slam(
            [flight], config, folder / "out", faults=False, above_m=None, progress=Progress()
        )
        placed, n_frames = round(row.tracked_share * row.frames), row.frames
        if row.errors is not None:
            off = f"{row.errors.ate_sim3_m:.3f} m of {row.errors.path_m:.1f} m"
    else:
        run = replay_here(flight, folder / "out" / sequence.name, "--set", "depth.enabled=false")
        assert run.status == 0, run.stderr
        placed, n_frames = (
            round(run.report["tracked_share"] * run.report["frames"]),
            run.report["frames"],
        )
        apart = turns_apart_deg(flight, run.out / "trajectory.tum")
        if len(apart):
            off = f"turns in a second {np.sqrt((apart**2).mean()):.2f} degrees (RMS)"
    told = sequence.name, f"{placed} of {n_frames}", off, sequence.others, sequence.licence
    return f"| {' | '.join(told)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--work", type=Path, required=True, metavar="DIR")
    parser.add_argument("--only", nargs="+", choices=[each.name for each in SEQUENCES])
    arguments = parser.parse_args()
    print("| sequence | frames placed | error | published | licence |")
    print("|---|---|---|---|---|")
    for sequence in SEQUENCES:
        if not arguments.only or sequence.name in arguments.only:
            print(measured(sequence, arguments.work), flush=True)


if __name__ == "__main__":
    main()
