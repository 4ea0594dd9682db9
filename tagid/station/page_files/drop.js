"use strict";
// A capture that is dragged into the page, or chosen from the device, is sent to the station and identified.
const MOST_FILE = 64 * 1024 * 1024;

async function sendCapture(file) {
  showProblem(null);
  if (!mayAct() || running) {
    showProblem({ message: running ? "A scan is running" : "Another browser operates the station", remedy: "Send the capture afterwards." });
    return;
  }
  if (file.size > MOST_FILE) {
    showProblem({ message: `${file.name} is too large`, remedy: "Send a capture of at most 64 MB." });
    return;
  }
  setText("drop-text", `Sending ${file.name}…`);
  const key = sessionStorage.getItem("key");
  try {
    const answer = await fetch("api/v1/captures", {
      method: "POST", body: file,
      headers: { ...OWN, "content-type": "application/octet-stream", "tagid-file-name": encodeURIComponent(file.name), ...(key ? { "tagid-key": key } : {}) },
    });
    if (answer.ok) location.hash = "#view-scan";
    else showProblem((await answer.json()).error);
  } catch (error) {
    showProblem({ message: "The file could not be sent", remedy: "Check the connection." });
  }
  setText("drop-text", "");
}

let over = 0;  // elements of the page that the dragged file is over
function onDrag(kind, act) {
  document.addEventListener(kind, (event) => {
    if (event.dataTransfer && [...event.dataTransfer.types].includes("Files")) act(event);
  });
}
function setOver(elements) {
  over = Math.max(elements, 0);
  $("drop").hidden = over === 0;
}
onDrag("dragenter", () => setOver(over + 1));
onDrag("dragleave", () => setOver(over - 1));
onDrag("dragover", (event) => event.preventDefault());
onDrag("drop", (event) => {
  event.preventDefault();
  setOver(0);
  if (event.dataTransfer.files.length) sendCapture(event.dataTransfer.files[0]);
});
$("file-button").addEventListener("click", () => $("file").click());
$("file").addEventListener("change", () => {
  if ($("file").files.length) sendCapture($("file").files[0]);
  $("file").value = "";
});
