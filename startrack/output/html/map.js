// Maps: the search area with what fits, the position with its posterior, and the positions of a batch.
const MOST_CLOSE_MAPS = 4; // of positions that fit
const METRES = { x: "east", y: "north", left: 72, gap: 60, text: (value, step) => (step >= 1000 ? `${say(value / 1000, 0)} km` : say(value, step < 1 ? 1 : 0, "m")) };
const reliefs = {};

function reliefOf(name) {
  const terrain = page.terrains[name];
  if (terrain?.relief && !reliefs[name]) {
    reliefs[name] = new Image();
    reliefs[name].onload = () => View.all.forEach((view) => view.redraw());
    reliefs[name].src = terrain.relief;
  }
  return reliefs[name];
}

function drawGroundMap(v, g, name) {
  const terrain = page.terrains[name];
  if (!terrain) return;
  const relief = reliefOf(name);
  const [x, y] = v.screen(0, 0);
  const circle = (radius) => {
    g.beginPath();
    g.arc(x, y, radius * v.perX * v.zoom, 0, 2 * Math.PI);
  };
  if (relief?.complete) {
    const [east, north] = terrain.centre_m;
    const [left, top] = v.screen(east - terrain.half_m, north + terrain.half_m);
    const side = 2 * terrain.half_m * v.perX * v.zoom;
    g.globalAlpha = 0.75;
    g.drawImage(relief, left, top, side, side);
    g.globalAlpha = 1;
  }
  if (terrain.rim_m) {
    circle(terrain.rim_m);
    g.fillStyle = colour("floor");
    g.fill();
    drawGrid(v, g);
    circle(terrain.rim_m);
    g.strokeStyle = colour("dim");
    g.lineWidth = 2;
    g.stroke();
  }
  circle(terrain.search_m);
  g.strokeStyle = colour("dim");
  g.setLineDash([6, 5]);
  g.lineWidth = 1.2;
  g.stroke();
  g.setLineDash([]);
}

// The ellipse of a covariance at `times` sigma, as a path; false where it would be smaller than `least` px.
function ellipsePath(v, g, east, north, [ee, en, nn], times, least) {
  const mean = (ee + nn) / 2;
  const off = Math.hypot((ee - nn) / 2, en);
  const scale = times * v.perX * v.zoom;
  const [long, short] = [mean + off, mean - off].map((square) => Math.sqrt(Math.max(square, 0)) * scale);
  if (long < (least || 0)) return false;
  const [x, y] = v.screen(east, north);
  g.beginPath();
  g.ellipse(x, y, long, short, -0.5 * Math.atan2(2 * en, ee - nn), 0, 2 * Math.PI);
  return true;
}

function drawPlus(g, [x, y], r, stroke) {
  g.strokeStyle = stroke;
  g.lineWidth = 2.2;
  g.beginPath();
  g.moveTo(x - r, y);
  g.lineTo(x + r, y);
  g.moveTo(x, y - r);
  g.lineTo(x, y + r);
  g.stroke();
}

function drawDot(g, [x, y], r) {
  g.fillStyle = colour("place");
  g.beginPath();
  g.arc(x, y, r, 0, 2 * Math.PI);
  g.fill();
}

function drawPosterior(v, g, position) {
  const { east_m: east, north_m: north, covariance_m2: c } = position;
  if (c && ellipsePath(v, g, east, north, [c[0][0], c[0][1], c[1][1]], 1)) {
    g.fillStyle = colour("place");
    g.globalAlpha = 0.3;
    g.fill();
    g.globalAlpha = 1;
  }
  const at = v.screen(east, north);
  g.setLineDash([7, 5]);
  ring(g, at, (position.radius999_m || 0) * v.perX * v.zoom, colour("place"), 1.4);
  g.setLineDash([]);
  ring(g, at, (position.radius95_m || 0) * v.perX * v.zoom, colour("place"), 2.2);
  drawDot(g, at, 3.5);
}

