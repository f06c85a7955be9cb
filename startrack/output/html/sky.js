// The stars of an image and their marks.
const KINDS = {
  seen: ["seen", "its light is there"],
  hidden: ["hidden", "its light is missing: the ground hides it"],
  uncertain: ["uncertain", "too faint to decide"],
  unusable: ["unusable", "not measured"],
  identified: ["identified", "a point source has its name"],
  unmatched: ["not matched", "no point source was found there"],
  body: ["predicted", "Sun, Moon, Earth or planet, where it must be"],
  hiddenbody: ["predicted, hidden", "Sun, Moon, Earth or planet behind the ground, where it must be"],
};

const shownKind = (kind) => ({ identified: "seen", unmatched: "uncertain" }[kind] || kind);

function starsOf(detail) {
  if (!detail.stars) return [];
  const { columns } = detail.stars;
  const value = (name, k) => (columns[name] ? columns[name][k] : null);
  return columns.id.map((id, k) => ({
    id, unit: detail.stars.unit, ...Object.fromEntries(Object.keys(columns).map((name) => [name, columns[name][k]])),
    kind: value("status", k) || (known(value("mx", k)) ? "identified" : "unmatched"), px: value("x", k), py: value("y", k),
  })).map((star) => {
    const designation = detail.stars.designations?.[star.name];
    return { ...star, designation, designated: star.name ? designationOf(designation || star.name) : null };
  });
}

// Sun, Moon, Earth and planets in the picture.
function bodiesOf(detail) {
  return (detail.picture?.marks?.bodies || []).map(([name, px, py, hidden]) => ({ id: name, name, kind: hidden ? "hiddenbody" : "body", px, py }));
}

const isBody = (star) => star.kind === "body" || star.kind === "hiddenbody";

function starText(star) {
  const [word, meaning] = KINDS[star.kind] || [star.kind, ""];
  const light = known(star.flux) ? `${say(star.flux)} ± ${say(star.sigma)} ${star.unit}` : null;
  return [star.name || star.id, [
    ["catalogue", star.name && !isBody(star) ? star.id : null],
    ["designation", star.designation],
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
function mark(g, [x, y], kind, r, stroke) {
  g.strokeStyle = g.fillStyle = stroke || colour(shownKind(kind));
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

// A small drawing of a mark for a legend; `draw(g, at, kind, r)` draws it.
function markSample(kind, draw) {
  const canvas = make("canvas", { width: 36, height: 36, class: "sample", "aria-hidden": "true" });
  const paint = () => {
    const g = canvas.getContext("2d");
    g.setTransform(2, 0, 0, 2, 0, 0);
    g.clearRect(0, 0, 18, 18);
    draw(g, [9, 9], kind, 4.5);
  };
  View.all.add({ node: canvas, redraw: paint });
  paint();
  return canvas;
}

// Boxes to choose which of the kinds of marks in `words` are drawn; calls `change` after each choice.
function kindBoxes(title, words, marks, chosen, change, draw = mark) {
  const kinds = Object.keys(words).filter((kind) => marks.some((one) => one.kind === kind));
  return make("fieldset", { class: "kinds" }, make("legend", {}, title), ...kinds.map((kind) => {
    const box = make("input", { type: "checkbox", checked: chosen.has(kind), onchange: () => {
      if (box.checked) chosen.add(kind);
      else chosen.delete(kind);
      change();
    } });
    return make("label", {}, box, markSample(kind, draw), words[kind][0]);
  }));
}
