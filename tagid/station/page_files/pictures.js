"use strict";
// Pictures with axes, a colour bar and zoom, and the curves of the range profile.
const MARGIN = { left: 66, right: 78, top: 14, bottom: 46 };
const MOST_ZOOM = 16;

function inked(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

// Round values between two ends, about as many as requested.
function ticks(low, high, about) {
  const rough = Math.abs(high - low) / about;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((one) => one * power >= rough);
  const places = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const found = [];
  for (let i = Math.ceil(Math.min(low, high) / step - 1e-9); i * step <= Math.max(low, high) + 1e-9 * step; i += 1) {
    found.push({ value: i * step, text: (i * step).toFixed(places).replace(/^-(0(\.0*)?)$/, "$1") });
  }
  return found;
}

// A canvas in pixels of the screen; the context draws in CSS pixels.
function sharp(canvas) {
  const scale = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  canvas.width = Math.max(1, Math.round(width * scale));
  canvas.height = Math.max(1, Math.round(height * scale));
  const context = canvas.getContext("2d");
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.font = "14px system-ui, sans-serif";
  context.fillStyle = context.strokeStyle = inked("--ink");
  const box = { x: MARGIN.left, y: MARGIN.top, width: width - MARGIN.left - MARGIN.right, height: height - MARGIN.top - MARGIN.bottom };
  return { context, box, width, height };
}

// Frame, ticks and names; x and y are [start, end, name], from the left and from the top.
function axes(context, box, x, y) {
  context.strokeStyle = context.fillStyle = inked("--ink");
  context.lineWidth = 1;
  context.strokeRect(box.x, box.y, box.width, box.height);
  context.textAlign = "center";
  context.textBaseline = "top";
  for (const { value, text } of ticks(x[0], x[1], box.width / 55)) {
    const at = box.x + box.width * (value - x[0]) / (x[1] - x[0]);
    context.fillRect(at - 0.5, box.y + box.height, 1, 5);
    context.fillText(text, at, box.y + box.height + 7);
  }
  context.fillText(x[2], box.x + box.width / 2, box.y + box.height + 26);
  context.textAlign = "right";
  context.textBaseline = "middle";
  for (const { value, text } of ticks(y[0], y[1], box.height / 50)) {
    const at = box.y + box.height * (value - y[0]) / (y[1] - y[0]);
    context.fillRect(box.x - 5, at - 0.5, 5, 1);
    context.fillText(text, box.x - 8, at);
  }
  context.save();
  context.translate(12, box.y + box.height / 2);
  context.rotate(-Math.PI / 2);
  context.textAlign = "center";
  context.fillText(y[2], 0, 0);
  context.restore();
}

class Picture {
  constructor(id) {
    this.canvas = $(id);
    this.raster = null;
    this.zoom = 1;
    this.middle = [0.5, 0.5];
    this.dragged = null;
    const figure = this.canvas.closest("figure");
    for (const button of figure.querySelectorAll("[data-zoom]")) {
      button.addEventListener("click", () => this.zoomed(Number(button.dataset.zoom)));
    }
    this.reset = figure.querySelector("[data-zoom='0']");
    this.canvas.addEventListener("pointerdown", (event) => {
      if (this.zoom > 1) {
        this.dragged = [event.clientX, event.clientY];
        this.canvas.setPointerCapture(event.pointerId);
      }
    });
    this.canvas.addEventListener("pointermove", (event) => {
      if (!this.dragged) return;
      const { box } = this.place;
      this.middle[0] -= (event.clientX - this.dragged[0]) / box.width / this.zoom;
      this.middle[1] -= (event.clientY - this.dragged[1]) / box.height / this.zoom;
      this.dragged = [event.clientX, event.clientY];
      this.draw();
    });
    for (const kind of ["pointerup", "pointercancel"]) this.canvas.addEventListener(kind, () => { this.dragged = null; });
    this.canvas.addEventListener("dblclick", () => this.zoomed(2));
    window.addEventListener("resize", () => this.draw());
    window.addEventListener("themed", () => this.draw());
  }

  // By a factor; 0 shows the whole picture.
  zoomed(factor) {
    this.zoom = factor ? Math.min(Math.max(this.zoom * factor, 1), MOST_ZOOM) : 1;
    this.draw();
  }

  // Levels 0..255 row by row; x and y are [start, end, name] from the left and from the top.
  show(width, height, text, depthDb, x, y, circles = []) {
    const levels = bytes(text);
    if (!palette || levels.length !== width * height) return;
    this.raster = document.createElement("canvas");
    this.raster.width = width;
    this.raster.height = height;
    const context = this.raster.getContext("2d");
    const data = context.createImageData(width, height);
    for (let i = 0; i < levels.length; i += 1) {
      data.data.set(palette.subarray(3 * levels[i], 3 * levels[i] + 3), 4 * i);
      data.data[4 * i + 3] = 255;
    }
    context.putImageData(data, 0, 0);
    Object.assign(this, { depthDb, x, y, circles });
    this.draw();
  }

  clear() {
    this.raster = null;
    this.draw();
  }

  draw() {
    // The frame is square: a metre is as long to the right as upwards.
    const side = this.canvas.clientWidth - MARGIN.left - MARGIN.right;
    this.canvas.style.height = `${Math.max(side, 20) + MARGIN.top + MARGIN.bottom}px`;
    this.place = sharp(this.canvas);
    const { context, box } = this.place;
    this.reset.disabled = this.zoom === 1;
    this.canvas.style.touchAction = this.zoom > 1 ? "none" : "auto";
    if (!this.raster || box.width < 20) return;
    const half = 0.5 / this.zoom;
    this.middle = this.middle.map((one) => Math.min(Math.max(one, half), 1 - half));
    const [left, top] = this.middle.map((one) => one - half);
    const part = ([from, to, name], start) => [from + start * (to - from), from + (start + 2 * half) * (to - from), name];
    const [x, y] = [part(this.x, left), part(this.y, top)];
    const { width, height } = this.raster;
    context.save();
    context.beginPath();
    context.rect(box.x, box.y, box.width, box.height);
    context.clip();
    context.imageSmoothingEnabled = false;
    context.drawImage(this.raster, left * width, top * height, 2 * half * width, 2 * half * height, box.x, box.y, box.width, box.height);
    context.strokeStyle = "white";
    context.lineWidth = 3;
    for (const one of this.circles) {
      context.setLineDash(one.matched ? [] : [6, 6]);
      context.beginPath();
      context.arc(box.x + box.width * (one.x_m - x[0]) / (x[1] - x[0]), box.y + box.height * (one.y_m - y[0]) / (y[1] - y[0]), 14, 0, 2 * Math.PI);
      context.stroke();
    }
    context.restore();
    axes(context, box, x, y);
    this.bar(context, box);
  }

  // The colours with their decibels below the strongest echo.
  bar(context, box) {
    const left = box.x + box.width + 12;
    for (let i = 0; i < 256; i += 1) {
      context.fillStyle = `rgb(${palette.subarray(3 * i, 3 * i + 3).join(",")})`;
      context.fillRect(left, box.y + box.height * (255 - i) / 256, 16, box.height / 256 + 1);
    }
    context.strokeStyle = context.fillStyle = inked("--ink");
    context.strokeRect(left, box.y, 16, box.height);
    context.textAlign = "left";
    context.textBaseline = "middle";
    for (const { value, text } of ticks(-this.depthDb, 0, 5)) {
      context.fillText(value === 0 ? "0 dB" : text, left + 21, box.y - box.height * value / this.depthDb);
    }
  }
}

let imagePicture = null;
let sinogramPicture = null;

function showPictures(message) {
  imagePicture = imagePicture || new Picture("image");
  sinogramPicture = sinogramPicture || new Picture("sinogram");
  const { scan, image, sinogram } = message;
  const empty = !image && !sinogram;
  if (document.body.dataset.pictures !== (empty ? "none" : "some")) document.body.dataset.pictures = empty ? "none" : "some";
  if (image) {
    const half = image.extent_m / 2;
    const [x, y] = image.centre_m;
    const circles = scan && scan.final && scan.answer ? scan.answer.reflectors : [];
    imagePicture.show(image.side, image.side, image.levels, image.depth_db, [x - half, x + half, "x (m)"], [y + half, y - half, "y (m)"], circles);
    setText("image-caption", `Image from above, ${image.extent_m.toFixed(2)} m wide${circles.length ? "; circles: reflectors of the answer, dashed: other echoes" : ""}`);
  } else {
    imagePicture.clear();
    setText("image-caption", "Image from above");
  }
  if (sinogram) {
    const down = scan.seconds ? [0, scan.seconds, "time (s)"] : [0, 1, "part of the recording"];
    sinogramPicture.show(sinogram.columns, sinogram.rows, sinogram.levels, sinogram.depth_db, [...sinogram.range_m, "range (m)"], down);
    setText("sinogram-caption", `Sinogram: range ${sinogram.range_m[0].toFixed(2)} to ${sinogram.range_m[1].toFixed(2)} m, time downwards`);
  } else {
    sinogramPicture.clear();
    setText("sinogram-caption", "Sinogram");
  }
}
