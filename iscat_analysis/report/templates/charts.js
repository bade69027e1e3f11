// Charts as inline SVG from small declarative specs; shared by every page.
//
// spec = { x: axis, y: axis, height, series: [...] },  axis = { label, scale: "linear"|"log", domain, categories, zero, whole }
//   { kind: "points",   name, color, x, y, ids, mask, hollow, under }
//   { kind: "line",     name, color, x, y, dash }
//   { kind: "bars",     name, color, edges, counts, base }        base: counts underneath, to stack
//   { kind: "interval", name, color, at, mid, lo, hi, lo2, hi2, offset }  along the axis that is not categorical
//   { kind: "rule",     name, color, axis: "x"|"y", value }
//   { kind: "diagonal", name, color }                             y = x
// color is the name of a theme variable: sigma, crb, qcrb, ok, flag, plain, ink.
"use strict";
window.iscat = (() => {
  const NS = "http://www.w3.org/2000/svg";
  const el = (tag, attributes = {}, ...children) => {
    const node = document.createElement(tag);
    for (const [key, value] of Object.entries(attributes)) {
      if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
      else if (value === true) node.setAttribute(key, "");
      else if (value !== null && value !== undefined && value !== false) node.setAttribute(key, value);
    }
    node.append(...children.filter((child) => child !== null && child !== undefined));
    return node;
  };
  const svg = (tag, attributes = {}, parent = null, text = null) => {
    const node = document.createElementNS(NS, tag);
    for (const [key, value] of Object.entries(attributes)) {
      if (value !== null && value !== undefined) node.setAttribute(key, value);
    }
    if (text !== null) node.textContent = text;
    if (parent) parent.append(node);
    return node;
  };
  const finite = (v) => typeof v === "number" && Number.isFinite(v);
  const css = (name) => `var(--${name})`;

  // ---- numbers ---------------------------------------------------------------------------------
  const SUPERSCRIPT = { "-": "⁻", 0: "⁰", 1: "¹", 2: "²", 3: "³", 4: "⁴", 5: "⁵", 6: "⁶", 7: "⁷", 8: "⁸", 9: "⁹" };
  const sign = (text) => text.replace("-", "−");
  const power = (v, digits) => {
    const [mantissa, exponent] = v.toExponential(digits).split("e");
    const raised = String(Number(exponent)).split("").map((c) => SUPERSCRIPT[c]).join("");
    return Number(mantissa) === 1 ? `10${raised}` : `${sign(String(Number(mantissa)))}×10${raised}`;
  };
  const fmt = (v, digits = 3) => {
    if (!finite(v)) return "—";
    if (v === 0) return "0";
    const size = Math.abs(v);
    if (size < 1e-3 || size >= 1e6) return power(v, digits - 1);
    const decimals = Math.max(0, digits - 1 - Math.floor(Math.log10(size)));
    return sign(v.toFixed(Math.min(decimals, 8)));
  };
  // A value to the digits its uncertainty supports.
  const fmtWith = (v, sigma) => {
    if (!finite(v)) return "—";
    if (!finite(sigma) || sigma <= 0) return fmt(v, 4);
    return sign(v.toFixed(Math.min(6, Math.max(0, 1 - Math.floor(Math.log10(sigma))))));
  };
  // How many decimals show so many digits of a column's median: its numbers then line up.
  const decimalsOf = (values, digits) => {
    const sizes = values.filter((v) => finite(v) && v !== 0).map(Math.abs).sort((a, b) => a - b);
    const middle = sizes.length ? sizes[sizes.length >> 1] : 1;
    return Math.min(8, Math.max(0, digits - 1 - Math.floor(Math.log10(middle))));
  };
  const fmtFixed = (v, decimals) => {
    if (!finite(v)) return "—";
    return v !== 0 && Math.abs(v) < 0.5 * 10 ** -decimals ? fmt(v, 1) : sign(v.toFixed(decimals));
  };
  const fmtPercent = (v) => (finite(v) ? `${fmt(100 * v, v < 0.0995 ? 2 : 3)} %` : "—");

  // ---- scales ----------------------------------------------------------------------------------
  const niceTicks = (lo, hi, count) => {
    const raw = (hi - lo) / Math.max(1, count);
    const unit = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].find((m) => m * unit >= raw * 0.999) * unit;
    const ticks = [];
    for (let i = Math.ceil(lo / step - 1e-9); i * step <= hi + step * 1e-9; i += 1) ticks.push(i * step);
    if (ticks.length < 2 && hi > lo && count < 20) return niceTicks(lo, hi, count + 1); // one tick tells no scale
    return { ticks, step };
  };
  const logTicks = (lo, hi, count) => {
    const decades = Math.log10(hi / lo);
    if (decades < 0.9) return niceTicks(lo, hi, count);
    const wanted = decades < 2 ? [1, 2, 5] : [1];
    const stride = Math.max(1, Math.ceil(decades / Math.max(2, count)));
    const ticks = [];
    for (let e = Math.floor(Math.log10(lo)); e <= Math.ceil(Math.log10(hi)); e += 1) {
      if (wanted.length === 1 && e % stride) continue;
      for (const m of wanted) if (m * 10 ** e >= lo * 0.999 && m * 10 ** e <= hi * 1.001) ticks.push(m * 10 ** e);
    }
    return { ticks, step: null };
  };
  const tickText = (v, step) => {
    if (v === 0) return "0";
    const size = Math.abs(v);
    if (size < 1e-3 || size >= 1e6) return power(v, 1);
    if (!step) return fmt(v, 1);
    return sign(v.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9))));
  };
  const makeScale = (axis, values, start, stop, labelSize) => {
    const log = axis.scale === "log";
    if (axis.categories) {
      const n = axis.categories.length;
      const at = (v) => start + ((v + 0.5) / n) * (stop - start);
      return { at, lo: -0.5, hi: n - 0.5, invert: null, ticks: axis.categories.map((text, i) => ({ v: i, text })) };
    }
    let usable = values.filter((v) => finite(v) && (!log || v > 0));
    if (!usable.length) usable = log ? [0.1, 1] : [0, 1];
    let lo = Infinity, hi = -Infinity;
    for (const v of usable) { if (v < lo) lo = v; if (v > hi) hi = v; }
    if (axis.domain) {
      [lo, hi] = axis.domain;
    } else if (log) {
      const pad = Math.max(1.06, (hi / lo) ** 0.06);
      lo /= pad; hi *= pad;
    } else {
      const pad = hi > lo ? (hi - lo) * 0.05 : Math.abs(hi) * 0.1 || 1;
      if (!(axis.zero && lo >= 0)) lo -= pad; else lo = 0;
      hi += pad;
    }
    const f = log ? Math.log : (v) => v;
    const [a, b] = [f(lo), f(hi)];
    const at = (v) => start + ((f(v) - a) / (b - a)) * (stop - start);
    const back = (p) => { const t = a + ((p - start) / (stop - start)) * (b - a); return log ? Math.exp(t) : t; };
    const count = Math.max(2, Math.floor(Math.abs(stop - start) / labelSize));
    const { ticks, step } = (log ? logTicks : niceTicks)(lo, hi, count);
    const shown = axis.whole ? ticks.filter((v) => Number.isInteger(v)) : ticks;
    return { at, lo, hi, invert: back, ticks: shown.map((v) => ({ v, text: tickText(v, axis.whole ? 1 : step) })) };
  };

  // ---- text ------------------------------------------------------------------------------------
  const ruler = document.createElement("canvas").getContext("2d");
  const textWidth = (text, size = 12) => {
    ruler.font = `${size}px system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", Arial, sans-serif`;
    return ruler.measureText(text).width;
  };

  // ---- tooltip ---------------------------------------------------------------------------------
  const tip = document.getElementById("tip");
  const showTip = (text, x, y) => {
    tip.textContent = text;
    tip.hidden = false;
    const box = tip.getBoundingClientRect();
    tip.style.left = `${Math.max(8, Math.min(x + 14, innerWidth - box.width - 8))}px`;
    tip.style.top = `${y + 18 + box.height > innerHeight ? y - box.height - 12 : y + 18}px`;
  };
  const hideTip = () => { tip.hidden = true; };

  // ---- download --------------------------------------------------------------------------------
  const save = (name, type, text) => {
    const url = URL.createObjectURL(new Blob([text], { type }));
    el("a", { href: url, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(url), 1000);
  };
  const KEPT = ["fill", "fill-opacity", "stroke", "stroke-width", "stroke-opacity", "stroke-dasharray", "stroke-linecap", "stroke-linejoin", "opacity", "font-size", "font-family", "font-weight", "text-anchor", "paint-order", "image-rendering"];
  // A stand-alone copy in the light theme, whatever the page shows.
  const standalone = (source) => {
    const root = document.documentElement;
    const theme = root.dataset.theme;
    root.dataset.theme = "light";
    const copy = source.cloneNode(true);
    const originals = [source, ...source.querySelectorAll("*")];
    [copy, ...copy.querySelectorAll("*")].forEach((node, i) => {
      const style = getComputedStyle(originals[i]);
      node.removeAttribute("style");
      node.removeAttribute("class");
      for (const key of KEPT) node.setAttribute(key, style.getPropertyValue(key));
    });
    if (theme === undefined) delete root.dataset.theme; else root.dataset.theme = theme;
    copy.querySelectorAll("[data-screen]").forEach((node) => node.remove());
    const [, , w, h] = source.getAttribute("viewBox").split(" ");
    for (const [key, value] of [["xmlns", NS], ["width", w], ["height", h]]) copy.setAttribute(key, value);
    copy.prepend(svg("rect", { width: w, height: h, fill: "#ffffff" }));
    return new XMLSerializer().serializeToString(copy);
  };
  const slug = (text) => text.toLowerCase().replace(/[^a-z0-9]+/g, "-").replace(/^-|-$/g, "") || "figure";
  const offerDownload = (figure) => {
    const caption = figure.querySelector("figcaption");
    if (!caption || caption.querySelector("button")) return;
    const title = figure.dataset.title;
    caption.append(el("button", {
      type: "button", class: "quiet", "aria-label": `Download ${title} as SVG`,
      onclick: () => { const s = figure.querySelector(".plot svg"); if (s) save(`${slug(figure.dataset.file || title)}.svg`, "image/svg+xml", standalone(s)); },
    }, "Save SVG"));
  };

  // ---- canvas of an SVG ------------------------------------------------------------------------
  const canvas = (host, width, height, title) => {
    const node = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": title });
    host.replaceChildren(node);
    return node;
  };
  // Draw now and again whenever the width changes.
  const responsive = (host, draw) => {
    let last = 0;
    const run = () => { const w = Math.round(host.clientWidth); if (w > 0) { last = w; draw(w); } };
    new ResizeObserver(() => { const w = Math.round(host.clientWidth); if (w > 0 && Math.abs(w - last) > 1) run(); }).observe(host);
    run();
    return run;
  };

  // ---- the chart -------------------------------------------------------------------------------
  const gather = (series, key) => {
    const out = [];
    for (const s of series) {
      if (s.kind === "points" || s.kind === "line") for (const v of s[key]) if (finite(v)) out.push(v);
      if (s.kind === "bars" && key === "x") out.push(s.edges[0], s.edges[s.edges.length - 1]);
      if (s.kind === "bars" && key === "y") out.push(0, ...s.counts.map((c, i) => c + (s.base ? s.base[i] : 0)));
      if (s.kind === "interval" && (s.along || "x") === key) {
        for (const name of ["mid", "lo", "hi", "lo2", "hi2"]) if (s[name]) out.push(...s[name].filter(finite));
      }
      if (s.kind === "rule" && s.axis === key) out.push(s.value);
    }
    return out;
  };
  const dots = (xs, ys) => xs.map((x, i) => `M${x.toFixed(1)} ${ys[i].toFixed(1)}h0`).join("");

  const chart = (host, spec, options = {}) => {
    const width = Math.max(220, Math.round(host.clientWidth));
    const height = spec.height || 280;
    const series = spec.series;
    const root = canvas(host, width, height, options.title || spec.y.label || "Chart");

    // Legend, wrapped into lines above the plot.
    let lx = 0, ly = 12;
    for (const s of series.filter((item) => item.name && spec.legend !== false)) {
      const w = 22 + textWidth(s.name) + 18;
      if (lx > 0 && lx + w - 18 > width) { lx = 0; ly += 19; }
      const g = svg("g", { transform: `translate(${lx} ${ly})` }, root);
      const color = css(s.color);
      if (s.kind === "bars") svg("rect", { x: 1, y: -10, width: 13, height: 11, style: `fill:${color};fill-opacity:${s.opacity || 0.85}` }, g);
      else if (s.kind === "points" && s.hollow) svg("circle", { cx: 8, cy: -4, r: 3.6, style: `fill:none;stroke:${color};stroke-width:1.6` }, g);
      else if (s.kind === "points") svg("circle", { cx: 8, cy: -4, r: 4, style: `fill:${color}` }, g);
      else svg("path", { d: "M0-4h16", style: `stroke:${color};stroke-width:2;fill:none;${s.dash || s.kind === "rule" ? "stroke-dasharray:4 3" : ""}` }, g);
      if (s.kind === "interval") svg("circle", { cx: 8, cy: -4, r: 4, style: `fill:${color}` }, g);
      svg("text", { x: 22 }, g, s.name);
      lx += w;
    }
    const legend = lx > 0 ? ly + 10 : 0;
    const titled = spec.y.label && !spec.y.categories ? 20 : 0;
    const top = legend + titled + 6;
    const bottom = height - 44;

    const yScale = makeScale(spec.y, gather(series, "y"), spec.y.categories ? top : bottom, spec.y.categories ? bottom : top, 44);
    const left = Math.max(...yScale.ticks.map((t) => textWidth(t.text)), 12) + 12;
    const right = width - 14;
    const widest = spec.x.categories ? 60 : 58;
    const xScale = makeScale(spec.x, gather(series, "x"), left, right, widest);
    const plot = { left, right, top, bottom };

    for (const t of yScale.ticks) {
      const y = yScale.at(t.v);
      if (y < top - 1 || y > bottom + 1) continue;
      svg("path", { d: `M${left} ${y.toFixed(1)}H${right}`, style: `stroke:${css("grid")};fill:none` }, root);
      svg("text", { x: left - 8, y: y + 4, "text-anchor": "end", class: spec.y.categories ? "strong" : null }, root, t.text);
    }
    let free = -Infinity;
    for (const t of xScale.ticks) {
      const x = xScale.at(t.v);
      const half = textWidth(t.text) / 2;
      svg("path", { d: `M${x.toFixed(1)} ${bottom}v5`, style: `stroke:${css("muted")};fill:none` }, root);
      if (x - half < free) continue;
      free = x + half + 6;
      svg("text", { x: Math.min(x, width - half), y: bottom + 18, "text-anchor": "middle", class: spec.x.categories ? "strong" : null }, root, t.text);
    }
    svg("path", { d: `M${left} ${bottom}H${right}`, style: `stroke:${css("muted")};fill:none` }, root);
    if (spec.x.label) svg("text", { x: (left + right) / 2, y: height - 6, "text-anchor": "middle" }, root, spec.x.label);
    if (titled) svg("text", { x: 0, y: legend + 13 }, root, spec.y.label);

    const targets = []; // [px, py, text, id]
    const many = series.some((s) => s.kind === "points" && s.x.length > 800);
    const layers = many ? [...series.filter((s) => s.under), ...series.filter((s) => !s.under)] : series;
    for (const s of layers) {
      const color = css(s.color);
      if (s.kind === "points") {
        const groups = [[[], []], [[], []]];
        s.x.forEach((vx, i) => {
          const vy = s.y[i];
          if (!finite(vx) || !finite(vy)) return;
          const [px, py] = [xScale.at(vx), yScale.at(vy)];
          if (!finite(px) || !finite(py) || px < left - 1 || px > right + 1 || py < top - 1 || py > bottom + 1) return;
          const active = !s.mask || s.mask[i];
          groups[active ? 0 : 1][0].push(px);
          groups[active ? 0 : 1][1].push(py);
          const id = s.ids ? s.ids[i] : null;
          if (active) targets.push([px, py, options.tip ? () => options.tip(s, i) : () => `${s.name || ""}\n${spec.x.label}: ${fmt(vx)}\n${spec.y.label}: ${fmt(vy)}`, id]);
        });
        const size = s.size || (many ? 4 : 6);
        groups.forEach(([xs, ys], dim) => {
          if (!xs.length) return;
          const look = `fill:none;stroke:${color};stroke-width:${size};stroke-linecap:round;stroke-opacity:${dim ? 0.12 : many ? 0.55 : 0.8}`;
          const path = svg("path", { d: dots(xs, ys), style: look }, root);
          if (s.hollow && !many) { path.style.strokeOpacity = dim ? 0.12 : 1; svg("path", { d: dots(xs, ys), style: `fill:none;stroke:${css("bg")};stroke-width:${size - 3};stroke-linecap:round` }, root); }
        });
      } else if (s.kind === "line") {
        let pen = false, d = "";
        s.x.forEach((vx, i) => {
          if (!finite(vx) || !finite(s.y[i])) { pen = false; return; }
          const [px, py] = [xScale.at(vx), yScale.at(s.y[i])];
          d += pen ? `L${px.toFixed(1)} ${py.toFixed(1)}` : `M${px.toFixed(1)} ${py.toFixed(1)}h0`;
          pen = true;
          targets.push([px, py, () => `${s.name || ""}\n${spec.x.label}: ${fmt(vx, 4)}\n${spec.y.label}: ${fmt(s.y[i], 4)}`.trim(), null]);
        });
        svg("path", { d, style: `fill:none;stroke:${color};stroke-width:${s.thin ? 1 : 1.8};stroke-linejoin:round;stroke-linecap:${s.dash ? "butt" : "round"};${s.dash ? "stroke-dasharray:5 4" : ""}` }, root);
      } else if (s.kind === "bars") {
        s.counts.forEach((count, i) => {
          if (!count) return;
          const base = s.base ? s.base[i] : 0;
          const [x0, x1] = [xScale.at(s.edges[i]), xScale.at(s.edges[i + 1])];
          const [y0, y1] = [yScale.at(base), yScale.at(base + count)];
          svg("rect", { x: (x0 + 0.5).toFixed(2), y: y1.toFixed(2), width: Math.max(0.8, x1 - x0 - 1).toFixed(2), height: Math.max(0.8, y0 - y1).toFixed(2), style: `fill:${color};fill-opacity:${s.opacity || 0.85}` }, root);
          targets.push([(x0 + x1) / 2, (y0 + y1) / 2, () => `${fmt(s.edges[i], 4)} to ${fmt(s.edges[i + 1], 4)}\n${s.name ? `${s.name}: ` : ""}${count}`, null, (x1 - x0) / 2 + 1]);
        });
      } else if (s.kind === "interval") {
        const across = (s.along || "x") === "y";
        s.at.forEach((position, i) => {
          const fixed = (across ? xScale : yScale).at(position) + (s.offset || 0);
          const along = across ? yScale : xScale;
          const stroke = (a, b, w, opacity = 1) => {
            if (!finite(a) || !finite(b)) return;
            const [p, q] = [along.at(a), along.at(b)];
            svg("path", { d: across ? `M${fixed} ${p}V${q}` : `M${p} ${fixed}H${q}`, style: `stroke:${color};stroke-width:${w};stroke-opacity:${opacity};stroke-linecap:round;fill:none` }, root);
          };
          if (s.lo2) stroke(s.lo2[i], s.hi2[i], 1.5);
          if (s.lo) stroke(s.lo[i], s.hi[i], s.lo2 ? 8 : 2, s.lo2 ? 0.4 : 1);
          if (!finite(s.mid[i])) return;
          const p = along.at(s.mid[i]);
          const [cx, cy] = across ? [fixed, p] : [p, fixed];
          svg("circle", { cx, cy, r: 4.5, style: `fill:${color}` }, root);
          targets.push([cx, cy, () => (s.tips ? s.tips[i] : `${s.name || ""}: ${fmt(s.mid[i])}`), null]);
        });
      } else if (s.kind === "rule" && finite(s.value)) {
        const p = (s.axis === "x" ? xScale : yScale).at(s.value);
        svg("path", { d: s.axis === "x" ? `M${p} ${top}V${bottom}` : `M${left} ${p}H${right}`, style: `stroke:${color};stroke-width:1.5;stroke-dasharray:5 4;fill:none` }, root);
      } else if (s.kind === "diagonal") {
        const lo = Math.max(xScale.lo, yScale.lo), hi = Math.min(xScale.hi, yScale.hi);
        if (lo < hi) svg("path", { d: `M${xScale.at(lo)} ${yScale.at(lo)}L${xScale.at(hi)} ${yScale.at(hi)}`, style: `stroke:${color};stroke-width:1.5;fill:none` }, root);
      }
    }
    interact(root, plot, targets, xScale, options);
    return { root, xScale, yScale, plot };
  };

  // ---- hover, pick and brush -------------------------------------------------------------------
  const interact = (root, plot, targets, xScale, options) => {
    const local = (event) => {
      const box = root.getBoundingClientRect();
      const k = root.viewBox.baseVal.width / box.width;
      return [(event.clientX - box.left) * k, (event.clientY - box.top) * k];
    };
    const nearest = (event) => {
      const [x, y] = local(event);
      let best = null, least = 26 ** 2;
      for (const t of targets) {
        const dx = Math.max(0, Math.abs(t[0] - x) - (t[4] || 0));
        const d = t[4] ? dx * dx * 400 + Math.abs(t[1] - y) * 0.5 : dx * dx + (t[1] - y) ** 2;
        if (d < least) { least = d; best = t; }
      }
      return best;
    };
    const ring = svg("circle", { r: 7, "data-screen": "", style: `fill:none;stroke:${css("ink")};stroke-width:1.8;display:none` }, root);
    const picks = options.onPick ? " pick" : options.onBrush ? " brush" : "";
    const hit = svg("rect", { x: plot.left, y: plot.top - 4, width: Math.max(0, plot.right - plot.left), height: Math.max(0, plot.bottom - plot.top + 4), class: `hit${picks}`, "data-screen": "" }, root);
    let start = null;
    const band = options.onBrush ? svg("rect", { y: plot.top, height: Math.max(0, plot.bottom - plot.top), "data-screen": "", style: `fill:${css("focus")};fill-opacity:.16;pointer-events:none` }, root) : null;
    const paint = (range) => {
      if (!range) { band.setAttribute("width", 0); return; }
      const clamp = (v) => Math.min(plot.right, Math.max(plot.left, xScale.at(v)));
      const [a, b] = [finite(range[0]) ? clamp(range[0]) : plot.left, finite(range[1]) ? clamp(range[1]) : plot.right];
      band.setAttribute("x", Math.min(a, b));
      band.setAttribute("width", Math.abs(b - a));
    };
    if (band) paint(options.brushed);
    hit.addEventListener("pointermove", (event) => {
      if (start !== null) {
        paint([xScale.invert(start), xScale.invert(local(event)[0])]);
        return;
      }
      const t = nearest(event);
      if (!t) { hideTip(); ring.style.display = "none"; return; }
      showTip(t[2](), event.clientX, event.clientY);
      if (!t[4]) { ring.setAttribute("cx", t[0]); ring.setAttribute("cy", t[1]); ring.style.display = ""; }
    });
    hit.addEventListener("pointerleave", () => { hideTip(); ring.style.display = "none"; });
    if (options.onPick) hit.addEventListener("click", (event) => { const t = nearest(event); if (t && t[3] !== null) { hideTip(); options.onPick(t[3]); } });
    if (options.onBrush) {
      hit.addEventListener("pointerdown", (event) => { start = local(event)[0]; hit.setPointerCapture(event.pointerId); hideTip(); });
      hit.addEventListener("pointerup", (event) => {
        const stop = Math.min(plot.right, Math.max(plot.left, local(event)[0]));
        const from = start;
        start = null;
        if (from === null) return;
        options.onBrush(Math.abs(stop - from) < 4 ? null : [xScale.invert(Math.min(from, stop)), xScale.invert(Math.max(from, stop))]);
      });
      hit.addEventListener("pointercancel", () => { start = null; paint(options.brushed); });
    }
  };

  // ---- what every page does --------------------------------------------------------------------
  const isDark = () => { const t = document.documentElement.dataset.theme; return t ? t === "dark" : matchMedia("(prefers-color-scheme: dark)").matches; };
  document.querySelector("[data-theme-toggle]").addEventListener("click", () => {
    const next = isDark() ? "light" : "dark";
    document.documentElement.dataset.theme = next;
    try { localStorage.setItem("iscat-theme", next); } catch { /* then it lasts for this visit only */ }
  });

  const sortable = (table) => {
    table.querySelectorAll("thead th").forEach((head, column) => {
      const button = el("button", { type: "button" }, head.textContent);
      head.replaceChildren(button);
      head.setAttribute("aria-sort", "none");
      button.addEventListener("click", () => {
        const down = head.getAttribute("aria-sort") === "ascending";
        table.querySelectorAll("th").forEach((th) => th.setAttribute("aria-sort", "none"));
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        const key = (row) => { const cell = row.cells[column]; const text = cell.dataset.sort ?? cell.textContent.trim().replaceAll("−", "-"); return text === "—" ? "" : text; };
        const rows = [...table.tBodies[0].rows];
        const numeric = rows.every((row) => key(row) === "" || Number.isFinite(Number(key(row))));
        const value = (row) => { const k = key(row); return numeric ? (k === "" ? Infinity : Number(k)) : k; };
        rows.sort((a, b) => { const [p, q] = [value(a), value(b)]; if (p === Infinity || q === Infinity) return (p === Infinity) - (q === Infinity); const c = p < q ? -1 : p > q ? 1 : 0; return down ? -c : c; });
        table.tBodies[0].append(...rows);
      });
    });
  };
  document.querySelectorAll("table.sortable").forEach(sortable);
  document.querySelectorAll("figure.chart").forEach((figure) => {
    offerDownload(figure);
    const source = figure.querySelector("script");
    if (!source) return;
    const spec = JSON.parse(source.textContent);
    responsive(figure.querySelector(".plot"), () => chart(figure.querySelector(".plot"), spec, { title: figure.dataset.title }));
  });
  return { el, svg, css, finite, fmt, fmtWith, fmtPercent, fmtFixed, decimalsOf, textWidth, niceTicks, tickText, chart, canvas, responsive, showTip, hideTip, save, offerDownload };
})();
