// The evidence by azimuth: stars near the skyline that are seen and hidden, and what each sector says for the position.
const AGAINST = "unusable"; // the colour
const BARS = { seen: "seen, as the position demands", hidden: "hidden, as it demands", [AGAINST]: "against the position: hidden above the skyline, or seen below it" };

function sectorPoints(sectors, height) {
  const count = sectors.nats.length;
  const width = 360 / count;
  return Array.from({ length: count }, (_, k) => ({ k, from: k * width, to: (k + 1) * width, x: (k + 0.5) * width, y: height(k) }));
}

function sectorText(sectors) {
  return ({ k, from, to }) => [`Azimuth ${sayDegrees(from, 0)} to ${sayDegrees(to, 0)}`, [
    ["above", `${sectors.above.seen[k]} seen, ${sectors.above.hidden[k]} hidden`],
    ["below", `${sectors.below.hidden[k]} hidden, ${sectors.below.seen[k]} seen`],
    ["for the position", say(sectors.supports[k], 1, "nats")], ["against it", say(sectors.opposes[k], 1, "nats")],
    ["beside the best horizon", known(sectors.nats[k]) ? say(sectors.nats[k], 1, "nats") : null],
  ]];
}

// One bar of a sector from one height to another; what speaks against the position is hatched as well as coloured.
function drawBar(v, g, point, low, high, kind) {
  if (low === high) return;
  const [left, top] = v.screen(point.from, Math.max(low, high));
  const [right, bottom] = v.screen(point.to, Math.min(low, high));
  const box = [left + 0.5, top, Math.max(right - left - 1, 1), bottom - top];
  g.fillStyle = colour(kind);
  g.fillRect(...box);
  if (kind !== AGAINST) return;
  g.save();
  g.beginPath();
  g.rect(...box);
  g.clip();
  g.strokeStyle = colour("plot");
  g.lineWidth = 1;
  g.beginPath();
  for (let x = left - (bottom - top); x < right; x += 5) {
    g.moveTo(x, bottom);
    g.lineTo(x + bottom - top, top);
  }
  g.stroke();
  g.restore();
}

function drawZero(v, g) {
  g.strokeStyle = colour("ink");
  g.lineWidth = 2;
  g.beginPath();
  g.moveTo(...v.screen(0, 0));
  g.lineTo(...v.screen(360, 0));
  g.stroke();
}

function sectorView(label, name, sectors, bars, unit) {
  const points = sectorPoints(sectors, (k) => bars(k).reduce((most, [, high]) => Math.max(most, high), 0));
  const all = points.flatMap(({ k }) => bars(k).flatMap(([low, high]) => [low, high]));
  const [low, high] = [least(all), -least(all.map((value) => -value))];
  return new View({
    label: `${label} of ${name}`, world: [0, Math.min(1.08 * low, -1), 360, Math.max(1.15 * high, 1)], square: false, ratio: window.innerWidth < 600 ? 0.6 : 0.2,
    points, describe: sectorText(sectors), most: 12,
    axes: { x: "azimuth, north through east", y: unit, steps: [AZIMUTH_STEPS, [1, 2, 5, 10, 20, 50, 100, 200, 500]], gap: 46, names: COMPASS,
      text: (value, step, axis) => (axis ? say(Math.abs(value), 0) : degreesText(value, step)) },
    draw(v, g) {
      for (const point of points) for (const [from, to, kind] of bars(point.k)) drawBar(v, g, point, from, to, kind);
      drawZero(v, g);
    },
  });
}

function evidenceCard(detail, name) {
  const { sectors } = detail;
  if (!sectors) return null;
  const { above, below } = sectors;
  const counts = (k) => [[0, above.seen[k], "seen"], [above.seen[k], above.seen[k] + above.hidden[k], AGAINST],
    [0, -below.hidden[k], "hidden"], [-below.hidden[k], -below.hidden[k] - below.seen[k], AGAINST]];
  const nats = (k) => [[0, sectors.supports[k], "skyline"], [0, -sectors.opposes[k], AGAINST]];
  const wrong = sectors.nats.flatMap((value, k) => (known(value) && value < sectors.contradicted_nats ? [k] : []));
  const width = 360 / sectors.nats.length;
  const words = wrong.length ? `Sectors that contradict the position: ${wrong.map((k) => `${k * width}° to ${(k + 1) * width}°`).join(", ")}.` : "No sector contradicts the position.";
  const key = make("ul", { class: "legend" }, ...Object.entries(BARS).map(([kind, text]) => make("li", {}, make("span", { class: `key bar ${kind}`, "aria-hidden": "true" }), text)));
  return section("Evidence by azimuth", make("p", { class: "dim" },
    `Stars within ${say(sectors.near_deg, 0)}° of the skyline at the estimated position, in sectors of ${width}°. ${words}`),
  make("h3", {}, "Number of stars above and below the skyline"), sectorView("Stars near the skyline by azimuth", name, sectors, counts, "stars").node, key,
  make("h3", { class: "next" }, "Their evidence for and against the position"), sectorView("Evidence of the stars by azimuth", name, sectors, nats, "nats").node);
}
