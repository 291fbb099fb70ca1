"""A daemon in flight that serves its page, with a file of settings.

    with Paged(tmp_path) as paged:
        paged.until_served()
        ... paged.url, paged.codes(), paged.config

The settings of camera and autopilot are in the file, where the page changes them.
"""

from __future__ import annotations

import signal
import urllib.request
from http.client import HTTPException
from pathlib import Path

from companion.page.codes import Codes, read_codes
from tests.support.autopilot.fake_wire import free_port
from tests.support.cameras.http_camera import RATE_HZ, world_from_body
from tests.support.processes.daemon_process import Daemon
from tests.support.processes.flying import N_FEATURES, Flying, PathOf
from tests.support.waiting import until

FILE = """\
# settings of a test
[camera]
source = "network"
url = "{camera}"
calibration = "{calibration}"
rate_hz = {rate_hz}

[link]
url = "{link}"

[feedback]
mode = "odometry"

[depth]
enabled = {depth}
"""


class Paged(Flying):
    """See above; `depth` makes the dense map too, `path` is another one to fly.

    Unless `mounted` nobody knows how the camera sits. Further settings are as after `--set`.
    """

    def __init__(
        self, folder: Path, *settings: str, depth: bool = False, path: PathOf = world_from_body,
        mounted: bool = True,
    ) -> None:  # fmt: skip
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.config = folder / "companion.toml"
        self._over_it = (
            f"page.listen=127.0.0.1:{self.port}", f"expert.features.n_features={N_FEATURES}",
            *settings,
        )  # fmt: skip
        self._depth = depth
        super().__init__(folder, url=f"udpout:127.0.0.1:{free_port()}", path=path)
        if not mounted:
            self.camera.write_calibration(folder / "camera.json", mounted=False)

    def _made(self) -> Daemon:
        if not self.config.exists():
            text = FILE.format(
                camera=self.camera.url, link=self.autopilot.url, depth=str(self._depth).lower(),
                calibration=self._folder / "camera.json", rate_hz=RATE_HZ,
            )  # fmt: skip
            self.config.write_text(text, "utf-8")
        return Daemon(self._folder, *self._over_it, config=self.config)

    def start_again(self, number: signal.Signals = signal.SIGTERM) -> int:
        """End the daemon, and start it again, as a service manager would; when it was told."""
        told_ns = super().start_again(number)
        self.until_served()
        return told_ns

    def until_served(self) -> None:
        """Wait until the page answers."""
        until(self._answers, "the page answers")

    def _answers(self) -> bool:
        try:
            with urllib.request.urlopen(self.url, timeout=20):
                return True
        except (OSError, HTTPException):  # a port that nobody has yet may be connected to itself
            return False

    def codes(self) -> Codes:
        """Codes of the page."""
        found = read_codes(self.daemon.flights)
        assert found is not None
        return found
