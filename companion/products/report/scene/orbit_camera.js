// Camera that turns about a target. World: north, east, down (x, y, z); angles in radians.
"use strict";

const FIELD_OF_VIEW = Math.PI / 4; // of the height
const STEEPEST = Math.PI / 2;

class OrbitCamera {
  constructor(target, distance, heading, pitch) {
    this.start = { target: [...target], distance, heading, pitch };
    this.reset();
  }

  reset() {
    this.target = [...this.start.target];
    this.distance = this.start.distance;
    this.heading = this.start.heading;
    this.pitch = this.start.pitch;
  }

  look(heading, pitch) {
    this.reset();
    this.heading = heading;
    this.pitch = pitch;
  }

  // Unit vectors to the right, up and ahead.
  axes() {
    const [sh, ch] = [Math.sin(this.heading), Math.cos(this.heading)];
    const [sp, cp] = [Math.sin(this.pitch), Math.cos(this.pitch)];
    return {
      right: [-sh, ch, 0],
      up: [ch * sp, sh * sp, -cp],
      ahead: [ch * cp, sh * cp, sp],
    };
  }

  turn(right_rad, down_rad) {
    this.heading -= right_rad;
    this.pitch = Math.min(Math.max(this.pitch + down_rad, -STEEPEST), STEEPEST);
  }

  // The scene follows a shift in pixels.
  shift(right_px, down_px, height_px) {
    const { right, up } = this.axes();
    const unit = this.distance / focal(height_px);
    for (let i = 0; i < 3; i++)
      this.target[i] += unit * (up[i] * down_px - right[i] * right_px);
  }

  // Closer by a factor; what lies at a place in pixels from the middle stays there.
  zoom(factor, right_px, down_px, height_px) {
    const least = this.start.distance / 2000, most = this.start.distance * 20;
    const kept = Math.min(Math.max(factor, least / this.distance), most / this.distance);
    this.shift(right_px * (kept - 1), down_px * (kept - 1), height_px);
    this.distance *= kept;
  }

  // Clip coordinates from the world, by columns, for pixels that are square.
  matrix(width, height) {
    const { right, up, ahead } = this.axes();
    const eye = this.target.map((v, i) => v - this.distance * ahead[i]);
    const reach = this.start.distance;
    const near = this.distance / 200;
    const far = this.distance + 12 * reach;
    const f = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const dot = (a) => a[0] * eye[0] + a[1] * eye[1] + a[2] * eye[2];
    const x = right.map((v) => (v * f * height) / width);
    const y = up.map((v) => v * f);
    const [a, b] = [(far + near) / (far - near), (-2 * far * near) / (far - near)];
    const [dx, dy, dz] = [dot(x), dot(y), dot(ahead)];
    return [
      x[0], y[0], a * ahead[0], ahead[0],
      x[1], y[1], a * ahead[1], ahead[1],
      x[2], y[2], a * ahead[2], ahead[2],
      -dx, -dy, b - a * dz, -dz,
    ];
  }
}

// Focal length in pixels.
function focal(height_px) {
  return height_px / 2 / Math.tan(FIELD_OF_VIEW / 2);
}

// Place in pixels from the upper left corner, and depth, of a point; null behind the camera.
function projected(matrix, [x, y, z], width, height) {
  const row = (i) => matrix[i] * x + matrix[4 + i] * y + matrix[8 + i] * z + matrix[12 + i];
  const w = row(3);
  if (w <= 0) return null;
  return { x: (0.5 + (0.5 * row(0)) / w) * width, y: (0.5 - (0.5 * row(1)) / w) * height, depth: w };
}
