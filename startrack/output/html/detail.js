// Everything about one image.
function detailOf(k) {
  const node = find(`detail-${k}`);
  return node ? JSON.parse(node.textContent) : null;
}

function showDetail(host, k) {
  const row = page.rows[k];
  const value = (name) => row[column[name]];
  const detail = detailOf(k);
  const record = detail ? detail.record : { status: value("status"), reason: value("reason"), message: value("message"), provenance: {} };
  const real = known(value("real_e")) ? [value("real_e"), value("real_n")] : null;
  const stars = detail ? starsOf(detail) : [];
  const name = value("image");
  const groups = detail ? factGroups(detail, value) : [];
  const views = []; // with stars to be found
  host.replaceChildren(...[
    make("div", { class: "title" }, make("h1", { tabindex: "-1" }, name), badge(record.status)),
    make("p", { class: "lead" }, leadOf(value, detail?.record)),
    refusalCard(record, detail?.advice), warningsCard(record), detail ? null : leftOut(),
    detail?.picture ? pictureCard(detail, stars, name, groups.splice(0, 3), views) : null,
    mapsCard(record, real, name),
    detail && stars.some((star) => known(star.az)) ? panoramaCard(detail, stars, name, views) : null,
    detail ? evidenceCard(detail, name) : null,
    groups.length ? make("div", { class: "cards" }, ...groups.map(([title, body]) => section(title, ...[body].flat()))) : null,
    stars.length ? starsCard(detail, stars) : null, filesCard(detail, value("stem"), value("kind")),
  ].filter(Boolean));
}

const LEAST_STAGES = 3; // of which a picture of their times shows something
const WIDE_TAIL = 5; // times the 95 % radius, from which that of 99.9 % is stated in the headline

// When, where, how sure, whither, and whether anything is doubtful.
function leadOf(value, record) {
  if (known(value("east_m"))) {
    const [radius95, radius999] = [value("radius95_m"), value("radius999_m")];
    const tail = known(radius999) && radius999 > WIDE_TAIL * radius95 ? ` and ${say(radius999, 1, "m")} (99.9 %)` : "";
    const level = record?.position?.protection_level_m;
    const heading = record?.attitude?.heading_deg;
    const warnings = record?.warnings?.length;
    return [
      known(value("time_utc")) ? `${sayTime(value("time_utc"))}: ` : "",
      `east\u00a0${say(value("east_m"), 1, "m")}, north\u00a0${say(value("north_m"), 1, "m")}, `,
      known(radius95) ? `within ${say(radius95, 1, "m")} (95 %)${tail}` : "approximate, no circle",
      known(level) ? `, protection level ${say(level, 1, "m")}` : "",
      known(heading) ? `; heading ${say(heading, 1)}°` : "",
      record?.warnings ? `; ${warnings ? say(warnings, 0) : "no"} warning${warnings === 1 ? "" : "s"}.` : ".",
      known(value("error_m")) ? ` The true position is ${say(value("error_m"), 1, "m")} away.` : "",
    ].join("").replace(/^e/, "E");
  }
  return value("status") === "ok" ? `${say(value("identified"), 0)} stars named.` : "";
}

function refusalCard(record, fitting) {
  if (record.status === "ok") return null;
  const [words, general] = page.words[record.reason] || [record.reason ? record.reason.replaceAll("_", " ") : statusWord(record.status), ""];
  const advice = fitting || general;
  const modes = record.status === "ambiguous" && record.modes ? make("ol", {}, ...record.modes.map((mode) => make("li", {},
    `East ${say(mode.east_m, 1, "m")}, north ${say(mode.north_m, 1, "m")}${known(mode.radius95_m) ? `, within ${say(mode.radius95_m, 1, "m")} (95 %)` : ""}: probability ${say(100 * mode.weight, 1)} %`))) : null;
  return make("section", { class: `card why ${record.status}`, "aria-label": "Why there is no single position" },
    make("h2", {}, words), known(record.message) ? make("p", { class: "message" }, record.message) : null, modes,
    advice ? make("p", {}, make("strong", {}, "What to try: "), advice) : null);
}

function warningsCard(record) {
  if (!record.warnings?.length) return null;
  return section("Warnings", make("ul", {}, ...record.warnings.map((text) => make("li", {}, text))));
}

function leftOut() {
  return make("p", { class: "card note" }, "This page holds the pictures and stars of some images only; startrack report OUT --images N holds more, and so does startrack report NAME.fix.json for this one.");
}

function pictureCard(detail, stars, name, groups, views) {
  const view = skyView(detail, stars, name);
  const found = Boolean(detail.picture.scale && stars.length);
  if (found) views.push(view);
  const hint = found ? "Point at a star, or tap it. Fainter stars appear as you zoom in. " : "";
  const ground = detail.record.modes?.length ? "; orange crosses are stars that should be here and are hidden, the blue line is the skyline at the estimated position." : ".";
  const below = [found ? searchForm([...stars, ...bodiesOf(detail)], detail, views) : null,
    make("p", { class: "dim" }, `${hint}Green rings are identified stars, grey rings other point sources${ground}`)];
  view.node.append(...below.filter(Boolean));
  return section("Picture", make("div", { class: "beside" }, view.node, make("div", {}, ...groups.map(([title, body]) => make("div", {}, make("h3", {}, title), body)))));
}

