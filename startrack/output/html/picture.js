// The picture of the sky and the marks on it, which are drawn anew at every magnification.
const SKY_FONT = "13px system-ui, sans-serif";
const LETTER_FONT = "600 17px system-ui, sans-serif";
const BRIGHTEST_RING = 9; // px, of a star of magnitude 0
const NAMES_PER_WIDTH = 1 / 32; // so many at most, for each px of the picture's width
const LAYERS = {
  names: ["names"], skyline: ["skyline of the map"], measured: ["skyline by the sky's light"], others: ["other point sources"],
  bodies: ["planets"], compass: ["compass"],
};
const onSky = (name) => colour(`sky-${name}`);

function skyDot(g, [x, y], r, fill) {
  g.fillStyle = fill;
  g.beginPath();
  g.arc(x, y, r, 0, 2 * Math.PI);
  g.fill();
}

function skyLine(g, points, stroke, width) {
  g.beginPath();
  points.forEach(([x, y], k) => (k ? g.lineTo(x, y) : g.moveTo(x, y)));
  g.strokeStyle = stroke;
  g.lineWidth = width;
  g.lineJoin = "round";
  g.stroke();
}

// Text on the sky: its rim is dark in either theme.
function skyText(g, text, x, y, fill) {
  writeOn(g, text, x, y, fill, onSky("ground"), 3.5);
}

// A ring about a star that has a detection, a dot where only its light was measured; other kinds have their shapes.
function drawStar(g, at, star, r) {
  if (star.kind === "seen" || star.kind === "identified") {
    if (known(star.mx)) ring(g, at, r, onSky("seen"), 1.5);
    else skyDot(g, at, 2, onSky("seen"));
    return;
  }
  mark(g, at, star.kind, 0.62 * r, onSky(shownKind(star.kind)));
}

const LAYER_SAMPLES = {
  names: (g, [x, y]) => { g.font = SKY_FONT; g.textAlign = "center"; g.textBaseline = "middle"; g.fillStyle = colour("ink"); g.fillText("Aa", x, y); },
  skyline: (g, [x, y]) => skyLine(g, [[x - 8, y], [x + 8, y]], colour("skyline"), 2.5),
  measured: (g, [x, y]) => [-6, 0, 6].forEach((dx) => skyDot(g, [x + dx, y], 1.6, colour("ink"))),
  others: (g, at) => ring(g, at, 5, colour("uncertain"), 1.5),
  bodies: (g, at) => ring(g, at, 6, colour("body"), 2.5),
  compass: (g, [x, y]) => { g.font = LETTER_FONT; g.textAlign = "center"; g.textBaseline = "middle"; g.fillStyle = colour("ink"); g.fillText("N", x, y); },
};

function drawLayers(v, g, marks, chosen, place) {
  if (chosen.has("skyline")) for (const stretch of marks.skyline) skyLine(g, stretch.map(place), onSky("skyline"), 2);
  if (chosen.has("measured")) for (const one of marks.measured) skyDot(g, place(one), Math.min(1 + 0.5 * v.zoom, 3), onSky("ink"));
  g.globalAlpha = 0.6;
  const wide = v.width * v.zoom > 600; // else they would cover the stars
  if (wide && chosen.has("others")) for (const one of marks.others) ring(g, place(one), 4.5, onSky("uncertain"), 1.2);
  g.globalAlpha = 1;
  if (chosen.has("compass")) drawCompass(g, marks, place);
}

function drawCompass(g, marks, place) {
  g.textAlign = "center";
  g.textBaseline = "middle";
  for (const [azimuth, foot, top, letter] of marks.compass) {
    const main = azimuth % 30 === 0;
    skyLine(g, [place(foot), place(top)], onSky(main ? "ink" : "uncertain"), main ? 2 : 1);
    g.font = LETTER_FONT;
    if (COMPASS[azimuth]) skyText(g, COMPASS[azimuth], ...place(letter), onSky("ink"));
  }
  if (!marks.nose) return;
  const [tip, behind] = marks.nose.map(place);
  const along = Math.atan2(tip[1] - behind[1], tip[0] - behind[0]);
  const corner = (turn, length) => [tip[0] - length * Math.cos(along + turn), tip[1] - length * Math.sin(along + turn)];
  g.beginPath();
  for (const [x, y] of [tip, corner(0.45, 17), corner(0, 12), corner(-0.45, 17)]) g.lineTo(x, y);
  g.fillStyle = onSky("ink");
  g.fill();
  g.font = SKY_FONT;
  skyText(g, "forward", ...corner(0, 28), onSky("ink"));
}

