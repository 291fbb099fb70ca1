"""A scalar sensor from the wire to the recording, the table and the viewer's plot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from rerun.chunk import RrdReader

from companion.config import ViewerConfig
from companion.geometry.camera import Camera
from companion.streaming.viewer import FileViewer
from companion.telemetry import AirspeedSample, HeightSample, Telemetry
from companion.timing.link_clock import ClockFilter
from drivers.recording.recording_codec import sample_bytes, sample_of, sample_topic
from drivers.telemetry.live_samples import LiveSamples
from drivers.telemetry.mavlink_samples import samples_of
from drivers.telemetry.telemetry_csv import read_telemetry_csv, telemetry_csv
from drivers.telemetry.telemetry_log import TelemetryLog
from drivers.telemetry.telemetry_tlog import read_tlog
from tests.support.flights import flown
from tests.support.flights.logs import START_NS, Tlog, attitude

S = 10**9
TEN_M_S_HPA = 0.5 * 1.225 * 10**2 / 100


def pressure(diff_hpa: float, boot_ms: int = 83_020) -> Any:
    return mavlink.MAVLink_scaled_pressure_message(boot_ms, 898.746, diff_hpa, 2000)


def speeds(samples: Any) -> list[float]:
    return [each.indicated_m_s for each in samples if isinstance(each, AirspeedSample)]


@pytest.mark.parametrize(
    ("diff_hpa", "told"),
    [(TEN_M_S_HPA, [10.0]), (4 * TEN_M_S_HPA, [20.0]), (-0.01, [0.0]), (0, [])],
)
def test_the_pressure_of_a_pitot_tube_is_an_airspeed(diff_hpa: float, told: list[float]) -> None:
    found = samples_of(pressure(diff_hpa), less_biases=False)
    assert speeds(found) == pytest.approx(told)
    assert len([each for each in found if isinstance(each, HeightSample)]) == 1


def test_it_is_read_of_the_link_and_of_its_log(tmp_path: Path) -> None:
    clock, live = ClockFilter(), list[Telemetry]()
    samples = LiveSamples(clock, live.append, lambda warned: None)
    log = Tlog()
    for k in range(50):
        boot_ns = (80 * 50 + k) * S // 50
        t_ns = START_NS + k * S // 50
        clock.exchange(t_ns, boot_ns, t_ns)
        said = pressure(TEN_M_S_HPA if k % 2 else float("nan"), boot_ns // 10**6)
        samples.take(said, t_ns)
        log.add(t_ns, attitude(boot_ns, 0, 0, 0))
        log.add(t_ns, said)
    assert speeds(live) == pytest.approx([10.0] * 25, rel=1e-6)
    (tmp_path / "telemetry.tlog").write_bytes(log.data)
    content = read_tlog(tmp_path / "telemetry.tlog")
    assert content.host_ns is not None
    logged = content.collected.finish(content.host_ns, content.clock)
    assert speeds(logged.samples) == pytest.approx([10.0] * 25, rel=1e-6)
    assert logged.rates_hz["airspeed"] == pytest.approx(25, rel=0.01)


def test_it_is_recorded_and_tabulated(tmp_path: Path) -> None:
    sample = AirspeedSample(5, 1 / 3)
    assert sample_topic(sample) == "/telemetry/airspeed"
    back = sample_of("/telemetry/airspeed", 5, sample_bytes(sample))
    assert speeds([back]) == [1 / 3] and back.t_ns == 5
    table = tmp_path / "telemetry.csv"
    table.write_text("".join(telemetry_csv(TelemetryLog("", [sample]))))
    assert table.read_text().endswith("\n5,airspeed,0.3333333333333333\n")
    log = read_telemetry_csv(table).collected.finish(lambda times, _: times, None)
    assert speeds(log.samples) == [1 / 3]


def test_the_viewer_plots_it_until_it_falls_silent(tmp_path: Path) -> None:
    path = tmp_path / "flight.rrd"
    with FileViewer(ViewerConfig(), Camera(64, 48, 60.0, 60.0, 31.5, 23.5), path) as viewer:
        for seq in range(20, 120):  # five seconds
            if seq < 60:
                viewer.take(AirspeedSample(flown.time_ns(seq), 0.25 * seq))
            viewer.take(flown.track(seq))
    plotted: list[float] = []
    for chunk in RrdReader(path).stream().to_chunks():
        if str(chunk.entity_path) == "/plots/telemetry/airspeed":
            batch = chunk.to_record_batch()
            if "Scalars:scalars" in batch.schema.names:
                plotted += [
                    value for row in batch.column("Scalars:scalars").to_pylist() for value in row
                ]
    assert plotted == [5.0, 10.0, 14.75]
