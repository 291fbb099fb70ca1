// The view in the page: pointer, touch and keys, labels, and the level of detail.
"use strict";

const PATH = [1.0, 0.69, 0.13], KEYFRAME = [0.35, 0.67, 1.0], RULER = [1.0, 0.93, 0.35];
const LEAST_POINTS = 20000;
const SLOW_MS = 34, FAST_MS = 20; // between pictures, while it moves
const REST_MS = 180; // so long after the last movement all points are drawn
const CLICK_PX = 5;

class CloudView {
  constructor(place, facts, data) {
    this.place = place;
    this.canvas = place.querySelector("canvas");
    const options = { antialias: false, alpha: false, powerPreference: "high-performance" };
    const gl = this.canvas.getContext("webgl2", options);
    if (!gl) throw new Error("no WebGL 2");
    this.facts = facts;
    this.steps = new Uint16Array(data.buffer, 0, 3 * facts.n);
    const colours = new Uint8Array(data.buffer, 6 * facts.n, 3 * facts.n);
    this.drawing = new CloudDrawing(gl, this.steps, colours, facts.step);
    const [low, high] = facts.around.map((corner) => this.local(corner));
    this.heights = [low[2], high[2]];
    const size = Math.max(Math.hypot(high[0] - low[0], high[1] - low[1], high[2] - low[2]), 1e-3);
    const middle = low.map((v, i) => (v + high[i]) / 2);
    const narrow = Math.max(1, (1.6 * this.canvas.clientHeight) / this.canvas.clientWidth);
    this.camera = new OrbitCamera(middle, 0.95 * size * narrow, ...facts.view);
    this.path = this.drawing.lines(facts.paths.flatMap((path) => this.segments(path)));
    this.keyframes = this.drawing.lines(
      facts.keyframes.flatMap((each) => this.frustum(each, 0.012 * size)),
    );
    this.shown = { path: true, keyframes: true, heights: false };
    this.marks = []; // { at, text } in the world, two at most
    this.budget = facts.n;
    this.moved_ms = -Infinity;
    this.due = false;
    this.listen();
    this.redraw();
  }

  local(world) {
    return world.map((v, i) => v - this.facts.low[i]);
  }

  segments(path) {
    const ends = [];
    for (let i = 0; i + 5 < path.length; i += 3)
      ends.push(...this.local(path.slice(i, i + 3)), ...this.local(path.slice(i + 3, i + 6)));
    return ends;
  }

  // The outline of a camera: `axes` are its right, down and forward in the world.
  frustum({ at, axes }, size) {
    const eye = this.local(at);
    const corner = (u, v) =>
      eye.map((e, i) => e + size * (0.8 * u * axes[i] + 0.6 * v * axes[3 + i] + axes[6 + i]));
    const corners = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
    return corners.flatMap((c, k) => [...eye, ...c, ...c, ...corners[(k + 1) % 4]]);
  }

  // --- drawing

  redraw(moving = false) {
    if (moving) this.moved_ms = performance.now();
    if (this.due) return;
    this.due = true;
    requestAnimationFrame((now) => this.draw(now));
  }

  draw(now) {
    this.due = false;
    const ratio = Math.min(window.devicePixelRatio || 1, 2), canvas = this.canvas;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    const [w, h] = [width, height].map((v) => Math.round(v * ratio));
    if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
    const moving = now - this.moved_ms < REST_MS;
    this.adapt(now, moving);
    const n = moving ? this.budget : this.facts.n;
    this.matrix = this.camera.matrix(width, height);
    // points left out are made up for by the size of the others
    const spacing = this.facts.spacing * Math.sqrt(this.facts.n / n);
    const lines = [];
    const add = (found, colour, width_px) =>
      found.n && lines.push({ ...found, colour, width_px: width_px * ratio });
    if (this.shown.keyframes) add(this.keyframes, KEYFRAME, 1.2);
    if (this.shown.path) add(this.path, PATH, 2.4);
    if (this.ruler) add(this.ruler, RULER, 2);
    this.drawing.draw(
      this.matrix, n, 2.0 * spacing * focal(h), this.heights, this.shown.heights, lines,
    );
    this.label(width, height);
    if (moving) this.redraw();
  }

