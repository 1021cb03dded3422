"use strict";
// The arrays of a page, by name.
async function unpack(listed, text) {
  const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(stream).arrayBuffer();
  const kinds = {
    float32: Float32Array, uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, int32: Int32Array,
  };
  const arrays = {};
  let at = 0;
  for (const [name, kind, size] of listed) {
    arrays[name] = new kinds[kind](buffer, at, size);
    at += Math.ceil(arrays[name].byteLength / 4) * 4;
  }
  return arrays;
}

// What is replayed of a robot. Everything is in its start frame, in metres, y upwards; `k` is a row. Of the map
// there is a picture for each of `shades`, the colours of unknown, free and occupied cells: alpha, blue, green, red.
function recordingOf(header, data, shades = [{ 0: 0xffe4e1de, 1: 0xffffffff, 101: 0xff4a3e36 }]) {
  const goalAt = offsets(data.goal_count), landmarkAt = offsets(data.landmark_count);
  const landmarks = data.landmark.length / 5;

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

  // The way ahead, x and y in turns; empty where there is none.
  function wayAt(k) {
    const i = noted(data.goal_step, k);
    return i < 0 ? [] : data.goal.subarray(2 * goalAt[i], 2 * goalAt[i + 1]);
  }

  // Of each landmark x, y and the semi-axes of its covariance in metres, the longer's direction in radians.
  function landmarksAt(k) {
    const i = noted(data.landmark_step, k), found = [];
    for (let j = landmarkAt[i]; j < landmarkAt[i + 1]; j++) {
      const [x, y, a, b, angle] = [0, 1, 2, 3, 4].map((row) => data.landmark[row * landmarks + j]);
      found.push([x / 1e3, y / 1e3, a / 1e4, b / 1e4, (angle * Math.PI) / 180]);
    }
    return found;
  }

  // The pose's covariance: semi-axes of its position [m], and the longer's direction.
  function poseEllipse(k) {
    const [xx, xy, yy] = data.cov.subarray(4 * k, 4 * k + 3), middle = (xx + yy) / 2, half = Math.hypot((xx - yy) / 2, xy);
    const axes = [middle + half, middle - half].map((v) => Math.sqrt(Math.max(v, 0)));
    return [...axes, Math.atan2(2 * xy, xx - yy) / 2];
  }

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
    const pictures = shades.map((shade) => {
      const canvas = new OffscreenCanvas(cols, rows), context = canvas.getContext("2d");
      const image = context.createImageData(cols, rows);
      return { shade, canvas, context, image, pixels: new Uint32Array(image.data.buffer) };
    });
    const classes = new Uint8Array(rows * cols); // 0 unknown, 1 free, 101 occupied
    let done = 0, cell = 0, edge = null;
    function clear() {
      done = cell = 0;
      classes.fill(0);
      for (const { pixels, shade } of pictures) pixels.fill(shade[0]);
    }
    function show(k) {
      const upTo = noted(data.map_step, k) + 1;
      if (upTo === done && done > 0) return;
      if (upTo < done || done === 0) clear();
      for (; done < upTo; done++) {
        let index = 0;
        for (const end = cell + data.map_count[done]; cell < end; cell++) {
          index += data.map_gap[cell];
          classes[index] = data.map_class[cell];
          const row = Math.floor(index / cols);
          const pixel = (rows - 1 - row) * cols + (index - row * cols);
          for (const { pixels, shade } of pictures) pixels[pixel] = shade[classes[index]];
        }
      }
      for (const { context, image } of pictures) context.putImageData(image, 0, 0);
      edge = null;
    }
    // Free cells beside unknown ones, as a path of squares on a canvas whose unit is the cell.
    function frontiers() {
      if (edge) return edge;
      const path = edge = new Path2D();
      for (let row = 0; row < rows; row++) {
        for (let col = 0, i = row * cols; col < cols; col++, i++) {
          if (classes[i] !== 1) continue;
          const inside = col > 0 && col < cols - 1 && row > 0 && row < rows - 1; // what lies outside is unknown
          if (inside && classes[i - 1] && classes[i + 1] && classes[i - cols] && classes[i + cols]) continue;
          path.rect(col, rows - 1 - row, 1, 1);
        }
      }
      return path;
    }
    clear();
    return { canvases: pictures.map(({ canvas }) => canvas), show, frontiers, classes };
  })();

  return { header, data, scanAt, wayAt, landmarksAt, poseEllipse, map };
}
