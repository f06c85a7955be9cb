// The table of a batch: sorted by its headers, filtered by words and outcome. Only the rows in sight are in the page,
// so that ten thousand scroll as ten do; how high each is, for a long name, is therefore reckoned before it is there.
const ROW_PX = 40;
const LINE_PX = 17;
const ROOM_PX = 6; // above and below the lines of a name
const LETTER_PX = 16; // what a line may lack of being full, for the next letter is wider
const SPARE_ROWS = 12;
const quantityHead = ([key, text, unit, decimals, always]) => [key, text, `${unit === "m" && !always ? "metres " : ""}num${always ? "" : " extra"}`, (row) => say(row[key], decimals, unit || undefined)];
const inMetres = ([, , unit]) => unit === "m";
const HEADS = [
  ["image", "Image", "wide", null], ["status", "Outcome", "mid", null],
  ["time_utc", "Time (UTC)", "time extra", (row) => (known(row.time_utc) ? sayTime(row.time_utc).replace(" UTC", "") : "–")],
  ...page.headings.filter(inMetres).map(quantityHead),
  ["error_m", "Error", "num extra", (row) => say(row.error_m, 1, "m")], ["nees", "NEES", "num extra", (row) => say(row.nees, 2)],
  ...page.headings.filter((head) => !inMetres(head)).map(quantityHead),
  ["seconds", "Stages", "num extra", (row) => say(row.seconds, 1, "s")],
];

class Table {
  constructor(open) {
    this.open = open;
    this.rows = page.rows.map((row, index) => ({ index, ...Object.fromEntries(page.columns.map((name, k) => [name, row[k]])) }));
    for (const row of this.rows) row.words = [row.image, row.status, row.reason?.replaceAll("_", " "), row.message].join(" ").toLowerCase();
    this.heads = HEADS.filter(([key]) => this.rows.some((row) => known(row[key])));
    this.statuses = new Set();
    this.key = "image";
    this.down = false;
    this.build();
    this.choose();
  }

  build() {
    this.search = make("input", { type: "search", placeholder: "name or reason", "aria-label": "Filter by name or reason", oninput: () => this.choose() });
    this.count = make("p", { class: "dim", role: "status" });
    this.buttons = ["ok", "ambiguous", "refused"].filter((status) => this.rows.some((row) => row.status === status)).map((status) => {
      const button = make("button", { type: "button", "aria-pressed": "false", class: `toggle ${status}`, onclick: () => {
        if (this.statuses.delete(status)) button.setAttribute("aria-pressed", "false");
        else {
          this.statuses.add(status);
          button.setAttribute("aria-pressed", "true");
        }
        this.choose();
      } }, make("strong", {}, say(this.rows.filter((row) => row.status === status).length, 0)), ` ${statusWord(status)}`);
      return button;
    });
    this.cells = this.heads.map(([key, text, kind]) => make("th", { scope: "col", class: kind }, make("button", { type: "button", onclick: () => this.sortBy(key) }, text, make("span", { "aria-hidden": "true" }))));
    this.body = make("tbody");
    const table = make("table", { class: "images", "aria-rowcount": String(this.rows.length + 1) }, make("caption", { class: "unseen" }, "Images and what became of them"),
      make("thead", {}, make("tr", { "aria-rowindex": "1" }, ...this.cells)), this.body);
    this.scroller = make("div", { class: "scroll rows", tabindex: "0", role: "region", "aria-label": "Table of images", onscroll: () => this.fill() }, table);
    this.node = section("Images", make("div", { class: "filters" }, make("div", { class: "toggles", role: "group", "aria-label": "Filter by outcome" }, ...this.buttons), this.search), this.count, this.scroller);
    new ResizeObserver(() => this.resized()).observe(this.scroller);
  }

  resized() {
    const head = this.cells[0];
    if (head.clientWidth && head.clientWidth !== this.headWidth) {
      this.headWidth = head.clientWidth;
      this.measure(head);
      this.stack();
      this.first = null;
    }
    this.fill();
  }

