// The page of a track: its map, the frame that the slider points at, the stated errors by frame, and a table.
const frames = page.frames;
const count = frames.image.length;
const SIGMAS_95 = Math.sqrt(-2 * Math.log(0.05));
const FRAME_WORDS = { used: "used", left_out: "left out", refused: "refused" };
const shown = new Set(["smoothed", "filtered", "odometry", "ellipses"]);
let current = count - 1;

const frameBadge = (k) => make("span", { class: `badge ${frames.status[k]}` }, FRAME_WORDS[frames.status[k]]);
const placeOf = (k, prefix) => [frames[`${prefix}east_m`][k], frames[`${prefix}north_m`][k]];
const isPlaced = (k, prefix) => known(frames[`${prefix}east_m`][k]);
const all = Array.from({ length: count }, (_, k) => k);

function placeText(k, prefix) {
  if (!isPlaced(k, prefix)) return "not known";
  const [east, north] = placeOf(k, prefix);
  return `east ${say(east, 2, "m")}, north ${say(north, 2, "m")}`;
}

const radiusText = (k, prefix) => say(frames[`${prefix}radius95_m`][k], 2, "m");

function frameRows(k) {
  return [
    ["Time", sayTime(frames.time_utc[k])], ["Why", frames.message[k]], ["Odometry", frames.slipped[k] ? "slip before this frame" : frames.outside_odometry[k] ? "does not cover this time" : null],
    ["Search", frames.search[k] === "beam" ? "beam: ended before the proof that no other position fits" : null],
    ["Smoothed", placeText(k, "")], ["95 % within", radiusText(k, "")],
    ["Filtered", placeText(k, "filtered_")], ["95 % within", radiusText(k, "filtered_")],
    ["Latitude", known(frames.latitude_deg[k]) ? sayDegrees(frames.latitude_deg[k], 6) : null],
    ["Longitude", known(frames.longitude_deg[k]) ? sayDegrees(frames.longitude_deg[k], 6) : null],
  ];
}

// --- the map ---

function drawLine(v, g, places, name, width) {
  g.beginPath();
  for (const place of places) g.lineTo(...v.screen(...place));
  g.lineJoin = "round";
  for (const [stroke, wide] of [[colour("plot"), width + 2], [colour(name), width]]) {
    g.strokeStyle = stroke;
    g.lineWidth = wide;
    g.stroke();
  }
}

function drawEllipse(v, g, k, prefix, name, least) {
  const covariance = ["ee", "en", "nn"].map((axes) => frames[`${prefix}covariance_${axes}_m2`][k]);
  if (!isPlaced(k, prefix) || !ellipsePath(v, g, ...placeOf(k, prefix), covariance, SIGMAS_95, least)) return;
  g.strokeStyle = colour(name);
  g.stroke();
}

function drawCross(v, g, k) {
  const [x, y] = v.screen(...placeOf(k, ""));
  g.strokeStyle = colour("unused");
  g.lineWidth = 2.6;
  g.beginPath();
  const ends = frames.status[k] === "refused" ? [[-5, -5, 5, 5], [-5, 5, 5, -5]] : [[-7, 0, 7, 0], [0, -7, 0, 7]];
  for (const [a, b, c, d] of ends) {
    g.moveTo(x + a, y + b);
    g.lineTo(x + c, y + d);
  }
  g.stroke();
}

function drawCurrent(v, g) {
  g.lineWidth = 2.4;
  drawEllipse(v, g, current, "filtered_", "filtered", 3);
  drawEllipse(v, g, current, "", "place", 3);
  const [place] = points.filter((point) => point.k === current);
  if (!place) return;
  const at = v.screen(place.x, place.y);
  ring(g, at, 11, colour("plot"), 6);
  ring(g, at, 11, colour("ink"), 2.5);
}

function drawTrack(v, g) {
  drawGroundMap(v, g, page.terrain);
  if (shown.has("odometry") && page.odometry) drawLine(v, g, page.odometry, "odometry", 2);
  const [placed, passed] = ["", "filtered_"].map((prefix) => all.filter((k) => isPlaced(k, prefix)));
  g.lineWidth = 1.3;
  if (shown.has("ellipses")) placed.forEach((k) => drawEllipse(v, g, k, page.at_rest ? "filtered_" : "", page.at_rest ? "filtered" : "place", 5));
  if (shown.has("smoothed")) drawLine(v, g, placed.map((k) => placeOf(k, "")), "place", 2.5);
  if (shown.has("filtered")) {
    if (page.at_rest) drawLine(v, g, passed.map((k) => placeOf(k, "filtered_")), "filtered", 1.2);
    g.fillStyle = colour("filtered");
    for (const k of passed) {
      g.beginPath();
      g.arc(...v.screen(...placeOf(k, "filtered_")), count > 300 ? 2 : 3.2, 0, 2 * Math.PI);
      g.fill();
    }
  }
  placed.filter((k) => frames.status[k] !== "used").forEach((k) => drawCross(v, g, k));
  drawCurrent(v, g);
}

