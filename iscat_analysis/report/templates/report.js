// The report's own behaviour: one filter that the table and every picture obey, rows that open.
"use strict";
(() => {
  const { el, fmt, fmtWith, fmtPercent, fmtFixed, decimalsOf, finite, chart, responsive, offerDownload, save } = window.iscat;
  const { panels, field, corner } = window.iscat.images;
  const data = JSON.parse(document.getElementById("analysis").textContent);
  const { columns, free, main, labels, units } = data;
  const n = columns.event.length;
  const signalUnit = data.scheme === "darkfield" ? "e⁻" : "contrast";
  const byId = (id) => document.getElementById(id);
  const plotOf = (id) => { const f = byId(id); return f ? f.querySelector(".plot") : null; };
  const isOk = (i) => columns.status[i] === "ok";
  const ratio = (i, name) => columns[`sigma_${name}`][i] / columns[`crb_${name}`][i];
  const used = (i, name) => (columns[`qcrb_${name}`][i] / columns[`crb_${name}`][i]) ** 2;
  const known = (v) => (v === null || !Number.isFinite(v) ? null : v);
  const derived = {};
  for (const name of free) {
    derived[`ratio_${name}`] = columns.event.map((_, i) => (finite(columns[`sigma_${name}`][i]) && columns[`crb_${name}`][i] ? known(ratio(i, name)) : null));
    derived[`used_${name}`] = columns.event.map((_, i) => (finite(columns[`qcrb_${name}`][i]) && columns[`crb_${name}`][i] ? known(used(i, name)) : null));
  }
  const column = (key) => columns[key] || derived[key];

  const state = { text: "", status: "", ranges: {}, sort: "event", down: false, page: 0, size: 25, bound: main, open: new Set() };
  let mask = new Array(n).fill(true);
  let order = columns.event.map((_, i) => i);

  const matches = (i) => {
    if (state.status && columns.status[i] !== state.status) return false;
    for (const [key, [lo, hi]] of Object.entries(state.ranges)) {
      const v = columns[key][i];
      if (!finite(v) || (lo !== null && v < lo) || (hi !== null && v > hi)) return false;
    }
    if (!state.text) return true;
    if (/^\d+$/.test(state.text)) return columns.event[i] === Number(state.text);
    return `${columns.status[i]} ${columns.flags[i]}`.toLowerCase().includes(state.text);
  };
  const arrange = () => {
    mask = columns.event.map((_, i) => matches(i));
    const values = column(state.sort);
    const empty = (v) => v === null || v === undefined || v === "";
    order = columns.event.map((_, i) => i).filter((i) => mask[i]);
    order.sort((a, b) => {
      const [p, q] = [values[a], values[b]];
      if (empty(p) || empty(q)) return empty(p) - empty(q) || a - b;
      const c = p < q ? -1 : p > q ? 1 : 0;
      return (state.down ? -c : c) || a - b;
    });
  };

  // ---- pictures --------------------------------------------------------------------------------
  const summaryOf = (i) => [
    `Event ${columns.event[i]} · ${columns.status[i]}`,
    ...free.map((name) => `${labels[name]} ${fmtWith(columns[name][i], columns[`sigma_${name}`][i])} ± ${fmt(columns[`sigma_${name}`][i], 2)} ${units[name]}`),
  ].join("\n");
  const boundTip = (i, name) => [
    `Event ${columns.event[i]} · ${columns.status[i]}`,
    `${labels[name]} ${fmtWith(columns[name][i], columns[`sigma_${name}`][i])} ${units[name]}`,
    `σ ${fmt(columns[`sigma_${name}`][i])} ${units[name]} = ${fmt(ratio(i, name))} × CRB`,
    `CRB ${fmt(columns[`crb_${name}`][i])} ${units[name]}`,
    `QCRB ${fmt(columns[`qcrb_${name}`][i])} ${units[name]}, ${fmtPercent(used(i, name))} of the light used`,
  ].join("\n");

  const histogram = (name) => (host) => {
    const values = columns[name].filter(finite);
    if (!values.length) { host.replaceChildren(el("p", { class: "empty" }, "No finite values to show.")); return; }
    let lo = Math.min(...values), hi = Math.max(...values);
    if (hi - lo < Math.abs(hi) * 1e-6 + 1e-9) { lo -= Math.abs(lo) * 0.1 + 0.5; hi += Math.abs(hi) * 0.1 + 0.5; }
    const spread = columns[`sigma_${name}`].filter((v, i) => finite(v) && v > 0 && isOk(i)).sort((a, b) => a - b);
    const width = spread.length ? 2 * spread[spread.length >> 1] : Infinity; // does not blur neighbouring species
    const bins = Math.max(10, Math.min(90, Math.round((hi - lo) / width)));
    const edges = Array.from({ length: bins + 1 }, (_, k) => lo + ((hi - lo) * k) / bins);
    const counts = { ok: new Array(bins).fill(0), flagged: new Array(bins).fill(0), out: new Array(bins).fill(0) };
    columns[name].forEach((v, i) => {
      if (!finite(v)) return;
      const k = Math.min(bins - 1, Math.floor(((v - lo) / (hi - lo)) * bins));
      counts[!mask[i] ? "out" : isOk(i) ? "ok" : "flagged"][k] += 1;
    });
    const below = counts.ok.map((c, k) => c + counts.flagged[k]);
    const series = [{ kind: "bars", name: "ok", color: "ok", edges, counts: counts.ok }];
    if (counts.flagged.some(Boolean)) series.push({ kind: "bars", name: "flagged", color: "flag", edges, counts: counts.flagged, base: counts.ok });
    if (counts.out.some(Boolean)) series.push({ kind: "bars", name: "filtered out", color: "plain", opacity: 0.3, edges, counts: counts.out, base: below });
    chart(host, { x: { label: `${labels[name]} [${units[name]}]`, domain: [lo, hi] }, y: { label: "events", zero: true, whole: true }, series }, {
      brushed: state.ranges[name] || null,
      onBrush: (range) => { if (range) state.ranges[name] = range; else delete state.ranges[name]; showRange(); refresh(); },
    });
  };
  const split = (x, y, color, extra = {}) => {
    const pick = (wanted) => columns.event.map((_, i) => i).filter((i) => isOk(i) === wanted);
    return [[true, "ok", color], [false, "flagged", "flag"]].flatMap(([wanted, name, tint]) => {
      const ids = pick(wanted);
      if (!ids.length) return [];
      return [{ kind: "points", name: extra.name ? `${extra.name}${wanted ? "" : ", flagged"}` : name, color: tint, x: ids.map((i) => x[i]), y: ids.map((i) => y[i]), ids, mask: ids.map((i) => mask[i]), hollow: !wanted, under: !wanted }];
    });
  };
  const timeline = (host) => {
    const series = data.mode === "track" ? [...tracks().values()].map((rows) => ({ kind: "line", color: "plain", thin: true, x: rows.map((i) => columns.frame[i]), y: rows.map((i) => columns[main][i]) })) : [];
    series.push(...split(columns.frame, columns[main], "ok"));
    chart(host, { x: { label: "frame", whole: true }, y: { label: `${labels[main]} [${units[main]}]` }, series }, { tip: (s, k) => summaryOf(s.ids[k]), onPick: openEvent });
  };
  const tracks = () => {
    const found = new Map();
    columns.event.forEach((event, i) => { if (!mask[i]) return; if (!found.has(event)) found.set(event, []); found.get(event).push(i); });
    for (const rows of found.values()) rows.sort((a, b) => columns.frame[a] - columns.frame[b]);
    return found;
  };
  const panel = (name) => (host) => {
    const [sigma, crb, qcrb] = ["sigma", "crb", "qcrb"].map((kind) => columns[`${kind}_${name}`]);
    if (!crb.some(finite)) { host.replaceChildren(el("p", { class: "empty" }, "No bound is known for this parameter.")); return; }
    const all = columns.event.map((_, i) => i);
    const series = [
      { kind: "diagonal", name: "CRB", color: "crb" },
      { kind: "points", name: "QCRB", color: "qcrb", x: crb, y: qcrb, ids: all, mask },
      ...split(crb, sigma, "sigma", { name: "achieved σ" }),
    ];
    chart(host, { height: 310, x: { label: `CRB [${units[name]}]`, scale: "log" }, y: { label: `σ and QCRB [${units[name]}]`, scale: "log" }, series }, { tip: (s, k) => boundTip(s.ids[k], name), onPick: openEvent });
  };
  const map = (host) => {
    const many = new Set(columns.event).size < n;
    if (!data.field) { host.replaceChildren(el("p", { class: "empty" }, "There is no image of the field.")); return; }
    const marks = columns.event.map((event, i) => ({ x: columns.x_px[i], y: columns.y_px[i], id: i, label: String(event), active: mask[i] })).filter((m) => finite(m.x) && finite(m.y));
    const lines = many ? [...tracks().values()] : [];
    if (many) { const firsts = new Set(lines.map((rows) => rows[0])); marks.forEach((m) => { if (!firsts.has(m.id)) m.label = null; }); }
    field(host, data.field, { nm: data.pixel_size_nm, unit: signalUnit, marks, tracks: lines.map((rows) => rows.filter((i) => finite(columns.x_px[i])).map((i) => [columns.x_px[i], columns.y_px[i]])), tip: summaryOf, onPick: openEvent, title: "Field of view" });
  };
  const redraws = [];
  const show = (id, draw) => { const host = plotOf(id); if (host) redraws.push(responsive(host, () => draw(host))); };

  // ---- table -----------------------------------------------------------------------------------
  const table = byId("table");
  const percent = (v) => (finite(v) ? `${fmtFixed(100 * v, 1)} %` : "—");
  const heads = () => [
    { key: "event", label: "event", numeric: true },
    { key: "frame", label: "frame", numeric: true },
    ...free.map((name) => ({ key: name, label: `${labels[name]} [${units[name]}]`, numeric: true, decimals: decimalsOf(columns[`sigma_${name}`], 2) })),
    ...["sigma", "crb", "qcrb"].map((kind) => ({ key: `${kind}_${state.bound}`, label: kind === "sigma" ? `σ ${labels[state.bound]}` : kind.toUpperCase(), numeric: true, decimals: decimalsOf(columns[`crb_${state.bound}`], 3) })),
    { key: `ratio_${state.bound}`, label: "σ / CRB", numeric: true, decimals: 3 },
    { key: `used_${state.bound}`, label: "light used", numeric: true, cell: (i) => percent(derived[`used_${state.bound}`][i]) },
    { key: "contrast", label: data.scheme === "darkfield" ? "signal [e⁻]" : "contrast", numeric: true, decimals: decimalsOf(columns.contrast, 3) },
    { key: "snr", label: "SNR", numeric: true, decimals: decimalsOf(columns.snr, 3) },
    { key: "chi2_reduced", label: "χ²", numeric: true, decimals: 2 },
    { key: "status", label: "status", cell: (i) => el("span", { class: isOk(i) ? "status" : "status flagged" }, columns.status[i]) },
  ];
  const render = () => {
    const list = heads();
    table.tHead.replaceChildren(el("tr", {}, ...list.map((h) => el("th", { scope: "col", class: h.numeric ? "num" : null, "aria-sort": state.sort === h.key ? (state.down ? "descending" : "ascending") : "none" },
      el("button", { type: "button", "data-key": h.key, onclick: () => { state.down = state.sort === h.key ? !state.down : false; state.sort = h.key; state.page = 0; refresh(false); table.querySelector(`[data-key="${h.key}"]`).focus(); } }, h.label)))));
    const pages = Math.max(1, Math.ceil(order.length / state.size));
    state.page = Math.min(state.page, pages - 1);
    const rows = order.slice(state.page * state.size, (state.page + 1) * state.size);
    const body = [];
    for (const i of rows) {
      const opened = state.open.has(i);
      const cells = list.map((h, k) => {
        const raw = column(h.key)[i];
        const content = k === 0 ? el("button", { type: "button", class: "toggle", "aria-expanded": String(opened), "aria-label": `Event ${columns.event[i]}` }, String(raw)) : h.cell ? h.cell(i) : h.decimals === undefined ? String(raw) : fmtFixed(raw, h.decimals);
        return el("td", { class: h.numeric ? "num" : null }, content);
      });
      body.push(el("tr", { class: opened ? "row open" : "row", id: `row-${i}`, onclick: () => toggle(i) }, ...cells));
      if (opened) body.push(el("tr", {}, el("td", { class: "detail", colspan: list.length, id: `detail-${i}` })));
    }
    if (!rows.length) body.push(el("tr", {}, el("td", { colspan: list.length }, "No event passes these filters.")));
    table.tBodies[0].replaceChildren(...body);
    for (const i of rows) if (state.open.has(i)) fill(i);
    byId("count").textContent = order.length === n ? `${n} ${n === 1 ? "event" : "events"}` : `${order.length} of ${n} events`;
    byId("page-text").textContent = `Page ${state.page + 1} of ${pages}`;
    byId("page-back").disabled = state.page === 0;
    byId("page-next").disabled = state.page >= pages - 1;
  };
  const toggle = (i) => {
    if (state.open.has(i)) state.open.delete(i); else state.open.add(i);
    render();
    const button = document.querySelector(`#row-${i} .toggle`);
    if (button) button.focus({ preventScroll: true });
  };
  const openEvent = (i) => {
    if (!mask[i]) clearFilters();
    state.open.add(i);
    state.page = Math.floor(order.indexOf(i) / state.size);
    render();
    byId(`row-${i}`).scrollIntoView({ block: "center" });
  };
  const pair = (name, value) => el("div", {}, el("dt", {}, name), el("dd", {}, value));
  const fill = (i) => {
    const cell = byId(`detail-${i}`);
    const image = data.images[i];
    const event = columns.event[i];
    const pictures = el("figure", { class: "chart", "data-title": `Event ${event}`, "data-file": `event-${event}` }, el("figcaption", {}, el("h3", {}, "Data, model, residual")), el("div", { class: "plot" }));
    const names = ["", "estimate", "σ", "CRB", "QCRB", "σ / CRB", "light used"];
    const numbers = el("table", { class: "data" }, el("thead", {}, el("tr", {}, ...names.map((t, k) => el("th", { scope: "col", class: k ? "num" : null }, t)))), el("tbody", {}, ...free.map((name) => el("tr", {},
      el("th", { scope: "row" }, `${labels[name]} [${units[name]}]`),
      ...[fmtWith(columns[name][i], columns[`sigma_${name}`][i]), fmt(columns[`sigma_${name}`][i]), fmt(columns[`crb_${name}`][i]), fmt(columns[`qcrb_${name}`][i]), fmtFixed(derived[`ratio_${name}`][i], 3), percent(derived[`used_${name}`][i])].map((t) => el("td", { class: "num" }, t))))));
    const other = (columns.flags[i] || "").split(";").filter((f) => f && f !== columns.status[i]);
    const fixed = ["z_nm", "mass_kda"].filter((name) => !free.includes(name)).map((name) => pair(`${labels[name]}, fixed`, `${fmt(columns[name][i])} ${units[name]}`));
    const facts = el("dl", { class: "pairs" },
      pair("Position", finite(columns.x_px[i]) && finite(columns.y_px[i]) ? `x ${columns.x_px[i].toFixed(2)}, y ${columns.y_px[i].toFixed(2)} px` : "—"),
      pair("Frames", `${columns.n_before[i]} before, ${columns.n_after[i]} after, from ${columns.frame[i]}`),
      ...fixed,
      pair(data.scheme === "darkfield" ? "Peak signal" : "Peak contrast", data.scheme === "darkfield" ? `${fmt(columns.contrast[i])} e⁻` : fmt(columns.contrast[i])),
      pair("Scattered photons", fmt(columns.n_scattered[i])),
      pair("SNR", fmt(columns.snr[i])),
      pair("Reduced χ², p", `${fmt(columns.chi2_reduced[i])}, ${fmt(columns.p_value[i], 2)}`),
      other.length ? pair("Flags", other.join(", ")) : null);
    const verdict = el("p", {}, el("span", { class: isOk(i) ? "status" : "status flagged" }, columns.status[i]), `: ${data.advice[columns.status[i]] || ""}`);
    const right = el("div", {}, verdict, el("div", { class: "scroll" }, numbers));
    cell.replaceChildren(el("div", {}, el("div", {}, pictures, facts), right));
    const plot = pictures.querySelector(".plot");
    if (image) {
      offerDownload(pictures);
      const list = [
        { title: "Data", data: image.data, palette: "grey", lo: image.lo, hi: image.hi, unit: signalUnit },
        { title: "Model", data: image.model, palette: "grey", lo: image.lo, hi: image.hi, unit: signalUnit },
        { title: "Residual", data: image.residual, palette: "diverging", lo: -image.limit, hi: image.limit, unit: "σ" },
      ];
      responsive(plot, () => panels(plot, list, { w: image.w, h: image.h, nm: data.pixel_size_nm, title: `Event ${event}: data, model, residual` }));
    } else {
      plot.replaceChildren(el("p", { class: "empty" }, "This page does not hold the images of this event."));
    }
    const posterior = data.posteriors[i];
    if (posterior) {
      const figure = cornerFigure(i);
      right.append(figure.node);
      figure.draw();
    } else if (data.refused[i] !== undefined) {
      right.append(el("p", { class: "refused" }, el("b", {}, "Posterior refused. "), data.refused[i]));
    }
  };
  const drawCorner = (host, i) => corner(host, data.posteriors[i], { labels, units, title: `Posterior of event ${columns.event[i]}`, estimate: Object.fromEntries(free.map((name) => [name, columns[name][i]])) });
  const cornerFigure = (i) => {
    const node = el("figure", { class: "chart", "data-title": `Posterior of event ${columns.event[i]}` }, el("figcaption", {}, el("h3", {}, "Posterior")), el("div", { class: "plot" }));
    offerDownload(node);
    return { node, draw: () => responsive(node.querySelector(".plot"), () => drawCorner(node.querySelector(".plot"), i)) };
  };

  // ---- controls --------------------------------------------------------------------------------
  const refresh = (pictures = true) => {
    arrange();
    if (table) render();
    if (pictures) requestAnimationFrame(() => redraws.forEach((draw) => draw()));
  };
  const showRange = () => {
    const [lo, hi] = state.ranges[main] || [null, null];
    const short = (v) => (v === null ? "" : String(Number(v.toPrecision(4))));
    byId("filter-low").value = short(lo);
    byId("filter-high").value = short(hi);
  };
  const clearFilters = () => {
    Object.assign(state, { text: "", status: "", ranges: {}, page: 0 });
    byId("filter-text").value = "";
    byId("filter-status").value = "";
    showRange();
    refresh();
  };
  const on = (id, type, action) => byId(id).addEventListener(type, action);
  if (table) {
    on("filter-text", "input", (e) => { state.text = e.target.value.trim().toLowerCase(); state.page = 0; refresh(); });
    on("filter-status", "change", (e) => { state.status = e.target.value; state.page = 0; refresh(); });
    for (const id of ["filter-low", "filter-high"]) {
      on(id, "change", () => {
        const read = (name) => { const v = byId(name).value; return v === "" ? null : Number(v); };
        const range = [read("filter-low"), read("filter-high")];
        if (range[0] === null && range[1] === null) delete state.ranges[main]; else state.ranges[main] = range;
        state.page = 0;
        refresh();
      });
    }
    on("bound-of", "change", (e) => { state.bound = e.target.value; state.sort = "event"; refresh(false); });
    on("filter-clear", "click", clearFilters);
    on("page-back", "click", () => { state.page -= 1; render(); });
    on("page-next", "click", () => { state.page += 1; render(); });
    on("page-size", "change", (e) => { state.size = Number(e.target.value); state.page = 0; render(); });
    on("save-csv", "click", () => {
      const names = Object.keys(columns);
      const text = (v) => (v === null || v === undefined ? "" : /[",\n]/.test(String(v)) ? `"${String(v).replace(/"/g, '""')}"` : String(v));
      save("fits-selection.csv", "text/csv", [names.join(","), ...order.map((i) => names.map((name) => text(columns[name][i])).join(","))].join("\n") + "\n");
    });
  }
  const chosen = byId("corner-of");
  if (chosen) {
    chosen.append(...Object.keys(data.posteriors).map((i) => el("option", { value: i }, String(columns.event[i]))));
    const host = plotOf("corner");
    const draw = responsive(host, () => drawCorner(host, chosen.value));
    const tabulate = () => {
      const i = chosen.value;
      const p = data.posteriors[i];
      const names = ["", "median", "central 68 %", "fit ± σ", "R̂", "ESS"];
      byId("corner-numbers").replaceChildren(
        el("thead", {}, el("tr", {}, ...names.map((t, k) => el("th", { scope: "col", class: k ? "num" : null }, t)))),
        el("tbody", {}, ...p.names.map((name, k) => {
          const half = (p.high[k] - p.low[k]) / 2;
          const sigma = columns[`sigma_${name}`][i];
          const cells = [fmtWith(p.median[k], half), `${fmtWith(p.low[k], half)} to ${fmtWith(p.high[k], half)}`, `${fmtWith(columns[name][i], sigma)} ± ${fmt(sigma, 2)}`, fmt(p.r_hat[k], 4), fmt(p.ess[k], 3)];
          return el("tr", {}, el("th", { scope: "row" }, `${labels[name]} [${units[name]}]`), ...cells.map((t) => el("td", { class: "num" }, t)));
        })));
    };
    tabulate();
    chosen.addEventListener("change", () => { draw(); tabulate(); });
  }

  arrange();
  if (table) render();
  for (const name of ["mass_kda", "z_nm"]) show(`histogram-${name}`, histogram(name));
  show("timeline", timeline);
  for (const name of free) show(`panel-${name}`, panel(name));
  show("field", map);
})();
