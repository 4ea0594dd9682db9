"use strict";
// Enrolling an object: name it, record three captures, check, store; and templates to print.
let enrolment = null;
// Whether the button to record gets the focus once it may be pressed.
let recordNext = false;
// Whether it had the focus last: a button that is hidden or disabled for a moment loses it to the page.
let recordHeld = false;

function millimetres(metres) {
  return metres < 1e-4 ? "less than 0.1 mm" : `${(1000 * metres).toFixed(1)} mm`;
}

// A share of readings, as the commands word it: "40 %", or a bound where a percentage has too many zeros.
function shareText(rate) {
  return rate < 1e-5 ? "under 0.001 %" : `${Number((100 * rate).toPrecision(2))} %`;
}

function showEnrolment() {
  if (!enrolment) return;
  const { subject, captures, needed, measuring, trouble, proposal, stored } = enrolment;
  if (document.activeElement !== document.body) recordHeld = document.activeElement === $("capture");
  const step = proposal && proposal.ready ? "check" : subject ? "record" : stored ? "done" : "name";
  for (const name of ["name", "record", "check", "done"]) setCurrent($(`step-${name}`), "step", name === step);
  $("done-part").hidden = Boolean(subject) || !(stored || enrolment.undone);
  if (stored) {
    setText("done-text", `${stored.name} is enrolled. The next scan of it shows its name.`);
    $("done-template").href = `api/v1/layouts/${encodeURIComponent(stored.name)}/template.pdf`;
  } else if (enrolment.undone) {
    setText("done-text", `${enrolment.undone} is no longer enrolled.`);
  }
  $("done-template").hidden = !(stored && stored.has_layout);
  $("undo").hidden = !stored;
  $("undo").disabled = !mayAct();
  showSubject(subject);
  $("record-part").hidden = !subject;
  $("cancel").hidden = !subject;
  $("cancel").disabled = !mayAct() || measuring || running;
  $("check-part").hidden = !proposal;
  if (!subject) return;
  showCaptures(captures, needed, measuring);
  const words = trouble ? [element("p", `${trouble.message}.`)] : [];
  if (trouble) words.push(element("p", captures.length < needed && captures.length > 1 ? "Go on with the next capture: it shows which one is wrong." : trouble.remedy));
  fill("trouble", JSON.stringify(trouble) + captures.length, words);
  fill("remarks", JSON.stringify(enrolment.remarks), enrolment.remarks.map((one) => element("li", one)));
  if (proposal) showProposal(subject, captures, proposal);
}

function showSubject(subject) {
  const shown = subject ? JSON.stringify(subject) : "";
  if ($("subject-form").dataset.shown !== shown) {
    $("subject-form").dataset.shown = shown;
    $("e-name").value = subject ? subject.name : "";
    $("e-label").value = subject ? subject.label : "";
    if (subject) $("e-kind").value = subject.kind;
    $("subject-part").open = !subject;
    setText("subject-summary", subject ? `${subject.name} (${subject.kind}): change` : "Name the object");
  }
  setText("e-begin", subject ? "Change" : "Begin");
  $("e-begin").disabled = !mayAct() || enrolment.measuring;
}

function showCaptures(captures, needed, measuring) {
  const next = captures.length + 1;
  let text = "Put the object on the table, within a centimetre of the middle, and record it.";
  if (next > 1 && next <= needed) text = "Turn the object by about a third of a turn, move it by a centimetre, and record it again.";
  if (next > needed) {
    // A conflict with an enrolled layout is no fault of a capture.
    text = enrolment.trouble && !enrolment.proposal ? "Remove the capture that disagrees, or record another." : "Enough captures. More make the positions more accurate.";
  }
  setText("instruction", text);
  const button = $("capture");
  setText("capture", recording ? "Stop" : next <= needed ? `Record ${next} of ${needed}` : "Record another");
  // Once there are enough, the large button is the one that enrolls.
  button.className = recording ? "big stop" : next <= needed ? "big" : "";
  button.disabled = running ? !recording : !mayAct() || measuring;
  if (!button.disabled && (recordNext || (recordHeld && document.activeElement === document.body))) {
    recordNext = false;
    recordHeld = true;
    button.focus();
  }
  setText("measuring", measuring ? "Measuring the reflectors…" : "");
  fill("captures", JSON.stringify([captures, mayAct(), measuring, running]), captures.map((one) => {
    const row = element("li");
    const seen = one.error ? one.error.message : `${one.reflectors} reflectors`;
    const known = one.status === "identified" ? `, read as ${one.layout}: is it enrolled already?` : "";
    row.append(element("b", `Capture ${one.number}`), element("span", `${seen}${known}`, one.error || known ? "what bad" : "what"));
    const drop = () => post("enrolment/drop", { number: one.number }).then(received);
    const button = actButton("Remove", `Remove capture ${one.number}`, drop);
    button.disabled = !mayAct() || measuring || running;
    row.append(button);
    return row;
  }));
}

