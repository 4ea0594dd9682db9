"use strict";
// The history: filters, a selection, its export and its report.
let report = null;
const picked = new Set();
let rows = [];

async function loadHistory() {
  const query = new URLSearchParams({ limit: "50" });
  if ($("f-status").value) query.set("status", $("f-status").value);
  if ($("f-layout").value.trim()) query.set("layout", $("f-layout").value.trim());
  if ($("f-since").value) query.set("since", $("f-since").value);
  try {
    const answer = await fetch(`api/v1/history?${query}`, { cache: "no-store" });
    const found = await answer.json();
    if (!answer.ok) throw new Error(found.error.message);
    rows = found.items;
  } catch (error) {
    setText("history-note", `The history cannot be read: ${error.message}`);
    return;
  }
  for (const number of picked) {
    if (!rows.some((one) => one.id === number)) picked.delete(number);
  }
  setText("history-note", rows.length ? "" : "no entries");
  $("history").replaceChildren(...rows.map(historyRow));
  showSelection();
}

function historyRow(one) {
  const row = element("li");
  const when = new Date(one.time_utc);
  const time = Number.isNaN(when.getTime()) ? one.time_utc : when.toLocaleString();
  if (scanned(one)) {
    const label = element("label", undefined, "check");
    const box = element("input");
    box.type = "checkbox";
    box.checked = picked.has(one.id);
    box.setAttribute("aria-label", `Select ${nameOf(one)}, ${time}`);
    row.className = box.checked ? "picked" : "";
    box.addEventListener("change", () => {
      if (box.checked) picked.add(one.id);
      else picked.delete(one.id);
      row.className = box.checked ? "picked" : "";
      showSelection();
    });
    label.append(box);
    row.append(label);
  }
  if (one.has_picture) {
    const small = element("img");
    small.src = `api/v1/history/${one.id}/thumbnail`;
    small.alt = "";
    small.loading = "lazy";
    row.append(small);
  }
  const about = element("div", undefined, "about");
  const who = element("span", nameOf(one), `who ${one.status}`);
  if (one.label) who.append(element("span", ` ${one.label}`, "label"));
  about.append(who, element("span", time, "more"));
  const acts = element("span", undefined, "acts");
  const button = (text, words, act) => acts.append(actButton(text, `${words} ${nameOf(one)}, ${time}`, act));
  const path = `api/v1/history/${one.id}`;
  if (one.has_picture) button("Picture", "Picture of", () => showViewer(`${path}/picture`, nameOf(one), one));
  if (one.has_residuals) button("Hypotheses", "Hypotheses of", () => showViewer(`${path}/residuals`, "What the hypotheses leave of the echo", one));
  if (one.has_capture && scanned(one)) button("Replay", "Replay", () => replay(one));
  // A capture that is not in this folder is named with its own.
  const file = one.has_capture ? fileName(one) : one.file;
  const why = one.status === "identified" ? "" : one.reason;
  const advice = one.cause ? `Likely cause: ${one.cause}` : one.advice;
  for (const [text, kind] of [[one.recording_note, "note"], [file, "quiet"], [why, "quiet"], [advice, "advice"]]) {
    if (text) about.append(element("span", text, `more ${kind}`));
  }
  row.append(about, acts);
  return row;
}

function scanned(one) {
  return one.command === "station" || one.command === "scan";
}

function fileName(one) {
  return one.file.slice(one.file.lastIndexOf("/") + 1);
}

// The picked entries, or all that are shown.
function chosen() {
  return picked.size ? [...picked] : rows.map((one) => one.id);
}

function showSelection() {
  const entries = chosen();
  const gone = rows.filter((one) => !one.has_capture && (!picked.size || picked.has(one.id))).length;
  setText("selected", (picked.size ? `${picked.size} selected` : `all ${rows.length} shown`) + (gone ? `, ${gone} without a capture here` : ""));
  $("select-all").checked = picked.size > 0;
  $("select-all").indeterminate = picked.size > 0 && picked.size < rows.length;
  const query = entries.length ? `?entries=${entries.join(",")}` : "?limit=1";
  $("export").href = `api/v1/history.csv${query}`;
  $("export-json").href = `api/v1/history.json${query}`;
  $("export-captures").href = `api/v1/history/captures.zip${query}`;
  showReport();
}

function showReport() {
  const busy = Boolean(report && report.running);
  $("report").disabled = !mayAct() || busy || rows.length === 0;
  $("report-part").hidden = !report;
  if (!report) return;
  let text = `Report ${report.number}: ${report.done} of ${report.total} captures read.`;
  if (report.error) text = `The report failed: ${report.error.message}. ${report.error.remedy}`;
  else if (report.complete) text = `Report ${report.number}: ${report.done} captures, stored in ${report.folder}.`;
  setText("report-text", report.left_out ? `${text} ${report.left_out}.` : text);
  $("report-bar").hidden = !busy;
  $("report-bar").value = report.total ? report.done / report.total : 0;
  $("report-stop").hidden = !busy || !mayAct();
  for (const [id, name] of [["report-page", "report.html"], ["report-csv", "items.csv"]]) {
    $(id).hidden = !report.complete;
    if (report.complete) $(id).href = `api/v1/reports/${report.number}/${name}`;
  }
}

async function replay(one) {
  if (await post(`history/${one.id}/replay`, {})) location.hash = "#view-scan";
}

// A picture of the station in a dialog, with the capture of an entry of the history if there is one.
async function showViewer(path, heading, one = null) {
  showProblem(null);
  const answer = await fetch(path, { cache: "no-store" });
  if (!answer.ok) {
    showProblem((await answer.json()).error);
    return;
  }
  const picture = $("viewer-picture");
  setText("viewer-head", heading);
  setText("viewer-capture", one ? fileName(one) : "");
  $("viewer-capture").hidden = !one;
  if (one) $("viewer-capture").href = `api/v1/history/${one.id}/capture`;
  if (picture.src) URL.revokeObjectURL(picture.src);
  picture.src = URL.createObjectURL(await answer.blob());
  picture.alt = one ? `${heading}, ${nameOf(one)}` : heading;
  $("viewer").showModal();
  $("viewer-head").focus();
}

$("filter").addEventListener("submit", (event) => event.preventDefault());
for (const id of ["f-status", "f-layout", "f-since"]) $(id).addEventListener("change", loadHistory);
$("select-all").addEventListener("change", () => {
  const all = $("select-all").checked;
  picked.clear();
  if (all) rows.filter(scanned).forEach((one) => picked.add(one.id));
  $("history").replaceChildren(...rows.map(historyRow));
  showSelection();
});
$("report").addEventListener("click", () => post("reports", { entries: chosen() }));
$("report-stop").addEventListener("click", () => post("reports/stop", {}));
$("viewer-close").addEventListener("click", () => $("viewer").close());
