// The search for a star or planet by name, designation or number: it is put in the middle of the picture and marked in
// every drawing.
const FOUND_ZOOM = 6;
const ANSWERED = ["catalogue", "magnitude", "direction"];

// The star that is meant: its name, its number in a catalogue, its designation (the brightest component where the words
// have no index), or the brightest whose name begins with, or holds, the words.
function starOf(stars, words) {
  const text = plain(words);
  if (!text) return null;
  const numbers = [text, `hip ${text}`];
  const names = (test) => stars.find((star) => star.name && test(plain(star.name)));
  const meant = designationOf(words);
  return names((name) => name === text) || stars.find((star) => numbers.includes(plain(star.id)))
    || stars.find((star) => isDesignation(star.designated, meant))
    || (/^\d+$/.test(text) ? null : names((name) => name.startsWith(text)) || names((name) => name.includes(text))) || null;
}

function goTo(star, views) {
  views.forEach((view, k) => {
    const point = view.points.find((one) => one.id === star.id);
    if (view.selected) view.select(null);
    view.pin(point || null, k ? null : FOUND_ZOOM);
  });
}

function searchForm(stars, detail, views) {
  const list = make("datalist", { id: "star-names" }, ...stars.filter((star) => star.name).map((star) => make("option", { value: star.name }, star.id)));
  const answer = make("p", { class: "dim answer", role: "status" });
  const input = make("input", { type: "search", id: "star-search", list: "star-names", autocomplete: "off", placeholder: "Vega, α Cen", "aria-keyshortcuts": "/" });
  const show = (star) => {
    goTo(star, views);
    const [title, rows] = starText(star);
    const texts = rows.filter(([term, text]) => known(text) && ANSWERED.includes(term)).map(([, text]) => text);
    answer.replaceChildren(make("strong", {}, title), `: ${[...texts, (KINDS[star.kind] || [star.kind])[0]].join(", ")}`);
  };
  const find = (event) => {
    event.preventDefault();
    const star = starOf(stars, input.value);
    if (star) show(star);
    else answer.textContent = input.value.trim() ? missing(input.value.trim(), stars, detail) : "";
  };
  input.addEventListener("input", () => {
    const meant = designationOf(input.value);
    const star = stars.find((one) => one.name && plain(one.name) === plain(input.value)) || stars.find((one) => isDesignation(one.designated, meant));
    if (star) show(star); // also where a name is picked from the list
  });
  return make("form", { role: "search", class: "search", onsubmit: find }, make("label", { for: "star-search" }, "Find a star"), input, list,
    make("button", { type: "submit" }, "Find"), answer);
}

function missing(words, stars, detail) {
  const { total } = detail.stars;
  const count = stars.filter((star) => !isBody(star)).length;
  return total > count ? `“${words}” is outside of the picture, or not among the ${say(count, 0)} brightest of its ${say(total, 0)} stars; NAME.stars.ecsv has all.`
    : `“${words}” is not among the ${say(total, 0)} stars in the picture.`;
}

document.addEventListener("keydown", (event) => {
  if (event.key !== "/" || event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, select, textarea")) return;
  const input = document.querySelector("#detail:not([hidden]) #star-search") || document.querySelector("#overview:not([hidden]) input[type=search]");
  if (!input) return;
  event.preventDefault();
  input.focus();
  input.select();
});
