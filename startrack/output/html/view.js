// A drawing that can be zoomed (wheel, pinch, + and -), moved (drag, arrows), reset (double click, 0) and queried
// its points (hover, tap, n and p). World coordinates [x0, y0, x1, y1]; `up` where y grows upward.
const NARROW_PX = 480;
const REACH = { mouse: 12, pen: 16, touch: 26 };

class View {
  constructor(options) {
    Object.assign(this, { up: true, square: true, ratio: 1, most: 40, points: [], axes: null, shown: () => true }, options);
    this.canvas = make("canvas", { tabindex: "0", role: "img", "aria-label": `${this.label}. ${View.help}` });
    this.canvas.view = this;
    this.tip = make("div", { class: "tip", hidden: true });
    this.live = make("p", { class: "unseen", role: "status" });
    this.stage = make("div", { class: "stage", style: `aspect-ratio:${1 / this.ratio}` }, this.canvas);
    const tool = (text, label, act) => make("button", { type: "button", "aria-label": `${label}: ${this.label}`, onclick: act }, text);
    this.tools = make("div", { class: "tools" }, tool("+", "Zoom in", () => this.zoomBy(1.6)),
      tool("−", "Zoom out", () => this.zoomBy(1 / 1.6)), tool("Reset", "Show all", () => this.reset()));
    this.controls = rovingGroup(`Controls: ${this.label}`, this.tools);
    this.node = make("figure", { class: "view" }, this.stage, this.tip, this.controls, this.live);
    this.fingers = new Map();
    this.listen();
    this.centre = this.middle();
    this.zoom = 1;
    new ResizeObserver(() => this.resize()).observe(this.stage);
    View.all.add(this);
  }

  middle() {
    const [x0, y0, x1, y1] = this.world;
    return [(x0 + x1) / 2, (y0 + y1) / 2];
  }

  resize() {
    const dots = window.devicePixelRatio || 1;
    this.width = this.stage.clientWidth;
    this.height = this.stage.clientHeight;
    if (!this.width || !this.height) return;
    this.canvas.width = Math.round(this.width * dots);
    this.canvas.height = Math.round(this.height * dots);
    this.box = this.axes ? [this.axes.left || 48, 8, this.width - 8, this.height - 34] : [0, 0, this.width, this.height];
    const [x0, y0, x1, y1] = this.world;
    const [left, top, right, bottom] = this.box;
    this.perX = (right - left) / (x1 - x0);
    this.perY = (bottom - top) / (y1 - y0);
    if (this.square) this.perX = this.perY = Math.min(this.perX, this.perY);
    this.changed();
  }

  screen(x, y) {
    const [left, top, right, bottom] = this.box;
    return [(left + right) / 2 + (x - this.centre[0]) * this.perX * this.zoom,
      (top + bottom) / 2 + (y - this.centre[1]) * this.perY * this.zoom * (this.up ? -1 : 1)];
  }

  pointAt(sx, sy) {
    const [left, top, right, bottom] = this.box;
    return [this.centre[0] + (sx - (left + right) / 2) / (this.perX * this.zoom),
      this.centre[1] + (sy - (top + bottom) / 2) / (this.perY * this.zoom) * (this.up ? -1 : 1)];
  }

  zoomBy(factor, sx, sy) {
    if (!this.box) return;
    const here = [sx ?? (this.box[0] + this.box[2]) / 2, sy ?? (this.box[1] + this.box[3]) / 2];
    const before = this.pointAt(...here);
    this.zoom = Math.min(Math.max(this.zoom * factor, 1), this.most);
    const after = this.pointAt(...here);
    this.centre = [this.centre[0] + before[0] - after[0], this.centre[1] + before[1] - after[1]];
    this.changed();
  }

  moveBy(dx, dy) {
    this.centre = [this.centre[0] - dx / (this.perX * this.zoom),
      this.centre[1] - (dy / (this.perY * this.zoom)) * (this.up ? -1 : 1)];
    this.changed();
  }

  reset() {
    this.zoom = 1;
    this.centre = this.middle();
    this.selected = this.pinned = null;
    this.changed();
  }

  // How many pixels of the screen a unit of the world is wide.
  get magnified() {
    return this.perX * this.zoom * (window.devicePixelRatio || 1);
  }

  changed() {
    const [x0, y0, x1, y1] = this.world;
    const half = [(this.box[2] - this.box[0]) / 2 / (this.perX * this.zoom), (this.box[3] - this.box[1]) / 2 / (this.perY * this.zoom)];
    this.centre = [[x0, x1], [y0, y1]].map(([low, high], k) => (2 * half[k] >= high - low ? (low + high) / 2
      : Math.min(Math.max(this.centre[k], low + half[k]), high - half[k])));
    this.stage.dataset.zoom = this.zoom.toFixed(3);
    this.canvas.style.touchAction = this.zoom > 1 ? "none" : "pan-y";
    this.redraw();
  }

