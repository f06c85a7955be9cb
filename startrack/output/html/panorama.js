// The panorama: horizon of the map, skyline of the image, stars; and the skyline's height above the horizon, enlarged.
const SOURCES = [null, "bystars", "bylight", "byboth"]; // by the numbers in the data
const SKYLINES = {
  bylight: ["by the sky's light", "where the light of the sky stops"],
  bystars: ["by stars", "between seen and hidden stars"],
  byboth: ["by both", "where the light of the sky stops, and between seen and hidden stars"],
};
const COMPASS = { 0: "N", 90: "E", 180: "S", 270: "W", 360: "N" };
const AZIMUTH_STEPS = [0.1, 0.5, 1, 2, 5, 10, 15, 30, 45, 90];
const SECTOR_DEG = 1.5;
const degreesText = (value, step) => `${say(value, Math.max(0, -Math.floor(Math.log10(step) + 1e-9)))}°`;

function skylinePoints({ skyline }) {
  if (!skyline) return [];
  return skyline.az.map((az, k) => ({
    az, el: skyline.el[k], sigma: skyline.sigma[k], above: skyline.above?.[k], kind: SOURCES[skyline.source[k]],
  }));
}

function skylineText(point) {
  const above = known(point.above) ? `${point.above > 0 ? "+" : ""}${say(point.above, 3)}°` : null;
  return [`Skyline of the image at azimuth ${sayDegrees(point.az, 2)}`, [
    ["elevation", `${sayDegrees(point.el, 3)} ± ${sayDegrees(point.sigma, 3)}`], ["above the map's", above], ["from", SKYLINES[point.kind][1]],
  ]];
}

const markText = (one) => (one.kind in SKYLINES ? skylineText(one) : starText(one));

function drawStars(v, g, stars, least) {
  for (const star of stars) {
    if (!v.shown(star)) continue;
    const size = Math.max(least, 3.8 - 0.5 * star.mag) * Math.min(1 + 0.25 * Math.log2(v.zoom), 2.2);
    mark(g, v.screen(star.x, star.y), star.kind, star.kind === "seen" ? size : Math.max(size, 1.6));
  }
}

// Marks at the skyline's points, and one sigma to either side where that is wider than the mark.
function drawMeasured(v, g, points, least) {
  const radius = Math.min(Math.max(0.25 * SECTOR_DEG * v.perX * v.zoom, least), 3.5);
  const shown = points.filter((point) => v.shown(point));
  g.globalAlpha = 0.3;
  for (const point of shown) {
    const [left, top] = v.screen(point.x - SECTOR_DEG / 2, point.y + point.sigma);
    const [right, bottom] = v.screen(point.x + SECTOR_DEG / 2, point.y - point.sigma);
    g.fillStyle = colour(point.kind);
    if (bottom - top > 2 * radius) g.fillRect(left, top, right - left, bottom - top);
  }
  g.globalAlpha = 1;
  for (const point of shown) mark(g, v.screen(point.x, point.y), point.kind, point.kind === "bylight" ? radius : radius + 2);
}

function choices(view, chosen, stars, points) {
  const redraw = () => view.redraw();
  view.controls.add(kindBoxes("Mark stars", KINDS, stars, chosen, redraw));
  if (points.length) view.controls.add(kindBoxes("Skyline of the image", SKYLINES, points, chosen, redraw));
}

