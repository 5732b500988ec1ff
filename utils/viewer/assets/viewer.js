"use strict";
(function () {
  const $ = (id) => document.getElementById(id);
  const overlay = $("overlay");
  let view = $("view");
  const points = decode(DATA.points, Float32Array), path = decode(DATA.path, Float32Array);
  const palette = decode(DATA.palette, Uint8Array);
  const frames = DATA.frames, cameras = frames.count ? decode(frames.cameras, Float32Array) : new Float32Array(0);
  const seconds = frames.seconds ? decode(frames.seconds, Float32Array) : null;
  const birth = frames.birth ? decode(frames.birth, Uint32Array) : null;
  const EDGES = [0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1];
  const RED = [1, 0.435, 0.38], GREEN = "#7ee787";
  const low = DATA.low, high = DATA.high, diagonal = norm(sub(high, low));
  const state = { target: [0, 0, 0], yaw: 0, pitch: 0, distance: 1, frame: Math.max(frames.count - 1, 0), playing: 0 };
  const HALF_ANGLE = 0.36, STEEPEST = Math.PI / 2 - 1e-4;
  const VIEWS = { perspective: [0.464, 0.35], top: [0, STEEPEST], side: [-Math.PI / 2, 0], front: [0, 0] };
  const wishes = location.hash.slice(1).split(",");  // for example #top or #canvas,side
  let renderer, matrix;

  // --- the camera that looks at the scene -----------------------------------------------------------------

  function axes() {
    const cp = Math.cos(state.pitch), sp = Math.sin(state.pitch), cy = Math.cos(state.yaw), sy = Math.sin(state.yaw);
    const forward = [sy * cp, sp, cy * cp], right = [cy, 0, -sy];
    return { forward, right, down: cross(forward, right) };
  }

  function setView(name) {
    [state.yaw, state.pitch] = VIEWS[name];
    state.target = [0, 1, 2].map((i) => (low[i] + high[i]) / 2);
    for (let round = 0; round < 4; round++) fit();
    request();
  }

  // Moves the box of the scene into the middle of the window and as near as it fits.
  function fit() {
    const { right, down, forward } = axes(), tan = Math.tan(HALF_ANGLE), room = [0.88 * tan * innerWidth / innerHeight, 0.72 * tan];
    const corners = [];
    for (let k = 0; k < 8; k++) corners.push(sub([0, 1, 2].map((i) => ((k >> i) & 1 ? high[i] : low[i])), state.target));
    state.distance = Math.max(...corners.map((d) =>
      Math.max(Math.abs(dot(d, right)) / room[0], Math.abs(dot(d, down)) / room[1]) - dot(d, forward)));
    for (const axis of [right, down]) {
      const seen = corners.map((d) => dot(d, axis) / Math.max(state.distance + dot(d, forward), 1e-3 * state.distance));
      state.target = add(state.target, axis, 0.5 * state.distance * (Math.min(...seen) + Math.max(...seen)));
    }
  }

  function updateMatrix() {
    const { right, down, forward } = axes();
    const eye = add(state.target, forward, -state.distance);
    const near = state.distance * 0.01, far = state.distance * 20 + 20 * diagonal;
    matrix = multiply(perspective(HALF_ANGLE, view.width / view.height, near, far), viewMatrix(eye, right, down, forward));
  }

  function toScreen(x, y, z) {
    const p = transform(matrix, x, y, z);
    return p[3] <= 0 ? null : [(0.5 + (0.5 * p[0]) / p[3]) * innerWidth, (0.5 - (0.5 * p[1]) / p[3]) * innerHeight];
  }

  // --- what is drawn ----------------------------------------------------------------------------------------

  function recolor() {
    const entry = DATA.colorings[$("coloring").selectedIndex], count = DATA.count;
    const levels = entry.levels && decode(entry.levels, Uint8Array);
    const own = entry.name === "rgb" && decode(DATA.colors, Uint8Array);
    const rgba = new Uint8Array(4 * count);
    for (let i = 0; i < count; i++) {
      const level = levels ? levels[i] : 0;
      for (let k = 0; k < 3; k++)
        rgba[4 * i + k] = own ? own[3 * i + k] : !levels ? [143, 180, 217][k] : level === 255 ? 110 : palette[3 * level + k];
      rgba[4 * i + 3] = birth && birth[i] > state.frame ? 0 : 255;
    }
    renderer.setColors(rgba);
    $("legend").hidden = !levels || !count;
    if (!levels) return;
    $("label").textContent = entry.label;
    const ticks = [0, 0.25, 0.5, 0.75, 1].map((s) => short(entry.low + s * (entry.high - entry.low)));
    $("ticks").replaceChildren(...ticks.map((text) => Object.assign(document.createElement("span"), { textContent: text })));
  }

  function gridLines() {
    const step = niceStep(Math.max(...sub(high, low)), 8), lines = [], floor = high[1];
    const from = [0, 2].map((i) => Math.floor(low[i] / step) * step), to = [0, 2].map((i) => Math.ceil(high[i] / step) * step);
    for (let x = from[0]; x <= to[0] + step / 2; x += step) lines.push(x, floor, from[1], x, floor, to[1]);
    for (let z = from[1]; z <= to[1] + step / 2; z += step) lines.push(from[0], floor, z, to[0], floor, z);
    renderer.setLines("grid", new Float32Array(lines), [0.3, 0.35, 0.43, 0.55]);
    state.step = step;
  }

  function pathLines() {
    const done = [];
    for (let i = 0; i + 1 < path.length / 3 && i < state.frame; i++) done.push(...path.subarray(3 * i, 3 * i + 6));
    renderer.setLines("path", new Float32Array(done), [...RED, 1]);
    const now = [];
    if (cameras.length) for (const corner of EDGES) now.push(...cameras.subarray(15 * state.frame + 3 * corner, 15 * state.frame + 3 * corner + 3));
    renderer.setLines("camera", new Float32Array(now), [1, 1, 1, 1]);
  }

  function showFrame(frame) {
    state.frame = frame;
    $("frame").value = frame;
    $("frame-text").textContent = `frame ${frame}` + (seconds ? `  ${seconds[frame].toFixed(2)} s` : "");
    pathLines();
    if (birth) recolor();
    request();
  }

  function drawOverlay() {
    const g = overlay.getContext("2d"), ratio = devicePixelRatio || 1;
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, innerWidth, innerHeight);
    if ($("show-path").checked && path.length) {
      mark(g, toScreen(path[0], path[1], path[2]), GREEN);
      label(g, toScreen(path[0], path[1], path[2]), "start", GREEN);
    }
    if ($("show-grid").checked) gridLabels(g);
    triad(g);
  }

  function mark(g, at, color) {
    if (!at) return;
    g.strokeStyle = color;
    g.lineWidth = 2;
    g.beginPath();
    g.arc(at[0], at[1], 7, 0, 2 * Math.PI);
    g.stroke();
  }

  function label(g, at, text, color) {
    if (!at) return;
    g.font = "12px system-ui, 'DejaVu Sans', sans-serif";
    g.fillStyle = color;
    g.fillText(text, at[0] + 11, at[1] - 8);
  }

  function gridLabels(g) {
    const y = high[1], step = state.step;
    for (const [axis, other] of [[0, 2], [2, 0]]) {
      const edge = Math.floor(low[other] / step) * step;
      for (let v = Math.ceil(low[axis] / step) * step, last = null; v <= high[axis] + step / 2; v += step) {
        const at = axis === 0 ? toScreen(v, y, edge) : toScreen(edge, y, v);
        if (!at || (last && Math.hypot(at[0] - last[0], at[1] - last[1]) < 30)) continue;
        label(g, [at[0] - 16, at[1] + 20], short(Math.abs(v) < step / 1e6 ? 0 : v), "#6d7787");
        last = at;
      }
    }
  }

  function triad(g) {
    const { right, down, forward } = axes(), cx = 56, cy = innerHeight - 190, size = 34;
    const all = [["x", [1, 0, 0], "#ff7b72"], ["y", [0, 1, 0], "#7ee787"], ["z", [0, 0, 1], "#79c0ff"]];
    all.sort((a, b) => dot(b[1], forward) - dot(a[1], forward));
    for (const [name, axis, color] of all) {
      const tip = [cx + size * dot(axis, right), cy + size * dot(axis, down)];
      g.strokeStyle = color;
      g.lineWidth = 2;
      g.beginPath();
      g.moveTo(cx, cy);
      g.lineTo(...tip);
      g.stroke();
      label(g, [tip[0] - 14 + 0.2 * (tip[0] - cx), tip[1] + 12 + 0.2 * (tip[1] - cy)], name, color);
    }
  }

  let pending = false;
  function request() {
    if (pending) return;
    pending = true;
    requestAnimationFrame(() => { pending = false; draw(); });
  }

  function draw() {
    const ratio = devicePixelRatio || 1;
    for (const canvas of [view, overlay]) {
      const width = Math.round(innerWidth * ratio), height = Math.round(innerHeight * ratio);
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    }
    updateMatrix();
    const hidden = new Set();
    if (!$("show-path").checked) hidden.add("path");
    if (!$("show-cameras").checked) hidden.add("cameras").add("camera");
    if (!$("show-grid").checked) hidden.add("grid");
    renderer.draw(matrix, Number($("size").value) * ratio, state.distance, hidden);
    drawOverlay();
    document.documentElement.dataset.drawn = renderer.name;
  }

  // --- hands ------------------------------------------------------------------------------------------------

  const pointers = new Map();
  function move(event) {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const delta = [event.clientX - before.x, event.clientY - before.y];
    const others = [...pointers.entries()].filter(([id]) => id !== event.pointerId).map(([, p]) => p);
    if (others.length) {
      const gap = (p) => Math.hypot(p.x - others[0].x, p.y - others[0].y) || 1;
      state.distance *= gap(before) / gap({ x: event.clientX, y: event.clientY });
      pan(delta[0] / 2, delta[1] / 2);
    } else if (before.pan) pan(...delta);
    else {
      state.yaw += delta[0] * 0.006;
      state.pitch = Math.min(Math.max(state.pitch + delta[1] * 0.006, -STEEPEST), STEEPEST);
    }
    pointers.set(event.pointerId, { ...before, x: event.clientX, y: event.clientY });
    request();
  }

  function pan(dx, dy) {
    const { right, down } = axes(), scale = (2 * state.distance * Math.tan(HALF_ANGLE)) / innerHeight;
    state.target = add(add(state.target, right, -dx * scale), down, -dy * scale);
  }

  function zoom(event) {
    event.preventDefault();
    state.distance = Math.min(Math.max(state.distance * Math.exp(event.deltaY * 0.001), diagonal * 1e-3), diagonal * 50);
    request();
  }

  function turnAbout(event) {
    let best = 20, found = null;
    for (let i = 0; i < points.length; i += 3) {
      const at = toScreen(points[i], points[i + 1], points[i + 2]);
      const away = at ? Math.hypot(at[0] - event.clientX, at[1] - event.clientY) : best;
      if (away < best) { best = away; found = [points[i], points[i + 1], points[i + 2]]; }
    }
    if (!found) return;
    const { forward } = axes(), eye = add(state.target, forward, -state.distance);
    state.distance = dot(sub(found, eye), forward);
    state.target = found;
    request();
  }

  function play() {
    clearInterval(state.playing);
    state.playing = state.playing ? 0 : setInterval(() => showFrame((state.frame + 1) % frames.count), 40);
    $("play").textContent = state.playing ? "\u275a\u275a" : "\u25b6";
  }

  function connect() {
    view.addEventListener("pointerdown", (event) => {
      view.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, pan: event.button !== 0 || event.shiftKey });
      view.classList.add("moving");
    });
    view.addEventListener("pointermove", move);
    for (const end of ["pointerup", "pointercancel"])
      view.addEventListener(end, (event) => { pointers.delete(event.pointerId); view.classList.remove("moving"); });
    view.addEventListener("wheel", zoom, { passive: false });
    view.addEventListener("dblclick", turnAbout);
    view.addEventListener("contextmenu", (event) => event.preventDefault());
    addEventListener("resize", request);
    addEventListener("keydown", (event) => {
      const name = { 0: "perspective", 1: "top", 2: "side", 3: "front" }[event.key];
      if (name) setView(name);
      else if (event.key === " " && frames.count > 1 && event.target.tagName !== "BUTTON") play();
    });
    for (const button of $("views").children) button.addEventListener("click", () => setView(button.dataset.view));
    for (const id of ["size", "show-path", "show-cameras", "show-grid"]) $(id).addEventListener("input", request);
    $("coloring").addEventListener("change", () => { recolor(); request(); });
    $("frame").addEventListener("input", () => showFrame(Number($("frame").value)));
    $("play").addEventListener("click", play);
  }

  function fillPage() {
    $("title").textContent = DATA.title;
    $("summary").textContent = DATA.summary;
    $("notes").textContent = [...DATA.notes, `grid step ${short(state.step)} ${DATA.unit}`].join("  |  ");
    for (const entry of DATA.colorings)
      $("coloring").append(Object.assign(document.createElement("option"), { textContent: entry.name, title: entry.label }));
    $("coloring").selectedIndex = Math.max(DATA.colorings.findIndex((entry) => entry.name === DATA.start), 0);
    $("size").value = DATA.count > 100000 ? 1.5 : DATA.count > 10000 ? 3 : 5;
    $("frame").max = state.frame;
    $("timeline").hidden = frames.count < 2;
    document.documentElement.dataset.points = DATA.count;
    const bar = $("bar").getContext("2d");
    for (let i = 0; i < 256; i++) {
      bar.fillStyle = `rgb(${palette.subarray(3 * i, 3 * i + 3)})`;
      bar.fillRect(i, 0, 1, 12);
    }
  }

  function start() {
    try {
      if (wishes.includes("canvas")) throw new Error("canvas asked for");
      renderer = new WebGlRenderer(view);
    } catch {
      const fresh = view.cloneNode();  // a canvas that was tried with WebGL gives no other context
      view.replaceWith(fresh);
      view = fresh;
      renderer = new CanvasRenderer(view);
    }
    renderer.setPoints(points);
    renderer.setLines("cameras", decode(DATA.frusta, Float32Array), [...RED, 0.5]);
    gridLines();
    fillPage();
    recolor();
    connect();
    setView(wishes.find((name) => name in VIEWS) || "perspective");
    showFrame(state.frame);
    if (!frames.count) $("frame-text").textContent = "";
  }

  start();
})();
