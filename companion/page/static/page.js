// Refreshes parts of a view, draws the live picture and the map. Without it all forms still work.
"use strict";

const away = document.getElementById("away");

async function ask(path) {
  const answer = await fetch(path, { signal: AbortSignal.timeout(8000), credentials: "same-origin" });
  if (answer.status === 401) { location.reload(); }
  if (!answer.ok) { throw new Error(answer.status); }
  if (away) { away.hidden = true; }
  return answer;
}

// One question after the other: what is slow is asked less often.
function again(everyMs, work) {
  const next = async () => {
    let pauseMs = everyMs;
    if (!document.hidden) {
      const beganMs = performance.now();
      try { await work(); } catch (error) {
        if (away) { away.hidden = false; }
        pauseMs = Math.max(2000, everyMs);
      }
      pauseMs = Math.max(pauseMs, performance.now() - beganMs);
    }
    setTimeout(next, pauseMs);
  };
  next();
}

// A fragment is some elements with ids; those of the view with the same ids get their content, where
// it is another than before: what a reader has opened or filled in meanwhile stays.
for (const view of document.querySelectorAll("[data-fragment]")) {
  const previous = new Map();
  again(Number(view.dataset.every), async () => {
    const fresh = document.createElement("template");
    fresh.innerHTML = await (await ask(view.dataset.fragment)).text();
    const line = document.getElementById("line");
    const before = line && line.textContent;
    for (const part of fresh.content.children) {
      const shown = document.getElementById(part.id);
      if (!shown || (previous.get(part.id) ?? shown.innerHTML) === part.innerHTML) { continue; }
      previous.set(part.id, part.innerHTML);
      const focused = shown.contains(document.activeElement) && document.activeElement.getAttribute("href");
      shown.innerHTML = part.innerHTML;
      const same = focused && shown.querySelector(`[href="${focused}"]`);
      if (same) { same.focus(); }
    }
    tellChange(before);
  });
}

// A screen reader hears the state when its words change, not with each number.
const told = document.createElement("p");
told.className = "unseen";
told.setAttribute("role", "status");
document.body.append(told);
function tellChange(before) {
  const line = document.getElementById("line");
  const words = (text) => (text || "").replace(/[\d.]+/g, "");
  if (line && words(line.textContent) !== words(before)) { told.textContent = line.textContent; }
}

for (const form of document.forms) {
  form.addEventListener("submit", () => {
    const button = form.querySelector("button");
    if (!button) { return; }
    setTimeout(() => { button.disabled = true; }, 0);
    if (form.dataset.wait) { button.textContent = form.dataset.wait; form.setAttribute("aria-busy", "true"); }
  });
}

// What may be changed depends on the motors: the view is loaded anew when they are armed or
// disarmed, unless somebody is filling in a form, or has just gone to another view (which loading
// this one would take back; a download leaves as well, and stays).
let typed = false;
let left = -Infinity;
addEventListener("beforeunload", () => { left = performance.now(); });
document.addEventListener("input", (event) => { typed = typed || Boolean(event.target.form); });
if (document.body.dataset.armed) {
  again(2500, async () => {
    const armed = await (await ask("/now/armed")).text();
    if (armed === document.body.dataset.armed || performance.now() - left < 10000) { return; }
    if (!typed) { location.reload(); return; }
    document.body.dataset.armed = armed;
    for (const button of document.querySelectorAll("main form button")) { button.disabled = armed !== "false"; }
  });
}

// The keys that have all the words, in their names or texts; the others are hidden.
const find = document.getElementById("find");
if (find) {
  find.addEventListener("input", () => {
    const words = find.value.toLowerCase().split(/\s+/).filter(Boolean);
    for (const group of document.querySelectorAll("details.group")) {
      let n = 0;
      for (const field of group.querySelectorAll(".field")) {
        const has = words.every((word) => field.textContent.toLowerCase().includes(word));
        field.hidden = !has;
        n += has;
      }
      group.hidden = n === 0;
      group.open = words.length > 0 && n > 0;
    }
    for (const purpose of document.querySelectorAll(".purpose")) {
      purpose.hidden = !purpose.querySelector("details.group:not([hidden])");
    }
  });
}

// A link to a key opens the section that has it.
function openTarget() {
  const target = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  const closed = target && target.closest("details");
  if (closed) { closed.open = true; target.scrollIntoView(); target.focus(); }
}
window.addEventListener("hashchange", openTarget);
openTarget();

const restart = document.querySelector("[data-restart]");
if (restart) {
  setTimeout(() => again(1500, async () => {
    await ask("/now/panel");
    location.href = "/";
  }), 4000);
}

// -- the live picture ---------------------------------------------------------------------------

