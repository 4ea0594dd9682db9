"use strict";
// Every text from the station is set as text, never as markup.
const $ = (id) => document.getElementById(id);
const OWN = { "tagid-station": "1" };
const STATUS = { identified: "", unknown: "Unknown tag", ambiguous: "Ambiguous", no_tag: "No tag", failed: "Failed" };
const SOUNDS = { identified: [880, 1320], unknown: [440, 330], ambiguous: [440, 440], no_tag: [330, 330], failed: [220, 220] };
let palette = null;
let socket = null;
let wait = 250;
let mine = false;
let operated = false;
let running = false;
// Whether Stop has an effect: the scan still waits for the radar or records.
let recording = false;
let health = null;
let newest = null;
let sound = false;
let audio = null;
let told = null;
let listed = -1;
const VIEWS = ["scan", "enrol", "history", "health", "settings", "commission"];

// One view at a time; the address keeps it over a reload.
function showView() {
  const found = VIEWS.find((name) => location.hash === `#view-${name}`);
  if (!found && document.body.dataset.view) return;
  const view = found || "scan";
  document.body.dataset.view = view;
  for (const part of document.querySelectorAll("[data-views]")) {
    part.hidden = !part.dataset.views.split(" ").includes(view) || (part.id === "wiring" && !part.dataset.wanted);
  }
  for (const link of document.querySelectorAll("nav a")) setCurrent(link, "page", link.hash === `#view-${view}`);
  if (view === "history") loadHistory();
  if (view === "enrol") loadLayouts();
  if (view === "settings") loadSettings();
  if (view === "commission") loadCommissioning();
  // A canvas that was hidden has no size.
  window.dispatchEvent(new Event("resize"));
  window.scrollTo(0, 0);
}

function bytes(text) {
  const raw = atob(text);
  const out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i += 1) out[i] = raw.charCodeAt(i);
  return out;
}

const LONGEST_BAR = 20;  // nats
const MOST_RIVALS = 4;

function element(tag, text, kind) {
  const node = document.createElement(tag);
  if (text !== undefined) node.textContent = text;
  if (kind) node.className = kind;
  return node;
}

function svgElement(tag, values, text) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(values)) node.setAttribute(name, String(value));
  if (text) node.textContent = text;
  return node;
}

// A button that acts, with other words for who hears it.
function actButton(text, words, act) {
  const button = element("button", text);
  button.type = "button";
  button.setAttribute("aria-label", words);
  button.addEventListener("click", act);
  return button;
}

function choice(value, words) {
  const option = element("option", words);
  option.value = value;
  return option;
}

// Marks one of several as the present one, for eyes and ears.
function setCurrent(node, kind, current) {
  if (current) node.setAttribute("aria-current", kind);
  else node.removeAttribute("aria-current");
}

// New content, only where it differs: what is replaced loses the keyboard.
function fill(id, shown, nodes) {
  if ($(id).dataset.shown === shown) return;
  $(id).dataset.shown = shown;
  $(id).replaceChildren(...nodes);
}

function setText(id, text) {
  if ($(id).textContent !== text) $(id).textContent = text;
}

function nameOf(answer) {
  return answer.status === "identified" ? answer.layout : STATUS[answer.status] || answer.status;
}

// What stands for the answer before a scan, or once what made one fail is over.
function idle() {
  if (!connected()) return ["Not connected", "", "", ""];
  if (!health || !health.checked) return ["Checking", "", "Looking for the radar.", ""];
  const radar = health.findings.find((one) => one.answers === false);
  const missing = health.wiring && !health.wiring.url;
  if (radar) return ["No radar", "failed", radarText(health.wiring), missing ? "Connect it, switch it on, and search for it under Settings." : radar.remedy];
  const problem = health.findings.find((one) => one.level === "problem");
  return problem ? ["Not ready", "failed", `${problem.topic}: ${problem.text}.`, problem.remedy] : ["Ready", "", "", ""];
}

function radarText(wiring) {
  return wiring.url ? `No radar answers at ${wiring.url}.` : "No radar is configured.";
}

