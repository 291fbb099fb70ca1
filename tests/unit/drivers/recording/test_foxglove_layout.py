"""The layout for Foxglove names what a recording has, and shows each of its panels."""

from __future__ import annotations

import json
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

from companion.messages import Odometry, TrackState
from drivers.recording.mcap_writer import McapWriter
from drivers.recording.recording_codec import odometry_bytes
from drivers.recording.recording_topics import (
    CALIBRATION,
    CLOUD,
    EVENTS,
    IMAGE,
    ODOMETRY,
    POSE,
    open_channels,
)

LAYOUT = Path(__file__).parents[4] / "config/foxglove_layout.json"


def panels(node: Any) -> list[str]:
    """Panels of a part of the layout."""
    return [node] if isinstance(node, str) else panels(node["first"]) + panels(node["second"])


def test_each_panel_is_shown_once() -> None:
    told = json.loads(LAYOUT.read_text("utf-8"))
    assert sorted(panels(told["layout"])) == sorted(told["configById"])


def test_what_it_shows_is_recorded() -> None:
    told = json.loads(LAYOUT.read_text("utf-8"))["configById"]
    assert set(told["3D!companion_map"]["topics"]) == {CLOUD, POSE}
    image = told["Image!companion_camera"]["imageMode"]
    assert (image["imageTopic"], image["calibrationTopic"]) == (IMAGE, CALIBRATION)
    assert told["RosOut!companion_events"]["topicToRender"] == EVENTS
    fields = json.loads(odometry_bytes(Odometry(0, 0, TrackState.LOST, 0)))
    paths = [each["value"] for panel in told.values() for each in panel.get("paths", ())]
    assert paths
    for path in paths:
        topic, _, name = path.partition(".")
        assert topic == ODOMETRY and name in fields


def refused(schema: Any) -> list[Any]:
    """What Foxglove refuses of a JSON schema, as its reader does."""
    if schema.get("type") == "array":
        item = schema.get("items", {})
        return [schema] if item.get("type") == "array" else refused(item)
    if schema.get("type") == "object" and "properties" in schema:
        return [each for inside in schema["properties"].values() for each in refused(inside)]
    return [] if schema.get("type") in ("boolean", "string", "number", "integer") else [schema]


def test_the_schemas_of_its_topics_are_ones_that_it_reads() -> None:
    data = bytearray()
    writer = McapWriter(data.extend, "")
    open_channels(writer)
    writer.finish()
    summary = make_reader(BytesIO(data)).get_summary()
    assert summary is not None
    schemas = summary.schemas.values()
    told = [json.loads(each.data) for each in schemas if each.encoding == "jsonschema"]
    assert len(told) > 10
    assert [each for schema in told for each in refused(schema)] == []