// A word beside a position: on its right, or on its left where there is no room.
function sideText(v, g, text, [x, y], gap) {
  const right = x + gap + g.measureText(text).width <= v.box[2] - 4;
  g.textAlign = right ? "left" : "right";
  writeOn(g, text, right ? x + gap : x - gap, y, colour("ink"));
}

// The position with its circles, or every mode that has some where several positions fit, with its number.
function statedPositions(record) {
  const positions = record.position ? [record.position] : (record.modes || []).map((mode, k) => ({ ...mode, number: k + 1 }));
  return positions.filter((position) => known(position.radius95_m));
}

const circleRows = (position) => (known(position.radius95_m) ? [["95 % within", say(position.radius95_m, 1, "m")], ["99.9 % within", say(position.radius999_m, 1, "m")]] : []);

function placesOf(record, real) {
  const p = record.position;
  const stated = p && known(p.radius95_m);
  const places = (p && !stated ? [] : record.modes || []).map((mode, k) => ({
    x: mode.east_m, y: mode.north_m, title: record.modes.length > 1 ? `Position ${k + 1}` : "Posterior's peak",
    rows: [["probability", `${say(100 * mode.weight, mode.weight > 0.9995 ? 0 : 1)} %`], ...(p ? [] : circleRows(mode))], weight: mode.weight,
  }));
  if (p) places.unshift({ x: p.east_m, y: p.north_m, title: "Position", rows: stated ? circleRows(p) : [["approximate", "no circle"]] });
  if (real) places.push({ x: real[0], y: real[1], title: "True position", rows: [["", "not known to the method"]], real: true });
  return places;
}

const positionText = (place) => [place.title, [["east", say(place.x, 1, "m")], ["north", say(place.y, 1, "m")], ...place.rows]];

function drawPositions(v, g, record, places) {
  for (const position of record.position ? [record.position] : statedPositions(record)) drawPosterior(v, g, position);
  for (const place of places) {
    const at = v.screen(place.x, place.y);
    if (place.real) drawPlus(g, at, 8, colour("real"));
    else if (record.status !== "ok") {
      drawDot(g, at, 4);
      ring(g, at, 8, colour("place"), 2);
      g.font = "13px system-ui, sans-serif";
      g.textBaseline = "middle";
      sideText(v, g, `${place.title.replace("Position ", "")}: ${place.rows[0][1]}`, at, 13);
    } else if (!place.weight) ring(g, at, 9, colour("place"), 2);
  }
}

function areaView(record, real, name) {
  const terrain = page.terrains[record.provenance?.terrain];
  const places = placesOf(record, real);
  const reach = Math.max(terrain?.search_m || 0, terrain?.rim_m || 0, terrain?.half_m || 0, ...places.flatMap((one) => [Math.abs(one.x), Math.abs(one.y)]));
  const half = 1.06 * (reach || 1);
  return new View({
    label: `Search area of ${name}, north up`, world: [-half, -half, half, half], points: places, describe: positionText, most: 2000, axes: METRES,
    draw(v, g) {
      drawGroundMap(v, g, record.provenance?.terrain);
      drawPositions(v, g, record, places);
    },
  });
}

function placeView(record, p, real, name) {
  const places = placesOf(record, real);
  let half = 1.25 * Math.max(p.radius999_m || 0, p.radius95_m || 0, 0.5);
  const truth = real ? 1.2 * Math.hypot(real[0] - p.east_m, real[1] - p.north_m) : 0;
  if (truth < 6 * half) half = Math.max(half, truth); // farther off, the map would show no circle
  return new View({
    label: `Posterior of ${p.number ? `position ${p.number}` : "the position"} of ${name}`, world: [p.east_m - half, p.north_m - half, p.east_m + half, p.north_m + half],
    points: places, describe: positionText, most: 40, axes: METRES, draw: (v, g) => drawPositions(v, g, record, places),
  });
}

