"""Ground with boxes, drawn by OpenGL on the processor: what a camera on a simulated vehicle sees.

    scene = Scene(seed=1, look="day", camera=camera)
    picture = scene.draw(world_from_camera, t_s)

The world is local NED; the ground is its plane z = 0, seamlessly repeated every GROUND_M. There are
three layers of texture, for distances from decimetres to tens of metres. Boxes stand around the
square in which a vehicle stands and lands, and no higher than BOX_MAX_M.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import Any

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes
from tests.firmware.boxes import boxes_of, triangles_of
from tests.firmware.ground_texture import grain_texture, ground_texture
from tests.firmware.landmarks import Landmarks
from tests.firmware.looks import LOOKS
from tests.firmware.sensor import Sensor

GROUND_M = 100.0
"""Of 4096 texels: 24 mm each, a pixel's size from 10 m."""
STONES_M, GRAIN_M = 6.13, 1.31
"""The same grain at 3 mm and 0.6 mm a texel: a pixel's size from 1.2 m and from 0.3 m. None is a
multiple of another, and they lie turned, so that what is seen at once never repeats."""
STONES_TURN = np.radians(23.0)
SEEN_M = 400.0
"""Half side of the plane that is drawn: beyond there is sky."""
NEAR_M, FAR_M = 0.02, 800.0
SKY = (0.72, 0.77, 0.82)
SUN_UP = np.radians(40.0)
"""Height of the sun, which stands in the south: shadows lie to the north."""
SUN_RAD = 0.0093
"""Width of the sun in the sky, which softens shadows."""
VEHICLE_M = 0.45
"""From the middle of the vehicle to the tip of its rotors; it is a cross with a disc."""

VERTEX = """
#version 330
uniform mat4 clip_from_world;
uniform vec3 strength;
uniform float drift;
uniform float light;
in vec3 place; in vec2 metres; in vec3 tint; in float is_ground;
out vec2 ground_at; out vec2 stones_at; out vec2 grain_at; out vec2 north_east;
flat out vec3 tinted; flat out vec3 strong;
uniform mat2 turn;
uniform vec3 sizes;
void main() {
    gl_Position = clip_from_world * vec4(place, 1.0);
    vec2 moved = vec2(drift, 0.6 * drift) * is_ground;
    ground_at = metres / sizes.x;
    stones_at = (turn * metres + moved) / sizes.y;
    grain_at = (metres - moved.yx) / sizes.z;
    north_east = place.xy;
    tinted = tint * light;
    strong = is_ground > 1.5 ? vec3(0.0) : mix(vec3(1.0), strength, is_ground);
}
"""
FRAGMENT = """
uniform sampler2D ground; uniform sampler2D grain;
uniform vec3 mean;
in vec2 ground_at; in vec2 stones_at; in vec2 grain_at; in vec2 north_east;
flat in vec3 tinted; flat in vec3 strong;
const float coarser = 0.4;  // of two sizes the nearer one is taken, which must not be too fine
layout(location = 0) out vec4 seen;
#ifdef SHADOW
uniform vec4 shadow;  // its middle, and the direction of an arm
uniform vec2 soft;    // half width of its edge, and the vehicle's size
float lit() {
    vec2 off = north_east - shadow.xy;
    vec2 arms = abs(vec2(dot(off, shadow.zw), dot(off, vec2(-shadow.w, shadow.z))));
    float along = max(arms.x, arms.y), across = min(arms.x, arms.y);
    float arm = max(along - 0.75 * soft.y, across - 0.06 * soft.y);
    float disc = length(off) - 0.35 * soft.y;
    float rotor = length(vec2(along - 0.7 * soft.y, across)) - 0.3 * soft.y;
    float inside = smoothstep(soft.x, -soft.x, min(arm, disc));
    return 1.0 - 0.6 * max(inside, 0.4 * smoothstep(soft.x, -soft.x, rotor));
}
#endif
void main() {
    vec3 colour = mix(mean, texture(ground, ground_at).rgb, strong.x) * tinted;
    float stones = 1.0 + strong.y * (1.3 * texture(grain, stones_at, coarser).r - 0.65);
    float fine = 1.0 + strong.z * (1.1 * texture(grain, grain_at, coarser).r - 0.55);
    colour *= stones * fine;
#ifdef SHADOW
    colour *= lit();
#endif
    seen = vec4(colour, 1.0);
}
"""


NONE = Landmarks()


