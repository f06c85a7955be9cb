// The grid, ticks and words of a drawing with axes.
const TICK_FONT = "12px system-ui, sans-serif";

function ticks(view, axis) {
  const [a, b] = [view.pointAt(view.box[0], view.box[3])[axis], view.pointAt(view.box[2], view.box[1])[axis]];
  const pixels = axis ? view.box[3] - view.box[1] : view.box[2] - view.box[0];
  const fixed = axis ? view.axes.fixedY || view.axes.fixed : view.axes.fixed;
  if (fixed) return [fixed.filter((value) => value >= Math.min(a, b) && value <= Math.max(a, b)), view.axes.fixed ? 1 : null];
  const given = axis ? view.axes.steps?.[1] : view.axes.steps?.[0];
  const stepOf = (gap) => {
    const least = (Math.abs(b - a) / pixels) * gap;
    return given?.find((one) => one >= least) ?? niceStep(least);
  };
  const gap = axis ? 46 : view.axes.gap || 74;
  const room = axis ? gap : Math.max(gap, ...[a, b].map((end) => widthOf(view, end, stepOf(gap)) + 16));
  const step = stepOf(room);
  const found = [];
  for (let k = Math.ceil(Math.min(a, b) / step); k * step <= Math.max(a, b) + 1e-9 * step; k += 1) found.push(k * step);
  return [found, step];
}

const tickText = (view, value, step, axis) => (view.axes.text ? view.axes.text(value, step, axis) : say(value, Math.max(0, Math.min(6, -Math.floor(Math.log10(step) + 1e-9)))));

// Width [px] of the text of the tick that is nearest to a value.
function widthOf(view, value, step) {
  const g = view.canvas.getContext("2d");
  g.font = TICK_FONT;
  return g.measureText(tickText(view, Math.round(value / step) * step, step, 0)).width;
}

function drawGrid(view, g) {
  g.strokeStyle = colour("grid");
  g.lineWidth = 1;
  g.beginPath();
  for (const x of ticks(view, 0)[0]) {
    const [sx] = view.screen(x, 0);
    g.moveTo(Math.round(sx) + 0.5, view.box[1]);
    g.lineTo(Math.round(sx) + 0.5, view.box[3]);
  }
  for (const y of ticks(view, 1)[0]) {
    const [, sy] = view.screen(0, y);
    g.moveTo(view.box[0], Math.round(sy) + 0.5);
    g.lineTo(view.box[2], Math.round(sy) + 0.5);
  }
  g.stroke();
}

function drawAxes(view, g) {
  const [left, top, right, bottom] = view.box;
  g.strokeStyle = colour("line");
  g.lineWidth = 1;
  g.strokeRect(left + 0.5, top + 0.5, right - left - 1, bottom - top - 1);
  g.fillStyle = colour("dim");
  g.font = TICK_FONT;
  g.textAlign = "center";
  g.textBaseline = "top";
  const [xs, xStep] = ticks(view, 0);
  for (const x of xs) {
    const [sx] = view.screen(x, 0);
    const text = view.axes.names?.[x] || tickText(view, x, xStep, 0);
    const half = g.measureText(text).width / 2;
    if (sx > left + 8 && sx + half < view.width) g.fillText(text, sx, bottom + 4);
  }
  g.fillText(view.axes.x, (left + right) / 2, bottom + 19);
  g.textAlign = "right";
  g.textBaseline = "middle";
  const [ys, yStep] = ticks(view, 1);
  for (const y of ys) {
    const [, sy] = view.screen(0, y);
    if (sy > top + 4 && sy < bottom - 2) g.fillText(tickText(view, y, yStep, 1), left - 5, sy);
  }
  g.textAlign = "left";
  g.textBaseline = "top";
  writeOn(g, view.axes.y, left + 6, top + 5, colour("dim"));
}