function showAnswer(scan) {
  const box = $("answer");
  const recovered = Boolean(scan && scan.phase === "failed" && health && health.recovered_scan === scan.number);
  let [text, kind, reason, advice] = idle();
  if (recovered && !reason) reason = `The last scan failed: ${scan.note}`;
  if (scan && !recovered) {
    [reason, advice] = ["", ""];
    const found = scan.answer;
    if (scan.phase === "failed") {
      [text, kind, reason] = ["Failed", "failed", scan.note];
    } else if (found) {
      [text, kind] = [nameOf(found), found.status];
      [reason, advice] = [found.reason || found.label, found.advice];
      const [cause] = found.causes;
      if (cause) advice = `Likely cause: ${cause.text}. ${cause.remedy}`;
      if (!scan.final) kind += " so-far";
    } else {
      text = scan.phase === "connecting" ? "Connecting" : scan.phase === "turning" ? "Turning" : "Reading";
      reason = scan.note || (scan.file ? `Capture ${scan.file}` : "");
    }
    if (scan.running && scan.silent_s > 2) {
      [text, kind] = ["No signal", "failed"];
      reason = `No scan for ${scan.silent_s.toFixed(0)} s. Scans so far are stored.`;
      advice = "Check the radar's cable and power; the scan goes on when it answers.";
    }
  }
  setText("answer", text);
  box.className = kind + (text.length > 10 ? " long" : "");
  setText("reason", reason || "");
  setText("advice", advice || "");
  const ended = scan && !recovered && (scan.final || scan.phase === "failed");
  const tone = `${scan ? scan.number : 0} ${kind}`;
  if (told === null) {
    told = ended ? tone : "";  // a scan that ended before the page was opened is not heard
  } else if (ended && tone !== told) {
    if (sound) play(SOUNDS[kind] || SOUNDS.failed);
    told = tone;
  }
}

function play(tones) {
  if (!audio) return;
  tones.forEach((tone, i) => {
    const at = audio.currentTime + 0.18 * i;
    const [source, gain] = [audio.createOscillator(), audio.createGain()];
    source.frequency.value = tone;
    gain.gain.setValueAtTime(0.25, at);
    gain.gain.exponentialRampToValueAtTime(0.001, at + 0.17);
    source.connect(gain).connect(audio.destination);
    source.start(at);
    source.stop(at + 0.18);
  });
}

function showScan(scan) {
  newest = scan;
  running = Boolean(scan && scan.running);
  recording = running && (scan.phase === "connecting" || scan.phase === "turning");
  showAnswer(scan);
  showRadar(scan);
  $("turn").value = scan && scan.turn_share ? scan.turn_share : 0;
  if (scan) {
    const words = scan.file ? [`Capture ${scan.file}`] : [];
    if (!scan.file || scan.scans) words.push(`${scan.scans} scans in ${scan.seconds.toFixed(1)} s`);
    if (!scan.file || scan.scans) words.push(scan.turned_deg === null ? "angle not known yet" : `${Math.min(scan.turned_deg, 360).toFixed(0)} of 360 degrees`);
    if (!scan.file) words.push(scan.snr_db === null ? "SNR -" : `SNR ${scan.snr_db.toFixed(1)} dB`);
    if (running && !scan.file) words.push(`lost ${scan.lost}`); // a remark says it of a finished one
    if (scan.note && scan.answer) words.push(scan.note);
    if (scan.remark) words.push(scan.remark);
    setText("figures", words.join(" · "));
    showEvidence(scan);
    if (!running && listed !== scan.number) {
      listed = scan.number;
      if (document.body.dataset.view === "history") loadHistory();
    }
  }
  showButton();
}

function connected() {
  return Boolean(socket && socket.readyState === WebSocket.OPEN);
}

// A scan that records shows whether the radar answers; otherwise the last health check does.
function showRadar(scan) {
  const scans = recording && scan.scans > 0;
  const found = health && health.findings.find((one) => one.answers !== null);
  const answers = scans ? scan.silent_s <= 2 : Boolean(found && found.answers);
  $("radar").hidden = !connected() || !(scans || found);
  $("radar").classList.toggle("bad", !answers);
  setText("radar", answers ? "radar ok" : scans ? "no signal" : "no radar");
}

function showButton() {
  const button = $("scan");
  const open = connected();
  const elsewhere = operated && !mine;
  setText("scan", recording ? "Stop" : "Scan");
  button.className = recording ? "big stop" : "big";
  button.disabled = !open || (running ? !recording : elsewhere);
  $("take").hidden = !(open && elsewhere && !running);
  setText("operator", elsewhere ? "Another browser operates the station; this one only watches." : mine ? "This browser operates the station." : "");
  showEnrolment();
  showReport();
  showProfile();
  showSettingsState();
  showStepState();
  $("file-button").disabled = !mayAct() || running;
}

