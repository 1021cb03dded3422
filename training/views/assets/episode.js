"use strict";
// The page of one robot: what it replays, its two views and its curves.
async function openRecording(header, text) {
  return recordingOf(header, await unpack(header.arrays, text));
}

async function openViews(header, recording, redraw) {
  const { data, wayAt, landmarksAt, poseEllipse, map } = recording;
  const { layers, canvases, ...draw } = await openCanvases(header, redraw);

  function drawWorld(k) {
    const { c, px } = draw.begin(canvases[0], data.true, k);
    draw.plan(c);
    if (layers.scan) draw.scan(c, recording, k, px, colours.truth);
    if (layers.paths) draw.path(c, data.true, k, colours.truth, px);
    draw.robot(c, data.true, k, colours.goal);
  }

  function drawBelief(k) {
    const { c, px } = draw.begin(canvases[1], data.estimate, k);
    const { left, top } = draw.map(c, recording, header, k, canvases[1]);
    if (layers.frontiers) {
      c.save();
      c.translate(left, top);
      c.scale(header.map.resolution, -header.map.resolution);
      c.fillStyle = colours.frontier;
      c.fill(map.frontiers());
      c.restore();
    }
    if (layers.landmarks) draw.landmarks(c, landmarksAt(k), px, colours.landmark);
    if (layers.paths) draw.path(c, data.estimate, k, colours.believed, px);
    if (layers.goal) draw.goal(c, wayAt(k), px, colours.goal);
    draw.robot(c, data.estimate, k, colours.believed);
    const [a, b, angle] = poseEllipse(k);
    Object.assign(c, { strokeStyle: colours.landmark, lineWidth: 2 * px });
    draw.ellipse(c, data.estimate[3 * k], data.estimate[3 * k + 1], 3 * a, 3 * b, angle, 1.5 * px);
  }

  return {
    draw(k) {
      drawWorld(k);
      drawBelief(k);
    },
  };
}

// Coverage, errors and consistency over time.
function curvesOf(header, { data, poseEllipse }) {
  const series = (f) => Float32Array.from({ length: header.rows }, (_, k) => f(k));
  return [
    {
      name: "coverage", unit: "%", digits: 1, colour: "--link", least: 100, goal: 100 * header.target,
      values: series((k) => 100 * data.coverage[k]),
    },
    {
      name: "position error and 3σ", unit: "cm", digits: 1, colour: "--believed",
      values: series((k) => 100 * positionError(data, k)),
      band: series((k) => 300 * poseEllipse(k)[0]),
    },
    {
      name: "heading error and 3σ", unit: "mrad", digits: 2, colour: "--believed", signed: true,
      values: series((k) => 1e3 * headingError(data, k)),
      band: series((k) => 3e3 * Math.sqrt(data.cov[4 * k + 3])),
    },
    {
      // The start is known by definition.
      name: "NEES / 3, ideally 1 on average", unit: "", digits: 2, colour: "--landmark", goal: 1,
      values: series((k) => (k ? data.nees[k] / 3 : NaN)),
    },
    {
      name: "health of the belief", unit: "", digits: 2, colour: "--link", least: 1, goal: 1,
      values: series((k) => data.health[k]),
    },
  ];
}