  // As many points while it moves as can be drawn 30 times a second.
  adapt(now, moving) {
    const took_ms = now - this.drawn_ms;
    this.drawn_ms = moving ? now : NaN;
    if (took_ms > SLOW_MS) this.budget *= Math.max(0.3, SLOW_MS / took_ms);
    if (took_ms < FAST_MS) this.budget *= 1.15;
    this.budget = Math.round(Math.min(Math.max(this.budget, LEAST_POINTS), this.facts.n));
  }

  label(width, height) {
    const { right, up } = this.camera.axes();
    for (const [name, i, sign] of [["north", 0, 1], ["east", 1, 1], ["up", 2, -1]]) {
      const [x, y] = [sign * right[i] * 26, -sign * up[i] * 26];
      const axis = this.place.querySelector(`.axis-${name}`);
      axis.querySelector("line").setAttribute("x2", x);
      axis.querySelector("line").setAttribute("y2", y);
      axis.querySelector("text").setAttribute("x", 1.36 * x);
      axis.querySelector("text").setAttribute("y", 1.36 * y);
    }
    const px_per_unit = focal(height) / this.camera.distance;
    const most = 160 / px_per_unit, power = 10 ** Math.floor(Math.log10(most));
    const length = [5, 2, 1].find((k) => k * power <= most) * power;
    const bar = this.place.querySelector(".scene-bar");
    bar.querySelector("div").style.width = `${length * px_per_unit}px`;
    bar.querySelector("span").textContent = `${+length.toPrecision(1)} ${this.facts.unit}`;
    this.place.querySelectorAll(".scene-mark").forEach((mark, k) => {
      const there = this.marks[k] && projected(this.matrix, this.marks[k].at, width, height);
      mark.hidden = !there;
      if (there) mark.style.transform = `translate(${there.x}px, ${there.y}px)`;
    });
  }

  // --- coordinates and distances

  pick(x, y) {
    const { n, step, low } = this.facts;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    let at, text;
    const near = this.shown.keyframes && this.keyframe_at(x, y, width, height);
    if (near) {
      at = this.local(near.at);
      const when = near.t_s === null ? "" : ` at ${near.t_s.toFixed(1)} s`;
      text = `keyframe ${near.id}${when}: ${this.coordinates(near.at)}`;
    } else {
      const i = picked(this.steps, n, step, this.matrix, [x, y], width, height);
      if (i < 0) return this.say("no point there");
      at = [0, 1, 2].map((k) => this.steps[3 * i + k] * step);
      text = this.coordinates(at.map((v, k) => v + low[k]));
    }
    if (this.marks.length === 2) this.marks.length = 0;
    this.marks.push({ at, text });
    const [a, b] = this.marks;
    this.ruler = b && this.drawing.lines([...a.at, ...b.at]);
    this.say(...this.marks.map((mark, k) => `${k + 1}   ${mark.text}`), ...(b ? [this.between(a, b)] : []));
    this.redraw();
  }

  keyframe_at(x, y, width, height) {
    let best = null, least = 7;
    for (const each of this.facts.keyframes) {
      const there = projected(this.matrix, this.local(each.at), width, height);
      const apart = there ? Math.hypot(there.x - x, there.y - y) : Infinity;
      if (apart < least) [best, least] = [each, apart];
    }
    return best;
  }

  coordinates(world) {
    const [x, y, z] = world.map((v) => v.toFixed(2));
    if (this.facts.unit !== "m") return `x ${x}, y ${y}, z ${z} map units`;
    const local = `north ${x} m, east ${y} m, down ${z} m`;
    if (!this.facts.earth) return local;
    const [latitude, longitude, altitude] = geodetic(world, this.facts.earth);
    return `${local}; ${latitude.toFixed(7)}°, ${longitude.toFixed(7)}°, ${altitude.toFixed(2)} m`;
  }

  between(a, b) {
    const [x, y, z] = b.at.map((v, i) => v - a.at[i]);
    const unit = this.facts.unit, length = Math.hypot(x, y, z).toFixed(2);
    if (unit !== "m") return `distance ${length} map units`;
    const rise = `${z > 0 ? "-" : "+"}${Math.abs(z).toFixed(2)}`;
    return `distance ${length} m: level ${Math.hypot(x, y).toFixed(2)} m, height ${rise} m`;
  }

  clear() {
    this.marks.length = 0;
    this.ruler = undefined;
    this.say();
    this.redraw();
  }

  say(...lines) {
    this.place.querySelector(".scene-said").textContent = lines.join("\n");
  }

  // --- input

