// Images with scale bar and colour bar, and corner plots, as SVG.
"use strict";
window.iscat.images = (() => {
  const { svg, css, fmt, textWidth, canvas, niceTicks, tickText, finite } = window.iscat;

  // Grey for signals, blue - white - vermillion for residuals; both read without colour vision.
  const GREY = (t) => { const v = Math.round(255 * t); return [v, v, v]; };
  const mix = (a, b, t) => a.map((v, i) => Math.round(v + (b[i] - v) * t));
  const DIVERGING = (t) => (t < 0.5 ? mix([0, 82, 140], [250, 250, 248], t * 2) : mix([250, 250, 248], [190, 70, 0], t * 2 - 1));
  const palette = (map) => Array.from({ length: 256 }, (_, i) => (i ? [...map((i - 1) / 254), 255] : [128, 128, 128, 0]));
  const PALETTES = { grey: palette(GREY), diverging: palette(DIVERGING) };

  const picture = (base64, w, h, name) => {
    const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
    const node = document.createElement("canvas");
    node.width = w; node.height = h;
    const context = node.getContext("2d");
    const image = context.createImageData(w, h);
    const colors = PALETTES[name];
    bytes.forEach((b, i) => image.data.set(colors[b], 4 * i));
    context.putImageData(image, 0, 0);
    return node.toDataURL();
  };
  const rampUrl = (name) => {
    const bytes = String.fromCharCode(...Array.from({ length: 255 }, (_, i) => i + 1));
    return picture(btoa(bytes), 255, 1, name);
  };

  const scaleBar = (parent, x, bottom, width, nmAcross) => {
    const bars = [50, 100, 200, 500, 1000, 2000, 5000, 10000, 20000, 50000, 100000];
    const nm = bars.filter((b) => b <= nmAcross * 0.4).pop() || bars[0];
    const length = (nm / nmAcross) * width;
    svg("rect", { x: x + 7, y: bottom - 12, width: length + 2, height: 5, style: "fill:#000;fill-opacity:.6" }, parent);
    svg("rect", { x: x + 8, y: bottom - 11, width: length, height: 3, style: "fill:#fff" }, parent);
    svg("text", { x: x + 8, y: bottom - 17, class: "halo" }, parent, `${nm / 1000} µm`);
  };
  const colorBar = (parent, x, y, width, name, lo, hi, unit) => {
    svg("image", { href: rampUrl(name), x, y, width, height: 8, preserveAspectRatio: "none" }, parent);
    svg("rect", { x, y, width, height: 8, style: `fill:none;stroke:${css("line")}` }, parent);
    const [a, b] = [fmt(lo, 2), fmt(hi, 2)];
    svg("text", { x, y: y + 22 }, parent, a);
    svg("text", { x: x + width, y: y + 22, "text-anchor": "end" }, parent, b);
    if (textWidth(a) + textWidth(b) + textWidth(unit) + 16 < width) svg("text", { x: x + width / 2, y: y + 22, "text-anchor": "middle" }, parent, unit);
    else svg("text", { x: x + width / 2, y: y + 37, "text-anchor": "middle" }, parent, unit);
  };

  // Panels side by side: { title, url | data, palette, lo, hi, unit }, all w by h pixels.
  const panels = (host, list, { w, h, nm, title }) => {
    const gap = 14;
    const width = Math.max(300, Math.min(host.clientWidth, 280 * list.length));
    const side = (width - gap * (list.length - 1)) / list.length;
    const tall = (side * h) / w;
    const root = canvas(host, width, tall + 66, title);
    root.style.maxWidth = `${width}px`;
    list.forEach((panel, i) => {
      const x = i * (side + gap);
      svg("text", { x, y: 12, class: "strong" }, root, panel.title);
      svg("image", { href: picture(panel.data, w, h, panel.palette), x, y: 20, width: side, height: tall, preserveAspectRatio: "none", style: "image-rendering:pixelated" }, root);
      if (i === 0) scaleBar(root, x, 20 + tall, side, w * nm);
      colorBar(root, x, 28 + tall, side, panel.palette, panel.lo, panel.hi, panel.unit);
    });
    return root;
  };

  // The field with rings; marks: [{ x, y, id, label, active }] in pixels, tracks: [[[x, y], …]].
  const field = (host, image, { nm, unit, marks, tracks, tip, onPick, title }) => {
    const width = Math.min(host.clientWidth, (560 * image.columns) / image.rows);
    const tall = (width * image.rows) / image.columns;
    const root = canvas(host, width, tall + 38, title);
    root.style.maxWidth = `${width}px`;
    const k = width / image.columns;
    // The last block of an averaged image may reach past the field; the picture is clipped to it.
    const frame = svg("svg", { x: 0, y: 0, width, height: tall, viewBox: `0 0 ${width} ${tall}` }, root);
    svg("image", { href: picture(image.data, image.w, image.h, "grey"), width: image.w * image.factor * k, height: image.h * image.factor * k, preserveAspectRatio: "none", style: "image-rendering:pixelated" }, frame);
    const at = (v) => (v + 0.5) * k;
    for (const track of tracks || []) svg("path", { d: track.map(([x, y], i) => `${i ? "L" : "M"}${at(x).toFixed(1)} ${at(y).toFixed(1)}`).join(""), style: "fill:none;stroke:#56b4e9;stroke-width:1.4;stroke-linejoin:round" }, frame);
    const r = marks.length > 1500 ? 2.5 : marks.length > 400 ? 4 : Math.max(6, Math.min(14, width / 36));
    const ring = (list) => list.map((m) => `M${(at(m.x) - r).toFixed(1)} ${at(m.y).toFixed(1)}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0`).join("");
    const shown = marks.filter((m) => m.active);
    svg("path", { d: ring(marks.filter((m) => !m.active)), style: "fill:none;stroke:#fff;stroke-opacity:.28;stroke-width:1" }, frame);
    if (!(tracks && tracks.length)) {
      if (shown.length <= 1500) svg("path", { d: ring(shown), style: "fill:none;stroke:#000;stroke-opacity:.45;stroke-width:3.4" }, frame);
      svg("path", { d: ring(shown), style: `fill:none;stroke:#f0e442;stroke-width:${shown.length > 1500 ? 0.8 : 1.5}` }, frame);
    }
    // Numbers where they fit: never over a neighbour's number or ring.
    const taken = shown.map((m) => [at(m.x) - r, at(m.y) - r, at(m.x) + r, at(m.y) + r]);
    taken.push([0, tall - 36, 110, tall]);
    const clear = (box) => taken.every((b) => box[2] < b[0] || box[0] > b[2] || box[3] < b[1] || box[1] > b[3]);
    for (const m of shown.slice(0, 400)) {
      if (!m.label) continue;
      const w = textWidth(m.label) + 4;
      const [x, y] = [at(m.x), at(m.y)];
      const spots = [[x + r + 3, y + 4], [x - r - 3 - w, y + 4], [x - w / 2, y - r - 4], [x - w / 2, y + r + 13]];
      for (const [tx, ty] of spots) {
        const box = [tx - 1, ty - 11, tx + w, ty + 2];
        if (box[0] < 0 || box[2] > width || box[1] < 0 || box[3] > tall || !clear(box)) continue;
        taken.push(box);
        svg("text", { x: tx, y: ty, class: "halo" }, frame, m.label);
        break;
      }
    }
    scaleBar(frame, 0, tall, width, image.columns * nm);
    colorBar(root, 0, tall + 8, width, "grey", image.lo, image.hi, unit);
    const hit = svg("rect", { width, height: tall, class: "hit pick", "data-screen": "" }, root);
    const nearest = (event) => {
      const box = root.getBoundingClientRect();
      const [x, y] = [((event.clientX - box.left) * width) / box.width, ((event.clientY - box.top) * width) / box.width];
      let best = null, least = Math.max(r + 6, 14) ** 2;
      for (const m of shown) { const d = (at(m.x) - x) ** 2 + (at(m.y) - y) ** 2; if (d < least) { least = d; best = m; } }
      return best;
    };
    hit.addEventListener("pointermove", (event) => { const m = nearest(event); if (m) window.iscat.showTip(tip(m.id), event.clientX, event.clientY); else window.iscat.hideTip(); });
    hit.addEventListener("pointerleave", window.iscat.hideTip);
    hit.addEventListener("click", (event) => { const m = nearest(event); if (m) { window.iscat.hideTip(); onPick(m.id); } });
  };

  const corner = (host, p, { labels, units, estimate, title }) => {
    const n = p.names.length;
    const gap = 8, left = 58, bottom = 42;
    const cell = Math.min(150, (Math.max(260, host.clientWidth) - left - 4) / n - gap);
    const size = left + n * (cell + gap);
    const high = 26 + n * (cell + gap) + bottom;
    const root = canvas(host, size, high, title);
    root.style.maxWidth = `${size}px`;
    const spot = (i) => ({ lo: p.ranges[i][0], hi: p.ranges[i][1] });
    for (let i = 0; i < n; i += 1) {
      for (let j = 0; j <= i; j += 1) {
        const g = svg("g", { transform: `translate(${left + j * (cell + gap)} ${26 + i * (cell + gap)})` }, root);
        svg("rect", { width: cell, height: cell, style: `fill:none;stroke:${css("line")}` }, g);
        const sx = spot(j), sy = spot(i);
        const X = (v) => ((v - sx.lo) / (sx.hi - sx.lo)) * cell;
        const Y = (v) => cell - ((v - sy.lo) / (sy.hi - sy.lo)) * cell;
        const rule = (d, look) => svg("path", { d, style: `fill:none;${look}` }, g);
        const bin = cell / p.bins;
        if (i === j) {
          const top = Math.max(...p.counts[i]) * 1.12 || 1;
          let d = `M0 ${cell}`;
          p.counts[i].forEach((c, b) => { const y = cell - (c / top) * cell; d += `L${(b * bin).toFixed(2)} ${y.toFixed(2)}L${((b + 1) * bin).toFixed(2)} ${y.toFixed(2)}`; });
          svg("path", { d: `${d}L${cell} ${cell}Z`, style: `fill:${css("qcrb")};fill-opacity:.28;stroke:${css("qcrb")};stroke-width:1.4` }, g);
          for (const v of [p.low[i], p.median[i], p.high[i]]) rule(`M${X(v)} 0V${cell}`, `stroke:${css("ink")};stroke-dasharray:3 3;stroke-width:1`);
        } else {
          const shades = p.pairs[`${i},${j}`];
          for (let level = 1; level <= 4; level += 1) {
            let d = "";
            for (let a = 0; a < p.bins; a += 1) for (let b = 0; b < p.bins; b += 1) if (Number(shades[a * p.bins + b]) === level) d += `M${(b * bin).toFixed(2)} ${(cell - (a + 1) * bin).toFixed(2)}h${bin.toFixed(2)}v${bin.toFixed(2)}h${(-bin).toFixed(2)}z`;
            svg("path", { d, style: `fill:${css("qcrb")};fill-opacity:${[0, 0.16, 0.36, 0.62, 0.92][level]}` }, g);
          }
          const y = estimate[p.names[i]];
          if (finite(y) && y > sy.lo && y < sy.hi) rule(`M0 ${Y(y)}H${cell}`, `stroke:${css("sigma")};stroke-width:1.2`);
        }
        const x = estimate[p.names[j]];
        if (finite(x) && x > sx.lo && x < sx.hi) rule(`M${X(x)} 0V${cell}`, `stroke:${css("sigma")};stroke-width:1.2`);
        const ticksOf = (s, count) => { const t = niceTicks(s.lo, s.hi, count); return t.ticks.map((v) => [v, tickText(v, t.step)]); };
        const fewest = cell > 110 ? 3 : 2;
        if (i === n - 1) {
          let shown = [];
          for (let count = fewest; shown.length < 2 && count < 9; count += 1) {
            let freeFrom = -Infinity;
            shown = ticksOf(sx, count).filter(([v, text]) => {
              const half = textWidth(text) / 2;
              if (X(v) - half < Math.max(freeFrom, -gap / 2 + 1) || X(v) + half > cell + gap / 2) return false;
              freeFrom = X(v) + half + 5;
              return true;
            });
          }
          for (const [v, text] of shown) {
            svg("path", { d: `M${X(v)} ${cell}v4`, style: `stroke:${css("muted")}` }, g);
            svg("text", { x: X(v), y: cell + 17, "text-anchor": "middle" }, g, text);
          }
          svg("text", { x: cell / 2, y: cell + 36, "text-anchor": "middle", class: "strong" }, g, `${labels[p.names[j]]} [${units[p.names[j]]}]`);
        }
        if (j === 0 && i > 0) {
          for (const [v, text] of ticksOf(sy, fewest)) {
            svg("path", { d: `M0 ${Y(v)}h-4`, style: `stroke:${css("muted")}` }, g);
            svg("text", { x: -7, y: Y(v) + 4, "text-anchor": "end" }, g, text);
          }
        }
        if (i === j) svg("text", { x: cell / 2, y: -8, "text-anchor": "middle", class: "strong" }, g, labels[p.names[i]]);
      }
    }
  };
  return { panels, field, corner };
})();
