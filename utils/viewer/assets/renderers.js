"use strict";
// Two ways to draw the same things: `points` (positions, colours, size, how many) and `lines` (named sets of segments).

class WebGlRenderer {
  constructor(canvas) {
    this.canvas = canvas;
    this.name = "webgl";
    const gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
    if (!gl) throw new Error("no WebGL");
    this.gl = gl;
    // the size of a point follows its distance a little, so that near and far can be told apart
    this.pointProgram = this.program(
      `attribute vec3 at; attribute vec4 tint; uniform mat4 m; uniform float size; uniform float away; varying vec4 c;
       void main() { gl_Position = m * vec4(at, 1.0); c = tint;
         gl_PointSize = tint.a > 0.0 ? clamp(size * away / max(gl_Position.w, 1e-6), 0.6 * size, 3.0 * size) : 0.0; }`,
      `precision mediump float; varying vec4 c;
       void main() { vec2 d = gl_PointCoord - 0.5; float r = dot(d, d); if (r > 0.25 || c.a == 0.0) discard;
         gl_FragColor = vec4(c.rgb * (1.0 - 0.9 * r), 1.0); }`);
    this.lineProgram = this.program(
      "attribute vec3 at; uniform mat4 m; void main() { gl_Position = m * vec4(at, 1.0); }",
      "precision mediump float; uniform vec4 tint; void main() { gl_FragColor = tint; }");
    this.buffers = { at: gl.createBuffer(), tint: gl.createBuffer() };
    this.sets = new Map();
    this.count = 0;
  }

  program(vertex, fragment) {
    const gl = this.gl, made = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    return made;
  }

  fill(buffer, values) {
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, buffer);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, values, this.gl.STATIC_DRAW);
  }

  setPoints(positions) { this.count = positions.length / 3; this.fill(this.buffers.at, positions); }
  setColors(rgba) { this.fill(this.buffers.tint, rgba); }

  setLines(name, positions, color) {
    const set = this.sets.get(name) || { buffer: this.gl.createBuffer() };
    this.sets.set(name, Object.assign(set, { count: positions.length / 3, color }));
    this.fill(set.buffer, positions);
  }

  attribute(program, name, buffer, size, type, normalized) {
    const gl = this.gl, where = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(where);
    gl.vertexAttribPointer(where, size, type, normalized, 0, 0);
  }

  draw(matrix, pointSize, away, hidden) {
    const gl = this.gl;
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(14 / 255, 17 / 255, 22 / 255, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    if (this.count) {
      gl.useProgram(this.pointProgram);
      gl.uniformMatrix4fv(gl.getUniformLocation(this.pointProgram, "m"), false, matrix);
      gl.uniform1f(gl.getUniformLocation(this.pointProgram, "size"), pointSize);
      gl.uniform1f(gl.getUniformLocation(this.pointProgram, "away"), away);
      this.attribute(this.pointProgram, "at", this.buffers.at, 3, gl.FLOAT, false);
      this.attribute(this.pointProgram, "tint", this.buffers.tint, 4, gl.UNSIGNED_BYTE, true);
      gl.drawArrays(gl.POINTS, 0, this.count);
      gl.disableVertexAttribArray(gl.getAttribLocation(this.pointProgram, "tint"));
    }
    gl.useProgram(this.lineProgram);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.lineProgram, "m"), false, matrix);
    for (const [name, set] of this.sets) {
      if (hidden.has(name) || !set.count) continue;
      gl.uniform4fv(gl.getUniformLocation(this.lineProgram, "tint"), set.color);
      this.attribute(this.lineProgram, "at", set.buffer, 3, gl.FLOAT, false);
      gl.drawArrays(gl.LINES, 0, set.count);
    }
  }
}

// The same without WebGL: points are splatted into an image with a depth per pixel.
class CanvasRenderer {
  constructor(canvas) {
    this.canvas = canvas;
    this.name = "canvas";
    this.context = canvas.getContext("2d");
    this.sets = new Map();
    this.positions = new Float32Array(0);
  }

  setPoints(positions) { this.positions = positions; }
  setColors(rgba) { this.colors = rgba; }
  setLines(name, positions, color) { this.sets.set(name, { positions, color }); }

  draw(matrix, pointSize, away, hidden) {
    const { width, height } = this.canvas;
    if (!this.image || this.image.width !== width || this.image.height !== height) {
      this.image = this.context.createImageData(width, height);
      this.depth = new Float32Array(width * height);
    }
    new Uint32Array(this.image.data.buffer).fill(0xff16110e);
    this.depth.fill(Infinity);
    this.splat(matrix, pointSize, away, width, height);
    this.context.putImageData(this.image, 0, 0);
    for (const [name, set] of this.sets) if (!hidden.has(name)) this.segments(matrix, set, width, height);
  }

  splat(m, pointSize, away, width, height) {
    const data = this.image.data, p = this.positions, c = this.colors;
    for (let i = 0, n = p.length / 3; i < n; i++) {
      if (c[4 * i + 3] === 0) continue;
      const [x, y, , w] = transform(m, p[3 * i], p[3 * i + 1], p[3 * i + 2]);
      if (w <= 1e-6) continue;
      const radius = 0.5 * Math.min(Math.max((pointSize * away) / w, 0.6 * pointSize), 3 * pointSize);
      const u = (0.5 + (0.5 * x) / w) * width, v = (0.5 - (0.5 * y) / w) * height;
      for (let row = Math.max(0, Math.ceil(v - radius)); row <= Math.min(height - 1, v + radius); row++)
        for (let col = Math.max(0, Math.ceil(u - radius)); col <= Math.min(width - 1, u + radius); col++) {
          const at = row * width + col;
          if ((row - v) ** 2 + (col - u) ** 2 > radius * radius || w >= this.depth[at]) continue;
          this.depth[at] = w;
          for (let k = 0; k < 3; k++) data[4 * at + k] = c[4 * i + k];
        }
    }
  }

  segments(m, set, width, height) {
    const g = this.context, p = set.positions;
    g.strokeStyle = `rgba(${set.color.slice(0, 3).map((v) => Math.round(255 * v))},${set.color[3]})`;
    g.beginPath();
    for (let i = 0; i < p.length; i += 6) {
      const a = transform(m, p[i], p[i + 1], p[i + 2]), b = transform(m, p[i + 3], p[i + 4], p[i + 5]);
      if (a[3] <= 1e-6 || b[3] <= 1e-6) continue;
      g.moveTo((0.5 + (0.5 * a[0]) / a[3]) * width, (0.5 - (0.5 * a[1]) / a[3]) * height);
      g.lineTo((0.5 + (0.5 * b[0]) / b[3]) * width, (0.5 - (0.5 * b[1]) / b[3]) * height);
    }
    g.stroke();
  }
}