const picture = document.getElementById("picture");
if (picture) {
  const text = document.getElementById("picture-text");
  const focus = document.querySelector("[data-focus]");
  const context = picture.getContext("2d", { willReadFrequently: Boolean(focus) });
  let number = -1, best = 0, sinceMs = 0;
  const needed = "needed" in picture.dataset ? "&needed" : "";
  again(200, async () => {
    const answer = await ask(`/now/picture?after=${number}${needed}`);
    if (answer.status === 204) {
      if (performance.now() - sinceMs > 5000 && number >= 0) {
        text.textContent = "No new picture for some seconds: this is an old one.";
        picture.classList.add("old");
      }
      return;
    }
    const found = await answer.json();
    const image = new Image();
    image.src = `data:image/jpeg;base64,${found.jpeg}`;
    await image.decode();
    number = found.number;
    sinceMs = performance.now();
    picture.classList.remove("old");
    picture.width = image.naturalWidth;
    picture.height = image.naturalHeight;
    context.drawImage(image, 0, 0);
    if (focus) { judge(context, picture, focus); }
    context.strokeStyle = "#50e678";
    context.lineWidth = Math.max(1, picture.width / 400);
    const side = picture.width / 90;
    for (let i = 0; i + 1 < found.found.length; i += 2) {
      context.strokeRect(found.found[i] - side / 2, found.found[i + 1] - side / 2, side, side);
    }
    const words = found.n_found ? `${found.n_found} points are tracked` : "nothing is tracked";
    text.textContent = `${image.naturalWidth} × ${image.naturalHeight}, ${words}.`;
    picture.setAttribute("aria-label", `Live picture, ${words}`);
  });

  // Variance of the Laplacian of the middle: it is highest where the lens is sharp.
  function judge(context, canvas, out) {
    const w = canvas.width >> 1, h = canvas.height >> 1;
    const data = context.getImageData(w >> 1, h >> 1, w, h).data;
    const grey = new Float32Array(w * h);
    let sum = 0;
    for (let i = 0; i < w * h; i++) {
      grey[i] = 0.299 * data[4 * i] + 0.587 * data[4 * i + 1] + 0.114 * data[4 * i + 2];
      sum += grey[i];
    }
    let n = 0, mean = 0, squares = 0;
    for (let y = 1; y < h - 1; y++) {
      for (let x = 1; x < w - 1; x++) {
        const i = y * w + x;
        const edge = grey[i - 1] + grey[i + 1] + grey[i - w] + grey[i + w] - 4 * grey[i];
        n += 1; mean += edge; squares += edge * edge;
      }
    }
    const sharp = squares / n - (mean / n) ** 2;
    const light = sum / (w * h);
    best = Math.max(best * 0.999, sharp);
    const share = Math.round(100 * sharp / best);
    const lit = light < 40 ? "too dark" : light > 215 ? "too bright" : "good";
    out.textContent = `Sharpness ${share} % of the best so far (${sharp.toFixed(0)}). Turn the lens until it rises no more. `
      + `Light ${light.toFixed(0)} of 255: ${lit}.`;
  }
}

// -- the map from above -------------------------------------------------------------------------

