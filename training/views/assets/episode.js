"use strict";
// The replay of an episode. Everything is in the start frame, in metres, y upwards; `k` is the row that is shown.
(async () => {
  const header = JSON.parse(document.getElementById("header").textContent);
  const byId = (id) => document.getElementById(id);
  let data;
  try {
    data = await unpack(byId("data").textContent.trim());
  } catch (error) {
    byId("broken").hidden = false;
    return;
  }
  const n = header.rows, step = header.step_s;
  const colours = {
    truth: "#168c70", believed: "#2c60cd", goal: "#de5c2a", frontier: "#f8a014", landmark: "#b22680", beam: "92,196,214",
  };

  // ---- the recording -------------------------------------------------------------------------------------------

  async function unpack(text) {
    const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const buffer = await new Response(stream).arrayBuffer();
    const kinds = {
      float32: Float32Array, uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, int32: Int32Array,
    };
    const arrays = {};
    let at = 0;
    for (const [name, kind, size] of header.arrays) {
      arrays[name] = new kinds[kind](buffer, at, size);
      at += Math.ceil(arrays[name].byteLength / 4) * 4;
    }
    return arrays;
  }

  // The last note at or before row k; -1 where there is none yet.
  function noted(steps, k) {
    let low = 0, high = steps.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (steps[middle] <= k) low = middle + 1; else high = middle;
    }
    return low - 1;
  }

  function offsets(counts) {
    const out = new Uint32Array(counts.length + 1);
    for (let i = 0; i < counts.length; i++) out[i + 1] = out[i] + counts[i];
    return out;
  }
  const goalAt = offsets(data.goal_count), landmarkAt = offsets(data.landmark_count);
  const landmarks = data.landmark.length / 5;

  function scanAt(k) {
    const i = noted(data.scan_step, k), ranges = new Float32Array(header.beams);
    let code = 0;
    for (let b = 0; b < header.beams; b++) {
      code = (code + data.scan[i * header.beams + b]) & 255;
      ranges[b] = code === 254 ? NaN : code === 253 ? Infinity : (code / 252) * header.range_max;
    }
    return { row: data.scan_step[i], ranges };
  }

  // The map as it is at row k, one pixel a cell, its first row the highest; changes are laid on one by one, and from
  // the beginning where time has run backwards.
  const map = (() => {
    const { rows, cols } = header.map;
    const canvas = new OffscreenCanvas(cols, rows), context = canvas.getContext("2d");
    const image = context.createImageData(cols, rows), pixels = new Uint32Array(image.data.buffer);
    const classes = new Uint8Array(rows * cols); // 0 unknown, 1 free, 101 occupied
    const shades = { 0: 0xffe4e1de, 1: 0xffffffff, 101: 0xff4a3e36 };
    let done = 0, gap = 0, cell = 0, edge = null;
    function clear() {
      done = gap = cell = 0;
      classes.fill(0);
      pixels.fill(shades[0]);
    }
    function show(k) {
      const upTo = noted(data.map_step, k) + 1;
      if (upTo === done && done > 0) return;
      if (upTo < done || done === 0) clear();
      for (; done < upTo; done++) {
        let index = 0;
        for (const end = cell + data.map_count[done]; cell < end; cell++) {
          let far = data.map_gap[gap++];
          while (far === 65535) { index += far; far = data.map_gap[gap++]; }
          index += far;
          classes[index] = data.map_class[cell];
          const row = Math.floor(index / cols);
          pixels[(rows - 1 - row) * cols + (index - row * cols)] = shades[classes[index]];
        }
      }
      context.putImageData(image, 0, 0);
      edge = null;
    }
    // Free cells beside unknown ones, as a path of squares on a canvas whose unit is the cell.
    function frontiers() {
      if (edge) return edge;
      const path = edge = new Path2D();
      for (let row = 1; row < rows - 1; row++) {
        for (let i = row * cols + 1; i < (row + 1) * cols - 1; i++) {
          if (classes[i] !== 1) continue;
          if (classes[i - 1] && classes[i + 1] && classes[i - cols] && classes[i + cols]) continue;
          path.rect(i - row * cols, rows - 1 - row, 1, 1);
        }
      }
      return path;
    }
    clear();
    return { canvas, show, frontiers, classes };
  })();

  // ---- drawing -------------------------------------------------------------------------------------------------

  const layers = { scan: true, landmarks: true, frontiers: true, goal: true, paths: true, follow: false };
  const truth = new Image();
  truth.src = "data:image/png;base64," + header.truth.png;
  await truth.decode();
  const box = {
    x: header.truth.left, y: header.truth.top, w: truth.width / header.truth.scale, h: truth.height / header.truth.scale,
  };
  // A long building is shown larger with one view above the other.
  const wide = box.w > 2 * box.h;
  document.querySelector(".views").classList.toggle("wide-plan", wide);
  const view = { zoom: 1, x: box.x + box.w / 2, y: box.y - box.h / 2 };
  const canvases = [byId("world"), byId("belief")];

  // Sharp on any screen: a canvas has as many pixels as the screen gives it.
  function fitted(canvas, height) {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth;
    const w = Math.round(width * ratio), h = Math.round(height * ratio);
    canvas.style.height = `${height}px`;
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    const c = canvas.getContext("2d");
    c.setTransform(1, 0, 0, 1, 0, 0);
    return { c, w, h, ratio };
  }

  // `poses`: of the robot that is followed, where one is.
  function begin(canvas, poses) {
    const width = canvas.clientWidth;
    const stacked = wide || window.innerWidth < 640;
    const most = Math.max((stacked ? 0.36 : 0.72) * window.innerHeight, 220);
    const height = Math.min(width * Math.max(box.h / box.w, stacked ? 0 : 0.5), most);
    const { c, w, h, ratio } = fitted(canvas, height);
    c.fillStyle = "#dee1e4";
    c.fillRect(0, 0, w, h);
    const scale = Math.min(w / box.w, h / box.h) * view.zoom;
    const [x, y] = layers.follow ? [poses[3 * k], poses[3 * k + 1]] : [view.x, view.y];
    c.setTransform(scale, 0, 0, -scale, w / 2 - x * scale, h / 2 + y * scale);
    canvas.scale = scale / ratio;
    return { c, px: ratio / scale }; // px: a pixel of the page in metres
  }

  function image(c, picture, x, top, width, height, smooth) {
    c.save();
    c.translate(x, top);
    c.scale(1, -1);
    c.imageSmoothingEnabled = smooth;
    c.drawImage(picture, 0, 0, width, height);
    c.restore();
  }

  function path(c, poses, k, colour, px) {
    c.beginPath();
    const stride = Math.max(1, Math.floor(k / 4000));
    for (let i = 0; i < k; i += stride) c.lineTo(poses[3 * i], poses[3 * i + 1]);
    c.lineTo(poses[3 * k], poses[3 * k + 1]);
    Object.assign(c, { strokeStyle: colour, lineWidth: 2 * px, lineJoin: "round" });
    c.stroke();
  }

  function robot(c, poses, k, colour) {
    const r = header.robot;
    c.save();
    c.translate(poses[3 * k], poses[3 * k + 1]);
    c.rotate(poses[3 * k + 2]);
    c.fillStyle = "#363e4a";
    const tyre = 0.11 * r.width;
    for (const [x, y] of r.wheels) {
      c.fillRect(x - 1.4 * r.wheel, Math.sign(y) * (r.width / 2 - 0.4 * tyre) - tyre, 2.8 * r.wheel, 2 * tyre);
    }
    c.fillStyle = colour;
    c.fillRect(-r.length / 2, -r.width / 2, r.length, r.width);
    c.fillStyle = "#ffffff";
    const a = r.length / 2, b = r.width / 2;
    c.beginPath();
    for (const [x, y] of [[-0.5 * a, 0.6 * b], [0.75 * a, 0], [-0.5 * a, -0.6 * b], [-0.2 * a, 0]]) c.lineTo(x, y);
    c.fill();
    c.restore();
  }

  function scan(c, k, px) {
    const { row, ranges } = scanAt(k);
    const [x, y, theta] = [data.true[3 * row], data.true[3 * row + 1], data.true[3 * row + 2]];
    const sx = x + header.lidar.offset * Math.cos(theta), sy = y + header.lidar.offset * Math.sin(theta);
    c.beginPath();
    c.moveTo(sx, sy);
    const hits = [];
    ranges.forEach((range, b) => {
      if (Number.isNaN(range)) return;
      const angle = theta + header.angle_min + b * header.angle_increment, far = Math.min(range, header.range_max);
      c.lineTo(sx + far * Math.cos(angle), sy + far * Math.sin(angle));
      if (Number.isFinite(range)) hits.push([sx + far * Math.cos(angle), sy + far * Math.sin(angle)]);
    });
    c.closePath();
    c.fillStyle = `rgba(${colours.beam},.28)`;
    c.fill();
    c.fillStyle = colours.truth;
    for (const [hx, hy] of hits) c.fillRect(hx - 1.2 * px, hy - 1.2 * px, 2.4 * px, 2.4 * px);
  }

  function ellipse(c, x, y, a, b, angle, least) {
    c.moveTo(x, y);
    c.beginPath();
    c.ellipse(x, y, Math.max(a, least), Math.max(b, least), angle, 0, 2 * Math.PI);
    c.stroke();
  }

  function drawWorld(k) {
    const { c, px } = begin(canvases[0], data.true);
    image(c, truth, box.x, box.y, box.w, box.h, true);
    if (layers.scan) scan(c, k, px);
    if (layers.paths) path(c, data.true, k, colours.truth, px);
    robot(c, data.true, k, colours.goal);
  }

  function drawBelief(k) {
    const { c, px } = begin(canvases[1], data.estimate);
    const m = header.map, left = m.col0 * m.resolution, top = (m.row0 + m.rows) * m.resolution;
    map.show(k);
    image(c, map.canvas, left, top, m.cols * m.resolution, m.rows * m.resolution, canvases[1].scale * m.resolution < 2);
    if (layers.frontiers) {
      c.save();
      c.translate(left, top);
      c.scale(m.resolution, -m.resolution);
      c.fillStyle = colours.frontier;
      c.fill(map.frontiers());
      c.restore();
    }
    if (layers.landmarks) drawLandmarks(c, k, px);
    if (layers.paths) path(c, data.estimate, k, colours.believed, px);
    if (layers.goal) drawGoal(c, k, px);
    robot(c, data.estimate, k, colours.believed);
    const [xx, xy, yy] = data.cov.subarray(4 * k, 4 * k + 3), middle = (xx + yy) / 2, half = Math.hypot((xx - yy) / 2, xy);
    Object.assign(c, { strokeStyle: colours.landmark, lineWidth: 2 * px });
    const axes = [middle + half, middle - half].map((v) => 3 * Math.sqrt(Math.max(v, 0)));
    ellipse(c, data.estimate[3 * k], data.estimate[3 * k + 1], ...axes, Math.atan2(2 * xy, xx - yy) / 2, 1.5 * px);
  }

  function drawLandmarks(c, k, px) {
    const i = noted(data.landmark_step, k), table = data.landmark;
    Object.assign(c, { strokeStyle: colours.landmark, fillStyle: colours.landmark, lineWidth: 1.2 * px });
    for (let j = landmarkAt[i]; j < landmarkAt[i + 1]; j++) {
      const [x, y, a, b, angle] = [0, 1, 2, 3, 4].map((row) => table[row * landmarks + j]);
      c.fillRect(x / 1e3 - 1.5 * px, y / 1e3 - 1.5 * px, 3 * px, 3 * px);
      ellipse(c, x / 1e3, y / 1e3, (3 * a) / 1e4, (3 * b) / 1e4, (angle * Math.PI) / 180, 2 * px);
    }
  }

  function drawGoal(c, k, px) {
    const i = noted(data.goal_step, k);
    if (i < 0 || goalAt[i + 1] === goalAt[i]) return;
    c.beginPath();
    for (let j = goalAt[i]; j < goalAt[i + 1]; j++) c.lineTo(data.goal[2 * j], data.goal[2 * j + 1]);
    Object.assign(c, { strokeStyle: colours.goal, fillStyle: colours.goal, lineWidth: 2 * px });
    c.stroke();
    const last = goalAt[i + 1] - 1;
    c.beginPath();
    c.arc(data.goal[2 * last], data.goal[2 * last + 1], 4.5 * px, 0, 2 * Math.PI);
    c.fill();
  }

  // ---- curves --------------------------------------------------------------------------------------------------

  const rows = Array.from({ length: n }, (_, k) => k);
  const series = (f) => Float32Array.from(rows, f);
  const turned = (a) => Math.atan2(Math.sin(a), Math.cos(a));
  const curves = [
    {
      name: "coverage", unit: "%", digits: 1, colour: "--link", least: 100, goal: 100 * header.target,
      values: series((k) => 100 * data.coverage[k]),
    },
    {
      name: "position error and 3σ", unit: "cm", digits: 1, colour: "--believed",
      values: series((k) => 100 * Math.hypot(data.true[3 * k] - data.estimate[3 * k], data.true[3 * k + 1] - data.estimate[3 * k + 1])),
      band: series((k) => {
        const [xx, xy, yy] = data.cov.subarray(4 * k, 4 * k + 3);
        return 300 * Math.sqrt(Math.max((xx + yy) / 2 + Math.hypot((xx - yy) / 2, xy), 0));
      }),
    },
    {
      name: "heading error and 3σ", unit: "mrad", digits: 2, colour: "--believed", signed: true,
      values: series((k) => 1e3 * turned(data.estimate[3 * k + 2] - data.true[3 * k + 2])),
      band: series((k) => 3e3 * Math.sqrt(data.cov[4 * k + 3])),
    },
    {
      // The start is known by definition.
      name: "NEES / 3, ideally 1 on average", unit: "", digits: 2, colour: "--landmark", goal: 1,
      values: series((k) => (k ? data.nees[k] / 3 : NaN)),
    },
  ];

  for (const curve of curves) {
    const figure = document.createElement("figure");
    figure.innerHTML = `<figcaption><span>${curve.name}${curve.unit ? ` [${curve.unit}]` : ""}</span><output></output></figcaption><canvas></canvas>`;
    byId("curves").append(figure);
    curve.canvas = figure.querySelector("canvas");
    curve.canvas.setAttribute("role", "img");
    curve.canvas.setAttribute("aria-label", `${curve.name} over time`);
    curve.output = figure.querySelector("output");
    let top = curve.least || 0;
    for (const values of [curve.values, curve.band || []]) {
      // A rare spike would flatten all else: the top is what all but the highest half per cent stay below.
      const sorted = Float32Array.from(values).map(Math.abs).filter(Number.isFinite).sort();
      if (sorted.length) top = Math.max(top, sorted[Math.min(sorted.length - 1, Math.floor(0.995 * sorted.length))] * 1.05);
    }
    curve.top = top || 1;
    const pick = (event) => {
      const at = (event.offsetX - 38) / (curve.canvas.clientWidth - 46);
      pause();
      seek(Math.round(Math.min(Math.max(at, 0), 1) * (n - 1)));
    };
    curve.canvas.addEventListener("pointerdown", pick);
    curve.canvas.addEventListener("pointermove", (event) => event.buttons && pick(event));
  }

  function ticks(top) {
    const power = 10 ** Math.floor(Math.log10(top));
    const unit = [5, 2, 1, 0.5, 0.2].map((f) => f * power).reverse().find((u) => top / u <= 4.01);
    return Array.from({ length: Math.floor(top / unit + 1e-6) + 1 }, (_, i) => i * unit);
  }

  function drawCurve(curve, k) {
    const { c, w, h, ratio } = fitted(curve.canvas, 132);
    const style = getComputedStyle(document.documentElement), tone = (name) => style.getPropertyValue(name).trim();
    c.clearRect(0, 0, w, h);
    c.scale(ratio, ratio);
    const width = w / ratio, height = h / ratio, left = 38, right = width - 8, top = 6, bottom = height - 18;
    const low = curve.signed ? -curve.top : 0;
    const x = (row) => left + ((right - left) * row) / Math.max(n - 1, 1);
    const y = (value) => bottom - ((bottom - top) * (Math.min(Math.max(value, low), curve.top) - low)) / (curve.top - low);
    Object.assign(c, { font: "11px system-ui, sans-serif", fillStyle: tone("--soft"), lineWidth: 1, strokeStyle: tone("--rule") });
    c.textAlign = "right";
    c.textBaseline = "middle";
    const marks = ticks(curve.top);
    for (const value of curve.signed ? [...marks, ...marks.slice(1).map((v) => -v)] : marks) {
      c.fillText(String(+value.toPrecision(3)), left - 5, y(value));
      c.beginPath();
      c.moveTo(left, y(value));
      c.lineTo(right, y(value));
      c.stroke();
    }
    c.textAlign = "center";
    const seconds = ticks((n - 1) * step || 1);
    for (const second of seconds) c.fillText(`${+second.toPrecision(3)} s`, Math.min(x(second / step), right - 10), height - 7);
    // More rows than pixels: of each pixel's rows the highest, so that no spike is lost.
    const stride = Math.max(1, Math.floor(n / (2 * width)));
    function peaks(values) {
      const found = [];
      for (let row = 0; row < n; row += stride) {
        let value = values[row];
        for (let j = row + 1; j < Math.min(row + stride, n); j++) if (Math.abs(values[j]) > Math.abs(value)) value = values[j];
        if (Number.isFinite(value)) found.push([row, value]);
      }
      return found;
    }
    if (curve.band) {
      const upper = peaks(curve.band);
      c.beginPath();
      for (const [row, value] of upper) c.lineTo(x(row), y(value));
      for (const [row, value] of upper.reverse()) c.lineTo(x(row), y(curve.signed ? -value : 0));
      c.globalAlpha = 0.16;
      c.fillStyle = tone(curve.colour);
      c.fill();
      c.globalAlpha = 1;
    }
    if (curve.goal !== undefined) {
      c.setLineDash([4, 4]);
      Object.assign(c, { strokeStyle: tone("--soft") });
      c.beginPath();
      c.moveTo(left, y(curve.goal));
      c.lineTo(right, y(curve.goal));
      c.stroke();
      c.setLineDash([]);
    }
    c.beginPath();
    for (const [row, value] of peaks(curve.values)) c.lineTo(x(row), y(value));
    Object.assign(c, { strokeStyle: tone(curve.colour), lineWidth: 1.6, lineJoin: "round" });
    c.stroke();
    Object.assign(c, { strokeStyle: tone("--goal"), lineWidth: 1.5 });
    c.beginPath();
    c.moveTo(x(k), top);
    c.lineTo(x(k), bottom);
    c.stroke();
    const value = curve.values[k];
    const band = curve.band ? ` of ${curve.signed ? "±" : ""}${curve.band[k].toFixed(curve.digits)}` : "";
    curve.output.textContent = Number.isFinite(value) ? `${value.toFixed(curve.digits)}${band}` : "–";
  }

  // Collisions, red below the slider.
  function drawMarks() {
    const { c, w, h } = fitted(byId("marks"), 5);
    c.clearRect(0, 0, w, h);
    c.fillStyle = "#d03030";
    for (let k = 1; k < n; k++) {
      if (data.collisions[k] > data.collisions[k - 1]) c.fillRect((w * k) / (n - 1) - 1, 0, 3, h);
    }
  }

  // ---- time ----------------------------------------------------------------------------------------------------

  const slider = byId("time"), button = byId("play"), speed = byId("speed");
  slider.max = n - 1;
  let k = 0, playing = false, exact = 0, last = 0, due = false;

  function draw() {
    due = false;
    drawWorld(k);
    drawBelief(k);
    for (const curve of curves) drawCurve(curve, k);
    slider.value = k;
    const clock = `${(k * step).toFixed(1)} s`;
    byId("clock").textContent = clock;
    slider.setAttribute("aria-valuetext", clock);
  }
  function redraw() {
    if (!due) { due = true; requestAnimationFrame(draw); }
  }
  function seek(row) {
    k = Math.min(Math.max(row, 0), n - 1);
    exact = k;
    redraw();
  }
  function pause() {
    playing = false;
    button.textContent = "▶";
    button.setAttribute("aria-label", "Play");
  }
  function play() {
    if (k >= n - 1) seek(0);
    playing = true;
    last = undefined;
    button.textContent = "❚❚";
    button.setAttribute("aria-label", "Pause");
    requestAnimationFrame(tick);
  }
  function tick(now) {
    if (!playing) return;
    const passed = last === undefined ? 0 : Math.max(now - last, 0);
    exact = Math.min(exact + (passed / 1e3 / step) * Number(speed.value), n - 1);
    last = now;
    if (Math.floor(exact) !== k) { k = Math.floor(exact); draw(); }
    if (exact >= n - 1) pause(); else requestAnimationFrame(tick);
  }

  button.addEventListener("click", () => (playing ? pause() : play()));
  slider.addEventListener("input", () => { pause(); seek(Number(slider.value)); });
  for (const input of document.querySelectorAll("[data-layer]")) {
    input.addEventListener("change", () => {
      layers[input.dataset.layer] = input.checked;
      if (input.dataset.layer === "follow") {
        if (input.checked && view.zoom < 2) zoom(3 / view.zoom);
        else if (!input.checked) whole();
      }
      redraw();
    });
  }
  document.addEventListener("keydown", (event) => {
    const second = Math.round((event.shiftKey ? 10 : 1) / step);
    const does = {
      " ": () => (playing ? pause() : play()),
      ArrowLeft: () => { pause(); seek(k - second); },
      ArrowRight: () => { pause(); seek(k + second); },
      Home: () => { pause(); seek(0); },
      End: () => { pause(); seek(n - 1); },
    }[event.key];
    if (!does || event.ctrlKey || event.metaKey || event.altKey || event.target.matches("select, summary")) return;
    // The button does so itself, and so does a box that was reached by keys.
    if (event.key === " " && event.target.matches("#play, input[type=checkbox]:focus-visible")) return;
    event.preventDefault();
    does();
  });

  // ---- zooming, both views alike ---------------------------------------------------------------------------------

  function zoom(factor) {
    if (!(factor > 0)) return; // two fingers on one spot
    view.zoom = Math.min(Math.max(view.zoom * factor, 1), 40);
    if (view.zoom === 1 && !layers.follow) whole();
    for (const canvas of canvases) canvas.classList.toggle("zoomed", view.zoom > 1);
    redraw();
  }
  function whole() {
    Object.assign(view, { zoom: 1, x: box.x + box.w / 2, y: box.y - box.h / 2 });
    layers.follow = document.querySelector("[data-layer=follow]").checked = false;
    for (const canvas of canvases) canvas.classList.remove("zoomed");
    redraw();
  }
  for (const canvas of canvases) {
    const touching = new Map();
    let meant = false; // the wheel: a click in the view says so, leaving it takes that back
    canvas.addEventListener("pointerleave", () => { meant = false; });
    const spread = () => {
      const [a, b] = [...touching.values()];
      return Math.hypot(a.x - b.x, a.y - b.y);
    };
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !meant && view.zoom === 1) return; // the page scrolls on
      event.preventDefault();
      const factor = Math.exp(-0.0016 * event.deltaY);
      const dx = (event.offsetX - canvas.clientWidth / 2) / canvas.scale;
      const dy = (canvas.clientHeight / 2 - event.offsetY) / canvas.scale;
      if (!layers.follow) { view.x += dx * (1 - 1 / factor); view.y += dy * (1 - 1 / factor); }
      zoom(factor);
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      touching.set(event.pointerId, { x: event.clientX, y: event.clientY });
      meant = true;
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = touching.get(event.pointerId);
      if (!before) return;
      const apart = touching.size === 2 ? spread() : 0;
      touching.set(event.pointerId, { x: event.clientX, y: event.clientY });
      if (touching.size === 2) zoom(spread() / apart);
      else if (view.zoom > 1 && !layers.follow) {
        view.x -= (event.clientX - before.x) / canvas.scale;
        view.y += (event.clientY - before.y) / canvas.scale;
        redraw();
      }
    });
    for (const end of ["pointerup", "pointercancel", "pointerleave"]) {
      canvas.addEventListener(end, (event) => touching.delete(event.pointerId));
    }
    canvas.addEventListener("dblclick", whole);
  }

  window.addEventListener("resize", () => { drawMarks(); redraw(); });
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  drawMarks();
  // report.html#t=12.5 opens at that time; otherwise the whole path and map are shown first.
  function asked() {
    const time = Number(/#t=([\d.]+)/.exec(location.hash)?.[1] ?? NaN);
    return Number.isFinite(time) ? Math.round(time / step) : n - 1;
  }
  window.addEventListener("hashchange", () => { pause(); seek(asked()); });
  seek(asked());
  window.replay = { seek, play, pause, data, header, map, get k() { return k; }, get playing() { return playing; } };
})();
