"use strict";
// World axes are those of the first camera: x right, y down, z forward. Matrices are column-major, as WebGL wants them.

const decode = (text, Type) => new Type(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const norm = (a) => Math.hypot(a[0], a[1], a[2]);
const unit = (a) => a.map((v) => v / (norm(a) || 1));

function multiply(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++)
    for (let r = 0; r < 4; r++)
      for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}

// Camera that looks along `forward` from `eye`; `down` is the image's y axis, so nothing is mirrored.
function viewMatrix(eye, right, down, forward) {
  return new Float32Array([
    right[0], -down[0], -forward[0], 0, right[1], -down[1], -forward[1], 0, right[2], -down[2], -forward[2], 0,
    -dot(right, eye), dot(down, eye), dot(forward, eye), 1]);
}

function perspective(halfAngle, aspect, near, far) {
  const f = 1 / Math.tan(halfAngle);
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1,
    0, 0, (2 * far * near) / (near - far), 0]);
}

function transform(m, x, y, z) {
  return [m[0] * x + m[4] * y + m[8] * z + m[12], m[1] * x + m[5] * y + m[9] * z + m[13],
    m[2] * x + m[6] * y + m[10] * z + m[14], m[3] * x + m[7] * y + m[11] * z + m[15]];
}

// A round step (1, 2, 5 times a power of ten) that divides `extent` into about `parts`.
function niceStep(extent, parts) {
  const raw = Math.max(extent, 1e-30) / parts, power = Math.pow(10, Math.floor(Math.log10(raw)));
  return power * [1, 2, 5, 10].find((step) => step * power >= raw * 0.999);
}

const short = (v) => String(Number(v.toPrecision(3)));
