"""The firmwares' own simulators as child processes, over level ground, in real time.

    with ArduCopter(binary, folder, ports, {"SIM_WIND_SPD": 3.0}) as firmware:
        firmware.restart()

Each speaks MAVLink by UDP to three ports: a ground station's, the companion's, and the camera's.
A restart keeps its parameters, as that of a real one does.
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Mapping
from dataclasses import astuple
from pathlib import Path
from types import TracebackType
from typing import IO, NamedTuple

from companion.geometry.geodesy import GeoOrigin

STOP_S = 8.0
SHELL_S = 10.0
UP_S = 3.0
"""PX4 takes commands of its shell after so long."""
CAMERA_STREAM_BYTES_S = 4_000_000


class Ports(NamedTuple):
    """UDP ports on this machine that the firmware sends to; the companion's may be PATH:BAUD."""

    ground: int
    companion: int | str
    camera: int


class Simulator:
    """One firmware. `with` starts it, and ends it whatever happened."""

    name = ""
    home = GeoOrigin(0.0, 0.0, 0.0)
    """Where the vehicle stands at first."""
    stands_m = 0.0
    """From the ground up to where its simulator says that it is while it stands."""
    without_gps: Mapping[str, float] = {}
    on_our_pose: Mapping[str, float] = {}
    """Parameters with which it flies on our pose: what docs/autopilots.md asks for."""

    def __init__(
        self, binary: Path, folder: Path, ports: Ports, parameters: Mapping[str, float]
    ) -> None:
        self.binary, self.folder, self.ports = binary, folder.resolve(), ports
        self.parameters = dict(parameters)
        self._process: subprocess.Popen[bytes] | None = None
        self._said: IO[bytes] | None = None

    def __enter__(self) -> Simulator:
        self._said = (self.folder / "firmware.txt").open("ab")
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self.stop()
        if self._said is not None:
            self._said.close()

    def start(self) -> None:
        """Power on."""
        self._process = subprocess.Popen(
            self._command(), cwd=self.folder, env=os.environ | self._environment(),
            stdin=subprocess.DEVNULL, stdout=self._said, stderr=subprocess.STDOUT,
            start_new_session=True,
        )  # fmt: skip

    def stop(self) -> None:
        """Power off."""
        process = self._process
        if process is None or process.poll() is not None:
            return
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def restart(self) -> None:
        """Power off and on again."""
        self.stop()
        self.start()

    def version(self) -> str:
        """The source that it was built from, by its revision."""
        asked = subprocess.run(
            ["git", "-C", str(self.binary.parent), "describe", "--always", "--tags"],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        return asked.stdout.strip() or "unknown"

    def _command(self) -> list[str]:
        raise NotImplementedError

    def _environment(self) -> dict[str, str]:
        return {}


class ArduCopter(Simulator):
    """`build/sitl/bin/arducopter`. Parameters are what it takes as the defaults of its board."""

    name = "ArduCopter"
    home = GeoOrigin(-35.363262, 149.165237, 584.0)
    stands_m = 0.09
    without_gps: Mapping[str, float] = {"GPS1_TYPE": 0, "SIM_GPS1_ENABLE": 0}
    on_our_pose: Mapping[str, float] = {
        "VISO_TYPE": 1, "EK3_SRC1_POSXY": 6, "EK3_SRC1_VELXY": 6, "EK3_SRC1_VELZ": 6,
        "EK3_SRC1_POSZ": 1, "EK3_SRC1_YAW": 1, "VISO_DELAY_MS": 62,
    }  # fmt: skip

    def _command(self) -> list[str]:
        defaults = self.folder / "defaults.parm"
        defaults.write_text("".join(f"{k} {v:.9g}\n" for k, v in self.parameters.items()))
        of_frame = self.binary.parents[3] / "Tools/autotest/default_params/copter.parm"
        home = ",".join(f"{each:.7f}" for each in (*astuple(self.home), 0.0))
        serial = [
            word
            for number, port in enumerate(self.ports)
            for word in (f"--serial{number}", _line_to(port))
        ]
        return [
            str(self.binary), "--model", "quad", "--speedup", "1", "--home", home,
            "--defaults", f"{of_frame},{defaults}", *serial,
        ]  # fmt: skip


def _line_to(port: int | str) -> str:
    return f"uart:{port}" if isinstance(port, str) else f"udpclient:127.0.0.1:{port}"


class Px4(Simulator):
    """`build/px4_sitl_sih/bin/px4`, whose simulator is in its own hardware layer (SIH).

    Its ports to the ground and to the companion are fixed: those that every PX4 in a simulator has.
    """

    name = "PX4"
    home = GeoOrigin(47.397742, 8.545594, 489.4)
    without_gps: Mapping[str, float] = {
        "SENS_EN_GPSSIM": 0, "SYS_HAS_GPS": 0, "EKF2_GPS_CTRL": 0
    }  # fmt: skip
    on_our_pose: Mapping[str, float] = {
        "EKF2_EV_CTRL": 7, "EKF2_HGT_REF": 0, "EKF2_EV_DELAY": 0, "EKF2_EV_NOISE_MD": 0,
        "EKF2_EVP_NOISE": 0.05, "EKF2_EVV_NOISE": 0.05, "COM_ARM_WO_GPS": 1,
    }  # fmt: skip
    FIXED = (14550, 14540)
    _has_parameters = False

    def start(self) -> None:
        """See `Simulator`; the camera gets a stream of its own.

        What is simulated is decided as it boots: with new parameters it boots twice.
        """
        super().start()
        time.sleep(UP_S)
        if not self._has_parameters:
            self._has_parameters = True
            for name, value in self.parameters.items():
                self.shell("param", "set", name, f"{value:g}")
            self.shell("param", "save")
            self.stop()
            super().start()
            time.sleep(UP_S)
        local = self.ports.camera + 1
        self.shell(
            "mavlink", "start", "-x", "-u", str(local), "-r", str(CAMERA_STREAM_BYTES_S),
            "-m", "custom", "-o", str(self.ports.camera),
        )  # fmt: skip
        self.shell("mavlink", "stream", "-u", str(local), "-s", "HIL_STATE_QUATERNION", "-r", "200")

    def shell(self, command: str, *words: str) -> str:
        """What a command of its shell says."""
        done = subprocess.run(
            [str(self.binary.with_name(f"px4-{command}")), *words], cwd=self.folder,
            capture_output=True, text=True, timeout=SHELL_S, check=False,
        )  # fmt: skip
        return done.stdout + done.stderr

    def _command(self) -> list[str]:
        etc = self.binary.parents[1] / "etc"
        return [str(self.binary), "-d", str(etc), "-w", str(self.folder)]

    def _environment(self) -> dict[str, str]:
        return {
            "PX4_SIM_MODEL": "sihsim_quadx",
            "PX4_HOME_LAT": str(self.home.latitude_deg),
            "PX4_HOME_LON": str(self.home.longitude_deg),
            "PX4_HOME_ALT": str(self.home.altitude_m),
        }
