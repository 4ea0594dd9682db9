"use strict";
(() => {
  const byId = (id) => document.getElementById(id);
  // Everything from outside goes into the page as text, never as markup.
  const maker = (space) => (tag, attributes = {}, ...children) => {
    const node = document.createElementNS(space, tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    node.append(...children);
    return node;
  };
  const make = maker("http://www.w3.org/1999/xhtml"), draw = maker("http://www.w3.org/2000/svg");
  const [POSITION, FILE, STATUS, LAYOUT, LABEL, SCORE, TURN, BOUND, CAVEATS, COPY, RECORDED, NOTE, WHY, REMEDY, EXPECTED,
    CORRECT, PICTURE] = Array(17).keys();
  const rows = JSON.parse(byId("row-data").textContent);
  const withExpected = byId("table").dataset.expected === "yes";
  const order = { failed: 0, no_tag: 1, unknown: 2, ambiguous: 3, identified: 4 };
  const counted = (count) => `${count} file${count === 1 ? "" : "s"}`;
  const words = (status) => status.replace("_", " ");
  const answer = (row) => (row[STATUS] === "identified" ? row[LAYOUT] : words(row[STATUS]));
  const columns = [
    { name: "image" },
    { name: "answer", key: STATUS, css: "status" },
    { name: "file", key: FILE, css: "file" },
    { name: "score", key: SCORE, css: "n" },
    { name: "turn", key: TURN, css: "n" },
    { name: "false accept", key: BOUND, css: "n bound" },
    { name: "why", key: WHY, css: "why" },
  ];
  if (withExpected) columns.push({ name: "expected", key: EXPECTED, css: "" });

  const filters = ["f-text", "f-status", "f-layout", "f-score-low", "f-score-high", "f-caveat", "f-correct"]
    .map(byId).filter(Boolean);
  const state = { sort: null, down: false, page: 0, shown: rows, open: -1, opener: null };
  const collator = new Intl.Collator("en", { numeric: true });
  const picture = (kind, position) => {
    const node = byId(kind + position);
    return node ? "data:image/png;base64," + node.textContent : "";
  };

  const compare = (a, b) => {
    const key = state.sort;
    if (key === STATUS) return order[a[key]] - order[b[key]] || collator.compare(a[LAYOUT], b[LAYOUT]);
    if (key === TURN || key === BOUND) return (a[key] ?? Infinity) - (b[key] ?? Infinity) || 0;
    if (typeof a[key] === "number") return a[key] - b[key];
    return collator.compare(a[key] ?? "", b[key] ?? "");
  };
  const wanted = () => {
    const value = (id) => (byId(id) ? byId(id).value : "");
    const text = value("f-text").trim().toLowerCase();
    const [status, layout, correct, caveat] = ["f-status", "f-layout", "f-correct", "f-caveat"].map(value);
    const limit = (id, otherwise) => (value(id) === "" ? otherwise : Number(value(id)));
    const [low, high] = [limit("f-score-low", -Infinity), limit("f-score-high", Infinity)];
    return (row) => (!status || row[STATUS] === status) && (!layout || row[LAYOUT] === layout)
      && row[SCORE] >= low && row[SCORE] <= high
      && (!caveat || (caveat === "none" ? !row[CAVEATS].length : row[CAVEATS].includes(caveat)))
      && (!correct || String(row[CORRECT]) === correct)
      && (!text || [FILE, LABEL, LAYOUT, WHY, NOTE].map((key) => row[key]).join(" ").toLowerCase().includes(text));
  };
  const choose = () => {
    state.shown = rows.filter(wanted());
    if (state.sort !== null) {
      const sign = state.down ? -1 : 1;
      state.shown.sort((a, b) => sign * compare(a, b) || a[POSITION] - b[POSITION]);
    }
    state.page = 0;
    show();
  };

  const percent = (share) => Math.round(100 * share) + "\u202f%";
  const marks = (row) => [...row[CAVEATS].map((name) => name.replaceAll("_", " ")), ...(row[COPY] ? ["copy"] : [])]
    .flatMap((text) => [" ", make("span", { class: "mark" }, text)]);
  const cell = (column, row) => {
    const cell = make("td", { class: column.css });
    if (column.key !== FILE && column.key !== STATUS && column.key !== WHY) cell.dataset.head = column.name;
    let value = row[column.key];
    if (column.key === FILE) value = make("span", { class: "name" }, value);
    const more = [];
    if (column.key === STATUS) {
      cell.classList.add("s-" + value);
      value = answer(row);
      if (row[LABEL]) more.push(make("div", { class: "small" }, row[LABEL]));
      if (marks(row).length) more.push(make("div", {}, ...marks(row)));
    } else if (column.key === SCORE) value = row[STATUS] === "failed" ? "" : value.toFixed(2);
    else if (column.key === TURN) value = value === null ? "" : percent(value);
    else if (column.key === BOUND) value = value === null ? "" : String(Number(value.toPrecision(2)));
    else if (column.key === WHY) {
      value = value && make("div", { class: "clip" }, value);
      if (row[REMEDY]) more.push(make("div", { class: "clip small" }, "What to do: " + row[REMEDY]));
    } else if (column.key === FILE) {
      const recording = [row[RECORDED] && row[RECORDED] + " UTC", row[NOTE]].filter(Boolean).join(", ");
      if (recording) more.push(make("div", { class: "clip small" }, recording));
    } else if (column.key === EXPECTED) {
      if (row[CORRECT] === false) cell.classList.add("miss");
      value = value && value + (row[CORRECT] ? " (yes)" : " (no)");
    }
    if (!value && !more.length) cell.classList.add("none");
    cell.append(value || "-", ...more);
    return cell;
  };
  const thumbnail = (row) => {
    const button = make("button", { type: "button", class: "thumb" });
    button.dataset.position = row[POSITION];
    button.setAttribute("aria-label", "Open " + row[FILE] + ", " + answer(row));
    const source = picture("i", row[POSITION]);
    if (source) button.append(make("img", { src: source, alt: "", width: 48, height: 48, loading: "lazy", decoding: "async" }));
    else button.append("open");
    button.addEventListener("click", () => open(row, button));
    return make("td", { class: "picture" }, button);
  };
  const fill = (some) => {
    byId("rows").replaceChildren(...some.map((row) => {
      const line = make("tr", {}, thumbnail(row), ...columns.slice(1).map((column) => cell(column, row)));
      line.dataset.position = row[POSITION];
      return line;
    }));
  };
  const show = () => {
    const size = Number(byId("p-size").value);
    const last = Math.max(0, Math.ceil(state.shown.length / size) - 1);
    state.page = Math.min(Math.max(state.page, 0), last);
    fill(state.shown.slice(state.page * size, (state.page + 1) * size));
    byId("count").textContent = state.shown.length === rows.length ? counted(rows.length)
      : `${state.shown.length} of ${counted(rows.length)}`;
    byId("p-where").textContent = `page ${state.page + 1} of ${last + 1}`;
    for (const id of ["p-first", "p-back"]) byId(id).disabled = state.page === 0;
    for (const id of ["p-next", "p-last"]) byId(id).disabled = state.page === last;
    for (const head of byId("heads").children) {
      if (head.dataset.key === undefined) continue;
      const mine = Number(head.dataset.key) === state.sort;
      head.setAttribute("aria-sort", mine ? (state.down ? "descending" : "ascending") : "none");
      head.querySelector("span").textContent = mine ? (state.down ? " \u25bc" : " \u25b2") : "";
    }
    const sorting = byId("sorting");
    if (sorting) sorting.value = state.sort === null ? "" : state.sort + (state.down ? "-" : "+");
  };
  const sortBy = (key, down) => { state.sort = key; state.down = down; choose(); };

  // Figures: the raster comes with the page, everything around it is drawn here.
  const VIRIDIS = ["#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30", "#fde725"];
  const ticks = (low, high, count) => {
    const span = Math.abs(high - low), power = 10 ** Math.floor(Math.log10(span / count));
    const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s * count >= span * 0.999999);
    const list = [], from = Math.min(low, high), to = Math.max(low, high);
    for (let i = Math.ceil(from / step - 1e-9); i <= Math.floor(to / step + 1e-9); i++) list.push(i * step);
    return list.map((value) => [value, value.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9)))]);
  };
  const BOX = { left: 58, top: 12, size: 320, width: 470, height: 382 };
  const plot = (source, x, y, range, label) => {
    const { left, top, size, width, height } = BOX;
    const at = (px, py) => [left + (px - x.from) / (x.to - x.from) * size, top + (y.from - py) / (y.from - y.to) * size];
    const svg = draw("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label });
    svg.append(draw("image", { href: source, x: left, y: top, width: size, height: size, preserveAspectRatio: "none" }));
    svg.append(draw("rect", { x: left, y: top, width: size, height: size, class: "axis" }));
    const text = (px, py, anchor, words, more = {}) =>
      svg.append(draw("text", { x: px, y: py, "text-anchor": anchor, ...more }, words));
    for (const [value, words] of ticks(x.from, x.to, 6)) {
      const px = at(value, y.to)[0];
      svg.append(draw("path", { d: `M${px} ${top + size}v5`, class: "axis" }));
      text(px, top + size + 19, "middle", words);
    }
    for (const [value, words] of ticks(y.from, y.to, 6)) {
      const py = at(x.from, value)[1];
      svg.append(draw("path", { d: `M${left} ${py}h-5`, class: "axis" }));
      text(left - 8, py + 4, "end", words);
    }
    text(left + size / 2, height - 12, "middle", x.label);
    text(13, top + size / 2, "middle", y.label, { transform: `rotate(-90 13 ${top + size / 2})` });
    const bar = left + size + 16, id = "bar" + label.length + Math.random().toString(36).slice(2);
    const gradient = draw("linearGradient", { id, x1: 0, y1: 1, x2: 0, y2: 0 });
    VIRIDIS.forEach((colour, i) => gradient.append(draw("stop", { offset: i / 8, "stop-color": colour })));
    svg.append(draw("defs", {}, gradient));
    svg.append(draw("rect", { x: bar, y: top, width: 14, height: size, fill: `url(#${id})`, class: "bar" }));
    svg.append(draw("path", { d: `M${bar} ${top}h14v${size}h-14z`, class: "axis" }));
    for (const [value, words] of ticks(-range, 0, 6)) {
      const py = top - value / range * size;
      svg.append(draw("path", { d: `M${bar + 14} ${py}h4`, class: "axis" }));
      text(bar + 21, py + 4, "start", words.replace("-0", "0"));
    }
    text(bar + 7, top + size + 19, "middle", "dB");
    return { svg, at };
  };
  const twice = (svg, tag, attributes, title) => {
    // A dark rim under a light line is seen on any colour.
    svg.append(draw(tag, { ...attributes, class: "rim", fill: "none", stroke: "#101014", "stroke-width": 4.5 }));
    const line = draw(tag, { ...attributes, fill: "none", "stroke-width": 2 });
    line.append(draw("title", {}, title));
    svg.append(line);
  };
  const image = (item, source) => {
    const d = item.drawing, half = d.extent_m / 2, [mx, my] = d.centre_m;
    const { svg, at } = plot(source, { from: mx - half, to: mx + half, label: "x, m" }, { from: my + half, to: my - half, label: "y, m" },
      d.image_db, `Radar image of ${item.file}: ${item.reflectors.length} reflectors`);
    const mm = (x, y) => `(${(1000 * x).toFixed(1)}, ${(1000 * y).toFixed(1)}) mm`;
    for (const [x, y] of d.layout_m) {
      const [cx, cy] = at(x, y);
      twice(svg, "circle", { cx, cy, r: 11, class: "layout", stroke: "#ffffff" }, `layout ${mm(x, y)}`);
    }
    item.reflectors.forEach((r, i) => {
      const [cx, cy] = at(r.x_m, r.y_m);
      const path = r.matched ? `M${cx - 6} ${cy}h12M${cx} ${cy - 6}v12` : `M${cx - 5} ${cy - 5}l10 10M${cx - 5} ${cy + 5}l10 -10`;
      twice(svg, "path", { d: path, class: "reflector", stroke: r.matched ? "#ffffff" : "#ff8c6e" },
        `reflector ${i + 1} ${mm(r.x_m, r.y_m)}, ${r.amplitude_db.toFixed(1)} dB${r.matched ? "" : ", not in the layout"}`);
    });
    return [svg, make("figcaption", {}, `Image (${d.method}), dB below the brightest pixel. Ring: layout; plus: reflector of the layout; cross: another reflector.`)];
  };
  const sinogram = (item, source) => {
    const d = item.drawing, angles = d.angle_deg;
    const y = angles ? { from: angles[0], to: angles[1], label: "angle, degrees" } : { from: 1, to: Math.max(2, d.views), label: "view" };
    const { svg } = plot(source, { from: d.range_m[0], to: d.range_m[1], label: "range, m" }, y, d.sinogram_db, `Sinogram of ${item.file}`);
    return [svg, make("figcaption", {}, `Sinogram of ${d.views} views, mean over angle subtracted.`)];
  };

  const seconds = (item) => Object.entries(item.seconds).map(([name, s]) => `${name} ${s.toFixed(3)}`).join(", ");
  const facts = (item) => [
    ["status", words(item.status)],
    ["layout", item.layout ? item.layout + (item.label ? ` (${item.label})` : "") : ""], ["expected", item.expected],
    ["score", item.score.toFixed(3)], ["margin", item.margin.toFixed(3)],
    ["rotation", item.rotation_deg === null ? "" : item.rotation_deg.toFixed(1) + " degrees"],
    ["centre", item.centre_m ? `(${(1000 * item.centre_m[0]).toFixed(1)}, ${(1000 * item.centre_m[1]).toFixed(1)}) mm` : ""],
    ["reflectors", `${item.reflectors.filter((r) => r.matched).length} of the layout, ${item.missing} missing, ${item.extra} extra`],
    ["others", item.scores.slice(0, 5).map((s) => `${s.layout} ${s.share.toFixed(2)}`).join(", ")],
    ["timings, s", seconds(item)], ["capture uuid", item.capture_uuid], ["content, sha256", item.content_sha256],
    ["size", item.size_bytes === null ? "" : item.size_bytes + " bytes"], ["tool version", item.tool_version],
    ["registry version", item.registry_version],
    ["identified", item.time_utc],
  ];
  const list = (id, pairs) => byId(id).replaceChildren(
    ...pairs.filter(([, value]) => value !== null && value !== undefined && value !== "")
      .flatMap(([name, value]) => [make("dt", {}, name), make("dd", {}, String(value))]));
  const viewer = byId("viewer");
  const open = (row, opener) => {
    const item = JSON.parse(byId("d" + row[POSITION]).textContent);
    state.open = state.shown.indexOf(row);
    if (opener) state.opener = opener;
    byId("v-title").textContent = item.file;
    const line = byId("v-answer");
    line.textContent = item.status === "identified" ? `${item.layout}, score ${item.score.toFixed(2)}, margin ${item.margin.toFixed(2)}` : words(item.status);
    line.className = "s-" + item.status;
    line.append(...marks(row));
    list("v-explained", item.explained);
    const [big, wave] = [picture("i", row[POSITION]), picture("s", row[POSITION])];
    byId("v-image").replaceChildren(...(big ? image(item, big) : [make("figcaption", {},
      row[PICTURE] === 0 ? "Picture omitted because of the size limit; tagid reconstruct draws it from the file." : "No picture.")]));
    byId("v-sinogram").replaceChildren(...(wave ? sinogram(item, wave) : []));
    list("v-facts", facts(item));
    byId("v-back").disabled = state.open <= 0;
    byId("v-next").disabled = state.open >= state.shown.length - 1;
    if (!viewer.open) { viewer.showModal(); byId("v-title").focus(); }
    viewer.scrollTop = 0;
  };
  const step = (by) => {
    const row = state.shown[state.open + by];
    if (row) open(row);
  };
  byId("v-close").addEventListener("click", () => viewer.close());
  byId("v-back").addEventListener("click", () => step(-1));
  byId("v-next").addEventListener("click", () => step(1));
  viewer.addEventListener("keydown", (event) => {
    if (event.key === "ArrowLeft") step(-1);
    if (event.key === "ArrowRight") step(1);
  });
  viewer.addEventListener("click", (event) => { if (event.target === viewer) viewer.close(); });
  viewer.addEventListener("close", () => {
    if (state.opener && state.opener.isConnected) state.opener.focus();
  });

  for (const column of columns) {
    const head = make("th", { scope: "col", class: column.css ?? "" });
    if (column.key === undefined) head.append(column.name);
    else {
      const button = make("button", { type: "button" }, column.name, make("span", { "aria-hidden": "true" }));
      head.dataset.key = column.key;
      button.addEventListener("click", () => sortBy(column.key, state.sort === column.key ? !state.down : false));
      head.append(button);
    }
    byId("heads").append(head);
  }
  // Phones hide the column headings; a list sorts instead.
  const sorting = make("select", { id: "sorting" }, make("option", { value: "" }, "as given"));
  for (const column of columns.slice(1)) {
    for (const [sign, words] of [["+", "rising"], ["-", "falling"]])
      sorting.append(make("option", { value: column.key + sign }, `${column.name}, ${words}`));
  }
  sorting.addEventListener("change", () => sorting.value === "" ? sortBy(null, false)
    : sortBy(Number(sorting.value.slice(0, -1)), sorting.value.endsWith("-")));
  byId("f-reset").before(make("label", { class: "sorting" }, "Sort ", sorting));
  for (const name of [...new Set(rows.map((row) => row[LAYOUT]).filter(Boolean))].sort(collator.compare))
    byId("f-layout").append(make("option", { value: name }, name));
  let waiting = 0;
  const soon = () => { clearTimeout(waiting); waiting = setTimeout(choose, 80); };
  // Not every browser reports a choice from a list as input.
  for (const filter of filters) for (const kind of ["input", "change"]) filter.addEventListener(kind, soon);
  byId("filters").addEventListener("submit", (event) => event.preventDefault());
  byId("filters").addEventListener("reset", () => setTimeout(() => { state.sort = null; choose(); }));
  byId("p-size").addEventListener("change", () => { state.page = 0; show(); });
  const turn = (id, to) => byId(id).addEventListener("click", () => { state.page = to(); show(); });
  turn("p-first", () => 0);
  turn("p-back", () => state.page - 1);
  turn("p-next", () => state.page + 1);
  turn("p-last", () => Infinity);
  // Printing shows all rows that fit.
  const MOST_PRINTED = 1000;
  addEventListener("beforeprint", () => fill(state.shown.slice(0, MOST_PRINTED)));
  addEventListener("afterprint", show);
  show();
})();