class Scene:
    """See above. It is drawn by the thread that made it."""

    def __init__(
        self, seed: int, look: str, camera: Camera, photos: Path | None = None,
        landmarks: Landmarks = NONE,
    ) -> None:  # fmt: skip
        # one thread: a second would take the other core from what is tried
        os.environ.setdefault("LP_NUM_THREADS", "1")
        # by name: it is there in trials only
        moderngl: Any = importlib.import_module("moderngl")
        self._camera = camera
        self.look = LOOKS[look]
        self.boxes = [*boxes_of(seed), *landmarks.walls()]
        self._sensor = Sensor(camera, self.look, seed)
        self._gl: Any = moderngl.create_context(standalone=True, backend="egl")
        defines = "#version 330\n" + "#define SHADOW\n" * self.look.shadow
        self._program = self._gl.program(VERTEX.strip(), defines + FRAGMENT)
        shapes = _plane(), triangles_of(self.boxes, seed), landmarks.triangles()
        vertices = np.concatenate(shapes).astype("f4")
        self._shape = self._gl.vertex_array(
            self._program,
            [(self._gl.buffer(vertices.tobytes()), "3f 2f 3f 1f",
              "place", "metres", "tint", "is_ground")],
        )  # fmt: skip
        ground, grain = ground_texture(seed, photos), grain_texture(seed)
        for unit, pixels in enumerate((ground, grain)):
            parts = pixels.shape[2] if pixels.ndim == 3 else 1
            texture = self._gl.texture(pixels.shape[1::-1], parts, pixels.tobytes())
            texture.build_mipmaps()
            # of the grain only the nearer of two sizes: a fifth of the work, and nothing to be seen
            between = moderngl.LINEAR_MIPMAP_NEAREST if unit else moderngl.LINEAR_MIPMAP_LINEAR
            texture.filter = (between, moderngl.LINEAR)
            texture.use(unit)
        size = (camera.width, camera.height)
        self._target = self._gl.framebuffer(
            [self._gl.renderbuffer(size, 4)], self._gl.depth_renderbuffer(size)
        )
        self._target.use()
        self._gl.enable(moderngl.DEPTH_TEST)
        c, s = np.cos(STONES_TURN), np.sin(STONES_TURN)
        shown = self.look
        self._set(
            ground=0, grain=1, mean=shown.mean, turn=(c, s, -s, c), light=shown.light,
            strength=(shown.ground, shown.stones, shown.grain),
            sizes=(GROUND_M, STONES_M, GRAIN_M),
        )  # fmt: skip

    def draw(self, world_from_camera: Pose, t_s: float) -> Bytes:
        """RGB picture (H, W, 3) with the sensor's noise, of the camera at a place at a time."""
        return self._sensor.picture(self.seen(world_from_camera, t_s), world_from_camera, t_s)

    def seen(self, world_from_camera: Pose, t_s: float) -> Bytes:
        """RGB picture (H, W, 3) of a sensor without noise that moves not."""
        with self._gl:  # there may be other scenes
            return self._drawn(world_from_camera, t_s)

    def _drawn(self, world_from_camera: Pose, t_s: float) -> Bytes:
        camera_from_world = world_from_camera.inverse().matrix()
        clip = (_clip_from_camera(self._camera) @ camera_from_world).T.astype("f4")
        self._program["clip_from_world"].write(clip.tobytes())
        self._set(drift=(self.look.drift_m_s * t_s) % (STONES_M * GRAIN_M * 100))
        if self.look.shadow:
            self._throw_shadow(world_from_camera)
        self._gl.clear(*(min(1.0, part * self.look.light) for part in SKY))
        self._shape.render()
        pixels = np.frombuffer(self._target.read(components=3, alignment=1), np.uint8)
        # the first row is the lowest of OpenGL's picture, whose y is the camera's
        return pixels.reshape(self._camera.height, self._camera.width, 3)

    def _set(self, **uniforms: Any) -> None:
        for name, value in uniforms.items():
            if name in self._program:
                self._program[name].value = value

    def _throw_shadow(self, world_from_camera: Pose) -> None:
        north, east, down = world_from_camera.translation
        height = max(-down, 0.0)
        # the camera's right axis is level on a level vehicle, and arms stand at 45 degrees to it
        right = world_from_camera.rotation[:, 0]
        arm = np.arctan2(right[1], right[0]) + np.pi / 4
        away = height / np.tan(SUN_UP)
        soft = 0.01 + 0.5 * SUN_RAD * height / np.sin(SUN_UP)
        self._set(
            shadow=(north + away, east, np.cos(arm), np.sin(arm)), soft=(soft, VEHICLE_M)
        )  # fmt: skip


def _clip_from_camera(camera: Camera) -> Array:
    """Projection of the camera, without its distortion; whole numbers are pixels' middles."""
    w, h = camera.width, camera.height
    deep = FAR_M - NEAR_M
    return np.array([
        [2 * camera.fx / w, 0, (2 * camera.cx + 1) / w - 1, 0],
        [0, 2 * camera.fy / h, (2 * camera.cy + 1) / h - 1, 0],
        [0, 0, (FAR_M + NEAR_M) / deep, -2 * FAR_M * NEAR_M / deep],
        [0, 0, 1, 0],
    ])  # fmt: skip


def _plane() -> Array:
    """The ground as two triangles: place, metres on it, tint, 1 (6, 9)."""
    corners = SEEN_M * np.array([(-1, -1), (-1, 1), (1, 1), (-1, -1), (1, 1), (1, -1)])
    return np.hstack([corners, np.zeros((6, 1)), corners, np.ones((6, 4))])