  listen() {
    const canvas = this.canvas, pointers = new Map();
    let gone_px = 0, spread = null;
    const here = (event) => {
      const box = canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, here(event));
      if (pointers.size === 1) gone_px = 0;
      spread = null;
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const now = here(event);
      pointers.set(event.pointerId, now);
      const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
      gone_px += Math.hypot(dx, dy);
      if (pointers.size === 2) {
        const [[ax, ay], [bx, by]] = [...pointers.values()];
        const wide = Math.hypot(ax - bx, ay - by);
        this.camera.shift(dx / 2, dy / 2, canvas.clientHeight);
        if (spread) this.zoom(spread / Math.max(wide, 1), (ax + bx) / 2, (ay + by) / 2);
        spread = wide;
      } else if (event.buttons & 6 || event.shiftKey || event.ctrlKey) {
        this.camera.shift(dx, dy, canvas.clientHeight);
      } else {
        this.camera.turn(dx / 200, dy / 200);
      }
      this.redraw(true);
    });
    canvas.addEventListener("pointerup", (event) => {
      const alone = pointers.size === 1 && event.button === 0;
      if (pointers.delete(event.pointerId) && alone && gone_px < CLICK_PX) this.pick(...here(event));
      spread = null;
    });
    canvas.addEventListener("pointercancel", (event) => pointers.delete(event.pointerId));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    // the wheel scrolls the page until the view was chosen
    canvas.addEventListener(
      "wheel",
      (event) => {
        if (!this.place.contains(document.activeElement) && !document.fullscreenElement) return;
        event.preventDefault();
        const lines = event.deltaMode === 1 ? 30 : 1;
        this.zoom(Math.exp(Math.min(Math.max(event.deltaY * lines, -200), 200) / 600), ...here(event));
      },
      { passive: false },
    );
    canvas.addEventListener("dblclick", (event) => {
      this.clear();
      const i = picked(
        this.steps, this.facts.n, this.facts.step, this.matrix, here(event),
        canvas.clientWidth, canvas.clientHeight,
      );
      if (i >= 0) this.camera.target = [0, 1, 2].map((k) => this.steps[3 * i + k] * this.facts.step);
      this.redraw(true);
    });
    canvas.addEventListener("keydown", (event) => this.key(event));
    for (const button of this.place.querySelectorAll("button"))
      button.addEventListener("click", () => this.press(button));
    new ResizeObserver(() => this.redraw()).observe(canvas);
  }

  zoom(factor, x, y) {
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    this.camera.zoom(factor, x - width / 2, y - height / 2, height);
    this.redraw(true);
  }

  key(event) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const turns = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const turn = turns[event.key];
    if (event.altKey || event.ctrlKey || event.metaKey) return;
    if (turn && event.shiftKey) this.camera.shift(-24 * turn[0], -24 * turn[1], height);
    else if (turn) this.camera.turn(-0.08 * turn[0], -0.08 * turn[1]);
    else if (event.key === "+" || event.key === "=") this.zoom(1 / 1.15, width / 2, height / 2);
    else if (event.key === "-") this.zoom(1.15, width / 2, height / 2);
    else if (event.key === "Home") this.camera.reset();
    else if (event.key === "Enter") this.pick(width / 2, height / 2);
    else if (event.key === "Escape") this.clear();
    else return;
    event.preventDefault();
    this.redraw(true);
  }

  press(button) {
    const does = button.dataset.does;
    if (does === "above") this.camera.look(0, STEEPEST);
    else if (does === "side") this.camera.look(this.facts.view[0], 0.06);
    else if (does === "oblique") this.camera.reset();
    else if (does === "clear") this.clear();
    else if (does === "full") {
      if (document.fullscreenElement) document.exitFullscreen();
      else this.place.requestFullscreen();
    } else {
      this.shown[does] = !this.shown[does];
      button.setAttribute("aria-pressed", this.shown[does]);
    }
    this.redraw(true);
  }
}

(() => {
  const place = document.getElementById("scene");
  const text = (id) => document.getElementById(id).textContent;
  try {
    const data = Uint8Array.from(atob(text("scene-points").trim()), (c) => c.charCodeAt(0));
    place.hidden = false;
    place.view = new CloudView(place, JSON.parse(text("scene-facts")), data);
    document.getElementById("scene-without").hidden = true;
  } catch (error) {
    place.hidden = true;
    document.getElementById("scene-without").textContent =
      `The cloud cannot be turned in this browser (${error.message}); the pictures below show it.`;
  }
})();
