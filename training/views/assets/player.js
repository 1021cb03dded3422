"use strict";
// The replay of an episode: `k` is the row that is shown.
(async () => {
  const header = JSON.parse(document.getElementById("header").textContent);
  const byId = (id) => document.getElementById(id);
  let recording;
  try {
    recording = await openRecording(header, byId("data").textContent.trim());
  } catch (error) {
    byId("broken").hidden = false;
    return;
  }
  const { data, map } = recording, n = header.rows, step = header.step_s;
  const slider = byId("time"), button = byId("play"), speed = byId("speed");
  slider.max = n - 1;
  let k = 0, playing = false, exact = 0, last = 0, due = false;
  const parts = [
    await openViews(header, recording, redraw),
    openCurves(header, curvesOf(header, recording), (row) => { pause(); seek(row); }),
  ];

  // Collisions, red below the slider.
  function drawMarks() {
    const { c, w, h } = fitted(byId("marks"), 5);
    c.clearRect(0, 0, w, h);
    c.fillStyle = "#d03030";
    for (let k = 1; k < n; k++) {
      if (data.collisions[k] > data.collisions[k - 1]) c.fillRect((w * k) / (n - 1) - 1, 0, 3, h);
    }
  }

  function draw() {
    due = false;
    for (const part of parts) part.draw(k);
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
    const passed = last === undefined ? 0 : Math.min(Math.max(now - last, 0), 250); // no frames come while it is hidden
    exact = Math.min(exact + (passed / 1e3 / step) * Number(speed.value), n - 1);
    last = now;
    if (Math.floor(exact) !== k) { k = Math.floor(exact); draw(); }
    if (exact >= n - 1) pause(); else requestAnimationFrame(tick);
  }

  button.addEventListener("click", () => (playing ? pause() : play()));
  slider.addEventListener("input", () => { pause(); seek(Number(slider.value)); });
  document.addEventListener("keydown", (event) => {
    const second = Math.round((event.shiftKey ? 10 : 1) / step);
    const does = {
      " ": () => (playing ? pause() : play()),
      ArrowLeft: () => { pause(); seek(k - second); },
      ArrowRight: () => { pause(); seek(k + second); },
      Home: () => { pause(); seek(0); },
      End: () => { pause(); seek(n - 1); },
    }[event.key];
    if (!does || event.ctrlKey || event.metaKey || event.altKey || event.target.matches("select, summary, pre, .wide")) return;
    // The button does so itself, and so does a box that was reached by keys.
    if (event.key === " " && event.target.matches("#play, input[type=checkbox]:focus-visible")) return;
    event.preventDefault();
    does();
  });

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
  window.replay = { seek, play, pause, data, header, map, curves: parts[1].curves, get k() { return k; }, get playing() { return playing; } };
})();
