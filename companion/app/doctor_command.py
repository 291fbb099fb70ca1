"""`companion doctor`: parameters of the autopilot that keep it from using our pose.

Reads over the configured link, or through the router of a daemon that holds that link. With `write`
sets them, after confirmation, reads each back, examines again, and has them stored.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, TextIO

from companion.app.doctor_findings import (
    Examination,
    counted,
    document,
    print_findings,
    print_outcome,
)
from companion.config import Config, LinkConfig
from companion.doctor.imu_room import BITS_PER_BYTE, LOOP_RATE, check_loop_rate, imu_room
from companion.doctor.line_rate import check_line, line_parameters
from companion.doctor.pose_parameters import advise, names_to_read
from companion.doctor.wanted import ARDUPILOT, FIRMWARES, Finding
from companion.errors import ConfigError, InputError, SourceError
from drivers.mavlink.asking_link import asking_link
from drivers.mavlink.parameters import Parameters
from drivers.mavlink.wire.link_url import LOOPBACK, client_endpoint, link_endpoint
from drivers.system.login_console import login_console_on
from drivers.system.status_socket import ask_status, found_socket_path

PATIENCE_S, SEARCH_PATIENCE_S = 10.0, 25.0
"""The second where the baud rate must be detected."""
ROUNDS = 3
"""A parameter that is set may reveal others."""
ANY_ADDRESS = ("0.0.0.0", "::")
GOOD, IN_THE_WAY = 0, 1

Ask = Callable[[str], bool]


def doctor(
    config: Config,
    *,
    write: bool = False,
    yes: bool = False,
    only: Collection[str] = (),
    as_json: bool = False,
    out: TextIO | None = None,
    ask: Ask | None = None,
) -> int:
    """Examine, print, and set on request; 0 if nothing prevents use of the pose, else 1.

    With `only`, parameters of these names are set and no others.

    InputError for an impossible configuration or usage, SourceError without an autopilot.
    """
    out = sys.stdout if out is None else out
    ask = _ask_at_terminal if ask is None else ask
    if as_json and write and not yes:
        raise InputError("doctor: --json with --write asks nobody; add --yes")
    if not config.link.url:
        raise ConfigError(
            "link.url: is empty; it says where the autopilot is, as in "
            "--set link.url=serial:/dev/ttyACM0:auto"
        )
    where = link_endpoint(config.link.url)
    console = login_console_on(where.device) if where.kind == "serial" else None
    if console is not None:  # which, first of all, keeps the autopilot from being understood
        raise SourceError(console.what)
    daemon = _running_daemon(config)
    link = replace(config.link, url=_url_to_ask_at(config, daemon))
    decide: Ask = (lambda question: True) if yes else ask
    show = None if as_json else lambda examination: print_findings(examination, config, out)
    found = asyncio.run(_examine(config, link, daemon, decide if write else None, only, show))
    if as_json:
        print(json.dumps(document(found), ensure_ascii=False), file=out)
    else:
        print_outcome(found, write, out)
    return IN_THE_WAY if found.blocking else GOOD


async def _examine(
    config: Config,
    link_config: LinkConfig,
    daemon: Mapping[str, Any] | None,
    decide: Ask | None,
    only: Collection[str],
    show: Callable[[Examination], None] | None,
) -> Examination:
    latency_ms = _latency_ms(daemon)
    mode = "odometry" if config.feedback.mode == "off" else config.feedback.mode
    patience_s = SEARCH_PATIENCE_S if link_config.url.endswith(":auto") else PATIENCE_S
    async with asking_link(link_config, patience_s) as (link, vehicle, baud):
        firmware = vehicle.firmware
        if firmware not in FIRMWARES:
            raise SourceError(
                f"{link_config.url}: {vehicle} is neither ArduPilot nor PX4; nothing is known of "
                "its parameters"
            )
        parameters = Parameters(link)
        look = partial(_look, parameters, firmware, config, mode, latency_ms, baud)
        findings, n_examined = await look()
        comes = _heard_by(daemon) or _imu_to_be(config.link, baud, firmware)
        found = Examination(vehicle, link_config.url, mode, findings, n_examined, comes)
        if show is not None:
            show(found)
        if decide is None or not found.settable(only):
            return found
        if link.vehicle is not None and link.vehicle.armed:
            raise SourceError(f"{vehicle} is armed; nothing is set in flight")
        if not await asyncio.to_thread(decide, _question(found, only)):
            return found
        for _ in range(ROUNDS):
            for finding in found.settable(only):
                await _set(parameters, finding, found)
            found.findings, found.n_examined = await look()
            if not found.settable(only) or found.refused:
                break
        if found.written:
            try:
                await parameters.store()
            except SourceError as error:
                found.not_stored = f"{error}: leave it on for ten seconds before it is rebooted"
        return found


async def _look(
    parameters: Parameters, firmware: str, config: Config, mode: str, latency_ms: float | None,
    baud: int,
) -> tuple[list[Finding], int]:  # fmt: skip
    """Findings about the parameters as they are now, and the number of these."""
    ports = line_parameters(firmware) if baud > 0 else ()
    loop = (LOOP_RATE,) if firmware == ARDUPILOT else ()
    read = await parameters.read([*names_to_read(firmware), *ports, *loop])
    values = {name: each.value for name, each in read.items()}
    feedback, link = config.feedback, config.link
    findings = advise(firmware, values, feedback, mode, latency_ms, config.gps, config.landing)
    if baud:
        findings += check_line(firmware, values, link, feedback, mode, config.camera.rate_hz, baud)
    return findings + check_loop_rate(values, link), len(values)


async def _set(parameters: Parameters, finding: Finding, found: Examination) -> None:
    assert finding.set_to is not None
    try:
        now = await parameters.write(finding.name, finding.set_to)
    except SourceError as error:
        found.refused.append(str(error))
        return
    found.written.append(
        {
            "name": finding.name, "from": finding.value, "to": now.value,
            "reboot": finding.reboot,
        }
    )  # fmt: skip


def _question(found: Examination, only: Collection[str]) -> str:
    n = len(found.settable(only))
    return f"Set {counted(n, 'parameter')} of {found.vehicle}? [y/N] "


def _ask_at_terminal(question: str) -> bool:
    try:
        return input(question).strip().lower() in ("y", "yes")
    except EOFError:
        print()
        return False


# -- where to ask --------------------------------------------------------------------------------


def _running_daemon(config: Config) -> Mapping[str, Any] | None:
    """Status document of the daemon on this machine; None if there is none."""
    try:
        return ask_status(found_socket_path(config.daemon.socket))
    except SourceError:
        return None


def _url_to_ask_at(config: Config, daemon: Mapping[str, Any] | None) -> str:
    """The link itself, or an endpoint of the router where a daemon holds the link."""
    url = config.link.url
    if daemon is None or link_endpoint(url).kind not in ("serial", "udpin"):
        return url
    for client in map(client_endpoint, config.router.clients):
        if client.kind == "udpout":
            continue
        host = LOOPBACK if client.host in ANY_ADDRESS else client.host
        host = f"[{host}]" if ":" in host else host
        return f"{'tcp' if client.kind == 'tcpin' else 'udpout'}:{host}:{client.port}"
    raise SourceError(
        f"{url}: the daemon holds it; stop it, or give it a place for others, as in "
        'router.clients = ["tcpin::5760"]'
    )


def _latency_ms(daemon: Mapping[str, Any] | None) -> float | None:
    """Latency from exposure to sending, as measured by the daemon in flight."""
    feedback = (daemon or {}).get("feedback")
    latency = feedback.get("latency_p50_ms") if isinstance(feedback, Mapping) else None
    return float(latency) if isinstance(latency, (int, float)) else None


def _heard_by(daemon: Mapping[str, Any] | None) -> str:
    """Words of the running daemon about the autopilot; "" without one."""
    for source in (daemon or {}).get("sources") or ():
        if source.get("name") == "autopilot":
            return f"the daemon hears {source.get('detail') or source.get('state')}"
    return ""


def _imu_to_be(link: LinkConfig, baud: int, firmware: str) -> str:
    """Rate that the daemon will ask for, in words; "" where that is set by hand."""
    if link.imu_hz != "auto":
        return ""
    room = imu_room(link, baud / BITS_PER_BYTE if baud else None, firmware)
    if not room.rate_hz:
        return f"no IMU will be asked for: {room.why}"
    return f"IMU: {room.message} at {room.rate_hz:.0f} Hz will be asked for, less where less comes"
