"""`companion devices`: cameras, serial ports and OpenCL devices of this machine."""

from __future__ import annotations

import dataclasses
import json
from itertools import groupby
from typing import Any

from companion.compute.compute_devices import remeasured_devices, unwritable_cache
from companion.dense.device_choice import MeasuredDevice, in_order, why_taken
from companion.dense.opencl import WANT
from drivers.camera.camera_devices import CameraControl, CameraDevice, CameraFormat, cameras
from drivers.system.serial_devices import SerialDevice, serial_devices


def devices(as_json: bool, verbose: bool = False) -> str:
    """Cameras, serial ports and OpenCL devices, as text for people or as JSON."""
    found_cameras, found_ports, compute = cameras(), serial_devices(), remeasured_devices()
    if as_json:
        document = {
            "cameras": [dataclasses.asdict(each) for each in found_cameras],
            "serial_ports": [dataclasses.asdict(each) for each in found_ports],
            **_as_document(compute),
        }
        return _as_json(document)
    lines = ["Cameras (camera.device)"]
    for camera in found_cameras:
        lines += _camera(camera)
    if not found_cameras:
        lines.append("  none")
    lines.append('Serial ports (link.url = "serial:PORT:auto")')
    for port in found_ports:
        lines += _port(port)
    if not found_ports:
        lines.append("  none")
    return "\n".join([*lines, *opencl_lines(compute, verbose)])


def opencl_devices(as_json: bool, verbose: bool) -> tuple[str, bool]:
    """OpenCL devices only, and whether one of them works."""
    compute = remeasured_devices()
    works = bool(in_order(compute))
    if as_json:
        return _as_json(_as_document(compute)), works
    return "\n".join(opencl_lines(compute, verbose)), works


def _as_document(compute: list[MeasuredDevice]) -> dict[str, Any]:
    taken = in_order(compute)[:1]
    return {
        "opencl_devices": [dataclasses.asdict(device) for device in compute],
        "opencl_auto": {"number": taken[0].number, "why": why_taken(taken[0], compute)}
        if taken else None,
    }  # fmt: skip


def _as_json(document: dict[str, Any]) -> str:
    return json.dumps(document, indent=2, ensure_ascii=False)


def opencl_lines(compute: list[MeasuredDevice], verbose: bool) -> list[str]:
    """Each device with its speed or its problem, and the one selected."""
    lines = ["OpenCL devices (opencl.device)"]
    for device in compute:
        speed = device.problem or f"{device.frames_per_s:.0f} frames/s of 640 x 480"
        lines.append(f"  {device.number}  {device.named}: {speed}")
        if verbose:
            said = [device.driver, *device.detail.splitlines()]
            lines += [f"       {line}" for line in said if line.strip()]
    taken = in_order(compute)[:1]
    if not compute:
        lines.append(f"  none: {WANT}{unwritable_cache()}")
    elif not taken:
        lines.append("  auto takes none of them")
    else:
        why = why_taken(taken[0], compute).partition(": ")[0]
        lines.append(f"  auto takes {taken[0].number}: {why}")
    return lines


def _camera(camera: CameraDevice) -> list[str]:
    lines = [f"  {camera.stable_path or camera.path}"]
    about = [camera.name, camera.path if camera.stable_path else "", camera.driver, camera.bus]
    if any(about):
        lines.append("    " + ", ".join(part for part in about if part))
    if camera.problem:
        lines.append(f"    {camera.problem}")
    for code, formats in groupby(camera.formats, key=lambda each: each.code):
        lines.append(f"    {code}  " + "; ".join(_format(each) for each in formats))
    lines += [f"    {_control(control)}" for control in camera.controls]
    return lines


def _format(form: CameraFormat) -> str:
    rates = ", ".join(f"{rate:g}" for rate in form.rates_hz)
    return f"{form.width} x {form.height}" + (f" at {rates}/s" if rates else "")


def _control(control: CameraControl) -> str:
    value = "?" if control.value is None else str(control.value)
    if control.choices:
        known = ", ".join(f"{number} {name}" for number, name in control.choices.items())
        return f"{control.name} = {value} of: {known}; default {control.default}"
    step = f" in steps of {control.step}" if control.step > 1 else ""
    limits = f"{control.minimum} to {control.maximum}{step}"
    return f"{control.name} = {value}, {limits}, default {control.default}"


def _port(port: SerialDevice) -> list[str]:
    about = [port.name, port.path if port.stable_path else "", port.usb_id]
    text = ", ".join(part for part in about if part and part != port.path)
    shown = port.stable_path or port.path
    lines = [f"  {shown}" + (f"  {text}" if text else "")]
    return [*lines, f"    {port.problem}"] if port.problem else lines