const points = all.filter((k) => isPlaced(k, "")).map((k) => {
  const [x, y] = placeOf(k, page.at_rest && isPlaced(k, "filtered_") ? "filtered_" : "");
  return { x, y, k };
});
const map = new View({
  label: "Track, north up", world: page.world, points, most: 2000, axes: METRES, draw: drawTrack,
  describe: ({ k }) => [frames.image[k], frameRows(k)], open: ({ k }) => choose(k),
});

function layers() {
  const kinds = { smoothed: "smoothed", filtered: "filtered", ...(page.odometry ? { odometry: "odometry alone" } : {}), ellipses: "95 % ellipses" };
  const box = ([kind, words]) => make("label", {}, make("input", {
    type: "checkbox", checked: true,
    onchange: (event) => {
      shown[event.target.checked ? "add" : "delete"](kind);
      map.redraw();
    },
  }), make("span", { class: `sample ${kind}`, "aria-hidden": "true" }), words);
  return make("fieldset", { class: "kinds" }, make("legend", {}, "Show"), ...Object.entries(kinds).map(box));
}

// --- the stated errors ---

// Radii from 0 on, or their logarithms where they differ much, which the axis then says (as in track.png).
const LOGARITHMIC = 8;
const allRadii = ["filtered_", ""].flatMap((prefix) => frames[`${prefix}radius95_m`].filter((metres) => known(metres) && metres > 0));
const isLog = allRadii.length > 0 && LOGARITHMIC * least(allRadii) < -least(allRadii.map((metres) => -metres));
const heightOf = (metres) => (isLog ? Math.log10(Math.max(metres, 0.001)) : metres);
const LENGTHS = [];
for (let power = -3; power < 7; power += 1) LENGTHS.push(power, power + Math.log10(2), power + Math.log10(5));

function radiiView() {
  const series = [["filtered_", "filtered"], ["", "place"]].map(([prefix, name]) => [
    all.filter((k) => known(frames[`${prefix}radius95_m`][k])).map((k) => ({ x: k + 1, y: heightOf(frames[`${prefix}radius95_m`][k]), k })), name,
  ]);
  const heights = series.flatMap(([line]) => line.map((point) => point.y));
  const top = heights.length ? -least(heights.map((y) => -y)) : 1;
  const [low, high] = isLog ? [least(heights) - 0.15, top + 0.15] : [0, 1.15 * top || 1];
  const inRange = LENGTHS.filter((value) => value >= low && value <= high);
  const lengths = inRange.length > 6 ? LENGTHS.filter(Number.isInteger) : LENGTHS;
  const view = new View({
    label: "Stated 95 percent radius by frame", world: [0.5, low, count + 0.5, high], square: false, ratio: 0.4, most: Math.max(1, count / 8), points: series[1][0],
    axes: isLog
      ? { x: "frame", y: "95 % radius (logarithmic)", left: 60, fixedY: lengths, text: (value, step) => (step === null ? sayLength(Number((10 ** value).toPrecision(3))) : say(value, 0)) }
      : { x: "frame", y: "95 % radius", left: 60, text: (value, _, axis) => (axis ? sayLength(Number(value.toPrecision(3))) : say(value, 0)) },
    describe: ({ k }) => [frames.image[k], [["filtered", radiusText(k, "filtered_")], ["smoothed", radiusText(k, "")]]], open: ({ k }) => choose(k),
    draw(v, g) {
      for (const [line, name] of series) {
        drawLine(v, g, line.map((point) => [point.x, point.y]), name, 2);
        g.fillStyle = colour(name);
        for (const point of count > 300 ? [] : line) {
          g.beginPath();
          g.arc(...v.screen(point.x, point.y), 2.6, 0, 2 * Math.PI);
          g.fill();
        }
      }
      drawLine(v, g, [[current + 1, low], [current + 1, high]], "ink", 1.5);
    },
  });
  return view;
}

// --- the chosen frame, the slider and the table ---

const rangeInput = make("input", { type: "range", min: "1", max: String(count), step: "1", "aria-label": "Frame", oninput: (event) => choose(Number(event.target.value) - 1) });
const caption = make("output", { "aria-live": "polite" });
const chosen = make("section", { class: "card", id: "frame" });
const radii = radiiView();
const bodyRows = all.map(tableRow);
let playing = null;

