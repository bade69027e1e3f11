// The result page: particles that are marked in one figure are marked in all; a click opens one.
"use strict";
(() => {
  const { held, rows, rowsOf, views, made, compare, show, onDraw } = iscat;
  const byId = (id) => document.getElementById(id);
  byId("print").addEventListener("click", () => print());
  if (!held.rows) return;
  const events = rows("events").map((event, row) => Object.assign(event, { row, marked: true })), still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const rejected = new Set(), gates = [];
  let asked = null, marked = null, interval = null, opened = -1, page = 0, order = events.map((_, k) => k);

  // ---- what is marked
  const figuresOfEvents = ["field", "time", "mobility"];
  const refresh = () => {
    for (const id of figuresOfEvents) {
      const view = views.get(id);
      if (view) view.data("events", events).runAsync();
    }
    bars();
    fill();
    const many = marked ? marked.size : 0;
    byId("selected").textContent = marked ? `${many} of ${held.rows} selected` : "Drag over the histogram to select particles.";
    byId("clear").hidden = !marked;
    byId("gate").hidden = !interval;
    byId("save-selection").hidden = !(gates.length || rejected.size);
    byId("save-selection").textContent = `Save selection (${[gates.length && `${gates.length} gate${gates.length > 1 ? "s" : ""}`, rejected.size && `${rejected.size} rejected`].filter(Boolean).join(", ")})`;
    document.querySelectorAll("tr[data-species]").forEach((line) => line.classList.toggle("off", marked !== null && !events.some((e) => e.marked && e.species === +line.dataset.species)));
  };
  let waiting = false;
  const mark = (test, range = null) => {
    asked = test;
    events.forEach((event) => { event.marked = (test === null || test(event)) && !rejected.has(event.event); });
    marked = test === null ? null : new Set(events.filter((event) => event.marked).map((event) => event.row));
    interval = range;
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; refresh(); });
  };

  // ---- the histogram, whose bins may have any width
  const first = held.figures.masses.params.find((param) => param.name === "bin").value;
  let width = first;
  const widths = [];
  for (let power = Math.floor(Math.log10(first)) - 2; power <= Math.floor(Math.log10(first)) + 2; power += 1) for (const step of [1, 2, 2.5, 5]) widths.push(step * 10 ** power);
  const middle = widths.reduce((best, w, k) => (Math.abs(Math.log(w / first)) < Math.abs(Math.log(widths[best] / first)) ? k : best), 0);
  const slider = byId("bin");
  const say = () => { byId("bin-value").textContent = `${+width.toPrecision(3)} ${held.unit}`.trim(); };
  const bars = () => {
    const view = views.get("masses");
    if (!view) return;
    const counts = new Map(), tops = new Map();
    for (const event of events) {
      if (event.value === null || rejected.has(event.event)) continue;
      const bin = Math.floor(event.value / width), found = counts.get(bin) ?? { ok: 0, flagged: 0, marked: 0 };
      found[event.status === "ok" ? "ok" : "flagged"] += 1;
      found.marked += marked !== null && event.marked ? 1 : 0;
      counts.set(bin, found);
    }
    const made = [];
    for (const [bin, found] of counts) {
      const low = bin * width, high = low + width, top = found.ok + found.flagged;
      tops.set(bin, top);
      if (found.ok) made.push({ low, high, bottom: 0, top: found.ok, count: found.ok, part: "ok" });
      if (found.flagged) made.push({ low, high, bottom: found.ok, top, count: found.flagged, part: "flagged" });
      if (found.marked) made.push({ low, high, bottom: 0, top: found.marked, count: found.marked, part: "marked" });
    }
    const peaks = rows("peaks").map((peak) => {
      const bin = Math.floor(peak.value / width);
      const { value, species, label, share, curve } = peak; // a copy of all would be known to Vega as the same row
      return { value, species, label, share, curve, height: Math.max(peak.curve * width, ...[bin - 1, bin, bin + 1].map((k) => tops.get(k) ?? 0)) };
    });
    const scale = view.scale("x"), highest = Math.max(...tops.values(), ...peaks.map((peak) => peak.height));
    const free = [];  // names that would lie over each other go one row up
    for (const peak of peaks.sort((a, b) => a.value - b.value)) {
      const at = scale(peak.value), row = Math.max(0, free.findIndex((end) => end < at - 45));
      const place = free.length && free[row] >= at - 45 ? free.length : row;
      free[place] = at + 45;
      peak.height += place * 0.14 * highest;
    }
    view.signal("bin", width).data("bars", made);
    if (peaks.length) view.data("peaks", peaks);
    view.runAsync();
  };
  slider?.addEventListener("input", () => { width = widths[Math.max(0, Math.min(widths.length - 1, middle + +slider.value - 6))]; say(); bars(); });
  byId("curves")?.addEventListener("input", (event) => views.get("masses")?.signal("curves_on", event.target.checked).runAsync());
  if (slider) say();

  // ---- selections in figures
  const within = (value, range) => !range || (value >= Math.min(...range) && value <= Math.max(...range));
  const watch = (view, name, fields) => {
    try {
      view.addSignalListener(name, (_, value) => {
        const ends = Object.entries(fields).map(([axis, key]) => [key, value?.[axis] ?? Object.entries(value ?? {}).find(([field]) => field.replace(/\\/g, "") === axis)?.[1]]);
        if (!ends.some(([, range]) => range)) { mark(null); return; }
        mark((event) => ends.every(([key, range]) => within(event[key], range)), name === "brush" ? ends[0][1] : null);
      });
    } catch { /* this figure has no selection */ }
  };
  onDraw((id, view) => {
    if (id === "masses") { watch(view, "brush", { low: "value" }); bars(); }
    if (id === "field") watch(view, "area", { x: "x", y: "y" });
    if (id === "time") watch(view, "stretch", { time: "time", value: "value" });
    if (id === "mobility") watch(view, "region", { value: "value", d: "d" });
    if (figuresOfEvents.includes(id)) view.addEventListener("click", (_, item) => { if (item?.datum?.row !== undefined) open(item.datum.row); });
  });
  byId("clear").addEventListener("click", () => { byId("filter").value = ""; mark(null); });
  document.querySelectorAll("tr[data-species]").forEach((line) => {
    const pick = () => mark((event) => event.species === +line.dataset.species);
    line.addEventListener("click", pick);
    line.addEventListener("keydown", (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); pick(); } });
  });

  // ---- gates and rejections, which `iscat species --select` reads
  byId("gate").addEventListener("click", () => { gates.push([Math.min(...interval), Math.max(...interval)]); refresh(); });
  byId("save-selection").addEventListener("click", () => {
    const content = { movie: held.movie, quantity: held.quantity, gates, rejected: events.filter((e) => rejected.has(e.event)).map(({ event, frame, x, y }) => ({ event, frame, x_px: x, y_px: y })) };
    const href = URL.createObjectURL(new Blob([`${JSON.stringify(content, null, 1)}\n`], { type: "application/json" }));
    made("a", { href, download: `${held.movie.replace(/\.[^.]*$/, "")}.selection.json` }).click();
  });

  // ---- the table, in pages
  const table = byId("table"), body = table.tBodies[0], filter = byId("filter"), size = 50;
  const columns = held.table.map((column) => (column.of ? { ...column, cells: events.map((event) => String(event[column.of])) } : column));
  let kept = order;
  const fill = () => {
    kept = order.filter((k) => !marked || marked.has(k));
    page = Math.max(0, Math.min(page, Math.ceil(kept.length / size) - 1));
    body.replaceChildren(...kept.slice(page * size, (page + 1) * size).map((k) => {
      const line = made("tr", { id: `row-${k}`, className: [k === opened && "hit", rejected.has(events[k].event) && "off"].filter(Boolean).join(" ") });
      columns.forEach((column, n) => {
        const last = n === columns.length - 1;
        const cell = made("td", { className: last ? `status ${events[k].status === "ok" ? "ok" : "flagged"}` : "num" });
        if (n) cell.textContent = column.cells[k];
        else cell.append(made("button", { type: "button", className: "toggle", textContent: column.cells[k], onclick: (event) => { event.stopPropagation(); open(k); } }));
        if (last) cell.title = column.advice[column.cells[k].split("; ")[0]] ?? "";
        line.append(cell);
      });
      line.addEventListener("click", () => open(k));
      return line;
    }));
    byId("count").textContent = kept.length < held.rows ? `· ${kept.length} of ${held.rows}` : `· ${held.rows}`;
    const pages = Math.ceil(kept.length / size);
    byId("page").textContent = pages > 1 ? `${page + 1} of ${pages}` : "";
    document.querySelectorAll("[data-page]").forEach((button) => { button.hidden = pages < 2; });
  };
  document.querySelectorAll("[data-page]").forEach((button) => button.addEventListener("click", () => { page += +button.dataset.page; fill(); }));
  filter.addEventListener("input", () => {
    const asked = filter.value.trim();
    page = 0;
    mark(asked ? (event) => columns.some((column) => column.cells[event.row].includes(asked)) : null);
  });
  [...table.tHead.rows[0].cells].forEach((head, n) => head.firstElementChild.addEventListener("click", () => {
    const down = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
    table.querySelectorAll("th").forEach((th) => th.setAttribute("aria-sort", "none"));
    head.setAttribute("aria-sort", down < 0 ? "descending" : "ascending");
    const cells = columns[n].cells, sorted = compare(cells, down);
    order = events.map((_, k) => k).sort((a, b) => sorted(cells[a], cells[b]));
    page = 0;
    fill();
  }));
  fill();

  // ---- one particle
  const panel = byId("particle");
  const open = async (k) => {
    opened = k;
    const event = events[k], found = held.images[k], parts = [];
    if (found) parts.push(made("img", { src: found.strip, alt: "Data, model and residual", className: "strip" }), made("p", { className: "caption", textContent: `Data, model, residual: ${found.scales}` }));
    let plot = null;
    if (found?.trace) parts.push(plot = made("div", { className: "plot" }), made("p", { className: "caption", textContent: found.told }));
    if (found?.clip) {
      const film = made("div", { className: "clip" }, made("img", { src: found.clip.image, alt: "Ratiometric clip around the step" }));
      film.style.aspectRatio = found.clip.ratio;
      film.firstChild.style.setProperty("--still", `${-100 * found.clip.still / found.clip.frames}%`);
      if (!still) film.firstChild.style.animation = `slide ${found.clip.seconds}s steps(${found.clip.frames}) infinite`;
      parts.push(film, made("p", { className: "caption", textContent: found.clip.told }));
    }
    const words = made("dl", { className: "pairs" });
    for (const column of columns.slice(1)) words.append(made("div", {}, made("dt", { textContent: column.heading }), made("dd", { textContent: column.cells[k] })));
    const last = columns.at(-1);
    parts.push(words, made("p", { className: "caption", textContent: last.advice[last.cells[k].split("; ")[0]] ?? "" }));
    byId("particle-title").textContent = `${held.kind} ${event.event}`;
    byId("reject").textContent = rejected.has(event.event) ? "Take back" : "Reject";
    byId("particle-body").replaceChildren(...parts);
    const shown = panel.hidden;
    panel.hidden = false;
    fill();
    if (shown) byId("particle-title").focus({ preventScroll: true });
    if (plot) await show(plot, held.trace, Object.fromEntries(Object.entries(found.trace).map(([name, part]) => [name, rowsOf(part)])));
  };
  const close = () => { panel.hidden = true; opened = -1; fill(); };
  const step = (by) => { const at = kept.indexOf(opened); if (kept.length) { const next = kept[(at + by + kept.length) % kept.length]; page = Math.floor(kept.indexOf(next) / size); open(next); } };
  panel.querySelectorAll("[data-step]").forEach((button) => button.addEventListener("click", () => step(+button.dataset.step)));
  panel.querySelector("[data-close]").addEventListener("click", close);
  byId("reject").addEventListener("click", () => {
    const number = events[opened].event;
    if (!rejected.delete(number)) rejected.add(number);
    byId("reject").textContent = rejected.has(number) ? "Take back" : "Reject";
    mark(asked, interval);
  });
  addEventListener("keydown", (event) => {
    if (panel.hidden || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName)) return;
    if (event.key === "ArrowLeft") step(-1);
    else if (event.key === "ArrowRight") step(1);
    else if (event.key === "Escape") close();
  });
})();