  // Heights of all rows, a name taking the lines that it needs at the width of its column.
  measure(head) {
    const side = getComputedStyle(head.firstChild);
    const width = head.clientWidth - parseFloat(side.paddingLeft) - parseFloat(side.paddingRight) - LETTER_PX;
    const g = make("canvas").getContext("2d");
    const { fontSize, fontFamily } = getComputedStyle(this.body);
    g.font = `${fontSize} ${fontFamily}`;
    for (const row of this.rows) row.height = Math.max(ROW_PX, ROOM_PX + LINE_PX * Math.ceil(g.measureText(row.image).width / width));
  }

  // Where each row that is shown begins, and behind them where the last one ends.
  stack() {
    this.tops = [0];
    for (const row of this.shown) this.tops.push(this.tops.at(-1) + (row.height || ROW_PX));
  }

  rowAt(top) {
    let [low, high] = [0, this.shown.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.tops[middle + 1] <= top) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  sortBy(key) {
    this.down = this.key === key && !this.down;
    this.key = key;
    this.choose();
  }

  choose() {
    const words = this.search.value.toLowerCase().split(/\s+/).filter(Boolean);
    this.shown = this.rows.filter((row) => (!this.statuses.size || this.statuses.has(row.status)) && words.every((word) => row.words.includes(word)));
    const sign = this.down ? -1 : 1;
    this.shown.sort((a, b) => {
      const [x, y] = [a[this.key], b[this.key]];
      if (known(x) !== known(y)) return known(x) ? -1 : 1; // what is not known comes last, whichever way
      return (x < y ? -sign : x > y ? sign : 0) || a.index - b.index;
    });
    this.heads.forEach(([key], k) => {
      const sorted = key === this.key;
      this.cells[k].setAttribute("aria-sort", sorted ? (this.down ? "descending" : "ascending") : "none");
      this.cells[k].querySelector("span").textContent = sorted ? (this.down ? " ▼" : " ▲") : "";
    });
    this.count.textContent = this.shown.length === this.rows.length ? `${say(this.rows.length, 0)} images` : `${say(this.shown.length, 0)} of ${say(this.rows.length, 0)} images`;
    this.scroller.scrollTop = 0;
    this.stack();
    this.first = null;
    this.fill();
  }

  fill() {
    const { scrollTop, clientHeight } = this.scroller;
    const first = Math.max(0, this.rowAt(scrollTop) - SPARE_ROWS);
    const last = Math.min(this.shown.length, this.rowAt(scrollTop + (clientHeight || 600)) + 1 + SPARE_ROWS);
    if (first === this.first && last === this.last) return;
    const held = this.body.contains(document.activeElement) ? document.activeElement.closest("tr")?.dataset.index : null;
    [this.first, this.last] = [first, last];
    const spacer = (height) => (height ? make("tr", { "aria-hidden": "true", class: "spacer", style: `height:${height}px` }, make("td", { colspan: String(this.heads.length) })) : null);
    const rows = this.shown.slice(first, last).map((row, k) => this.line(row, first + k));
    this.body.replaceChildren(...[spacer(this.tops[first]), ...rows, spacer(this.tops.at(-1) - this.tops[last])].filter(Boolean));
    if (held) this.body.querySelector(`tr[data-index="${held}"] a`)?.focus({ preventScroll: true });
  }

  line(row, place) {
    const cells = this.heads.map(([key, , kind, text]) => {
      if (key === "image") return make("th", { scope: "row", class: kind, title: row.image }, make("a", { href: `#i${row.index}`, title: row.image }, row.image));
      if (key === "status") return make("td", { class: kind, title: row.reason }, badge(row.status), outcomeWords(row));
      return make("td", { class: kind }, text(row));
    });
    return make("tr", { "aria-rowindex": String(place + 2), "data-index": String(row.index), style: `height:${row.height || ROW_PX}px`, onclick: () => this.open(row.index) }, ...cells);
  }
}

function outcomeWords(row) {
  const words = row.reason && row.reason !== row.status ? row.reason.replaceAll("_", " ") : "";
  return words ? make("span", { class: "extra dim" }, ` ${words}`) : null;
}