function panoramaView(detail, stars, name) {
  const { horizon } = detail;
  const chosen = new Set(["seen", "hidden", ...Object.keys(SKYLINES)]);
  const placed = stars.filter((star) => known(star.az)).map((star) => ({ ...star, x: star.az, y: star.el }));
  const measured = skylinePoints(detail).map((point) => ({ ...point, x: point.az, y: point.el }));
  const lowest = Math.min(0, ...(horizon || []), ...placed.map((star) => star.y)) - 1;
  const deepest = () => (view.width < 600 ? 4.7 : 6) + 1.5 * Math.log2(view.zoom); // fainter stars come with the zoom
  const view = new View({
    shown: (one) => chosen.has(one.kind) && !(one.mag > deepest()),
    label: `Panorama of ${name}: horizon of the estimated position, skyline of the image, and stars by azimuth and elevation`,
    world: [0, lowest, 360, 90], square: false, ratio: window.innerWidth < 600 ? 0.8 : 0.42, points: [...measured, ...placed], describe: markText, most: 60,
    axes: {
      x: "azimuth, north through east", y: "elevation", steps: [AZIMUTH_STEPS, [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30]],
      gap: 46, names: COMPASS, text: degreesText,
    },
    draw(v, g) {
      if (horizon) drawGround(v, g, horizon, lowest);
      if (horizon) drawUnknown(v, g, horizon, detail.unknown);
      drawStars(v, g, placed, 0.9);
      if (horizon) drawSkyline(v, g, horizon);
      drawMeasured(v, g, measured, 0.5);
    },
  });
  choices(view, chosen, placed, measured);
  if (horizon && detail.unknown.some(known)) view.node.append(make("p", {}, "Shaded: the maps end there, and ground beyond could stand so high."));
  return view;
}

// The skyline of the image and the stars near it, by their heights above the horizon of the map.
function enlargedView(detail, stars, name) {
  const { half, near } = detail.skyline;
  const chosen = new Set(["seen", "hidden", ...Object.keys(SKYLINES)]);
  const placed = near.map(([k, above]) => ({ ...stars[k], x: stars[k].az, y: above }));
  const measured = skylinePoints(detail).map((point) => ({ ...point, x: point.az, y: point.above }));
  const view = new View({
    shown: (one) => chosen.has(one.kind),
    label: `Skyline of ${name}: its height above the horizon of the estimated position by azimuth`,
    world: [0, -half, 360, half], square: false, ratio: window.innerWidth < 600 ? 0.7 : 0.26, points: [...measured, ...placed], describe: markText, most: 30,
    axes: { x: "azimuth, north through east", y: "height above the horizon of the map", left: 58, steps: [AZIMUTH_STEPS], gap: 46, names: COMPASS, text: degreesText },
    draw(v, g) {
      drawGround(v, g, [0, 0], -half);
      drawMeasured(v, g, measured, 1);
      drawSkyline(v, g, [0, 0]);
      drawStars(v, g, placed, 1.8);
    },
  });
  choices(view, chosen, placed, measured);
  return view;
}

function skylinePath(v, g, horizon) {
  horizon.forEach((elevation, k) => {
    const [x, y] = v.screen((360 * k) / (horizon.length - 1), elevation);
    if (k) g.lineTo(x, y);
    else g.moveTo(x, y);
  });
}

function drawGround(v, g, horizon, lowest) {
  g.beginPath();
  skylinePath(v, g, horizon);
  g.lineTo(...v.screen(360, lowest));
  g.lineTo(...v.screen(0, lowest));
  g.closePath();
  g.fillStyle = colour("ground");
  g.fill();
}

// Where the maps end: from the horizon up to where ground beyond them could stand.
function drawUnknown(v, g, horizon, unknown) {
  g.globalAlpha = 0.25;
  g.fillStyle = colour("hidden");
  unknown.forEach((elevation, k) => {
    if (!known(elevation)) return;
    const [left, top] = v.screen((360 * (k - 0.5)) / (horizon.length - 1), elevation);
    const [right, bottom] = v.screen((360 * (k + 0.5)) / (horizon.length - 1), horizon[k]);
    g.fillRect(left, top, right - left, bottom - top);
  });
  g.globalAlpha = 1;
}

function drawSkyline(v, g, horizon) {
  g.beginPath();
  skylinePath(v, g, horizon);
  g.strokeStyle = colour("skyline");
  g.lineWidth = 2;
  g.stroke();
}
