"use strict";
// The echo over range before a scan, with the range of the object.
let profile = null;
const SHOWN_DB = 60;

function showProfile() {
  const on = Boolean(profile && profile.running);
  setText("profile-button", on ? "Stop" : "Show it");
  $("profile-button").disabled = !connected() || (!on && (!mayAct() || running));
  const ready = Boolean(profile && profile.echo_db.length);
  $("profile-figure").hidden = !ready;
  let text = "The radar transmits for two minutes at most, and nothing is stored.";
  if (profile && profile.error) text = `${profile.error.message}. ${profile.error.remedy}`;
  else if (on && !ready) text = "Waiting for the radar…";
  else if (ready) text = profileWords();
  setText("profile-text", text);
  if (ready) drawProfile();
}

// Where what moves is strongest, compared with the range of the object.
function profileWords() {
  const { range_m, moving_db, object_m, axis_m, scans } = profile;
  const at = moving_db.indexOf(Math.max(...moving_db));
  const range = range_m[0] + at * (range_m[1] - range_m[0]) / Math.max(moving_db.length - 1, 1);
  if (scans < 20) return "Listening…";
  if (object_m === null) return `What moves is strongest at ${range.toFixed(2)} m. Set the axis distance to mark the object.`;
  const inside = range >= object_m[0] && range <= object_m[1];
  const advice = inside ? "That is where the object is expected." : `The object is expected around ${axis_m.toFixed(2)} m: check the axis distance, and that the table turns.`;
  return `What moves is strongest at ${range.toFixed(2)} m. ${advice}`;
}

function drawProfile() {
  const { context, box } = sharp($("profile-canvas"));
  if (box.width < 20) return;
  const { range_m, echo_db, moving_db, object_m, axis_m } = profile;
  const top = Math.ceil((Math.max(...echo_db, ...moving_db) + 3) / 10) * 10;
  const bottom = top - SHOWN_DB;
  const atX = (range) => box.x + box.width * (range - range_m[0]) / (range_m[1] - range_m[0]);
  const atY = (decibels) => box.y + box.height * (top - Math.max(decibels, bottom)) / SHOWN_DB;
  if (object_m) {
    context.fillStyle = inked("--panel");
    context.fillRect(atX(object_m[0]), box.y, atX(object_m[1]) - atX(object_m[0]), box.height);
    context.strokeStyle = inked("--line");
    context.setLineDash([4, 4]);
    for (const range of [...object_m, axis_m]) {
      context.beginPath();
      context.moveTo(atX(range), box.y);
      context.lineTo(atX(range), box.y + box.height);
      context.stroke();
    }
    context.setLineDash([]);
    context.fillStyle = inked("--ink");
    context.textAlign = "center";
    context.textBaseline = "top";
    context.fillText("object", atX(axis_m), box.y + 4);
  }
  for (const [curve, colour, width] of [[echo_db, "--quiet", 1.5], [moving_db, "--good", 2.5]]) {
    context.strokeStyle = inked(colour);
    context.lineWidth = width;
    context.beginPath();
    curve.forEach((decibels, i) => context.lineTo(box.x + box.width * i / (curve.length - 1), atY(decibels)));
    context.stroke();
  }
  axes(context, box, [...range_m, "range (m)"], [top, bottom, "echo (dB)"]);
}

$("profile-button").addEventListener("click", () => post(profile && profile.running ? "profile/stop" : "profile", {}));
window.addEventListener("themed", showProfile);
window.addEventListener("resize", showProfile);
