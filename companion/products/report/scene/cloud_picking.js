// The point under the pointer, and where it is on Earth.
"use strict";

const REACH_PX = 8;
const SAME_DEPTH = 1.01; // points so much farther than the nearest still count as of its surface

// Index of the point nearest to a place in pixels, of those in front; -1 where there is none.
function picked(steps, n, step_m, matrix, at_px, width, height) {
  const m = matrix, found = [];
  let nearest = Infinity;
  for (let i = 0; i < n; i++) {
    const x = steps[3 * i] * step_m, y = steps[3 * i + 1] * step_m, z = steps[3 * i + 2] * step_m;
    const w = m[3] * x + m[7] * y + m[11] * z + m[15];
    if (w <= 0) continue;
    const dx = (0.5 + (0.5 * (m[0] * x + m[4] * y + m[8] * z + m[12])) / w) * width - at_px[0];
    if (dx > REACH_PX || dx < -REACH_PX) continue;
    const dy = (0.5 - (0.5 * (m[1] * x + m[5] * y + m[9] * z + m[13])) / w) * height - at_px[1];
    if (dx * dx + dy * dy > REACH_PX * REACH_PX) continue;
    found.push([i, w, dx * dx + dy * dy]);
    nearest = Math.min(nearest, w);
  }
  let best = -1, least = Infinity;
  for (const [i, w, apart] of found)
    if (w <= nearest * SAME_DEPTH && apart < least) [best, least] = [i, apart];
  return best;
}

// Latitude and longitude in degrees, altitude in metres of a place in local NED (Bowring 1976).
// `earth`: Earth-centred coordinates of the local zero, and the axes north, east, down as rows.
function geodetic([north, east, down], earth) {
  const a = 6378137, f = 1 / 298.257223563, e2 = f * (2 - f), b = a * (1 - f);
  const [x, y, z] = earth.zero.map(
    (v, i) => v + north * earth.axes[i] + east * earth.axes[3 + i] + down * earth.axes[6 + i],
  );
  const level = Math.hypot(x, y);
  let reduced = Math.atan2(z, level * (1 - f)), latitude = 0;
  for (let k = 0; k < 3; k++) {
    latitude = Math.atan2(
      z + (e2 / (1 - e2)) * b * Math.sin(reduced) ** 3,
      level - e2 * a * Math.cos(reduced) ** 3,
    );
    reduced = Math.atan2((1 - f) * Math.sin(latitude), Math.cos(latitude));
  }
  const sine = Math.sin(latitude);
  const altitude = level * Math.cos(latitude) + z * sine - a * Math.sqrt(1 - e2 * sine * sine);
  return [latitude, Math.atan2(y, x)].map((v) => (v * 180) / Math.PI).concat(altitude);
}