const above = document.getElementById("above");
if (above) {
  const context = above.getContext("2d");
  const text = document.getElementById("above-text");
  let scene = null, zoom = 1, follows = false, scale = 1;
  let [north, east] = [0, 0];  // how far the view was moved, centimetres
  again(1000, async () => {
    scene = await (await ask("/now/above")).json();
    draw();
  });
  for (const button of document.querySelectorAll("[data-zoom]")) {
    button.addEventListener("click", () => {
      const factor = Number(button.dataset.zoom);
      if (!factor) { setFollows(false); }
      [zoom, north, east] = factor ? [zoom * factor, north, east] : [1, 0, 0];
      draw();
    });
  }
  const follow = document.querySelector("[data-follow]");
  function setFollows(wanted) {
    follows = wanted;
    follow.setAttribute("aria-pressed", follows);
    [north, east] = [0, 0];
    draw();
  }
  if (follow) {
    follow.addEventListener("click", () => setFollows(!follows));
    moveByHand();
  }

  // The map is dragged by one finger or the mouse, made larger by two or the wheel.
  function moveByHand() {
    const held = new Map();
    const apart = () => { const [a, b] = [...held.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
    above.style.touchAction = "none";
    above.addEventListener("pointerdown", (event) => {
      held.set(event.pointerId, { x: event.clientX, y: event.clientY });
      above.setPointerCapture(event.pointerId);
    });
    above.addEventListener("pointermove", (event) => {
      const was = held.get(event.pointerId);
      if (!was) { return; }
      const before = held.size === 2 ? apart() : 0;
      held.set(event.pointerId, { x: event.clientX, y: event.clientY });
      const ratio = above.width / above.clientWidth / held.size / scale;
      east -= (event.clientX - was.x) * ratio;
      north += (event.clientY - was.y) * ratio;
      if (before) { zoom *= apart() / before; }
      draw();
    });
    for (const end of ["pointerup", "pointercancel"]) {
      above.addEventListener(end, (event) => { held.delete(event.pointerId); });
    }
    above.addEventListener("wheel", (event) => {
      event.preventDefault();
      zoom *= Math.exp(-event.deltaY / 500);
      draw();
    }, { passive: false });
  }
  window.addEventListener("resize", draw);

  function draw() {
    if (!scene) { return; }
    const ratio = window.devicePixelRatio || 1;
    const box = above.getBoundingClientRect();
    above.width = Math.round(box.width * ratio);
    above.height = Math.round(box.width * 0.75 * ratio);
    const styles = getComputedStyle(document.documentElement);
    context.clearRect(0, 0, above.width, above.height);
    const lines = [...scene.path, ...scene.autopilot];
    let [n0, n1, e0, e1] = [Infinity, -Infinity, Infinity, -Infinity];
    const take = (n, e) => { n0 = Math.min(n0, n); n1 = Math.max(n1, n); e0 = Math.min(e0, e); e1 = Math.max(e1, e); };
    for (const line of lines) { for (let i = 0; i + 1 < line.length; i += 2) { take(line[i], line[i + 1]); } }
    const norths = [], easts = [];
    for (let i = 0; i + 2 < scene.points.length; i += 3) { norths.push(scene.points[i]); easts.push(scene.points[i + 1]); }
    if (norths.length > 20) {  // without stray points
      norths.sort((a, b) => a - b); easts.sort((a, b) => a - b);
      const low = Math.floor(norths.length * 0.02), high = Math.ceil(norths.length * 0.98) - 1;
      take(norths[low], easts[low]); take(norths[high], easts[high]);
    }
    if (scene.here) { take(scene.here[0], scene.here[1]); }
    if (!scene.metric || !isFinite(n0)) {
      text.textContent = scene.metric ? "Nothing is mapped yet." : "No map with a scale yet.";
      return;
    }
    const span = Math.max((n1 - n0) / above.height, (e1 - e0) / above.width, 200 / above.width) * 1.15;
    scale = zoom / span;  // pixels for a centimetre
    let [cn, ce] = follows && scene.here ? scene.here : [(n0 + n1) / 2, (e0 + e1) / 2];
    [cn, ce] = [cn + north, ce + east];
    const x = (e) => above.width / 2 + (e - ce) * scale, y = (n) => above.height / 2 - (n - cn) * scale;
    const dot = 2 * ratio;
    for (let i = 0; i + 2 < scene.points.length; i += 3) {
      context.fillStyle = `#${scene.points[i + 2].toString(16).padStart(6, "0")}`;
      context.fillRect(x(scene.points[i + 1]) - dot / 2, y(scene.points[i]) - dot / 2, dot, dot);
    }
    strokes(scene.autopilot, "#7896ff", 1.5 * ratio);
    strokes(scene.path, styles.getPropertyValue("--path"), 2.5 * ratio);
    if (scene.here) {
      const [n, e, an, ae] = scene.here;
      const turn = Math.hypot(an, ae) > 0.2 ? Math.atan2(ae, an) : null;
      context.save();
      context.translate(x(e), y(n));
      context.fillStyle = "#1fae4b";
      context.strokeStyle = "#ffffff";
      context.lineWidth = 1.5 * ratio;
      context.beginPath();
      if (turn === null) { context.arc(0, 0, 6 * ratio, 0, 7); } else {
        context.rotate(turn);
        context.moveTo(0, -11 * ratio); context.lineTo(7 * ratio, 8 * ratio); context.lineTo(-7 * ratio, 8 * ratio);
      }
      context.closePath(); context.fill(); context.stroke();
      context.restore();
    }
    const wanted = above.width / 4 / scale / 100;  // metres
    const power = 10 ** Math.floor(Math.log10(wanted));
    const metres = [5, 2, 1].map((k) => k * power).find((m) => m <= wanted) || power;
    const ink = styles.getPropertyValue("--text");
    context.strokeStyle = ink; context.fillStyle = ink; context.lineWidth = 2 * ratio;
    context.font = `${13 * ratio}px system-ui, sans-serif`;
    const left = 12 * ratio, bottom = above.height - 12 * ratio;
    context.beginPath(); context.moveTo(left, bottom); context.lineTo(left + metres * 100 * scale, bottom); context.stroke();
    context.fillText(`${metres} m`, left, bottom - 6 * ratio);
    context.fillText("N ↑", above.width - 34 * ratio, 20 * ratio);
    const parts = [];
    if (scene.height_m !== undefined && scene.height_m !== null) { parts.push(`${scene.height_m.toFixed(1)} m above the origin`); }
    if (scene.speed_m_s !== undefined && scene.speed_m_s !== null) { parts.push(`${scene.speed_m_s.toFixed(1)} m/s`); }
    text.textContent = `${parts.join(", ") || "No position now"}. Orange: the camera's path; blue: the autopilot's own.`;

    function strokes(all, colour, width) {
      context.strokeStyle = colour; context.lineWidth = width; context.lineJoin = "round";
      for (const line of all) {
        context.beginPath();
        for (let i = 0; i + 1 < line.length; i += 2) {
          if (i) { context.lineTo(x(line[i + 1]), y(line[i])); } else { context.moveTo(x(line[1]), y(line[0])); }
        }
        context.stroke();
      }
    }
  }
}
