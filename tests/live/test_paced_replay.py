"""A replay in the flight's own time goes through the processes of a live flight."""

from __future__ import annotations

from pathlib import Path

from tests.support.processes.program import replay
from tests.support.reference.scoring import read_tum

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
SECONDS, RATE_HZ = 12, 10


def test_a_paced_replay_leaves_what_a_replay_leaves(tmp_path: Path) -> None:
    """Nearly all frames have a pose also on a machine that drops some."""
    done = replay(
        SAMPLE, tmp_path / "out", "--paced", "--stop", str(SECONDS),
        "--set", "depth.enabled=false",
    )  # fmt: skip
    assert done.status == 0, done.stderr
    report = done.report
    assert report["completed"]
    assert "localisation frames" in report["dropped"]
    n = SECONDS * RATE_HZ
    assert 0.9 * n <= report["frames"] <= n
    assert len(read_tum(done.out / "trajectory.tum").t_s) > 0.5 * n
    for name in ("report.html", "flight.rrd"):
        assert (done.out / name).stat().st_size > 1000
    assert not (done.out / "flight.mcap").exists()
