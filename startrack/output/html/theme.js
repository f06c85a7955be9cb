// Light or dark: the browser's preference, until the button in the head of the page chooses the other one. The choice is
// kept for later visits where the browser can store it.
const THEME_KEY = "startrack-theme";
const PREFERS_DARK = "(prefers-color-scheme: dark)";
const darkRules = [...document.styleSheets].flatMap((sheet) => [...sheet.cssRules])
  .filter((rule) => rule instanceof CSSMediaRule && rule.conditionText === PREFERS_DARK);
const systemTheme = window.matchMedia(PREFERS_DARK);
const themeButton = find("theme");
let chosenTheme = storedTheme();

function storedTheme() {
  try {
    const theme = window.localStorage.getItem(THEME_KEY);
    return theme === "dark" || theme === "light" ? theme : null;
  } catch {
    return null; // a browser that refuses storage: its preference counts
  }
}

function storeTheme(theme) {
  try {
    window.localStorage.setItem(THEME_KEY, theme);
  } catch {
    themeButton.title = "This browser keeps the theme only until the page is reloaded";
  }
}

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
  storeTheme(chosenTheme);
  showTheme();
});
systemTheme.addEventListener("change", showTheme);
showTheme();
themeButton.hidden = false;
