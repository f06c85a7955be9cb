// How large the errors are and whether the stated ones hold, where the true positions are known.
const DECADES = [];
for (let power = -3; power < 6; power += 1) DECADES.push(power, power + Math.log10(2), power + Math.log10(5));

function errorsCard(rows, open) {
  const value = (row, name) => row[column[name]];
  const measured = rows.filter((row) => known(value(row, "error_m")));
  const e = page.errors;
  const words = facts([
    ["Images", `${say(e.count, 0)} with a known position`], ["Error", `${say(e.mean_m, 2, "m")} mean, ${say(e.median_m, 2, "m")} median, ${say(e.largest_m, 2, "m")} largest`],
    ["NEES", known(e.mean_nees) ? `${say(e.mean_nees, 2)} mean; 2 is perfect, less is cautious` : null],
    ["Inside the circle", known(e.inside95) ? `95 %: ${say(100 * e.inside95, 1)} % of images; 99.9 %: ${say(100 * e.inside999, 1)} %` : null],
  ]);
  return section("Errors", words, make("div", { class: "pair" },
    panel("Error beside the stated 95 % radius: right of the line an image lies outside its circle", circleView(measured, value, open)),
    panel("NEES: part of the images below a value; the smooth curve is what a perfect covariance gives", neesView(measured, value, open))));
}

function panel(caption, view) {
  view.node.append(make("figcaption", {}, caption));
  return view.node;
}

function circleView(rows, value, open) {
  const log = (metres) => Math.log10(Math.max(metres, 0.001));
  const points = rows.filter((row) => known(value(row, "radius95_m"))).map((row) => ({ x: log(value(row, "error_m")), y: log(value(row, "radius95_m")), row }));
  const all = points.flatMap((point) => [point.x, point.y]);
  const [low, high] = all.length ? [least(all) - 0.2, 0.2 - least(all.map((x) => -x))] : [0, 2];
  return new View({
    label: "Error of each image beside its stated 95 percent radius", world: [low, low, high, high], square: false, ratio: 0.75, points, most: 20,
    axes: { x: "error", y: "stated 95 % radius", fixed: DECADES, text: (power) => sayLength(Number((10 ** power).toPrecision(3))) },
    describe: (point) => rowText(point.row), open: (point) => open(point.row),
    draw(v, g) {
      g.strokeStyle = colour("skyline");
      g.lineWidth = 1.6;
      g.beginPath();
      g.moveTo(...v.screen(low, low));
      g.lineTo(...v.screen(high, high));
      g.stroke();
      for (const point of points) drawDot(g, v.screen(point.x, point.y), points.length > 500 ? 2 : 3.5);
    },
  });
}

function neesView(rows, value, open) {
  const sorted = rows.filter((row) => known(value(row, "nees"))).sort((a, b) => value(a, "nees") - value(b, "nees"));
  const points = sorted.map((row, k) => ({ x: value(row, "nees"), y: (k + 0.5) / sorted.length, row }));
  const high = Math.min(Math.max(8, 1.05 * (points.at(-1)?.x || 0)), 30);
  return new View({
    label: "NEES of the images, cumulative", world: [0, 0, high, 1], square: false, ratio: 0.75, points, most: 20, axes: { x: "NEES", y: "part of the images below" },
    describe: (point) => rowText(point.row), open: (point) => open(point.row),
    draw(v, g) {
      g.strokeStyle = colour("skyline");
      g.lineWidth = 1.6;
      g.beginPath();
      for (let k = 0; k <= 120; k += 1) g.lineTo(...v.screen((high * k) / 120, 1 - Math.exp((-0.5 * high * k) / 120)));
      g.stroke();
      for (const point of points) drawDot(g, v.screen(point.x, point.y), points.length > 500 ? 2 : 3.5);
    },
  });
}