function panoramaCard(detail, stars, name, views) {
  const { total } = detail.stars;
  const cut = total > stars.length ? ` The ${say(stars.length, 0)} brightest of ${say(total, 0)} stars; fainter ones appear as you zoom in.` : " Fainter stars appear as you zoom in.";
  const line = detail.horizon ? "The blue line is the horizon that the map gives at the estimated position: seen stars belong above it, hidden ones below." : "The terrain's file is not available, so its horizon is omitted.";
  const dots = detail.skyline ? " The dots on it are the skyline that the image shows." : "";
  const panorama = panoramaView(detail, stars, name);
  const enlarged = detail.skyline?.above ? enlargedView(detail, stars, name) : null;
  views.push(panorama, ...(enlarged ? [enlarged] : []));
  return section("Panorama", make("p", { class: "dim" }, line + dots + cut), panorama.node,
    ...(enlarged ? [make("h3", { class: "next" }, "The skyline of the image, enlarged"),
      make("p", { class: "dim" }, "Its height above the horizon that the map gives at the estimated position. Bands are one sigma. Stars above the skyline should be seen, stars below it hidden."),
      enlarged.node] : []));
}

function mapsCard(record, real, name) {
  if (!record.position && !record.modes?.length) return null;
  const area = panel(`The search area${record.provenance?.terrain ? ` on ${fileName(record.provenance.terrain)}` : ""}; north is up`, areaView(record, real, name));
  const close = statedPositions(record).slice(0, MOST_CLOSE_MAPS).map((position) => panel(position.number
    ? `Position ${position.number}, probability ${say(100 * position.weight, 1)} %` : "The position and how sure it is", placeView(record, position, real, name)));
  return section("Map", make("div", { class: close.length ? "pair" : "single" }, area, ...close), mapLegend(record, real));
}

// The quantities of the record come with their texts; the page adds what it knows of the truth, times and origin.
function factGroups(detail, value) {
  const { record } = detail;
  const v = record.provenance;
  const groups = detail.facts.map(([title, rows]) => [title, facts(title === "Position" ? [...rows,
    ["Error", known(value("error_m")) ? say(value("error_m"), 2, "m") : null], ["NEES", known(value("nees")) ? say(value("nees"), 2) : null]] : rows)]);
  return [
    ...groups,
    Object.values(record.timing_ms || {}).filter((ms) => ms > 0).length >= LEAST_STAGES && ["Time of each stage", timings(record.timing_ms)],
    v && ["Made from", facts([["Time", sayTime(v.time_utc)], ["Exposure", known(v.exposure_s) ? say(v.exposure_s, 3, "s") : null], ["Camera", fileNode(v.camera)], ["Terrain", fileNode(v.terrain)],
      ["Catalogue", v.catalog], ["startrack", v.version], ["Image's SHA-256", v.image_sha256 ? [make("code", {}, v.image_sha256)] : null]])],
  ].filter(Boolean);
}

function timings(spent) {
  const all = Object.values(spent).reduce((sum, ms) => sum + (ms || 0), 0);
  const longest = Math.max(...Object.values(spent), 1e-9);
  const time = (ms) => (ms >= 1000 ? say(ms / 1000, 2, "s") : say(ms, ms < 10 ? 1 : 0, "ms"));
  const rows = Object.entries(spent).filter(([, ms]) => ms > 0).map(([stage, ms]) => make("tr", {}, make("th", { scope: "row" }, stage),
    make("td", { class: "bar" }, make("span", { style: `width:${(100 * ms) / longest}%` })), make("td", {}, time(ms))));
  return [make("table", { class: "times" }, make("tbody", {}, ...rows), make("tfoot", {}, make("tr", {}, make("th", { scope: "row" }, "all stages"), make("td"), make("td", {}, time(all))))),
    make("p", { class: "dim" }, "The first image of a run also pays for loading programs, catalogue and maps; later ones take less. The time on the command line contains the writing of tables and pictures, too.")];
}

function starsCard(detail, stars) {
  const head = ["Star", "V mag", "Status", "Light", "Expected", "Evidence"];
  const kept = stars.slice(0, 50);
  const body = kept.map((star) => make("tr", {}, make("th", { scope: "row" }, star.name ? `${star.name} (${star.id})` : star.id), ...[say(star.mag, 2),
    (KINDS[star.kind] || [star.kind])[0] + (star.cause ? `: ${star.cause}` : ""), say(star.flux, 0), say(star.exp, 0), say(star.ev, 2)].map((text) => make("td", {}, text))));
  return make("details", { class: "card" }, make("summary", {}, `The ${kept.length} brightest stars as a table`),
    make("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "The brightest stars" }, make("table", { class: "stars" },
      make("caption", {}, `Light in ${detail.stars.unit}; every star is in the star table`), make("thead", {}, make("tr", {}, ...head.map((text) => make("th", { scope: "col" }, text)))), make("tbody", {}, ...body))));
}

function filesCard(detail, stem, kind) {
  const folder = stem.slice(0, stem.lastIndexOf("/") + 1);
  const names = detail ? detail.files : [`${stem.slice(folder.length)}.${kind}.json`];
  const path = (name) => `${page.base}/${`${folder}${name}`.split("/").map(encodeURIComponent).join("/")}`;
  return section("Files", make("ul", { class: "files" }, ...names.map((name) => make("li", {}, make("a", { href: path(name) }, name)))));
}
