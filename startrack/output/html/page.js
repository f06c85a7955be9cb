// The page: the batch as a whole, or one image; which of them is said by the address after the #.
const overview = find("overview");
const detailHost = find("detail");
let cameFrom = 0;

function openImage(index) {
  window.location.hash = `#i${index}`;
}

function buildOverview() {
  const solved = page.rows.filter((row) => row[column.status] === "ok").length;
  const rowIndex = new Map(page.rows.map((row, k) => [row, k]));
  const open = (row) => openImage(rowIndex.get(row));
  overview.replaceChildren(...[
    make("h1", { tabindex: "-1" }, `${say(page.rows.length, 0)} ${page.rows.length === 1 ? "image" : "images"}`),
    make("p", { class: "lead" }, `${say(solved, 0)} solved, ${say(page.rows.length - solved, 0)} not.`),
    unreadCard(),
    new Table(openImage).node, trajectoryCard(open), page.errors ? errorsCard(page.rows, open) : null,
  ].filter(Boolean));
}

function unreadCard() {
  if (!page.unread.length) return null;
  const [first, rest] = [page.unread.slice(0, 20), page.unread.length - 20];
  return make("section", { class: "card why refused" }, make("h2", {}, `${say(page.unread.length, 0)} of the results could not be read`),
    make("ul", {}, ...first.map((text) => make("li", {}, text)), rest > 0 ? make("li", {}, `and ${say(rest, 0)} others`) : null));
}

// What the map of positions shows, in numbers.
function placesFacts(rows) {
  const of = (name) => rows.map((row) => row[column[name]]).filter(known).sort((a, b) => a - b);
  const span = (values) => (values.length ? say(values.at(-1) - values[0], 0, "m") : null);
  const radii = of("radius95_m");
  const median = (radii[Math.floor((radii.length - 1) / 2)] + radii[Math.floor(radii.length / 2)]) / 2;
  const times = rows.map((row) => row[column.time_utc]).filter(known).sort();
  return facts([["Positions", say(rows.length, 0)], ["From", times.length ? sayTime(times[0]) : null], ["To", times.length ? sayTime(times.at(-1)) : null],
    ["East to west", span(of("east_m"))], ["North to south", span(of("north_m"))],
    ["95 % within", radii.length ? `${say(median, 1, "m")} median, ${say(radii.at(-1), 1, "m")} largest` : null]]);
}

function trajectoryCard(open) {
  const located = page.rows.filter((row) => known(row[column.east_m]));
  const names = [...new Set(located.map((row) => row[column.terrain] || ""))].sort();
  if (!names.length) return null;
  const holder = make("div", { class: "beside" });
  const show = (name) => {
    const shown = located.filter((row) => (row[column.terrain] || "") === name);
    holder.replaceChildren(trajectoryView(shown, name, open).node, make("div", {}, placesFacts(shown)));
  };
  const select = make("select", { "aria-label": "Terrain", onchange: () => show(select.value) }, ...names.map((name) => make("option", { value: name }, name ? fileName(name) : "terrain not known")));
  show(names[0]);
  return section("Positions", make("p", { class: "dim" }, "Positions less than 6 hours apart are joined in the order of time. Zoomed in, ellipses hold 95 % of each position's posterior. A click opens the image."), names.length > 1 ? select : null, holder);
}

function neighbours(k) {
  const link = (index, text) => (index >= 0 && index < page.rows.length ? make("a", { href: `#i${index}` }, text) : make("span", { class: "dim" }, text));
  return make("nav", { class: "path", "aria-label": "Images" }, make("a", { href: "#all" }, "← All images"), make("span", {}, link(k - 1, "Previous"), " · ", link(k + 1, "Next")));
}

function route() {
  const match = /^#i(\d+)$/.exec(window.location.hash);
  const index = page.single ? 0 : match && Number(match[1]) < page.rows.length ? Number(match[1]) : null;
  if (index === null && !["", "#all"].includes(window.location.hash) && !detailHost.hidden) return; // #main: stay
  const change = overview.hidden !== (index !== null) || detailHost.dataset.index !== String(index);
  if (!change) return;
  const moved = !(overview.hidden && detailHost.hidden);
  if (index !== null && !overview.hidden) cameFrom = window.scrollY;
  overview.hidden = index !== null;
  detailHost.hidden = index === null;
  detailHost.dataset.index = String(index);
  if (index === null) detailHost.replaceChildren();
  else {
    showDetail(detailHost, index);
    if (!page.single) detailHost.prepend(neighbours(index));
  }
  for (const view of View.all) if (view.stage && !view.node.isConnected) View.all.delete(view);
  if (moved) {
    window.scrollTo(0, index === null ? cameFrom : 0);
    (index === null ? overview : detailHost).querySelector("h1")?.focus({ preventScroll: true });
  }
}

if (!page.single) buildOverview();
window.addEventListener("hashchange", route);
route();
