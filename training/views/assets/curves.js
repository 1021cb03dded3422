"use strict";
// What is measured, over time; `pick` is told the row that was pointed at. A curve has `values`, or several `lines`: of
// lines that are `alike` the least and the largest value are told, else the last one's, which lies above the others.
function openCurves(header, curves, pick) {
  const n = header.rows, step = header.step_s;
  for (const curve of curves) {
    const figure = document.createElement("figure");
    figure.innerHTML = `<figcaption><span>${curve.name}${curve.unit ? ` [${curve.unit}]` : ""}</span><output aria-live="off"></output></figcaption><canvas></canvas>`;
    document.getElementById("curves").append(figure);
    curve.canvas = figure.querySelector("canvas");
    curve.canvas.setAttribute("role", "img");
    curve.canvas.setAttribute("aria-label", `${curve.name} over time`);
    curve.output = figure.querySelector("output");
    if (curve.alike) curve.output.title = "least and largest at this time";
    let top = Math.max(curve.least || 0, curve.goal || 0);
    curve.lines ??= [curve];
    for (const values of [...curve.lines.map((line) => line.values), curve.band || []]) {
      // A rare spike would flatten all else: the top is what all but the highest half per cent stay below.
      const sorted = Float32Array.from(values).map(Math.abs).filter(Number.isFinite).sort();
      if (sorted.length) top = Math.max(top, sorted[Math.min(sorted.length - 1, Math.floor(0.995 * sorted.length))] * 1.05);
    }
    curve.top = top || 1;
    const point = (event) => {
      const at = (event.offsetX - 38) / (curve.canvas.clientWidth - 46);
      pick(Math.round(Math.min(Math.max(at, 0), 1) * (n - 1)));
    };
    curve.canvas.addEventListener("pointerdown", point);
    curve.canvas.addEventListener("pointermove", (event) => event.buttons && point(event));
  }

  function ticks(top) {
    const power = 10 ** Math.floor(Math.log10(top));
    const unit = [5, 2, 1, 0.5, 0.2].map((f) => f * power).reverse().find((u) => top / u <= 4.01);
    return Array.from({ length: Math.floor(top / unit + 1e-6) + 1 }, (_, i) => i * unit);
  }

  function drawCurve(curve, k) {
    const { c, w, h, ratio } = fitted(curve.canvas, 132);
    const style = getComputedStyle(document.documentElement), tone = (name) => (name.startsWith("#") ? name : style.getPropertyValue(name).trim());
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
    for (const line of curve.lines) {
      c.beginPath();
      for (const [row, value] of peaks(line.values)) c.lineTo(x(row), y(value));
      Object.assign(c, { strokeStyle: tone(line.colour), lineWidth: line.width ?? 1.6, lineJoin: "round" });
      c.stroke();
    }
    Object.assign(c, { strokeStyle: tone("--goal"), lineWidth: 1.5 });
    c.beginPath();
    c.moveTo(x(k), top);
    c.lineTo(x(k), bottom);
    c.stroke();
    const told = (curve.alike ? curve.lines : curve.lines.slice(-1)).map((line) => line.values[k]).filter(Number.isFinite);
    const ends = new Set([Math.min(...told), Math.max(...told)].map((value) => value.toFixed(curve.digits)));
    const band = curve.band ? ` of ${curve.signed ? "±" : ""}${curve.band[k].toFixed(curve.digits)}` : "";
    curve.output.textContent = told.length ? [...ends].join(" – ") + band : "–";
  }

  return {
    curves,
    draw(k) {
      for (const curve of curves) drawCurve(curve, k);
    },
  };
}

function positionError(data, k) {
  return Math.hypot(data.true[3 * k] - data.estimate[3 * k], data.true[3 * k + 1] - data.estimate[3 * k + 1]);
}

function headingError(data, k) {
  const off = data.estimate[3 * k + 2] - data.true[3 * k + 2];
  return Math.atan2(Math.sin(off), Math.cos(off));
}
