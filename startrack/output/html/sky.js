// The stars of an image, their marks, and the picture.
const KINDS = {
  seen: ["seen", "its light is there"],
  hidden: ["hidden", "its light is missing: the ground hides it"],
  uncertain: ["uncertain", "too faint to decide"],
  unusable: ["unusable", "not measured"],
  identified: ["identified", "a point source has its name"],
  unmatched: ["not matched", "no point source was found there"],
};

function starsOf(detail) {
  if (!detail.stars) return [];
  const { columns } = detail.stars;
  const value = (name, k) => (columns[name] ? columns[name][k] : null);
  return columns.id.map((id, k) => ({
    id, unit: detail.stars.unit, ...Object.fromEntries(Object.keys(columns).map((name) => [name, columns[name][k]])),
    kind: value("status", k) || (known(value("mx", k)) ? "identified" : "unmatched"), px: value("x", k), py: value("y", k),
  }));
}

function starText(star) {
  const [word, meaning] = KINDS[star.kind] || [star.kind, ""];
  const light = known(star.flux) ? `${say(star.flux)} ± ${say(star.sigma)} ${star.unit}` : null;
  return [star.name || star.id, [
    ["catalogue", star.name ? star.id : null],
    ["magnitude", known(star.mag) ? `V ${say(star.mag, 2)}` : null],
    [word, star.cause || meaning],
    ["light", light],
    ["expected", known(star.exp) ? say(star.exp, 0, star.unit) : null],
    ["evidence", known(star.ev) ? `${star.ev > 0 ? "+" : ""}${say(star.ev, 2)}` : null],
    ["direction", known(star.az) ? `azimuth ${sayDegrees(star.az, 2)}, elevation ${sayDegrees(star.el, 2)}` : null],
    ["pixel", known(star.px) ? `${say(star.px, 1)}, ${say(star.py, 1)}` : null],
    ["measured", known(star.mx) ? `${say(Math.hypot(star.mx - star.px, star.my - star.py), 2, "px")} beside it` : null],
  ]];
}

// One shape for each kind, so that colour is never needed to distinguish them.
function mark(g, [x, y], kind, r) {
  g.strokeStyle = g.fillStyle = colour(kind === "identified" ? "seen" : kind === "unmatched" ? "uncertain" : kind);
  g.lineWidth = 1.6;
  g.beginPath();
  if (kind === "bystars" || kind === "byboth") {
    g.moveTo(x, y - r);
    g.lineTo(x + r, y);
    g.lineTo(x, y + r);
    g.lineTo(x - r, y);
    g.closePath();
    if (kind === "byboth") g.fill();
    else g.stroke();
  } else if (kind === "hidden") {
    g.moveTo(x - r, y - r);
    g.lineTo(x + r, y + r);
    g.moveTo(x - r, y + r);
    g.lineTo(x + r, y - r);
    g.stroke();
  } else if (kind === "unusable") {
    g.strokeRect(x - r, y - r, 2 * r, 2 * r);
  } else if (kind === "uncertain" || kind === "unmatched") {
    g.moveTo(x - r, y);
    g.lineTo(x + r, y);
    g.moveTo(x, y - r);
    g.lineTo(x, y + r);
    g.stroke();
  } else {
    g.arc(x, y, r, 0, 2 * Math.PI);
    g.fill();
  }
}

function markSample(kind) {
  const canvas = make("canvas", { width: 36, height: 36, class: "sample", "aria-hidden": "true" });
  const paint = () => {
    const g = canvas.getContext("2d");
    g.setTransform(2, 0, 0, 2, 0, 0);
    g.clearRect(0, 0, 18, 18);
    mark(g, [9, 9], kind, 4.5);
  };
  View.all.add({ node: canvas, redraw: paint });
  paint();
  return canvas;
}

// Boxes to choose which of the kinds of marks in `words` are drawn; calls `change` after each choice.
function kindBoxes(title, words, marks, chosen, change) {
  const kinds = Object.keys(words).filter((kind) => marks.some((one) => one.kind === kind));
  return make("fieldset", { class: "kinds" }, make("legend", {}, title), ...kinds.map((kind) => {
    const box = make("input", { type: "checkbox", checked: chosen.has(kind), onchange: () => {
      if (box.checked) chosen.add(kind);
      else chosen.delete(kind);
      change();
    } });
    return make("label", {}, box, markSample(kind), words[kind][0]);
  }));
}

function skyView(detail, stars, name) {
  const { picture } = detail;
  const image = new Image();
  const chosen = new Set();
  const placed = picture.scale ? stars.filter((star) => known(star.px)).map((star) => (
    { ...star, x: picture.scale * (star.px + 0.5), y: picture.scale * (star.py + 0.5) })) : [];
  const view = new View({
    label: `Annotated picture ${name}`, world: [0, 0, picture.width, picture.height], up: false,
    ratio: picture.height / picture.width, points: placed, describe: starText, most: 24,
    draw(v, g) {
      const [x, y] = v.screen(0, 0);
      const [right, bottom] = v.screen(picture.width, picture.height);
      g.imageSmoothingEnabled = v.magnified < 2; // magnified, a pixel shall look like one
      g.imageSmoothingQuality = "high";
      if (image.complete) g.drawImage(image, x, y, right - x, bottom - y);
      for (const star of placed) if (chosen.has(star.kind)) mark(g, v.screen(star.x, star.y), star.kind, 3.5 + 0.6 * Math.min(v.zoom, 6));
    },
  });
  image.onload = () => view.redraw();
  image.src = picture.src;
  if (placed.length) view.node.append(kindBoxes("Mark stars", KINDS, placed, chosen, () => view.redraw()));
  return view;
}
