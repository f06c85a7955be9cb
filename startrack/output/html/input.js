// How a view is handled: mouse, fingers and keys.
View.prototype.listen = function listen() {
  const { canvas } = this;
  const place = (event) => {
    const frame = canvas.getBoundingClientRect();
    return [event.clientX - frame.left, event.clientY - frame.top];
  };
  canvas.addEventListener("wheel", (event) => {
    if (event.deltaY >= 0 && this.zoom <= 1) return; // nothing to zoom out of: the page scrolls
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 30 : 1;
    this.zoomBy(Math.exp(-event.deltaY * lines * 0.002), ...place(event));
  }, { passive: false });
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    this.fingers.set(event.pointerId, place(event));
    this.travelled = this.fingers.size > 1 ? Infinity : 0;
  });
  canvas.addEventListener("pointermove", (event) => this.moved(event, place(event)));
  canvas.addEventListener("pointerup", (event) => {
    this.fingers.delete(event.pointerId);
    if (this.travelled > 6) return;
    const point = this.nearest(...place(event), REACH[event.pointerType] || 12);
    const again = point && point === this.selected;
    this.select(point, true, event.pointerType !== "mouse");
    if (point && this.open && (event.pointerType === "mouse" || again)) this.open(point);
  });
  canvas.addEventListener("pointercancel", (event) => this.fingers.delete(event.pointerId));
  canvas.addEventListener("pointerleave", (event) => {
    if (event.pointerType === "mouse" && !this.fingers.size && !this.tapped) this.select(null); // a tap scrolls the page
  });
  canvas.addEventListener("dblclick", (event) => {
    event.preventDefault();
    this.reset();
  });
  canvas.addEventListener("keydown", (event) => this.pressed(event));
};

View.prototype.moved = function moved(event, now) {
  const before = this.fingers.get(event.pointerId);
  if (!before) {
    if (event.pointerType === "mouse") this.select(this.nearest(...now, REACH.mouse));
    return;
  }
  const others = [...this.fingers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
  this.fingers.set(event.pointerId, now);
  this.travelled += Math.hypot(now[0] - before[0], now[1] - before[1]);
  if (others.length) {
    const [other] = others;
    const apart = (at) => Math.max(Math.hypot(at[0] - other[0], at[1] - other[1]), 1);
    this.zoomBy(apart(now) / apart(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
    this.moveBy((now[0] - before[0]) / 2, (now[1] - before[1]) / 2);
  } else if (this.zoom > 1 && this.travelled > 3) {
    this.moveBy(now[0] - before[0], now[1] - before[1]);
  }
};

View.prototype.pressed = function pressed(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const acts = {
    "+": () => this.zoomBy(1.4), "=": () => this.zoomBy(1.4), "-": () => this.zoomBy(1 / 1.4), 0: () => this.reset(),
    n: () => this.step(1), p: () => this.step(-1), Escape: () => this.select(null),
    Enter: () => this.selected && this.open && this.open(this.selected),
  };
  if (this.zoom > 1) {
    Object.assign(acts, {
      ArrowLeft: () => this.moveBy(60, 0), ArrowRight: () => this.moveBy(-60, 0),
      ArrowUp: () => this.moveBy(0, 60), ArrowDown: () => this.moveBy(0, -60),
    });
  }
  if (!(event.key in acts)) return;
  event.preventDefault();
  acts[event.key]();
};

// Buttons and boxes as one stop of the tab key: arrow keys, Home and End move among them. `add` takes further ones in.
function rovingGroup(label, ...kids) {
  const bar = make("div", { role: "toolbar", "aria-label": label, class: "controls" }, ...kids);
  const all = () => [...bar.querySelectorAll("button, input")];
  const stopAt = (chosen) => all().forEach((one) => { one.tabIndex = one === chosen ? 0 : -1; });
  bar.addEventListener("focusin", (event) => stopAt(event.target));
  bar.addEventListener("keydown", (event) => {
    const places = all();
    const [here, count] = [places.indexOf(event.target), places.length];
    const next = { ArrowRight: here + 1, ArrowDown: here + 1, ArrowLeft: here - 1 + count, ArrowUp: here - 1 + count, Home: 0, End: count - 1 }[event.key];
    if (here < 0 || next === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    places[next % count].focus();
  });
  bar.add = (node) => {
    bar.append(node);
    stopAt(all()[0]);
  };
  stopAt(all()[0]);
  return bar;
}
