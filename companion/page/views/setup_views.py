"""View Set up: steps that tick themselves off, with the settings and parameters they need."""

from __future__ import annotations

import asyncio
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from companion.page.doctor_process import Doctor
from companion.page.setup_steps import steps
from companion.page.views.setting_views import SettingViews
from companion.page.views.site import Form, RefusedError, Site
from drivers.camera.camera_devices import cameras
from drivers.system.serial_devices import serial_devices

NEEDED = {
    "camera": ("camera.source", "camera.device", "camera.url", "camera.width", "camera.height",
               "camera.rate_hz"),
    "lens": ("camera.calibration", "camera.assumed_hfov_deg"),
    "mount": ("mount.known", "mount.roll_deg", "mount.pitch_deg", "mount.yaw_deg", "mount.x_m",
              "mount.y_m", "mount.z_m"),
    "autopilot": ("link.url",),
    "place": ("feedback.origin_latitude_deg", "feedback.origin_longitude_deg",
              "feedback.origin_altitude_m"),
    "ready": ("feedback.mode", "daemon.flight"),
}  # fmt: skip
"""Settings of each step."""
ROUTER = "tcpin:127.0.0.1:5760"
"""Place at the link for the doctor, where the daemon holds it."""


class SetupViews:
    """See the module."""

    def __init__(self, site: Site, setting_views: SettingViews) -> None:
        self._site, self._settings = site, setting_views
        self._doctor = Doctor(site.facts)

    def routes(self) -> list[Route]:
        """Routes of this view."""
        looking, changing = self._site.looking, self._site.changing
        return [
            Route("/setup", looking(self._show)),
            Route("/setup/steps", looking(self._steps)),
            Route("/setup/devices", looking(self._devices)),
            Route("/setup/examine", changing(self._examine), methods=["POST"]),
            Route("/setup/parameter", changing(self._set), methods=["POST"]),
        ]

    async def _show(self, request: Request) -> Response:
        config = await asyncio.to_thread(self._site.facts.configured)
        fields = {key: self._settings.fields(names) for key, names in NEEDED.items()}
        values = await self._values()
        return await self._site.render(
            request, "setup.html.j2", **values, fields=fields, router=ROUTER,
            file=self._site.facts.path, waiting=self._settings.waiting(config),
            supervised=self._site.facts.supervised,
        )  # fmt: skip

    async def _steps(self, request: Request) -> Response:
        return await self._site.render(request, "setup_steps.html.j2", **await self._values())

    async def _devices(self, request: Request) -> Response:
        """Cameras and serial ports that this machine has."""
        found, ports = await asyncio.gather(
            asyncio.to_thread(cameras), asyncio.to_thread(serial_devices)
        )
        return await self._site.render(request, "devices.html.j2", cameras=found, ports=ports)

    async def _examine(self, request: Request, form: Form) -> Response:
        self._check_free()
        good = "error" not in await self._doctor.examine()
        said = "The parameters were examined." if good else "The parameters could not be examined."
        return self._site.done(request, "/setup#parameters", said, good)

    async def _set(self, request: Request, form: Form) -> Response:
        name = form.get("name", "")
        found = self._doctor.found or {}
        settable = [
            each["name"] for each in found.get("in_the_way", ()) if each["set_to"] is not None
        ]
        set_all = bool(form.get("all"))
        if not settable or not (set_all or name in settable):
            raise RefusedError("Examine the parameters first.")
        self._check_free()
        found = await (self._doctor.set_all() if set_all else self._doctor.set_one(name))
        if "error" in found:
            raise RefusedError(found["error"])
        said = [f"{each['name']} is now {each['to']:g}" for each in found["written"]]
        said += [f"not set: {each}" for each in found["refused"]]
        said += [f"not stored: {found['not_stored']}"] if found["not_stored"] else []
        text = "; ".join(said) + ". " if said else "Nothing was set. "
        text += "Reboot the autopilot." if found["reboot_needed"] else ""
        return self._site.done(request, "/setup#parameters", text, good=not found["refused"])

    def _check_free(self) -> None:
        if self._doctor.is_busy:
            raise RefusedError("They are being examined just now.")

    async def _values(self) -> dict[str, Any]:
        status = await self._site.watch.status()
        told = steps(status, self._site.facts.config, self._doctor.found)
        return {"steps": told, "examined": self._doctor.found}
