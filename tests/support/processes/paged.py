"""A daemon that serves its page, with camera, autopilot and a file of settings.

    with Paged(tmp_path) as paged:
        paged.until_served()
        ... paged.url, paged.codes(), paged.config

The camera films what is known (`HttpCamera`), the autopilot is on UDP. The settings of both are in
the file, where the page changes them.
"""

from __future__ import annotations

import time
import urllib.error
import urllib.request
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

from companion.page.codes import Codes, read_codes
from tests.support.autopilot.fake_autopilot import FakeAutopilot
from tests.support.autopilot.fake_wire import free_port
from tests.support.cameras.http_camera import HttpCamera, world_from_body
from tests.support.processes.daemon_process import Daemon
from tests.support.processes.flying import IMU, RANGE, flight_of

FILE = """\
# settings of a test
[camera]
source = "network"
url = "{camera}"
calibration = "{calibration}"

[link]
url = "{link}"

[feedback]
mode = "odometry"

[depth]
enabled = {depth}
"""


class Paged:
    """See above; `depth` makes the dense map too. Further settings are as after `--set`."""

    def __init__(self, folder: Path, *settings: str, depth: bool = False) -> None:
        self.camera = HttpCamera(world_from_body=world_from_body)
        self.autopilot = FakeAutopilot(
            "ardupilot", f"udpout:127.0.0.1:{free_port()}", flight_of(world_from_body),
            lacks=RANGE + IMU,
        )  # fmt: skip
        self.autopilot.fly(at_monotonic_ns=0, arm=False)
        self.config = folder / "companion.toml"
        self.config.write_text(
            FILE.format(
                camera=self.camera.url, link=self.autopilot.url, depth=str(depth).lower(),
                calibration=self.camera.write_calibration(folder / "camera.json"),
            ), "utf-8",
        )  # fmt: skip
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self._folder, self._settings = folder, settings
        self.daemon = self._daemon()
        self._open = ExitStack()

    def __enter__(self) -> Paged:
        with ExitStack() as entering:
            for part in (self.camera, self.autopilot, self.daemon):
                entering.enter_context(part)
            self._open = entering.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._open.close()

    def start_again(self) -> None:
        """End the daemon, and start it again, as a service manager would."""
        self.daemon.stop()
        self.daemon = self._daemon()
        self._open.enter_context(self.daemon)
        self.until_served()

    def _daemon(self) -> Daemon:
        page = f"page.listen=127.0.0.1:{self.port}"
        return Daemon(self._folder, page, *self._settings, config=self.config)

    def until_served(self, timeout_s: float = 30.0) -> None:
        """Wait until the page answers."""
        until_s = time.monotonic() + timeout_s
        while True:
            try:
                with urllib.request.urlopen(self.url, timeout=5):
                    return
            except (urllib.error.URLError, OSError):
                assert time.monotonic() < until_s, "the page does not answer"
                time.sleep(0.1)

    def codes(self) -> Codes:
        """Codes of the page."""
        found = read_codes(self.daemon.flights)
        assert found is not None
        return found
