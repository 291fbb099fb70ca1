"""The path of a flight, thinned, as a mission: QGroundControl's .plan, or the .waypoints of others.

Heights are above mean sea level, as the origin of the flight has them.
"""

from __future__ import annotations

import json
from typing import Any

from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned
from companion.geometry.transforms import Array

NAV_WAYPOINT, GLOBAL_FRAME = 16, 0
"""MAV_CMD_NAV_WAYPOINT, and MAV_FRAME_GLOBAL: heights above sea level."""
ABOVE_SEA = 2
"""QGroundControl's AltitudeMode of such heights."""
QUADROTOR, ANY_AUTOPILOT = 2, 0
"""MAV_TYPE_QUADROTOR, MAV_AUTOPILOT_GENERIC."""
SPEED_M_S = 5.0
"""Of QGroundControl's estimate of the time; the autopilot flies at its own."""


def mission_plan(places_ned_m: Array, origin: GeoOrigin) -> bytes:
    """QGroundControl's .plan, version 1: a waypoint for each place (N, 3)."""
    places = _places(places_ned_m, origin)
    items = [
        {
            "AMSLAltAboveTerrain": None, "Altitude": height, "AltitudeMode": ABOVE_SEA,
            "autoContinue": True, "command": NAV_WAYPOINT, "doJumpId": n, "frame": GLOBAL_FRAME,
            "params": [0, 0, 0, None, lat, lon, height], "type": "SimpleItem",
        }
        for n, (lat, lon, height) in enumerate(places, 1)
    ]  # fmt: skip
    plan: dict[str, Any] = {
        "fileType": "Plan", "version": 1, "groundStation": "companion",
        "geoFence": {"circles": [], "polygons": [], "version": 2},
        "rallyPoints": {"points": [], "version": 2},
        "mission": {
            "version": 2, "items": items, "plannedHomePosition": places[0],
            "vehicleType": QUADROTOR, "firmwareType": ANY_AUTOPILOT,
            "cruiseSpeed": SPEED_M_S, "hoverSpeed": SPEED_M_S,
            "globalPlanAltitudeMode": ABOVE_SEA,
        },
    }  # fmt: skip
    return (json.dumps(plan, indent=2) + "\n").encode()


def mission_waypoints(places_ned_m: Array, origin: GeoOrigin) -> bytes:
    """QGC WPL 110, as Mission Planner and MAVProxy read it: home first, then a waypoint each."""
    places = _places(places_ned_m, origin)
    lines = ["QGC WPL 110"]
    for n, (lat, lon, height) in enumerate([places[0], *places]):
        columns = [n, int(n == 0), GLOBAL_FRAME, NAV_WAYPOINT, 0, 0, 0, 0]
        words = [*map(str, columns), f"{lat:.8f}", f"{lon:.8f}", f"{height:.3f}", "1"]
        lines.append("\t".join(words))
    return ("\n".join(lines) + "\n").encode()


def _places(places_ned_m: Array, origin: GeoOrigin) -> list[list[float]]:
    """Latitude, longitude and height of places; to a centimetre, and a millimetre."""
    return [
        [round(lat, 8), round(lon, 8), round(height, 3)]
        for lat, lon, height in geodetic_from_ned(places_ned_m, origin).tolist()
    ]
