"use strict";
// Measuring the rig: its steps in their order, each with what to do, its results, and a button.
let commissioning = null;
let stepping = null;
let pressed = null;
const TAPE = { "c-axis": "axis_distance_m", "c-height": "antenna_height_m", "c-target": "target_distance_m", "c-error": "error_m" };

async function loadCommissioning() {
  const answer = await ask("commissioning");
  if (answer) showCommissioning(answer);
}

function showCommissioning(state) {
  commissioning = state;
  stepping = state.progress;
  for (const [id, name] of Object.entries(TAPE)) {
    const value = state.tape[name];
    if ($(id) !== document.activeElement) $(id).value = value === null ? "" : String(value);
  }
  $("c-page").hidden = !state.steps.some((one) => one.report);
  const [kind, size] = state.tape.target.split(":");
  $("c-kind").value = kind;
  if ($("c-size") !== document.activeElement) $("c-size").value = size || "";
  setText("c-profile", state.profile ? `The rig was commissioned on ${state.profile}; the profile is in use.` : "The rig is not commissioned yet.");
  // A button that is disabled loses the keyboard; it gets it back when its step has ended.
  const focused = document.activeElement === document.body ? pressed : document.activeElement.dataset.step;
  $("c-steps").replaceChildren(...state.steps.map(stepRow));
  showStepState();
  if (focused && !stepping.running) document.querySelector(`#c-steps button[data-step="${focused}"]`).focus();
}

function stepRow(step) {
  const { report } = step;
  const state = report ? (report.passed ? "passed" : "failed") : "open";
  const row = element("li", undefined, state);
  const head = element("p", undefined, "row");
  const act = report ? "Repeat" : "Start";
  const button = actButton(act, `${act}: ${step.title}`, () => runStep(step.name));
  button.dataset.step = step.name;
  if (step.name === commissioning.next) row.setAttribute("aria-current", "step");
  head.append(element("b", step.title), element("span", state, `state ${state}`), button);
  row.append(head);
  if (step.prepare) row.append(element("p", `First: ${step.prepare}.`));
  if (report) {
    const rows = report.rows.map((one) => {
      const line = element("li", undefined, one.level);
      line.append(element("b", one.level, "level"), element("span", one.name, "name"), element("span", one.number.replace("+-", "±"), "number"));
      if (one.text) line.append(element("span", one.text.replaceAll("`", ""), "words"));
      if (one.advice) line.append(element("span", one.advice.replaceAll("`", ""), "advice"));
      return line;
    });
    const list = element("ul");
    list.append(...rows);
    const details = element("details");
    details.open = !report.passed || step.name === lastStep();
    const pictures = report.pictures.map((title, number) => {
      const picture = element("img");
      picture.alt = title;
      picture.loading = "lazy";
      picture.src = `api/v1/commissioning/${step.name}/${number}.svg?${encodeURIComponent(report.date_utc)}`;
      return picture;
    });
    details.append(element("summary", `${report.rows.length} results of ${report.date_utc.slice(0, 16).replace("T", " ")} UTC`), list, ...pictures);
    row.append(details);
  }
  return row;
}

const lastStep = () => (stepping ? stepping.step : null);

// The buttons and the bar, without drawing the results again.
function showStepState() {
  if (!commissioning) return;
  const busy = Boolean(stepping && stepping.running);
  const free = mayAct() && !running && !busy;
  for (const button of document.querySelectorAll("#c-steps button")) button.disabled = !free;
  for (const field of document.querySelectorAll("#c-tape :is(input, select)")) field.disabled = !free;
  $("c-running").hidden = !busy;
  $("c-stop").disabled = !connected();
  $("c-bar").value = busy ? stepping.share : 0;
  const step = commissioning.steps.find((one) => one.name === lastStep());
  let text = busy && step ? `${step.title}: ${stepping.remark || "working"}` : "";
  if (!busy && stepping && stepping.error) text = `${stepping.error.message}. ${stepping.error.remedy}`;
  setText("c-state", text);
}

function showStepProgress(message) {
  const ended = stepping && stepping.running && (!message.running || stepping.step !== message.step);
  stepping = message;
  if (document.body.dataset.view !== "commission") return;
  if (ended || !commissioning) loadCommissioning();
  else showStepState();
}

function tapeGiven() {
  const given = { target: $("c-kind").value + ($("c-size").value.trim() ? `:${$("c-size").value.trim()}` : "") };
  for (const [id, name] of Object.entries(TAPE)) {
    const words = $(id).value.trim().replace(",", ".");
    if (words) given[name] = Number(words);
  }
  return given;
}

function runStep(step) {
  const tape = tapeGiven();
  const odd = Object.entries(TAPE).find(([, name]) => Number.isNaN(tape[name]));
  if (odd) {
    showProblem({ message: `${document.querySelector(`label[for="${odd[0]}"]`).textContent}: that is no number`, remedy: "Give metres, e.g. 1.02." });
    $(odd[0]).focus();
    return;
  }
  pressed = step;
  post("commissioning", { step, tape });
}

$("c-kind").addEventListener("change", () => { $("c-size").value = ""; });
$("c-stop").addEventListener("click", () => post("commissioning/stop", {}));
$("c-tape").addEventListener("submit", (event) => event.preventDefault());