function choose(k) {
  bodyRows[current].removeAttribute("aria-current");
  current = Math.min(Math.max(k, 0), count - 1);
  bodyRows[current].setAttribute("aria-current", "true");
  rangeInput.value = String(current + 1);
  const words = `${frames.image[current]}, ${FRAME_WORDS[frames.status[current]]}`;
  rangeInput.setAttribute("aria-valuetext", `frame ${current + 1} of ${count}: ${words}`);
  caption.textContent = `${current + 1} of ${count} · ${sayTime(frames.time_utc[current])} · ${words} · 95 % within ${radiusText(current, "")}`;
  chosen.replaceChildren(make("div", { class: "title" }, make("h2", {}, frames.image[current]), frameBadge(current)), facts(frameRows(current)));
  showRow(bodyRows[current]);
  map.redraw();
  radii.redraw();
}

// Scrolls the table, and not the page, to a row.
function showRow(row) {
  const box = row.closest(".rows");
  if (!box) return;
  const [outer, inner] = [box.getBoundingClientRect(), row.getBoundingClientRect()];
  if (inner.top < outer.top + 44 || inner.bottom > outer.bottom) box.scrollTop += inner.top - outer.top - outer.height / 2;
}

function stop() {
  window.clearInterval(playing);
  playing = null;
  playButton.textContent = "Play";
  playButton.setAttribute("aria-pressed", "false");
}

function play() {
  if (playing) {
    stop();
    return;
  }
  if (current === count - 1) choose(0);
  playing = window.setInterval(() => (current < count - 1 ? choose(current + 1) : stop()), Math.max(60, Math.min(600, 20000 / count)));
  playButton.textContent = "Pause";
  playButton.setAttribute("aria-pressed", "true");
}

const playButton = make("button", { type: "button", "aria-pressed": "false", onclick: play }, "Play");

function slider() {
  const step = (by, text, label) => make("button", { type: "button", "aria-label": label, onclick: () => choose(current + by) }, text);
  return make("div", { class: "slider", role: "group", "aria-label": "Frame" }, step(-1, "‹", "Previous frame"), rangeInput, step(1, "›", "Next frame"), playButton, caption);
}

function tableRow(k) {
  const number = (name, decimals, kind) => make("td", { class: kind }, say(frames[name][k], decimals));
  const button = make("button", { type: "button" }, frames.image[k]);
  return make("tr", { onclick: () => choose(k) }, make("th", { scope: "row", class: "text" }, button),
    make("td", { class: "text extra" }, sayTime(frames.time_utc[k])), make("td", { class: "text" }, frameBadge(k)),
    number("east_m", 2), number("north_m", 2), number("radius95_m", 2), number("filtered_radius95_m", 2, "extra"));
}

function table() {
  const head = (text, kind) => make("th", { scope: "col", class: kind }, text);
  return make("div", { class: "scroll rows", tabindex: "0", role: "region", "aria-label": "Frames" }, make("table", { class: "frames" },
    make("thead", {}, make("tr", {}, head("Frame", "text"), head("Time", "text extra"), head("Status", "text"), head("East [m]"), head("North [m]"), head("95 % [m]"), head("filtered [m]", "extra"))),
    make("tbody", {}, ...bodyRows)));
}

function leadText() {
  const of = (status) => frames.status.filter((one) => one === status).length;
  const parts = Object.entries(FRAME_WORDS).map(([status, words]) => [of(status), words]).filter(([n]) => n).map(([n, words]) => `${say(n, 0)} ${words}`);
  const last = all.filter((k) => isPlaced(k, "") && known(frames.radius95_m[k])).at(-1);
  const where = last === undefined ? "" : ` Last position, ${sayTime(frames.time_utc[last])}: ${placeText(last, "").replaceAll(" ", "\u00a0").replace(",\u00a0", ", ")}, within ${radiusText(last, "")} (95 %).`;
  return `${say(count, 0)} ${count === 1 ? "frame" : "frames"} on ${page.terrain}: ${[parts.join(", "), ...page.crater, ...page.legs].join("; ")}.${where}`;
}

map.node.append(layers());
radii.node.append(make("figcaption", {}, "Smoothed: by all frames. Filtered: by the frames up to each."));
const host = find("overview");
host.append(
  make("h1", { tabindex: "-1" }, page.title), make("p", { class: "lead" }, leadText()),
  section("Map", make("p", { class: "dim" }, "Ellipses hold 95 % and have their true size: zoom in to see small ones. A click on a position chooses its frame."), make("div", { class: "beside" }, map.node, make("div", {}, chosen, radii.node))),
  slider(), section("Frames", table()),
  make("details", { class: "card" }, make("summary", {}, "Picture"), make("img", { class: "whole", src: page.picture, alt: "Map of the track with the stated errors by frame" })),
);
host.hidden = false;
choose(current);
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  themeColours = {};
  for (const view of View.all) view.redraw();
});
