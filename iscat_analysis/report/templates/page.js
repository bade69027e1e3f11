// What every page does: the theme, tables that sort, events that open, and points that tell their event.
"use strict";
(() => {
  const root = document.documentElement;
  document.querySelector("[data-theme-toggle]").addEventListener("click", () => {
    const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    root.dataset.theme = dark ? "light" : "dark";
    try { localStorage.setItem("iscat-theme", root.dataset.theme); } catch { /* it lasts for this visit only */ }
  });

  const close = (row) => {
    if (row?.nextElementSibling?.className !== "detail") return false;
    row.nextElementSibling.remove();
    row.querySelector(".toggle").setAttribute("aria-expanded", "false");
    return true;
  };
  const number = (text) => parseFloat(text.replace(/^[^\d−.]+/, "").replace("−", "-"));
  document.querySelectorAll("table.sortable").forEach((table) => {
    [...table.tHead.rows[0].cells].forEach((head, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...head.childNodes);
      head.replaceChildren(button);
      head.setAttribute("aria-sort", "none");
      button.addEventListener("click", () => {
        const down = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
        table.querySelectorAll("th").forEach((th) => th.setAttribute("aria-sort", "none"));
        head.setAttribute("aria-sort", down < 0 ? "descending" : "ascending");
        [...table.tBodies[0].rows].forEach(close);
        table.classList.remove("late");
        const rows = [...table.tBodies[0].rows].map((row) => [row, row.cells[column].textContent.trim()]);
        const numeric = rows.every(([, text]) => text === "—" || Number.isFinite(number(text)));
        rows.sort(([, a], [, b]) => {
          if (a === "—" || b === "—") return (a === "—") - (b === "—");
          return down * (numeric ? number(a) - number(b) : a < b ? -1 : Number(a > b));
        });
        table.tBodies[0].append(...rows.map(([row]) => row));
      });
    });
  });

  document.querySelectorAll(".tall").forEach((box) => {
    const label = Object.assign(document.createElement("label"), { className: "narrow", textContent: "Rows that contain" });
    const input = Object.assign(document.createElement("input"), { type: "search" });
    label.append(input);
    box.before(label);
    input.addEventListener("input", () => {
      [...box.querySelectorAll("tbody tr")].forEach((row) => { row.hidden = !row.textContent.includes(input.value.trim()); });
    });
  });

  const table = document.getElementById("table");
  if (!table) return;
  const images = JSON.parse(document.getElementById("images").textContent);
  const picture = (row) => {
    const found = images[row.id.slice(4)];
    if (!found) return [];
    const image = Object.assign(new Image(), { src: `data:image/png;base64,${found[0]}`, alt: "Data, model and residual", className: "strip" });
    return [image, Object.assign(document.createElement("p"), { className: "note", textContent: `Data, model, residual: ${found[1]}` })];
  };
  const made = (tag, properties, ...children) => {
    const node = Object.assign(document.createElement(tag), properties);
    node.append(...children);
    return node;
  };
  const story = (row) => {  // what happened in time
    const [, , trace, words, clip, sliding] = images[row.id.slice(4)] ?? [];
    const parts = [[trace, words], [clip, sliding]].filter(([drawn]) => drawn).map(([drawn, said]) =>
      made("figure", {}, made("div", { innerHTML: drawn }), made("figcaption", { className: "note", textContent: said })));
    return parts.length ? [made("div", { className: "story" }, ...parts)] : [];
  };
  const open = (row) => {
    const cell = document.createElement("td");
    cell.colSpan = row.cells.length;
    const advice = Object.assign(document.createElement("p"), { textContent: row.lastElementChild.title });
    const inside = Object.assign(document.createElement("div"), { className: "inside" });
    inside.append(...picture(row), ...story(row), advice);
    cell.append(inside);
    const detail = Object.assign(document.createElement("tr"), { className: "detail" });
    detail.append(cell);
    row.after(detail);
    row.querySelector(".toggle").setAttribute("aria-expanded", "true");
  };
  table.tBodies[0].addEventListener("click", (event) => {
    const row = event.target.closest("tr[id]");
    if (row && !close(row)) open(row);
  });

  const count = document.getElementById("count");
  const filter = document.getElementById("filter");
  const narrow = () => {
    const rows = [...table.tBodies[0].rows];
    rows.forEach(close);
    if (filter.value) table.classList.remove("late");
    const kept = rows.filter((row) => row.id).filter((row) => {
      row.hidden = !row.textContent.includes(filter.value.trim());
      return !row.hidden;
    });
    const all = rows.filter((row) => row.id).length;
    count.textContent = (kept.length < all ? `${kept.length} of ` : "") + `${all} row${all === 1 ? "" : "s"}`;
  };
  filter.addEventListener("input", narrow);
  narrow();

  // To lay out thousands of rows takes a second: they wait until they are looked for.
  const whole = () => table.classList.remove("late");
  const near = new IntersectionObserver((seen) => { if (seen.some((row) => row.isIntersecting)) whole(); }, { rootMargin: "1000px" });
  if (table.tBodies[0].rows[199]) near.observe(table.tBodies[0].rows[199]);
  window.addEventListener("beforeprint", whole);
  window.addEventListener("keydown", (event) => { if (event.key === "F3" || ((event.ctrlKey || event.metaKey) && event.key === "f")) whole(); });

  // A figure names the rows of its points in order: the n-th point of the group rows-4_7_9 is the n-th of these.
  const tip = document.getElementById("tip");
  const rowOf = (node) => {
    const group = node.closest?.("use")?.closest("[id*='rows-']");
    if (!group) return null;
    const rows = group.id.split("rows-")[1].split("_");
    return document.getElementById(`row-${rows[[...group.querySelectorAll("use")].indexOf(node.closest("use"))]}`);
  };
  const heads = [...table.tHead.rows[0].cells].map((head) => head.textContent);
  document.addEventListener("mouseover", (event) => {
    const row = rowOf(event.target);
    tip.hidden = !row;
    if (!row) return;
    const text = [...row.cells].map((cell, k) => `${heads[k]} ${cell.textContent}`).join("\n");
    tip.replaceChildren(...picture(row).slice(0, 1), text);
    const box = tip.getBoundingClientRect();
    tip.style.left = `${Math.max(8, Math.min(event.clientX + 14, innerWidth - box.width - 8))}px`;
    tip.style.top = `${Math.max(8, Math.min(event.clientY + 18, innerHeight - box.height - 8))}px`;
  });
  document.addEventListener("click", (event) => {
    const row = rowOf(event.target);
    if (!row) return;
    tip.hidden = true;
    filter.value = "";
    narrow();
    whole();
    open(row);
    row.scrollIntoView({ block: "center" });
  });
})();
