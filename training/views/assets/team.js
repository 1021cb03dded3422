"use strict";
// The page of a team: its robots' recordings, all of them in two views, and curves of each and of all together.
// A robot's recording is in the frame of its own belief; `frame` is where that truly lies in the first robot's.
async function openRecording(header, text) {
  const arrays = await unpack(header.arrays, text);
  const robots = header.robots.map((robot) => {
    const data = {};
    for (const [name] of robot.arrays) data[name.slice(name.indexOf(".") + 1)] = arrays[name];
    return recordingOf(robot, data, shadesOf(robot.colour));
  });
  return { data: arrays, robots };
}

// Free cells in as much of the robot's colour as the pictures of a team have, and walls, which lie above all of them.
function shadesOf(colour) {
  const [red, green, blue] = [1, 3, 5].map((i) => Math.round(0.45 * parseInt(colour.slice(i, i + 2), 16) + 0.55 * 255));
  return [{ 0: 0, 1: (0xff000000 | (blue << 16) | (green << 8) | red) >>> 0, 101: 0 }, { 0: 0, 1: 0, 101: 0xff4a3e36 }];
}

async function openViews(header, { data, robots }, redraw) {
  const { layers, canvases, ...draw } = await openCanvases(header, redraw);
  const chosen = document.getElementById("map-of");
  chosen.addEventListener("change", redraw);
  const count = robots.length;
  // A robot that has ended stands still.
  const rowOf = (robot, k) => Math.min(k, robot.header.rows - 1);

  // Calls `paint` with the canvas in the frame of each robot, the first one last: it lies above.
  function each(c, shown, paint) {
    for (const robot of [...shown].reverse()) {
      const [x, y, theta] = robot.header.frame;
      c.save();
      c.translate(x, y);
      c.rotate(theta);
      paint(robot);
      c.restore();
    }
  }

  // Where a robot is in the first one's frame.
  function placed({ header: { frame } }, poses, k) {
    const [x, y, theta] = frame, c = Math.cos(theta), s = Math.sin(theta);
    return [x + c * poses[3 * k] - s * poses[3 * k + 1], y + s * poses[3 * k] + c * poses[3 * k + 1]];
  }

  function links(c, k, px) {
    c.beginPath();
    for (let i = 0; i < count; i++) {
      for (let j = 0; j < i; j++) {
        if (data.group[count * k + i] !== data.group[count * k + j]) continue;
        c.moveTo(...placed(robots[i], robots[i].data.true, rowOf(robots[i], k)));
        c.lineTo(...placed(robots[j], robots[j].data.true, rowOf(robots[j], k)));
      }
    }
    Object.assign(c, { strokeStyle: "#363e4a", lineWidth: 1.5 * px });
    c.setLineDash([2 * px, 5 * px]);
    c.stroke();
    c.setLineDash([]);
  }

  const followed = () => robots[Number(chosen.value || 0)];

  function drawWorld(k) {
    const { data: { true: poses } } = followed();
    const { c, px } = draw.begin(canvases[0], placed(followed(), poses, rowOf(followed(), k)), 0);
    draw.plan(c);
    if (layers.scan) each(c, robots, (robot) => draw.scan(c, robot, rowOf(robot, k), px, robot.header.colour));
    if (layers.links) links(c, k, px);
    if (layers.paths) each(c, robots, (robot) => draw.path(c, robot.data.true, rowOf(robot, k), robot.header.colour, px));
    each(c, robots, (robot) => draw.robot(c, robot.data.true, rowOf(robot, k), robot.header.colour));
  }

  // Where several have a place, the mean of their colours: sums of shares, laid on until they cover.
  const sums = new OffscreenCanvas(1, 1);
  function maps(c, shown, k) {
    const canvas = canvases[1], n = shown.length;
    if (!canvas.width || !canvas.height) return; // in a frame that is not shown yet
    Object.assign(sums, { width: canvas.width, height: canvas.height });
    const s = sums.getContext("2d");
    s.setTransform(c.getTransform());
    Object.assign(s, { globalCompositeOperation: "lighter", globalAlpha: 1 / n });
    each(s, shown, (robot) => draw.map(s, robot, robot.header, k, canvas, 0));
    c.save();
    c.setTransform(1, 0, 0, 1, 0, 0);
    for (let i = 0; i < (n > 1 ? 3 * n : 1); i++) c.drawImage(sums, 0, 0);
    c.restore();
    each(c, shown, (robot) => draw.map(c, robot, robot.header, k, canvas, 1));
  }

  function drawMaps(k) {
    const shown = chosen.value === "" ? robots : [followed()];
    const { data: { estimate: poses } } = followed();
    const { c, px } = draw.begin(canvases[1], placed(followed(), poses, rowOf(followed(), k)), 0);
    maps(c, shown, k);
    if (layers.landmarks) each(c, shown, (robot) => draw.landmarks(c, robot.landmarksAt(k), px, robot.header.colour));
    if (layers.paths) each(c, shown, (robot) => draw.path(c, robot.data.estimate, rowOf(robot, k), robot.header.colour, px));
    const goingOn = shown.filter((robot) => k < robot.header.rows);
    if (layers.goal) each(c, goingOn, (robot) => draw.goal(c, robot.wayAt(k), px, robot.header.colour));
    each(c, shown, (robot) => draw.robot(c, robot.data.estimate, rowOf(robot, k), robot.header.colour));
  }

  return {
    draw(k) {
      drawWorld(k);
      drawMaps(k);
    },
  };
}

function curvesOf(header, { data, robots }) {
  const n = header.rows, count = robots.length;
  const series = (f) => Float32Array.from({ length: n }, (_, k) => f(k));
  // After a robot's end there is nothing to show.
  const ofEach = (f) => robots.map((robot) => ({
    colour: robot.header.colour, values: series((k) => (k < robot.header.rows ? f(robot.data, k) : NaN)),
  }));
  const largest = (k) => Math.max(...Array.from({ length: count }, (_, g) =>
    data.group.subarray(count * k, count * (k + 1)).filter((group) => group === g).length));
  return [
    {
      name: "coverage: team, own maps", unit: "%", digits: 1, least: 100, goal: 100 * header.target,
      lines: [
        ...ofEach((own, k) => 100 * own.coverage[k]),
        { colour: "--ink", width: 2.4, values: series((k) => 100 * data.coverage[k]) },
      ],
    },
    { name: "position errors", unit: "cm", digits: 1, alike: true, lines: ofEach((own, k) => 100 * positionError(own, k)) },
    {
      name: "NEES / 3 of each, ideally 1 on average", unit: "", digits: 2, goal: 1, alike: true,
      lines: ofEach((own, k) => (k ? own.nees[k] / 3 : NaN)),
    },
    { name: "robots in the largest group in touch", unit: "", digits: 0, colour: "--link", least: count, values: series(largest) },
  ];
}
