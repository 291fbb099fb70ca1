// WebGL 2: points into a picture with depth, their edges shaded by it (eye-dome lighting, Boucheny
// 2009), then lines over it, faint where points hide them.
"use strict";

const POINT_VERTEX = `#version 300 es
in vec3 at;
in vec3 colour;
uniform mat4 clip_from_world;
uniform float metres_per_step, size_px, most_px;
uniform vec2 heights;
uniform bool by_height;
flat out vec3 shown;
const vec3 RAMP[6] = vec3[6](
  vec3(0.20, 0.22, 0.58), vec3(0.11, 0.50, 0.68), vec3(0.28, 0.68, 0.45),
  vec3(0.80, 0.80, 0.30), vec3(0.93, 0.56, 0.22), vec3(0.82, 0.24, 0.20));
vec3 ramp(float t) {
  int low = min(int(t * 5.0), 4);
  return mix(RAMP[low], RAMP[low + 1], t * 5.0 - float(low));
}
void main() {
  vec3 world = at * metres_per_step;
  gl_Position = clip_from_world * vec4(world, 1.0);
  gl_PointSize = clamp(size_px / gl_Position.w, 2.0, most_px);
  float t = clamp((heights.y - world.z) / (heights.y - heights.x), 0.0, 1.0);
  shown = by_height ? ramp(t) : colour;
}`;

const POINT_FRAGMENT = `#version 300 es
precision mediump float;
flat in vec3 shown;
out vec4 pixel;
void main() { pixel = vec4(shown, 1.0); }`;

const SCREEN_VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID % 2, gl_VertexID / 2) * 4.0 - 1.0, 0.0, 1.0); }`;

const SHADE_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D colours;
uniform highp sampler2D depths;
uniform float near_over_far, strength, height_px;
out vec4 pixel;
float nearness(ivec2 at) { return 1.0 - texelFetch(depths, at, 0).r * (1.0 - near_over_far); }
void main() {
  ivec2 here = ivec2(gl_FragCoord.xy), most = textureSize(depths, 0) - 1;
  if (texelFetch(depths, here, 0).r == 1.0) {
    float t = gl_FragCoord.y / height_px;
    pixel = vec4(mix(vec3(0.045, 0.052, 0.065), vec3(0.095, 0.11, 0.135), t), 1.0);
    return;
  }
  float own = log2(nearness(here)), behind = 0.0;
  for (int i = 0; i < 4; i++) {
    ivec2 aside = ivec2(i < 2 ? 2 * i - 1 : 0, i < 2 ? 0 : 2 * i - 5);
    behind += clamp(log2(nearness(clamp(here + aside, ivec2(0), most))) - own, 0.0, 0.1);
  }
  pixel = vec4(texelFetch(colours, here, 0).rgb * exp2(-strength * behind), 1.0);
}`;

const LINE_VERTEX = `#version 300 es
in vec3 from, to;
uniform mat4 clip_from_world;
uniform vec2 size_px;
uniform float width_px;
out float across;
void main() {
  vec4 a = clip_from_world * vec4(from, 1.0), b = clip_from_world * vec4(to, 1.0);
  float near = 1e-3 * max(a.w, b.w);
  if (near <= 0.0) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
  if (a.w < near) a = mix(a, b, (near - a.w) / (b.w - a.w));
  if (b.w < near) b = mix(b, a, (near - b.w) / (a.w - b.w));
  vec2 along = (b.xy / b.w - a.xy / a.w) * size_px;
  along = length(along) > 1e-3 ? normalize(along) : vec2(1.0, 0.0);
  float side = float(gl_VertexID % 2) * 2.0 - 1.0, half_px = 0.5 * width_px + 0.7;
  bool first = gl_VertexID < 2;
  vec4 end = first ? a : b;
  vec2 out_px = half_px * (side * vec2(-along.y, along.x) + (first ? -0.5 : 0.5) * along);
  across = side * half_px;
  gl_Position = end + vec4(2.0 * out_px / size_px * end.w, 0.0, 0.0);
}`;

const LINE_FRAGMENT = `#version 300 es
precision highp float;
in float across;
uniform highp sampler2D depths;
uniform vec3 colour;
uniform float width_px;
out vec4 pixel;
void main() {
  float hidden = step(texelFetch(depths, ivec2(gl_FragCoord.xy), 0).r, gl_FragCoord.z);
  float edge = clamp(0.5 * width_px + 0.5 - abs(across), 0.0, 1.0);
  pixel = vec4(colour, edge * mix(1.0, 0.28, hidden));
}`;