// Names beside their marks, the brightest first, where no other name stands: [text, place, colour, gap].
function drawNames(v, g, names) {
  g.font = SKY_FONT;
  g.textAlign = "left";
  g.textBaseline = "middle";
  const taken = [];
  const most = Math.max(8, v.width * NAMES_PER_WIDTH);
  for (const [text, [x, y], fill, gap] of names) {
    if (taken.length >= most) return;
    if (x < 0 || y < 0 || x > v.width || y > v.height) continue;
    const width = g.measureText(text).width;
    const left = x + gap + width < v.width ? x + gap : x - gap - width;
    const box = [left - 3, y - 9, left + width + 3, y + 9];
    if (left < 0 || taken.some((one) => box[0] < one[2] && box[2] > one[0] && box[1] < one[3] && box[3] > one[1])) continue;
    taken.push(box);
    skyText(g, text, left, y, fill);
  }
}

function skyView(detail, stars, name) {
  const { picture } = detail;
  const { marks } = picture;
  const image = new Image();
  const chosen = new Set(marks ? ["seen", "identified", "hidden", ...Object.keys(LAYERS)] : []);
  const onPicture = (x, y) => [picture.scale * (x + 0.5), picture.scale * (y + 0.5)];
  const placed = picture.scale ? stars.filter((star) => known(star.px)).map((star) => {
    const [x, y] = onPicture(known(star.mx) ? star.mx : star.px, known(star.mx) ? star.my : star.py);
    return { ...star, x, y };
  }) : [];
  const bodyPoints = bodiesOf(detail).map((body) => {
    const [x, y] = onPicture(body.px, body.py);
    return { ...body, x, y };
  });
  const deepest = () => (view.width < 600 ? 3.2 : 4.8) + 1.7 * Math.log2(view.zoom); // fainter stars come with the zoom
  const isShown = (star) => !marks || (isBody(star) ? chosen.has("bodies") : chosen.has(star.kind) && star.mag <= deepest() - (star.kind === "hidden" ? 1 : 0));
  const view = new View({
    label: `Picture ${name} with its stars`, world: [0, 0, picture.width, picture.height], up: false,
    ratio: picture.height / picture.width, points: [...placed, ...bodyPoints], shown: isShown, describe: starText, most: 24,
    draw(v, g) {
      const [x, y] = v.screen(0, 0);
      const [right, bottom] = v.screen(picture.width, picture.height);
      g.imageSmoothingEnabled = v.magnified < 2; // magnified, a pixel shall look like one
      g.imageSmoothingQuality = "high";
      if (image.complete) g.drawImage(image, x, y, right - x, bottom - y);
      if (marks) drawMarks(v, g);
      else for (const star of placed) if (chosen.has(star.kind)) mark(g, v.screen(star.x, star.y), star.kind, 3.5 + 0.6 * Math.min(v.zoom, 6));
    },
  });
  const drawMarks = (v, g) => {
    const place = ([x, y]) => v.screen(...onPicture(x, y));
    const names = [];
    const grown = Math.min(0.75 + 0.25 * v.zoom, 2) * Math.min(Math.max(v.width / 600, 0.7), 1);
    drawLayers(v, g, marks, chosen, place);
    for (const star of placed) {
      if (!isShown(star)) continue;
      const at = v.screen(star.x, star.y);
      const r = Math.max(BRIGHTEST_RING - star.mag, 3.5) * grown;
      drawStar(g, at, star, r);
      if (star.name) names.push([star.name, at, onSky(shownKind(star.kind)), r + 4]);
    }
    const bodies = chosen.has("bodies") ? marks.bodies : [];
    for (const [, x, y, hidden] of bodies) {
      g.globalAlpha = hidden ? 0.6 : 1;
      ring(g, place([x, y]), hidden ? 6 : 9, onSky("body"), 2);
    }
    g.globalAlpha = 1;
    names.unshift(...bodies.map(([text, x, y]) => [text, place([x, y]), onSky("body"), 13]));
    if (chosen.has("names")) drawNames(v, g, names);
  };
  image.onload = () => view.redraw();
  image.src = picture.src;
  const redraw = () => view.redraw();
  if (placed.length) view.controls.add(kindBoxes("Mark stars", KINDS, placed, chosen, redraw));
  const words = marks?.undrawn ? { ...LAYERS, others: [`${LAYERS.others[0]} (${say(marks.undrawn, 0)} further not drawn)`] } : LAYERS;
  if (marks) view.controls.add(kindBoxes("Also draw", words, layersWithin(marks, placed), chosen, redraw, (g, at, kind) => LAYER_SAMPLES[kind](g, at)));
  return view;
}

// The layers that have anything to draw, in the form of marks.
function layersWithin(marks, placed) {
  return Object.keys(LAYERS).filter((kind) => (kind === "names" ? placed.some((star) => star.name) : marks[kind].length)).map((kind) => ({ kind }));
}
