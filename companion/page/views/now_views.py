"""View Now: the state in one line, the live picture, the map from above, warnings."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import Route

from companion.page.remedies import OF_REASON, OTHER, remedy
from companion.page.setup_steps import source
from companion.page.views.rerun_views import viewer_link
from companion.page.views.site import Site, is_number
from companion.timing.clock import monotonic_s

ABOVE_FRESH_S = 0.8
"""Age at which the map from above is drawn anew; an open view asks once a second."""
RECENT_S = 600.0
"""Age of warnings that are shown here; Health in the journal has all."""
WORDS = {
    "tracking": "Tracking", "standing": "Standing", "dead reckoning": "Dead reckoning",
    "initialising": "The map is being begun", "lost": "Lost", "starting": "Starting",
}  # fmt: skip


class NowViews:
    """See the module."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._panel_of: Mapping[str, Any] | None = None
        self._panel_html = ""
        self._above_lock = asyncio.Lock()
        self._above_s, self._above_json = -ABOVE_FRESH_S, b""

    def routes(self) -> list[Route]:
        """Routes of this view."""
        looking = self._site.looking
        return [
            Route("/", looking(self._now)),
            Route("/now/panel", looking(self._panel)),
            Route("/now/armed", looking(self._armed)),
            Route("/now/picture", looking(self._picture)),
            Route("/now/above", looking(self._above)),
            Route("/map", looking(self._map)),
        ]

    async def _now(self, request: Request) -> Response:
        values = self._values(await self._site.watch.status())
        return await self._site.render(request, "now.html.j2", **values)

    async def _panel(self, request: Request) -> Response:
        status = await self._site.watch.status()
        if status is not self._panel_of:  # all who look have the same one
            self._panel_html = self._site.part("now_panel.html.j2", **self._values(status))
            self._panel_of = status
        return HTMLResponse(self._panel_html)

    async def _armed(self, request: Request) -> Response:
        """true, false, or none where nobody knows: what a view may do changes with it."""
        status = await self._site.watch.status()
        return PlainTextResponse(str(status.get("armed")).lower())

    async def _picture(self, request: Request) -> Response:
        await self._site.watch.status()  # which tells where the exporter is
        if "needed" in request.query_params:  # by a step of the setup
            self._site.watch.keep_viewer()
        after = request.query_params.get("after", "")
        found = self._site.scene.picture_after(int(after) if is_number(after) else -1)
        if found is None:
            return Response(status_code=204)
        return Response(found, media_type="application/json")

    async def _above(self, request: Request) -> Response:
        await self._site.watch.status()
        async with self._above_lock:
            if monotonic_s() - self._above_s > ABOVE_FRESH_S:
                self._above_json = await asyncio.to_thread(self._site.scene.from_above)
                self._above_s = monotonic_s()
        return Response(self._above_json, media_type="application/json")

    async def _map(self, request: Request) -> Response:
        is_web = self._site.facts.config.daemon.viewer == "web"
        rerun = viewer_link(request.headers.get("host", "")) if is_web else ""
        return await self._site.render(request, "map.html.j2", rerun=rerun)

    def _values(self, status: Mapping[str, Any]) -> dict[str, Any]:
        good, line = headline(status, self._site.watch.problem)
        return {
            "good": good, "line": line, "rows": rows(status), "advice": advice(status),
            "warnings": warnings(status),
        }  # fmt: skip


def headline(status: Mapping[str, Any], problem: str) -> tuple[bool, str]:
    """State in one line, and whether it is well."""
    if not status:
        return False, f"companion does not answer: {problem}"
    tracker = str(status.get("tracker", ""))
    blind = _is_blind(status)  # then what was tracked last says nothing about now
    parts = ["No pictures come" if blind else WORDS.get(tracker, tracker.capitalize())]
    feedback = status.get("feedback") or {}
    good = tracker in ("tracking", "standing") and not blind
    if feedback.get("mode", "off") == "off":
        parts.append("poses are not sent (feedback.mode is off)")
    elif feedback.get("sending"):
        parts.append(f"{feedback.get('rate_hz') or 0:.0f} poses a second go to the autopilot")
    else:
        good = False
        parts.append("no pose is sent" if blind else f"no pose is sent: {_why_not(feedback)}")
    for each in status.get("sources") or ():
        if each.get("state") != "running":
            good = False
            parts.append(f"{each.get('name')} {each.get('state')}")
    return good, ", ".join(parts) + "."


def advice(status: Mapping[str, Any]) -> str:
    """Advice on why no pose is sent; "" where one is, or none is wanted."""
    feedback = status.get("feedback") or {}
    if not status or feedback.get("mode", "off") == "off" or feedback.get("sending"):
        return ""
    why = "no frames" if _is_blind(status) else feedback.get("why_not") or "no pose yet"
    return OF_REASON.get(why, OTHER)


def rows(status: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and values of the state, the most important first."""
    if not status:
        return []
    load, feedback = status.get("load") or {}, status.get("feedback") or {}
    quality = -1 if _is_blind(status) else status.get("quality") or -1
    out = [
        ("Motors", "armed" if status.get("armed") else "disarmed"),
        ("Quality", f"{quality} of 100" if quality > 0 else "none"),
        ("Scale", str(status.get("scale") or "not known yet")),
        ("Pose age", _number(status.get("pose_latency_p95_ms"), " ms (p95)")),
    ]  # fmt: skip
    if feedback.get("sending"):
        out.append(("Sent", f"{feedback['rate_hz']:.0f}/s, {feedback.get('n_resets', 0)} resets"))
    for name in ("camera", "autopilot"):
        found = source(status, name)
        if found:
            rate = f", {found['rate_hz']:.0f}/s" if found.get("rate_hz") else ""
            out.append((f"{name.capitalize()}", f"{found.get('state')}{rate}"))
    out += [
        ("Processor", _number(_times(load.get("cpu_share"), 100), " %")),
        ("Memory", _number(_times(load.get("memory_share"), 100), " %")),
        ("Temperature", _number(load.get("temperature_c"), " °C")),
        ("Disk free", _number(_times(load.get("disk_free_mib"), 1 / 1024), " GiB", 1)),
        ("Reduced", str(status.get("degraded") or "nothing")),
        ("Flight", str(status.get("flight") or "not kept before arming")),
    ]  # fmt: skip
    return out


def warnings(status: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Recent warnings with what to do, the newest first."""
    return [
        {**each, "remedy": remedy(each["what"]), "ago": ago(each["age_s"])}
        for each in status.get("warnings") or ()
        if each["age_s"] < RECENT_S and not each["good"]
    ]


def ago(age_s: float) -> str:
    """Age in words."""
    if age_s < 90:
        return f"{max(age_s, 0):.0f} s ago"
    return f"{age_s / 60:.0f} min ago"


def _is_blind(status: Mapping[str, Any]) -> bool:
    """True while the camera gives nothing."""
    return bool(source(status, "camera").get("state", "running") != "running")


def _why_not(feedback: Mapping[str, Any]) -> str:
    return str(feedback.get("why_not") or "not yet")


def _number(value: Any, unit: str, digits: int = 0) -> str:
    return "unknown" if value is None else f"{value:.{digits}f}{unit}"


def _times(value: Any, factor: float) -> Any:
    return None if value is None else value * factor
