"""Fuzzing of topic decoders: decoded, or refused with a StreamError."""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.config import Config
from companion.daemon.nodes.kept_chunks import NAME, KeptChunks
from companion.dense.depth_stage import DepthStage
from companion.errors import StreamError
from companion.messages import Message
from companion.timing.clock import StageTimes
from companion.topics.camera_fields import camera_fields, camera_of
from companion.topics.envelope import LENGTH, Envelope, unpack
from companion.topics.keyframe_bundle import MapMirror, bundle_of, frame_of
from companion.topics.message_codec import cloud_envelope, cloud_of_envelope
from tests.support.flights import flown, topic_flight
from tests.support.reference import opencl_devices

N = 400
NASTY: list[Any] = [
    None, True, -1, 0, 2**40, -(2**70), 1e300, "", "x" * 500, [], [[]], {}, [1, 2, 3], "<f4",
]  # fmt: skip

KINDS: dict[str, tuple[Envelope, Callable[[Envelope], object]]] = {
    "cloud": (cloud_envelope("f", flown.chunk(2, 30), flown.update()), cloud_of_envelope),
    "bundle": (unpack(topic_flight.bundles(8)[1].pack()), bundle_of),
    "flight": (
        Envelope("flight", {"camera": camera_fields(topic_flight.CAMERA)}, {}),
        lambda envelope: camera_of(envelope.part("camera")),
    ),
}


def damaged(data: bytes, luck: random.Random) -> bytes:
    """Bytes with some of them others, missing or doubled."""
    out = bytearray(data)
    head = LENGTH.size + LENGTH.unpack_from(data)[0]
    for _ in range(luck.randint(1, 8)):
        what, at = luck.random(), luck.randrange(luck.choice([head, len(out)]))
        at = min(at, len(out) - 1)
        if what < 0.6:
            out[at] = luck.randrange(256)
        elif what < 0.8:
            del out[at : at + luck.randint(1, 40)]
        else:
            out[at:at] = out[at : at + luck.randint(1, 40)]
    return bytes(out)


def twisted(data: bytes, luck: random.Random) -> bytes:
    """Well-formed bytes whose fields, or numbers in arrays, are others."""
    (length,) = LENGTH.unpack_from(data)
    head = json.loads(data[LENGTH.size : LENGTH.size + length])
    body = bytearray(data[LENGTH.size + length :])
    for _ in range(luck.randint(0, 2)):
        where = luck.choice([head, *(v for v in head.values() if isinstance(v, dict))])
        name = luck.choice([*where, "more"])
        where[name] = copy.deepcopy(luck.choice(NASTY))
    for _ in range(luck.randint(0, 3)):
        if len(body) > 8:
            at = luck.randrange(len(body) - 8)
            odd = luck.choice([np.nan, np.inf, -1e300, 1e-300, 0.0])
            body[at : at + 8] = np.float64(odd).tobytes()
    text = json.dumps(head).encode()
    return LENGTH.pack(len(text)) + text + bytes(body)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("how", [damaged, twisted])
def test_nothing_but_a_stream_error_comes_of_it(
    kind: str, how: Callable[[bytes, random.Random], bytes]
) -> None:
    envelope, decode = KINDS[kind]
    data, luck = envelope.pack(), random.Random(f"{kind} {how.__name__}")
    n_refused = 0
    for _ in range(N):
        try:
            decode(unpack(how(data, luck)))
        except StreamError:
            n_refused += 1
    assert n_refused > N // 20


def test_noise_is_refused() -> None:
    luck = random.Random(3)
    for _ in range(N):
        with pytest.raises(StreamError):
            unpack(luck.randbytes(luck.randrange(300)))


def test_what_is_well_formed_but_wrong_does_not_bring_the_depth_stage_down() -> None:
    config, luck = Config(), random.Random(8)
    stage = DepthStage(
        config.depth, config.cloud, topic_flight.CAMERA, opencl_devices.devices(), StageTimes()
    )
    mirror = MapMirror()
    packed = [bundle.pack() for bundle in topic_flight.bundles(48)]
    n_taken = n_maps = 0
    for data in packed * 3:
        try:
            bundle = bundle_of(unpack(twisted(data, luck)))
            frames = [frame_of(picture, topic_flight.CAMERA) for picture in bundle.pictures]
        except StreamError:
            continue
        n_taken += 1
        told: list[Message] = [*frames, *bundle.tracks, *bundle.keyframes]
        for message in told:
            stage.step(message)
        if bundle.change is not None:
            n_maps += len(stage.step(mirror.take(bundle.change)))
    stage.flush()
    assert n_taken > 5 and n_maps > 0


def test_a_file_of_chunks_that_was_cut_off_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    kept = KeptChunks(tmp_path)
    for number in range(6):
        assert kept.put("f", flown.chunk(number, 40), "run", 3 * number)
    assert not kept.put("f", flown.chunk(2, 40), "run", 30)
    kept.close()
    path = tmp_path / NAME
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    again = KeptChunks(tmp_path)
    assert [k.chunk.keyframe_id for k in again.found] == [0, 1, 2, 3, 4]
    assert again.resume_after("run") == 1 and again.resume_after("another") == -1
    assert again.put("f", flown.chunk(5, 40), "run", 15)
    again.close()
    assert path.read_bytes() == whole
    luck = random.Random(4)
    for _ in range(50):
        path.write_bytes(damaged(whole, luck))
        KeptChunks(tmp_path).close()