// May this browser act? Anybody may stop a scan.
function mayAct() {
  return connected() && !(operated && !mine);
}

// During a scan what each layout explains so far; beside an answer what else it could be.
function showEvidence(scan) {
  const answer = scan.final ? scan.answer : null;
  const others = answer ? answer.hypotheses.slice(1).filter((one) => !one.layout || one.layout !== answer.layout) : [];
  const rivals = others.slice(0, MOST_RIVALS);
  setText("evidence-head", rivals.length ? "What else it could be" : "Evidence for each layout");
  setText("evidence-text", rivals.length
    ? "The longer the bar, the less likely. A name needs all others beyond the line."
    : "How well each layout explains the scans so far, and how far it is ahead.");
  $("residuals").hidden = !(answer && scan.has_residuals);
  showBars(rivals.length ? rivals.map((one) => rivalBar(one, answer.lead_needed)) : scan.evidence.map((one) => layoutBar(one, scan.evidence[0])));
}

function layoutBar(one, best) {
  const share = Math.max(one.log_evidence, 0) / Math.max(best.log_evidence, 1);
  return { name: one.layout, share, needed: null, number: nats(one.lead), enough: false };
}

function nats(value) {
  return value.toFixed(Math.abs(value) < 10 ? 1 : 0);
}

function rivalBar(one, needed) {
  const behind = -one.log_evidence;
  return {
    name: one.words,
    share: Math.min(behind / LONGEST_BAR, 1),
    needed: needed === null ? null : Math.min(needed / LONGEST_BAR, 1),
    number: nats(behind),
    enough: needed !== null && behind >= needed,
  };
}

function showBars(items) {
  const list = $("evidence");
  while (list.children.length > items.length) list.lastChild.remove();
  items.slice(0, 12).forEach((one, i) => {
    let row = list.children[i];
    if (!row) {
      row = element("li");
      row.append(element("span", "", "name"), element("span", "", "bar"), element("span", "", "number"));
      const drawing = svgElement("svg", { viewBox: "0 0 100 10", preserveAspectRatio: "none", "aria-hidden": true });
      drawing.append(svgElement("rect", { class: "fill", height: 10 }), svgElement("line", { class: "need", y2: 10 }));
      row.children[1].append(drawing);
      list.append(row);
    }
    row.className = one.enough ? "enough" : "";
    const [fill, need] = row.querySelector("svg").children;
    fill.setAttribute("width", String(100 * one.share));
    need.setAttribute("visibility", one.needed === null ? "hidden" : "visible");
    need.setAttribute("x1", String(100 * one.needed));
    need.setAttribute("x2", String(100 * one.needed));
    if (row.children[0].textContent !== one.name) row.children[0].textContent = one.name;
    row.children[2].textContent = one.number;
  });
}

function showHealth() {
  if (!health.checked) return;
  const order = { problem: 0, warning: 1, ok: 2 };
  const rows = [...health.findings].sort((a, b) => order[a.level] - order[b.level]).map((one) => {
    const row = element("li", undefined, one.level);
    row.append(element("b", `${one.topic}: ${one.level}`, one.level), element("p", one.text));
    if (one.remedy) row.append(element("p", one.remedy, "remedy"));
    return row;
  });
  const fine = rows.filter((row) => row.className === "ok");
  const text = JSON.stringify(health.findings);
  fill("health", text, rows.filter((row) => row.className !== "ok"));
  fill("health-fine", text, fine);
  setText("health-count", `${fine.length} of ${rows.length} checks passed`);
  showAlert();
}

// What hinders a scan, on every view, with the way to its remedy.
function showAlert() {
  const bad = health.findings.filter((one) => one.level === "problem" || one.answers === false);
  $("health-mark").hidden = bad.length === 0;
  $("alert").hidden = bad.length === 0;
  const words = bad.map((one) => (one.answers === false ? "No radar." : `${one.topic}: ${one.text}.`));
  setText("alert-text", words.join(" "));
}

