"use strict";
// The theme of this browser, set before anything is drawn.
const THEMES = ["auto", "light", "dark"];
const darkDevice = window.matchMedia("(prefers-color-scheme: dark)");

function chosenTheme() {
  const kept = localStorage.getItem("theme");
  return THEMES.includes(kept) ? kept : "auto";
}

function applyTheme() {
  const chosen = chosenTheme();
  const dark = chosen === "auto" ? darkDevice.matches : chosen === "dark";
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  window.dispatchEvent(new Event("themed"));
}

darkDevice.addEventListener("change", applyTheme);
applyTheme();
