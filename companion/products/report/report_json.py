"""Numbers of a run, for programs and for the report's page."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from companion.messages import Track, TrackState
from companion.messages.run_facts import RunFacts
from companion.products.cloud import Cloud
from companion.products.flight_result import FlightResult, WorldPose
from companion.products.trajectory_file import exact_seconds


def report(
    result: FlightResult, facts: RunFacts, poses: Sequence[WorldPose], cloud: Cloud
) -> dict[str, Any]:
    """All numbers; lengths in `unit`, times in seconds, null for unknown values."""
    first, last = result.first_t_ns, result.last_t_ns
    duration_s = (last - first) * 1e-9 if first is not None and last is not None else 0.0
    spans = state_spans(result.tracks)
    return {
        "completed": facts.completed,
        "frames": result.n_frames,
        "frames_in_flight": facts.n_frames_total,
        "first_unix_s": exact_seconds(first) if first is not None else None,
        "duration_s": round(duration_s, 3),
        "tracked": len(poses),
        "tracked_share": round(len(poses) / result.n_frames, 4) if result.n_frames else 0.0,
        "tracked_afterwards": sum(track.backfilled for track in result.tracks),
        "segments": sum(span["state"] == TrackState.TRACKING.value for span in spans),
        "keyframes": result.n_keyframes,
        "reunions": [
            {
                "unix_s": exact_seconds(r.t_ns),
                "keyframe": r.keyframe_id,
                "same_as": r.other_id,
                "kind": "loop" if r.same_map else "weld",
                "moved": _finite(r.moved),
                "scale": _finite(r.scale),
            }
            for r in result.loop_closures
        ],
        "depth_maps": result.n_depth_maps,
        "points": len(cloud),
        "unit": result.unit,
        "path_length": round(path_length(poses), 3),
        **_scale(result),
        "clock": _clock(facts),
        "origin": None if facts.origin is None else asdict(facts.origin),
        "camera": _camera(facts),
        "speed": {
            "wall_s": round(facts.wall_s, 3),
            "frames_per_s": round(result.n_frames / facts.wall_s, 2) if facts.wall_s > 0 else None,
            "peak_memory_mb": round(facts.peak_memory_mb, 1),
        },
        "stages": {name: dict(times) for name, times in facts.stage_times.items()},
        "kernels": result.kernel_times(),
        "dropped": dict(facts.dropped),
        "refused": dict(result.refused),
        "believed": list(facts.believed),
        "rates_hz": {name: round(rate, 2) for name, rate in facts.rates_hz.items()},
        "states": dict(Counter(track.state.value for track in result.tracks)),
        "state_spans": spans,
        "warnings": [
            {"what": what, "count": warning.count, "first_detail": warning.first_detail}
            for what, warning in sorted(result.warnings.items(), key=lambda w: (-w[1].count, w[0]))
        ],
        "device": facts.device,
        "command": facts.command,
        "config": facts.config,
        "versions": dict(facts.versions),
    }


def report_json(numbers: dict[str, Any]) -> bytes:
    """The numbers as JSON; ValueError on nan and infinity, which JSON has not."""
    return (json.dumps(numbers, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()


def state_spans(tracks: Sequence[Track]) -> list[dict[str, Any]]:
    """Spans of one tracking state: seconds since the first frame, and number of frames."""
    spans: list[dict[str, Any]] = []
    for track in tracks:
        t_s = round((track.t_ns - tracks[0].t_ns) * 1e-9, 3)
        if spans and spans[-1]["state"] == track.state.value:
            spans[-1]["frames"] += 1
        else:
            spans.append({"state": track.state.value, "from_s": t_s, "to_s": t_s, "frames": 1})
        spans[-1]["to_s"] = t_s
    return spans


def path_length(poses: Sequence[WorldPose]) -> float:
    """Length of the path through all poses; gaps count as straight lines."""
    if len(poses) < 2:
        return 0.0
    places = np.stack([pose.world_from_camera.translation for pose in poses])
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def _scale(result: FlightResult) -> dict[str, Any]:
    georeference = result.georeference
    if georeference is None:
        return {"metres_per_unit": None, "scale": None}
    return {
        "metres_per_unit": float(georeference.world_from_map.scale),
        "scale": {
            "method": georeference.method,
            "sigma_relative": _finite(georeference.sigma_scale),
            "sigma_yaw_deg": _finite(float(np.degrees(georeference.sigma_yaw_rad))),
            "positions": georeference.n_positions,
            "residual_m": _finite(georeference.residual_m),
        },
    }


def _clock(facts: RunFacts) -> dict[str, Any] | None:
    if facts.clock is None:
        return None
    return {
        "method": facts.clock.method,
        "offset_s": round(facts.clock.offset_s, 6),
        "drift_ppm": round(facts.clock.drift_ppm, 3),
        "sigma_ms": _finite(facts.clock.sigma_ms),
        "reboots": facts.clock.n_reboots,
    }


def _camera(facts: RunFacts) -> dict[str, Any]:
    camera = facts.camera
    return {
        **camera.lens,
        "distortion": camera.distortion.value,
        "coefficients": list(camera.coefficients),
        "assumed": camera.assumed,
        "mounted": camera.body_from_camera is not None,
    }


def _finite(value: float) -> float | None:
    return round(float(value), 6) if np.isfinite(value) else None