function showWiring(wiring) {
  const part = $("wiring");
  part.dataset.wanted = wiring ? "yes" : "";
  part.hidden = !wiring || document.body.dataset.view !== "health";
  if (!wiring) return;
  const names = { ethernet: "network cable", usb: "USB cable", uart: "serial adapter", none: "which cable?" };
  setText("wiring-name", names[wiring.cable]);
  setText("wiring-found", radarText(wiring));
  fill("wiring-steps", wiring.steps.join("\n"), wiring.steps.map((one) => element("li", one)));
}

function receive(message) {
  if (message.type === "hello") {
    sessionStorage.setItem("key", message.key);
    palette = bytes(message.palette);
    setText("mode", message.demo ? "demonstration: the radar is emulated" : "");
    $("object-row").hidden = message.objects.length === 0;
    if (!$("object").options.length) {
      $("object").replaceChildren(...message.objects.map((one) => choice(one.name, one.words)));
    }
  } else if (message.type === "operator") {
    mine = message.you;
    showButton();
  } else if (message.type === "status") {
    operated = message.operated;
    enrolment = message.enrolment;
    report = message.report;
    health = message.health;
    showHealth();
    showWiring(health.wiring);
    showScan(message.scan);
  } else if (message.type === "frame") {
    showScan(message.scan);
    showPictures(message);
    document.body.dataset.frames = String(Number(document.body.dataset.frames || 0) + 1);
  } else if (message.type === "profile") {
    profile = message;
    showProfile();
  } else if (message.type === "commissioning") {
    showStepProgress(message);
  } else if (message.type === "error") {
    showProblem(message.error);
  }
}

function connect() {
  const one = new WebSocket(`ws://${location.host}/api/v1/live`);
  socket = one;
  one.addEventListener("open", () => {
    wait = 250;
    one.send(JSON.stringify({ type: "hello", key: sessionStorage.getItem("key") }));
    setText("link", "connected");
    $("pairing").hidden = true;
    showButton();
  });
  one.addEventListener("message", (event) => receive(JSON.parse(event.data)));
  one.addEventListener("close", async () => {
    setText("link", "not connected");
    mine = false;
    health = null;
    showScan(newest);
    // A refused WebSocket gives no reason, but a request does.
    try {
      const answer = await fetch("api/v1/status", { cache: "no-store" });
      if (answer.ok && (await answer.json()).full) setText("link", "too many pages are connected: close one");
      if (answer.status === 401) {
        $("pairing").hidden = false;
        setText("link", "not paired");
        $("code").focus();
        return;
      }
    } catch (error) {
      setText("link", "the station does not respond");
    }
    setTimeout(connect, wait);
    wait = Math.min(2 * wait, 4000);
  });
}

function showProblem(error) {
  setText("problem", error ? `${error.message}. ${error.remedy}` : "");
}

// The answer to a request; null where there is none, which is shown.
async function ask(path, options = { cache: "no-store" }) {
  try {
    const response = await fetch(`api/v1/${path}`, options);
    const answer = await response.json();
    if (response.ok) return answer;
    showProblem(answer.error);
  } catch (error) {
    showProblem({ message: "The station does not respond", remedy: "" });
  }
  return null;
}

function post(path, values) {
  showProblem(null);
  return ask(path, {
    method: "POST", headers: { ...OWN, "content-type": "application/json" },
    body: JSON.stringify({ ...values, key: sessionStorage.getItem("key") }),
  });
}

function send(message) {
  showProblem(null);
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

$("scan").addEventListener("click", () => send(recording ? { type: "stop" } : { type: "scan", note: $("note").value, object: $("object").value }));
$("residuals").addEventListener("click", () => showViewer("api/v1/scan/residuals", "What the hypotheses leave of the echo"));
$("take").addEventListener("click", () => send({ type: "take" }));
$("sound").addEventListener("click", () => {
  sound = !sound;
  if (sound && !audio) audio = new AudioContext();
  $("sound").setAttribute("aria-pressed", String(sound));
  setText("sound", sound ? "Sound on" : "Sound off");
  if (sound) play([660]);
});
$("pair-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  setText("pair-error", "");
  const answer = await fetch("api/v1/pair", {
    method: "POST", headers: { ...OWN, "content-type": "application/json" }, body: JSON.stringify({ code: $("code").value }),
  });
  if (answer.ok) {
    $("code").value = "";
    connect();
  } else {
    setText("pair-error", (await answer.json()).error.message);
  }
});
window.addEventListener("hashchange", showView);
// The other scripts of the page are loaded by then.
document.addEventListener("DOMContentLoaded", () => {
  showView();
  connect();
});