function showProposal(subject, captures, proposal) {
  const spread = proposal.spread_m.length ? `, differing by ${millimetres(Math.max(...proposal.spread_m))} between the captures` : "";
  const what = proposal.reflectors.length ? `${proposal.reflectors.length} reflectors${spread}.` : "The body hides the reflectors: the object is enrolled by its whole echo.";
  setText("measured-text", what);
  $("plan").toggleAttribute("hidden", proposal.reflectors.length === 0);
  $("own-template").hidden = proposal.reflectors.length === 0;
  fill("plan", JSON.stringify(proposal.reflectors), drawn(proposal.reflectors));
  fill("nearest", JSON.stringify(proposal.nearest), proposal.nearest.length ? proposal.nearest.map((one) => {
    const apart = one.worst_m !== null ? `${millimetres(one.worst_m)} apart` : one.difference !== null ? `differs by ${(100 * one.difference).toFixed(0)} %` : "another number of reflectors";
    return element("li", `${one.name}: ${apart}${one.confusable ? ", could be confused" : ""}`, one.confusable ? "bad" : "");
  }) : [element("li", "no other layout is enrolled")]);
  const rate = proposal.confusion_rate;
  setText("confusion", rate === null ? "" : `Expected wrong names at ${proposal.reference.views} views and ${proposal.reference.snr_db} dB: ${shareText(rate)} of readings.`);
  setText("store", `Enroll ${subject.name}`);
  const busy = !mayAct() || running || enrolment.measuring;
  $("store").disabled = busy || !proposal.ready;
  $("store-anyway").hidden = proposal.ready;
  $("store-anyway").disabled = busy;
}

// Seen from above, x to the right and y up, as in layout files; 1 unit is what fits the outermost on 90.
function drawn(reflectors) {
  const scale = 90 / Math.max(0.01, ...reflectors.map((one) => Math.hypot(one.x_m, one.y_m)));
  const nodes = [
    svgElement("line", { class: "axis", x1: -105, x2: 105, y1: 0, y2: 0 }), svgElement("line", { class: "axis", x1: 0, x2: 0, y1: -105, y2: 105 }),
  ];
  reflectors.forEach((one, i) => {
    nodes.push(svgElement("circle", { class: "spot", cx: scale * one.x_m, cy: -scale * one.y_m, r: 9 }));
    nodes.push(svgElement("text", { x: scale * one.x_m, y: 3 - scale * one.y_m }, String(i + 1)));
  });
  return nodes;
}

function received(found) {
  if (!found) return;
  enrolment = found;
  showEnrolment();
}

async function loadLayouts() {
  const answer = await ask("layouts");
  if (!answer) return;
  const { items } = answer;
  const before = $("t-layout").value;
  $("t-layout").replaceChildren(...items.map((one) => element("option", one.name)));
  if (items.some((one) => one.name === before)) $("t-layout").value = before;
  showTemplate();
}

function showTemplate() {
  const name = $("t-layout").value;
  $("template").hidden = !name;
  $("template").href = `api/v1/layouts/${encodeURIComponent(name)}/template.pdf?paper=${$("t-paper").value}`;
}

$("subject-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const values = { name: $("e-name").value.trim(), kind: $("e-kind").value, label: $("e-label").value.trim() };
  const found = await post("enrolment", values);
  recordNext = Boolean(found);
  received(found);
});
$("capture").addEventListener("click", () => (recording ? send({ type: "stop" }) : post("enrolment/capture", {})));
const store = (values) => post("enrolment/store", values).then((found) => { received(found); loadLayouts(); });
$("store").addEventListener("click", () => store({}));
$("store-anyway").addEventListener("click", () => store({ force: true }));
$("undo").addEventListener("click", () => post("enrolment/undo", {}).then((found) => { received(found); loadLayouts(); }));
$("cancel").addEventListener("click", () => post("enrolment/cancel", {}).then(received));
$("template-form").addEventListener("submit", (event) => event.preventDefault());
for (const id of ["t-layout", "t-paper"]) $(id).addEventListener("change", showTemplate);
