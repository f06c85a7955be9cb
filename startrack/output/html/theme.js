// Light or dark: the browser's preference, until the button in the head of the page chooses the other one.
const PREFERS_DARK = "(prefers-color-scheme: dark)";
const darkRules = [...document.styleSheets].flatMap((sheet) => [...sheet.cssRules])
  .filter((rule) => rule instanceof CSSMediaRule && rule.conditionText === PREFERS_DARK);
const systemTheme = window.matchMedia(PREFERS_DARK);
const themeButton = find("theme");
let chosenTheme = null;

const currentTheme = () => chosenTheme || (systemTheme.matches ? "dark" : "light");

function showTheme() {
  const dark = currentTheme() === "dark";
  for (const rule of darkRules) rule.media.mediaText = chosenTheme ? (dark ? "all" : "not all") : PREFERS_DARK;
  document.documentElement.style.colorScheme = chosenTheme || "";
  themeButton.textContent = dark ? "Light theme" : "Dark theme";
  themeColours = {};
  for (const view of View.all) view.redraw();
}

themeButton.addEventListener("click", () => {
  chosenTheme = currentTheme() === "dark" ? "light" : "dark";
  showTheme();
});
systemTheme.addEventListener("change", showTheme);
showTheme();
themeButton.hidden = false;
