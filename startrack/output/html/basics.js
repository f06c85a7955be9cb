"use strict";
// What every part of the page needs: elements made without HTML in texts, numbers with units, colours of the theme.
const find = (id) => document.getElementById(id);
const page = JSON.parse(find("results").textContent);
const column = Object.fromEntries(page.columns.map((name, k) => [name, k]));

function make(tag, props, ...kids) {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(props || {})) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else node.setAttribute(key, value === true ? "" : value);
  }
  node.append(...kids.flat().filter((kid) => kid !== null && kid !== undefined && kid !== ""));
  return node;
}

function known(value) {
  return value !== null && value !== undefined && value !== "" && !(typeof value === "number" && !Number.isFinite(value));
}

// A number with grouped thousands, a true minus and its unit, which no line break separates from it.
function say(value, decimals, unit) {
  if (!known(value)) return "–";
  const digits = { minimumFractionDigits: decimals, maximumFractionDigits: decimals };
  const text = Number(value).toLocaleString("en-US", digits).replace(/^-(?=[0.,]*$)/, "").replace("-", "−");
  return unit ? `${text}\u00a0${unit}` : text;
}

function sayTime(utc) {
  return known(utc) ? `${String(utc).replace("T", " ").replace(/(\.\d+)?(Z|\+00:00)?$/, "")} UTC` : "not known";
}

function sayLength(metres) {
  if (metres >= 1000) return say(metres / 1000, metres % 1000 ? 1 : 0, "km");
  if (metres >= 1) return say(metres, metres % 1 ? 1 : 0, "m");
  return say(metres * 100, 0, "cm");
}

const sayDegrees = (value, decimals) => (known(value) ? `${say(value, decimals)}°` : "–");
const STATUS_WORDS = { ok: "solved", ambiguous: "ambiguous", refused: "refused" };
const statusWord = (status) => STATUS_WORDS[status] || status;

function badge(status) {
  return make("span", { class: `badge ${status in STATUS_WORDS ? status : "refused"}` }, statusWord(status));
}

let themeColours = {};
function colour(name) {
  if (!(name in themeColours)) {
    themeColours[name] = getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  }
  return themeColours[name];
}

// Text on a drawing, with a rim of the ground's colour that keeps it apart from whatever lies below.
function writeOn(g, text, x, y, fill, rim = colour("plot"), width = 4) {
  g.lineJoin = "round";
  g.lineWidth = width;
  g.strokeStyle = rim;
  g.strokeText(text, x, y);
  g.fillStyle = fill;
  g.fillText(text, x, y);
}

// What a file is called, with where it lies as a tooltip: "fisheye-2048" of "/somewhere/calib/fisheye-2048.toml".
const fileName = (path) => String(path).split(/[\\/]/).pop().replace(/\.toml$/, "");
const fileNode = (path) => (known(path) ? [make("span", fileName(path) === path ? {} : { title: path, class: "tipped" }, fileName(path))] : null);

// Rows of a table of facts: a term, what is known of it, and perhaps what it means; unknown ones are left out.
function facts(rows) {
  const shown = rows.filter(([, value]) => known(value) && value !== "–");
  return make("dl", { class: "facts" }, ...shown.flatMap(([term, value, help]) => [
    make("dt", help ? { title: help } : {}, help ? make("span", { class: "tipped" }, term) : term), make("dd", {}, ...(Array.isArray(value) ? value : [value])),
  ]));
}

function section(title, ...kids) {
  return make("section", { class: "card" }, make("h2", {}, title), ...kids);
}

// The smallest of 1, 2, 5 times a power of ten that is no less than the length.
function niceStep(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return ([1, 2, 5].find((m) => m * power >= length * 0.999999) || 10) * power;
}