  redraw() {
    if (this.waiting) return;
    this.waiting = requestAnimationFrame(() => {
      this.waiting = null;
      if (this.box && this.node.isConnected) this.paint();
    });
  }

  paint() {
    const g = this.canvas.getContext("2d");
    const dots = window.devicePixelRatio || 1;
    g.setTransform(dots, 0, 0, dots, 0, 0);
    g.clearRect(0, 0, this.width, this.height);
    g.fillStyle = colour("plot");
    g.fillRect(0, 0, this.width, this.height);
    const [left, top, right, bottom] = this.box;
    g.save();
    g.beginPath();
    g.rect(left, top, right - left, bottom - top);
    g.clip();
    if (this.axes) drawGrid(this, g);
    this.draw(this, g);
    if (this.pinned) drawPin(g, this.screen(this.pinned.x, this.pinned.y));
    if (this.selected) {
      const at = this.screen(this.selected.x, this.selected.y);
      ring(g, at, 9, "#000", 4.5); // light on dark, to be seen on any ground
      ring(g, at, 9, "#fff", 2);
    }
    g.restore();
    if (this.axes) drawAxes(this, g);
    this.placeTip();
  }

  // Puts a point in the middle, at least so much magnified, and marks it until another is, or all is shown.
  pin(point, zoom) {
    this.pinned = point;
    if (point && zoom) {
      this.zoom = Math.min(Math.max(this.zoom, zoom), this.most);
      this.centre = [point.x, point.y];
    }
    if (this.box) this.changed();
  }

  nearest(sx, sy, reach) {
    let best = null;
    let least = reach * reach;
    for (const point of this.points) {
      if (!this.shown(point)) continue;
      const [x, y] = this.screen(point.x, point.y);
      const away = (x - sx) ** 2 + (y - sy) ** 2;
      if (away < least) [best, least] = [point, away];
    }
    return best;
  }

  // Selects a point and describes it; `aloud` for screen readers too. After a tap the description may stand below the stage.
  select(point, aloud, tapped) {
    if (point === this.selected) return;
    this.selected = point;
    this.tapped = Boolean(tapped);
    this.tip.replaceChildren();
    if (point) {
      const [title, rows] = this.describe(point);
      this.tip.append(make("strong", {}, title), facts(rows));
      if (aloud) this.live.textContent = `${title}: ${rows.filter(([, v]) => known(v)).map(([k, v]) => `${k} ${v}`).join(", ")}`;
    }
    this.canvas.style.cursor = point ? "pointer" : "";
    this.placeTip();
    if (this.tip.classList.contains("tapped")) this.tip.scrollIntoView({ block: "nearest" });
    this.redraw();
  }

  placeTip() {
    this.tip.hidden = !this.selected;
    if (!this.selected) return;
    const below = this.width < NARROW_PX; // there it would hide most of the drawing, and the point itself
    this.tip.classList.toggle("below", below);
    this.tip.classList.toggle("tapped", below && this.tapped);
    if (below) {
      this.tip.style.left = this.tip.style.top = "";
      return;
    }
    const [x, y] = this.screen(this.selected.x, this.selected.y);
    const { offsetWidth: w, offsetHeight: h } = this.tip;
    const left = x + 16 + w <= this.width ? x + 16 : x - 16 - w;
    this.tip.style.left = `${Math.min(Math.max(left, 4), Math.max(this.width - w - 4, 4))}px`;
    this.tip.style.top = `${Math.min(Math.max(y - h / 2, 4), Math.max(this.height - h - 4, 4))}px`;
  }

  step(by) {
    const [left, top, right, bottom] = this.box;
    const inside = this.points.filter((point) => {
      const [x, y] = this.screen(point.x, point.y);
      return this.shown(point) && x >= left && x <= right && y >= top && y <= bottom;
    });
    if (!inside.length) return;
    const next = (inside.indexOf(this.selected) + by + inside.length) % inside.length;
    this.select(inside[this.selected || by > 0 ? next : inside.length - 1], true);
  }
}

// Four strokes around a point, light on dark, that leave it and its mark free.
function drawPin(g, [x, y]) {
  for (const [stroke, width] of [["#000", 6], ["#ffd400", 3]]) {
    g.strokeStyle = stroke;
    g.lineWidth = width;
    g.beginPath();
    for (const [dx, dy] of [[1, 1], [-1, 1], [1, -1], [-1, -1]]) {
      g.moveTo(x + 14 * dx, y + 14 * dy);
      g.lineTo(x + 24 * dx, y + 24 * dy);
    }
    g.stroke();
  }
}

View.all = new Set();
View.help = "Plus and minus zoom, arrow keys move, 0 shows all, n and p step through the points";

function ring(g, [x, y], radius, stroke, width) {
  g.beginPath();
  g.arc(x, y, radius, 0, 2 * Math.PI);
  g.strokeStyle = stroke;
  g.lineWidth = width || 1.5;
  g.stroke();
}
