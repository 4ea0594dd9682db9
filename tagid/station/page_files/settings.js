"use strict";
// The settings: of the station in its configuration file, and of this browser.
let settings = null;
const FREE = /^free(?:\?rpm=([0-9.]+)(&direction=(?:cw|ccw))?)?$/;

async function loadSettings() {
  const answer = await ask("settings");
  if (answer) showSettings(answer);
}

function setting(name) {
  return settings.items.find((one) => one.name === name);
}

function showSettings(found) {
  settings = found;
  $("s-radar").value = setting("radar.url").value || "";
  $("s-axis").value = setting("motion.axis_distance_m").value === null ? "" : String(setting("motion.axis_distance_m").value);
  $("s-sure").checked = setting("station.until_sure").value === "yes";
  showMotions(setting("motion.url").value || "free");
  fill("s-radars", JSON.stringify(found.found.radar), choices(found.found.radar, (url) => { $("s-radar").value = url; }));
  fill("s-motions-note", JSON.stringify(found.found.motion), found.found.motion && found.found.motion.note ? [element("li", found.found.motion.note)] : []);
  showSettingsState();
}

// What a search found, each with a button.
function choices(search, choose) {
  if (!search) return [];
  const rows = search.devices.map((one) => {
    const row = element("li");
    row.append(element("b", one.url), element("span", one.problem ? `${one.text}: ${one.problem}` : one.text, one.problem ? "what bad" : "what"));
    row.append(actButton("Use it", `Use ${one.url}`, () => choose(one.url)));
    return row;
  });
  return search.note ? [...rows, element("li", search.note)] : rows;
}

function showMotions(value) {
  const free = FREE.exec(value);
  const search = settings.found.motion;
  const devices = search ? search.devices.map((one) => [one.url, `${one.url}, ${one.text}`]) : [];
  if (!free && !devices.some(([url]) => url === value)) devices.push([value, value]);
  $("s-motion").replaceChildren(...[["free", "turns by itself"], ...devices].map(([url, words]) => choice(url, words)));
  $("s-motion").value = free ? "free" : value;
  $("s-rpm").value = free && free[1] ? free[1] : "";
}

function showSettingsState() {
  if (!settings) return;
  const fixed = (name) => setting(name).fixed;
  const fields = [["s-radar", "radar.url"], ["s-axis", "motion.axis_distance_m"], ["s-motion", "motion.url"], ["s-rpm", "motion.url"], ["s-sure", "station.until_sure"]];
  for (const [id, name] of fields) $(id).disabled = Boolean(fixed(name)) || !mayAct() || running;
  $("s-rpm-row").hidden = $("s-motion").value !== "free";
  for (const id of ["s-find-radar", "s-find-motion", "s-store"]) $(id).disabled = !mayAct() || running || Boolean($(id).dataset.busy);
  const named = { "radar.url": "radar", "motion.axis_distance_m": "axis distance", "motion.url": "motion", "station.until_sure": "end of a scan" };
  const reasons = [...new Set(settings.items.map((one) => one.fixed).filter(Boolean))];
  setText("s-fixed", reasons.map((why) => {
    const names = settings.items.filter((one) => one.fixed === why).map((one) => named[one.name]);
    return `Cannot be changed here (${why}): ${names.join(", ")}.`;
  }).join(" "));
}

// Only what was changed is written, so that defaults stay defaults.
function changed() {
  const free = FREE.exec(setting("motion.url").value || "free");
  const direction = free && free[2] ? free[2] : "";
  const rpm = $("s-rpm").value.trim();
  const motion = $("s-motion").value === "free" ? (rpm ? `free?rpm=${rpm}${direction}` : "free") : $("s-motion").value;
  const values = {
    "radar.url": $("s-radar").value.trim(), "motion.url": motion,
    "motion.axis_distance_m": $("s-axis").value.trim().replace(",", "."), "station.until_sure": $("s-sure").checked ? "yes" : "no",
  };
  return Object.fromEntries(Object.entries(values).filter(([name, value]) => {
    const before = setting(name).value;
    return !setting(name).fixed && value !== "" && value !== (before === null ? "" : String(before));
  }));
}

async function search(kind, id, words) {
  const button = $(id);
  button.dataset.busy = "yes";
  setText("s-state", words);
  showSettingsState();
  const found = await post("settings/find", { kind });
  delete button.dataset.busy;
  setText("s-state", found ? "The search has ended." : "");
  if (found) {
    // What was typed meanwhile stays.
    const typed = ["s-radar", "s-axis", "s-rpm"].map((one) => [one, $(one).value]);
    showSettings(found);
    for (const [one, value] of typed) $(one).value = value;
  }
  showSettingsState();
}

$("s-find-radar").addEventListener("click", () => search("radar", "s-find-radar", "Searching for radars, 3 seconds…"));
$("s-find-motion").addEventListener("click", () => search("motion", "s-find-motion", "Searching for robots and tables, 5 seconds…"));
$("s-motion").addEventListener("change", showSettingsState);
$("settings-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  if (!settings) return;
  const changes = changed();
  if (!Object.keys(changes).length) {
    setText("s-state", "Nothing was changed.");
    return;
  }
  const found = await post("settings", { changes });
  setText("s-state", found ? "Stored; the next scan uses it." : "");
  if (found) showSettings(found);
});
$("s-theme").value = chosenTheme();
$("s-theme").addEventListener("change", () => {
  localStorage.setItem("theme", $("s-theme").value);
  applyTheme();
});
for (const [id, kind] of [["s-sound-named", "identified"], ["s-sound-unknown", "unknown"]]) {
  $(id).addEventListener("click", () => {
    audio = audio || new AudioContext();
    play(SOUNDS[kind]);
  });
}
