// What every page does: the theme, tables that sort, parts that unfold, and figures that are drawn when they are seen.
"use strict";
const iscat = (() => {
  const root = document.documentElement;
  const held = JSON.parse(document.getElementById("data")?.textContent ?? "null");
  const views = new Map(), listeners = [], sets = new Map();
  const made = (tag, properties, ...children) => {
    const node = Object.assign(document.createElement(tag), properties);
    node.append(...children);
    return node;
  };

  // ---- data: columns become rows once, and figures that share a data set share its rows
  const rowsOf = (columns) => {
    const names = Object.keys(columns);
    return names.length ? columns[names[0]].map((_, k) => Object.fromEntries(names.map((name) => [name, columns[name][k]]))) : [];
  };
  const rows = (name) => {
    if (!sets.has(name)) sets.set(name, rowsOf(held.datasets[name] ?? {}));
    return sets.get(name);
  };

  // ---- figures
  const isDark = () => (root.dataset.theme ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
  const themed = () => {
    const ink = getComputedStyle(root).getPropertyValue("--ink"), soft = getComputedStyle(root).getPropertyValue("--muted"), grid = getComputedStyle(root).getPropertyValue("--grid");
    const axis = { labelColor: soft, titleColor: soft, gridColor: grid, domainColor: grid, tickColor: grid };
    return isDark() ? { axis, legend: { labelColor: soft, titleColor: soft }, header: { labelColor: ink }, title: { color: ink }, text: { color: soft }, rule: { color: soft } } : {};
  };
  const brighter = { "#0072b2": "#56b4e9", "#d55e00": "#ff8a3d", "#009e73": "#2fd6a3", "#cc79a7": "#f0a5cf", "#e69f00": "#ffd166", "#7d858f": "#a6aeb8" };
  const onDark = (spec) => JSON.parse(JSON.stringify(spec).replace(/#[0-9a-f]{6}/g, (colour) => brighter[colour] ?? colour));
  const show = async (node, given, data) => {
    const spec = isDark() ? onDark(given) : given;
    const many = Math.max(0, ...Object.values(data).map((part) => part.length));
    const { view } = await vegaEmbed(node, { ...spec, config: themed(), datasets: data }, { config: held.config, actions: false, ast: true, renderer: many > 1500 ? "canvas" : "svg", tooltip: { theme: isDark() ? "dark" : "light" } });
    return view;
  };
  const dataOf = (id) => Object.fromEntries(Object.entries(held.figures[id].usermeta.datasets).map(([local, key]) => [local, rows(key)]));
  const drawing = new Map();
  const draw = (node) => { drawing.set(node, drawNow(node)); return drawing.get(node); };
  const drawNow = async (node) => {
    const id = node.dataset.figure;
    const view = await show(node, held.figures[id], dataOf(id));
    views.set(id, view);
    performance.mark(id);
    for (const listener of listeners) listener(id, view, node);
    const figure = node.closest("figure");
    if (figure && !figure.querySelector(".figure-tools")) figure.querySelector("figcaption").append(tools(id, node));
  };
  const save = async (id, kind) => {
    const view = views.get(id);
    const href = kind === "svg" ? URL.createObjectURL(new Blob([await view.toSVG()], { type: "image/svg+xml" })) : await view.toImageURL("png", 2);
    made("a", { href, download: `${held.movie ? `${held.movie.replace(/\.[^.]*$/, "")}-` : ""}${id}.${kind}` }).click();
  };
  const tools = (id, node) => {  // the numbers behind a figure, for readers of screens and of spreadsheets
    const box = made("div", { className: "figure-tools" });
    for (const kind of ["svg", "png"]) box.append(made("button", { type: "button", textContent: kind.toUpperCase(), title: `Save this figure as ${kind.toUpperCase()}`, onclick: () => save(id, kind) }));
    const button = made("button", { type: "button", textContent: "Numbers" });
    button.setAttribute("aria-expanded", "false");
    button.onclick = () => {
      const open = button.getAttribute("aria-expanded") === "true";
      button.setAttribute("aria-expanded", String(!open));
      if (open) { node.nextElementSibling.remove(); return; }
      const list = made("div", { className: "numbers" });
      for (const [name, part] of Object.entries(dataOf(id))) {
        const heads = Object.keys(part[0] ?? {}).filter((head) => !["marked", "row", "url", "few"].includes(head));
        if (!heads.length) continue;
        const table = made("table", { className: "data" }, made("caption", { textContent: part.length > 200 ? `${name}: the first 200 of ${part.length} rows` : name }));
        const top = table.createTHead().insertRow(), body = table.createTBody();
        for (const head of heads) top.append(made("th", { scope: "col", textContent: head }));
        for (const row of part.slice(0, 200)) { const line = body.insertRow(); for (const head of heads) line.insertCell().textContent = row[head] ?? "—"; }
        list.append(table);
      }
      node.after(list);
    };
    box.append(button);
    return box;
  };
  const all = [...document.querySelectorAll("[data-figure]")];
  const seen = new IntersectionObserver((entries) => { for (const entry of entries) if (entry.isIntersecting && !drawing.has(entry.target)) draw(entry.target); }, { rootMargin: "300px" });
  const start = () => all.forEach((node) => seen.observe(node));
  const redraw = () => all.filter((node) => drawing.has(node)).forEach(draw);
  const drawAll = () => Promise.all(all.filter((node) => node.offsetParent).map((node) => drawing.get(node) ?? draw(node)));
  addEventListener("beforeprint", drawAll);
  document.querySelectorAll("[data-save]").forEach((button) => button.addEventListener("click", () => save(button.dataset.of, button.dataset.save)));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);

  // ---- theme
  document.querySelector("[data-theme-toggle]").addEventListener("click", () => {
    root.dataset.theme = isDark() ? "light" : "dark";
    try { localStorage.setItem("iscat-theme", root.dataset.theme); } catch { /* it lasts for this visit only */ }
    redraw();
  });

  // ---- parts that unfold: a link to something inside opens them
  const unfold = () => {
    const target = location.hash.length > 1 && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    for (let part = target; part; part = part.parentElement) if (part.tagName === "DETAILS") part.open = true;
    if (target) target.scrollIntoView();
  };
  addEventListener("hashchange", unfold);
  document.addEventListener("click", (event) => { const link = event.target.closest?.("a[href^='#']"); if (link && link.hash === location.hash) unfold(); });
  unfold();

  // ---- tables
  const number = (text) => parseFloat(text.replace(/^[^\d−.]+/, "").replace("−", "-"));
  const compare = (texts, down) => {
    const numeric = texts.every((text) => text === "—" || Number.isFinite(number(text)));
    return (a, b) => {
      if (a === "—" || b === "—") return (a === "—") - (b === "—");
      return down * (numeric ? number(a) - number(b) : a < b ? -1 : Number(a > b));
    };
  };
  document.querySelectorAll("table.sortable").forEach((table) => {
    [...table.tHead.rows[0].cells].forEach((head, column) => {
      const button = made("button", { type: "button" }, ...head.childNodes);
      head.replaceChildren(button);
      head.setAttribute("aria-sort", "none");
      button.addEventListener("click", () => {
        const down = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
        table.querySelectorAll("th").forEach((th) => th.setAttribute("aria-sort", "none"));
        head.setAttribute("aria-sort", down < 0 ? "descending" : "ascending");
        const lines = [...table.tBodies[0].rows].map((row) => [row, row.cells[column].textContent.trim()]);
        const order = compare(lines.map(([, text]) => text), down);
        table.tBodies[0].append(...lines.sort(([, a], [, b]) => order(a, b)).map(([row]) => row));
      });
    });
  });
  document.querySelectorAll(".tall").forEach((box) => {
    const input = made("input", { type: "search" });
    box.before(made("label", { className: "narrow", textContent: "Rows that contain" }, input));
    input.addEventListener("input", () => {
      [...box.querySelectorAll("tbody tr")].forEach((row) => { row.hidden = !row.textContent.includes(input.value.trim()); });
    });
  });

  const onDraw = (listener) => listeners.push(listener);
  setTimeout(start);  // after the scripts below, which listen
  return { held, rows, rowsOf, views, made, compare, show, onDraw, drawAll };
})();