function mapLegend(record, real) {
  const item = (kind, text) => make("li", {}, make("span", { class: `key ${kind}`, "aria-hidden": "true" }), text);
  const whole = record.position ? "the posterior" : "this position’s part";
  const posterior = statedPositions(record).length ? [item("solid", `95 % of ${whole}`), item("dashed", "99.9 %"), record.position ? item("filled", "covariance, one sigma") : null] : [];
  const others = record.status !== "ok" ? [item("dot", "position that fits, with its probability")] : posterior.length ? [] : [item("dot", "position, approximate")];
  return make("ul", { class: "legend" }, ...posterior, ...others, real ? item("plus", "true position") : null);
}

const JOINED_MS = 6 * 3600e3; // between two positions of one drive; pictures of other days are other visits

// Every position of a batch on one terrain; those of one drive are joined in the order of time.
function trajectoryView(rows, terrain, open) {
  const value = (row, name) => row[column[name]];
  const placed = rows.filter((row) => known(value(row, "east_m"))).map((row) => ({ x: value(row, "east_m"), y: value(row, "north_m"), row, time: value(row, "time_utc") || "" }));
  const dated = placed.filter((place) => place.time).sort((a, b) => (a.time < b.time ? -1 : a.time > b.time ? 1 : 0));
  const joins = (k) => k > 0 && Date.parse(dated[k].time) - Date.parse(dated[k - 1].time) <= JOINED_MS;
  const xs = placed.map((place) => place.x);
  const ys = placed.map((place) => place.y);
  const [low, high] = [[least(xs), least(ys)], [-least(xs.map((x) => -x)), -least(ys.map((y) => -y))]];
  const half = Math.max(0.62 * Math.max(high[0] - low[0], high[1] - low[1]), 20 * Math.max(0.5, value(placed[0].row, "radius95_m") || 0));
  const [x, y] = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2];
  const draw = (v, g) => {
    drawGroundMap(v, g, terrain);
    g.beginPath();
    dated.forEach((place, k) => (joins(k) ? g.lineTo(...v.screen(place.x, place.y)) : g.moveTo(...v.screen(place.x, place.y))));
    g.strokeStyle = colour("skyline");
    g.lineWidth = 1.6;
    g.stroke();
    for (const place of placed) {
      const covariance = ["cov_ee", "cov_en", "cov_nn"].map((name) => value(place.row, name));
      if (known(covariance[0]) && ellipsePath(v, g, place.x, place.y, covariance, 2.4477, 4)) {
        g.strokeStyle = colour("place");
        g.lineWidth = 1.5;
        g.stroke();
      }
      drawDot(g, v.screen(place.x, place.y), placed.length > 500 ? 2.5 : 4);
      if (known(value(place.row, "real_e")) && v.zoom > 4) drawPlus(g, v.screen(value(place.row, "real_e"), value(place.row, "real_n")), 6, colour("real"));
    }
    g.font = "13px system-ui, sans-serif";
    g.textBaseline = "middle";
    const ends = dated.some((_, k) => joins(k)) ? [["first", dated[0]], ["last", dated[dated.length - 1]]] : [];
    for (const [word, place] of ends) {
      sideText(v, g, word, v.screen(place.x, place.y), 9);
    }
  };
  return new View({ label: "Positions, north up; those of one drive are joined", world: [x - half, y - half, x + half, y + half], points: placed, most: 5000, axes: METRES, draw,
    describe: (place) => rowText(place.row), open: (place) => open(place.row) });
}

const least = (values) => values.reduce((a, b) => Math.min(a, b), Infinity);

function rowText(row) {
  const value = (name) => row[column[name]];
  return [value("image"), [
    ["time", known(value("time_utc")) ? sayTime(value("time_utc")) : null], ["east", say(value("east_m"), 1, "m")],
    ["north", say(value("north_m"), 1, "m")], ["95 % within", say(value("radius95_m"), 1, "m")],
    ["error", known(value("error_m")) ? say(value("error_m"), 1, "m") : null], ["NEES", known(value("nees")) ? say(value("nees"), 2) : null],
  ]];
}
