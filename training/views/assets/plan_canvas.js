"use strict";
const colours = {
  truth: "#168c70", believed: "#2c60cd", goal: "#de5c2a", frontier: "#f8a014", landmark: "#b22680", beam: "92,196,214",
};

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

// World and belief, side by side, and what is drawn on them; `redraw` is called where what they show has changed.
async function openCanvases(header, redraw) {
  const layers = {};
  for (const input of document.querySelectorAll("[data-layer]")) layers[input.dataset.layer] = input.checked;
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
  const canvases = ["world", "belief"].map((id) => document.getElementById(id));

  // `poses`: of the robot that is followed, where one is.
  function begin(canvas, poses, k) {
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

  function plan(c) {
    image(c, truth, box.x, box.y, box.w, box.h, true);
  }

  // What the lidar of a recording saw, from where it truly was.
  function scan(c, { header: own, data, scanAt }, k, px, colour) {
    const { row, ranges } = scanAt(k);
    const [x, y, theta] = [data.true[3 * row], data.true[3 * row + 1], data.true[3 * row + 2]];
    const sx = x + header.lidar.offset * Math.cos(theta), sy = y + header.lidar.offset * Math.sin(theta);
    c.beginPath();
    c.moveTo(sx, sy);
    const hits = [];
    ranges.forEach((range, b) => {
      if (Number.isNaN(range)) return;
      const angle = theta + own.angle_min + b * own.angle_increment, far = Math.min(range, own.range_max);
      c.lineTo(sx + far * Math.cos(angle), sy + far * Math.sin(angle));
      if (Number.isFinite(range)) hits.push([sx + far * Math.cos(angle), sy + far * Math.sin(angle)]);
    });
    c.closePath();
    c.fillStyle = `rgba(${colours.beam},.28)`;
    c.fill();
    c.fillStyle = colour;
    for (const [hx, hy] of hits) c.fillRect(hx - 1.2 * px, hy - 1.2 * px, 2.4 * px, 2.4 * px);
  }

  function ellipse(c, x, y, a, b, angle, least) {
    c.moveTo(x, y);
    c.beginPath();
    c.ellipse(x, y, Math.max(a, least), Math.max(b, least), angle, 0, 2 * Math.PI);
    c.stroke();
  }

  // Each a dot in its 3σ ellipse.
  function landmarks(c, found, px, colour) {
    Object.assign(c, { strokeStyle: colour, fillStyle: colour, lineWidth: 1.2 * px });
    for (const [x, y, a, b, angle] of found) {
      c.fillRect(x - 1.5 * px, y - 1.5 * px, 3 * px, 3 * px);
      ellipse(c, x, y, 3 * a, 3 * b, angle, 2 * px);
    }
  }

  // One of the map's pictures, on a canvas of the page.
  function map(c, { map }, header, k, canvas, picture = 0) {
    const m = header.map, left = m.col0 * m.resolution, top = (m.row0 + m.rows) * m.resolution;
    map.show(k);
    image(c, map.canvases[picture], left, top, m.cols * m.resolution, m.rows * m.resolution, canvas.scale * m.resolution < 2);
    return { left, top };
  }

  function goal(c, way, px, colour) {
    const last = way.length - 2;
    if (last < 0) return;
    c.beginPath();
    for (let j = 0; j <= last; j += 2) c.lineTo(way[j], way[j + 1]);
    Object.assign(c, { strokeStyle: colour, fillStyle: colour, lineWidth: 2 * px });
    c.stroke();
    c.beginPath();
    c.arc(way[last], way[last + 1], 4.5 * px, 0, 2 * Math.PI);
    c.fill();
  }

  // ---- zooming, both views alike -------------------------------------------------------------------------------

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
      const factor = Math.min(Math.max(Math.exp(-0.0016 * event.deltaY), 1 / view.zoom), 40 / view.zoom);
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

  return { layers, canvases, begin, plan, path, robot, scan, ellipse, landmarks, map, goal };
}