class CloudDrawing {
  // `steps` (3 N) u16 and `colours` (3 N) u8, both from coarse to fine.
  constructor(gl, steps, colours, metres_per_step) {
    this.gl = gl;
    this.metres_per_step = metres_per_step;
    this.points = program(gl, POINT_VERTEX, POINT_FRAGMENT);
    this.shade = program(gl, SCREEN_VERTEX, SHADE_FRAGMENT);
    this.line = program(gl, LINE_VERTEX, LINE_FRAGMENT);
    this.cloud = gl.createVertexArray();
    gl.bindVertexArray(this.cloud);
    attribute(gl, this.points.at("at"), steps, gl.UNSIGNED_SHORT, false);
    attribute(gl, this.points.at("colour"), colours, gl.UNSIGNED_BYTE, true);
    this.nothing = gl.createVertexArray();
    this.target = gl.createFramebuffer();
    this.colour = gl.createTexture();
    this.depth = gl.createTexture();
    this.size = [0, 0];
  }

  // Lines from `ends`: x y z of both ends, one line after the other.
  lines(ends) {
    const gl = this.gl, array = gl.createVertexArray();
    gl.bindVertexArray(array);
    attribute(gl, this.line.at("from"), new Float32Array(ends), gl.FLOAT, false, 24, 0, 1);
    attribute(gl, this.line.at("to"), null, gl.FLOAT, false, 24, 12, 1);
    return { array, n: ends.length / 6 };
  }

  // `lines`: { array, n, colour, width_px } each. `size_px`: of a point at distance 1.
  draw(matrix, n_points, size_px, heights, by_height, lines) {
    const gl = this.gl, [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
    this.resize(width, height);
    gl.viewport(0, 0, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.points.program);
    gl.uniformMatrix4fv(this.points.is("clip_from_world"), false, matrix);
    gl.uniform1f(this.points.is("metres_per_step"), this.metres_per_step);
    gl.uniform1f(this.points.is("size_px"), size_px);
    gl.uniform1f(this.points.is("most_px"), Math.max(3, height / 40));
    gl.uniform2f(this.points.is("heights"), ...heights);
    gl.uniform1i(this.points.is("by_height"), by_height);
    gl.bindVertexArray(this.cloud);
    gl.drawArrays(gl.POINTS, 0, n_points);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.DEPTH_TEST);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.colour);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.depth);
    gl.useProgram(this.shade.program);
    gl.uniform1i(this.shade.is("colours"), 0);
    gl.uniform1i(this.shade.is("depths"), 1);
    gl.uniform1f(this.shade.is("near_over_far"), near_over_far(matrix));
    gl.uniform1f(this.shade.is("strength"), 7);
    gl.uniform1f(this.shade.is("height_px"), height);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);

    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(this.line.program);
    gl.uniformMatrix4fv(this.line.is("clip_from_world"), false, matrix);
    gl.uniform2f(this.line.is("size_px"), width, height);
    gl.uniform1i(this.line.is("depths"), 1);
    for (const each of lines) {
      gl.uniform3f(this.line.is("colour"), ...each.colour);
      gl.uniform1f(this.line.is("width_px"), each.width_px);
      gl.bindVertexArray(each.array);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, each.n);
    }
  }

  resize(width, height) {
    if (this.size[0] === width && this.size[1] === height) return;
    this.size = [width, height];
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    for (const [texture, inside, format, type, place] of [
      [this.colour, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, gl.COLOR_ATTACHMENT0],
      [this.depth, gl.DEPTH_COMPONENT24, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, gl.DEPTH_ATTACHMENT],
    ]) {
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, inside, width, height, 0, format, type, null);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, place, gl.TEXTURE_2D, texture, 0);
    }
  }
}

// Of the projection in a matrix of OrbitCamera: z clip = a w + b, with w the depth.
function near_over_far(matrix) {
  const length = Math.hypot(matrix[3], matrix[7], matrix[11]);
  const a = Math.hypot(matrix[2], matrix[6], matrix[10]) / length;
  return (a - 1) / (a + 1);
}

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS))
      throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const places = {};
  return {
    program: made,
    at: (name) => gl.getAttribLocation(made, name),
    is: (name) => (places[name] ??= gl.getUniformLocation(made, name)),
  };
}

// Three numbers a vertex from `data`, or from what was given last; `each`: an instance, not a vertex.
function attribute(gl, place, data, type, normalised, stride = 0, begin = 0, each = 0) {
  if (data) {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
  }
  gl.enableVertexAttribArray(place);
  gl.vertexAttribPointer(place, 3, type, normalised, stride, begin);
  gl.vertexAttribDivisor(place, each);
}
