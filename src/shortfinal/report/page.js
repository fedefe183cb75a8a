"use strict";
// The parts of the report that move: theme, Stanford diagram, rows. Text enters the page as text nodes only.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const rows = data.rows.map((values) => Object.fromEntries(data.fields.map((name, i) => [name, values[i]])));
  const byNumber = new Map(rows.map((row) => [row.row, row]));
  const find = (id) => document.getElementById(id);
  const NONE = "–";
  const CORNERS = ["near left", "near right", "far right", "far left"];
  const AXES = ["along", "cross", "vertical"];

  // Elements
  const fill = (element, attributes, children) => {
    for (const [name, value] of Object.entries(attributes)) {
      if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
      else if (value !== null && value !== false) element.setAttribute(name, value === true ? "" : value);
    }
    element.append(...children);
    return element;
  };
  const make = (tag, attributes = {}, ...children) => fill(document.createElement(tag), attributes, children);
  const draw = (tag, attributes = {}, ...children) =>
    fill(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);

  // Numbers. null: not known; "inf": a protection level that cannot be given
  const known = (value) => typeof value === "number";
  const show = (value, digits = 3) => {
    if (value === "inf") return "none";
    if (!known(value)) return NONE;
    const size = Math.abs(value);
    if (size !== 0 && (size < 1e-4 || size >= 1e7)) return value.toExponential(2).replace("-", "−");
    const decimals = size === 0 ? 0 : Math.max(0, digits - 1 - Math.floor(Math.log10(size)));
    return value.toFixed(Math.min(decimals, 8)).replace("-", "−");
  };
  const word = (text) => (text === "" || text === null ? NONE : text);
  const at = (vector, i) => (vector ? vector[i] : null);
  const largest = (values) => values.reduce((most, v) => (known(v) && (most === null || v > most) ? v : most), null);

  for (const row of rows) {
    const { truth_px: truth, mean_px: mean, sigma_px: sigma } = row;
    const error = truth && mean ? mean.map((v, i) => (known(v) && known(truth[i]) ? v - truth[i] : null)) : null;
    row.error_px = error;
    row.worst_px = error
      ? largest([0, 2, 4, 6].map((i) => (known(error[i]) && known(error[i + 1]) ? Math.hypot(error[i], error[i + 1]) : null)))
      : null;
    row.worst_sigmas = error && sigma ? largest(error.map((v, i) => (known(v) && sigma[i] > 0 ? Math.abs(v) / sigma[i] : null))) : null;
    row.over_level = largest(AXES.map((_, i) => ratio(row, i)));
    row.words = [row.picture, row.source, row.ident, row.airport, row.light, row.decision, row.reason, `row ${row.row}`]
      .join("\n").toLowerCase();
  }
  function ratio(row, axis) {
    const error = at(row.error_m, axis), level = at(row.level_m, axis);
    if (!known(error)) return null;
    return level === "inf" ? 0 : known(level) && level > 0 ? Math.abs(error) / level : null;
  }

  // Theme
  const theme = find("theme");
  const isDark = () => (document.documentElement.dataset.theme ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
  const nameTheme = () => { theme.textContent = isDark() ? "Light" : "Dark"; theme.setAttribute("aria-label", `${theme.textContent} colours`); };
  theme.hidden = false;
  theme.addEventListener("click", () => { document.documentElement.dataset.theme = isDark() ? "light" : "dark"; nameTheme(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", nameTheme);
  nameTheme();

  // Paper knows no folding
  let folded = [];
  addEventListener("beforeprint", () => { folded = [...document.querySelectorAll("details:not([open])")]; folded.forEach((d) => { d.open = true; }); });
  addEventListener("afterprint", () => { folded.forEach((d) => { d.open = false; }); });

  // Rows: filter, sort, leaf through, look at one
  const PAGE = 50;
  const columns = [
    { name: "Row", key: (r) => r.row, text: (r) => String(r.row) },
    { name: "Picture", key: (r) => r.picture },
    { name: "Label", key: (r) => r.source, text: (r) => word(r.source) },
    { name: "Runway", key: (r) => r.ident, text: (r) => word(r.ident) },
    { name: "Distance, m", key: (r) => r.distance_m, text: (r) => (known(r.distance_m) ? r.distance_m.toFixed(0) : NONE) },
    { name: "Decision", key: (r) => r.decision },
    { name: "Worst corner, px", key: (r) => r.worst_px, text: (r) => show(r.worst_px) },
    { name: "Worst |e| / σ", key: (r) => r.worst_sigmas, text: (r) => show(r.worst_sigmas) },
    { name: "p", key: (r) => r.p_value, text: (r) => show(r.p_value, 2) },
    ...AXES.map((axis, i) => ({
      name: `${axis[0].toUpperCase()}${axis.slice(1)}, m`,
      key: (r) => (known(at(r.error_m, i)) ? Math.abs(r.error_m[i]) : null),
      text: (r) => show(at(r.error_m, i)),
    })),
    { name: "|e| / level", key: (r) => r.over_level, text: (r) => show(r.over_level, 2) },
  ];
  const view = { rows, page: 0, by: columns[6], descending: true, chosen: null, from: null };
  const table = find("table");
  if (table) {
    const fillSelect = (select, values) =>
      select.append(...[...new Set(values)].filter((v) => v).sort().map((v) => make("option", { value: v }, v)));
    fillSelect(find("by-airport"), rows.map((r) => r.airport));
    fillSelect(find("by-decision"), rows.map((r) => r.decision));
    for (const id of ["by-text", "by-airport", "by-decision"]) find(id).addEventListener("input", () => { view.page = 0; refresh(); });
    find("clear").addEventListener("click", () => { clearFilters(); refresh(); });
    find("previous").addEventListener("click", () => { view.page -= 1; showPage(); });
    find("next").addEventListener("click", () => { view.page += 1; showPage(); });
    refresh();
  }

  function clearFilters() {
    for (const id of ["by-text", "by-airport", "by-decision"]) find(id).value = "";
    view.page = 0;
  }

  function refresh() {
    const wanted = find("by-text").value.trim().toLowerCase();
    const airport = find("by-airport").value, decision = find("by-decision").value;
    const sign = view.descending ? -1 : 1, key = view.by.key;
    const empty = (v) => v === null || v === "";
    view.rows = rows
      .filter((r) => (!wanted || r.words.includes(wanted)) && (!airport || r.airport === airport) && (!decision || r.decision === decision))
      .sort((a, b) => {
        const left = key(a), right = key(b);
        if (empty(left) || empty(right)) return empty(left) - empty(right) || a.row - b.row; // unknown ones last, either way
        return sign * (typeof left === "string" ? left.localeCompare(right, "en", { numeric: true }) : left - right) || a.row - b.row;
      });
    showPage();
  }

  function showPage(focused = null) {
    const pages = Math.max(1, Math.ceil(view.rows.length / PAGE));
    view.page = Math.min(Math.max(view.page, 0), pages - 1);
    const head = make("tr", {}, ...columns.map((column) => {
      const sorted = column === view.by ? (view.descending ? "descending" : "ascending") : null;
      const mark = sorted ? (view.descending ? " ▼" : " ▲") : "";
      const sort = () => {
        view.descending = column === view.by ? !view.descending : true;
        view.by = column;
        view.page = 0;
        focused = column.name;
        refresh();
        [...table.querySelectorAll("th button")].find((b) => b.dataset.name === column.name).focus();
      };
      return make("th", { scope: "col", "aria-sort": sorted }, make("button", { type: "button", "data-name": column.name, onclick: sort }, column.name + mark));
    }));
    const body = view.rows.slice(view.page * PAGE, (view.page + 1) * PAGE).map((row) =>
      make("tr", { "data-row": row.row, class: row === view.chosen ? "chosen" : null, onclick: () => choose(row.row) },
        ...columns.map((column) => {
          const text = column.text ? column.text(row) : column.key(row);
          if (column.name === "Picture") return make("td", { class: "name" }, make("button", { type: "button" }, text));
          if (column.name === "Decision") return make("td", {}, make("span", { class: `swatch ${row.decision}` }), text);
          return make("td", { class: column.name === "Label" || column.name === "Runway" ? null : "num" }, text);
        })));
    table.replaceChildren(make("table", {}, make("caption", { class: "soft screen" }, ""), make("thead", {}, head), make("tbody", {}, ...body)));
    const of = rows.length < data.total ? ` of ${data.total.toLocaleString("en")} evaluated` : "";
    find("found").textContent = `${view.rows.length.toLocaleString("en")} of ${rows.length.toLocaleString("en")} rows held here${of}; page ${view.page + 1} of ${pages}`;
    find("previous").disabled = view.page === 0;
    find("next").disabled = view.page >= pages - 1;
  }

  /** Select a row everywhere: address, table, diagram, the panel of its numbers. */
  function choose(number) {
    const row = byNumber.get(number);
    if (!row || !table) return;
    view.chosen = row;
    if (!view.rows.includes(row)) { clearFilters(); refresh(); }
    view.page = Math.floor(view.rows.indexOf(row) / PAGE);
    showPage();
    if (location.hash !== `#row-${number}`) history.replaceState(null, "", `#row-${number}`);
    inspect(row);
    stanford?.ring();
  }

  function facts(pairs) {
    return make("dl", { class: "facts" }, ...pairs.flatMap(([name, value]) => [make("dt", {}, name), make("dd", {}, value)]));
  }

  function grid(head, lines) {
    return make("div", { class: "scroll" }, make("table", {},
      make("thead", {}, make("tr", {}, ...head.map((text) => make("th", { scope: "col" }, text)))),
      make("tbody", {}, ...lines.map(([name, ...cells]) => make("tr", {}, make("th", { scope: "row" }, name), ...cells.map((c) => make("td", { class: "num" }, c)))))));
  }

  function inspect(row) {
    const panel = find("detail");
    if (!panel.contains(document.activeElement)) view.from = document.activeElement;
    const place = view.rows.indexOf(row);
    const step = (by) => { const next = view.rows[place + by]; if (next) { choose(next.row); find(by < 0 ? "row-before" : "row-after").focus(); } };
    const close = () => { panel.hidden = true; document.body.classList.remove("inspecting"); focusBack(); };
    const before = make("button", { type: "button", id: "row-before", onclick: () => step(-1), disabled: place <= 0 }, "Previous");
    const after = make("button", { type: "button", id: "row-after", onclick: () => step(1), disabled: place >= view.rows.length - 1 }, "Next");
    const children = [
      make("div", { class: "tools" }, before, after, make("button", { type: "button", id: "close", onclick: close }, "Close")),
      make("h3", { tabindex: "-1" }, row.picture),
      make("p", { class: "soft" }, `${word(row.source)} · row ${row.row}`),
    ];
    const picture = document.querySelector(`.examples a[href="#row-${row.row}"] img`);
    if (picture) children.push(make("img", { src: picture.src, alt: picture.alt }));
    const sketched = sketch(row);
    if (sketched) children.push(sketched, make("p", { class: "soft" }, "Solid: truth. Dashed: predicted, with 2σ ellipses. Pixels, drawn to scale."));
    children.push(
      facts([
        ["Decision", make("span", {}, make("span", { class: `swatch ${row.decision}` }), row.decision)],
        ["Reason", word(row.reason)],
        ["Runway", word(row.ident)], ["Airport", word(row.airport)], ["Light", word(row.light)],
        ["Distance", `${show(row.distance_m, 5)} m`],
        ["Glide, lateral", `${show(row.glide_deg)}°, ${show(row.lateral_deg)}°`],
        ["Runway in view", show(row.present)],
        ["Test statistic", `${show(row.statistic)} with ${show(row.dof, 1)} degrees of freedom`],
        ["p", show(row.p_value)],
        ["Latency", `${show(row.latency_ms)} ms`],
        ["Network's px per px", show(row.enlarged)],
      ]),
      make("h4", {}, "Position, m"),
      grid(["", "error", "σ", "level"], AXES.map((axis, i) => [axis, show(at(row.error_m, i)), show(at(row.sigma_m, i)), show(at(row.level_m, i))])),
      make("h4", {}, "Corners, px"),
      grid(["", "true", "predicted", "error", "σ", "e / σ"], CORNERS.flatMap((corner, i) => ["u", "v"].map((name, j) => {
        const k = 2 * i + j, error = at(row.error_px, k), sigma = at(row.sigma_px, k);
        return [`${corner} ${name}`, show(at(row.truth_px, k), 6), show(at(row.mean_px, k), 6), show(error), show(sigma), show(known(error) && sigma > 0 ? error / sigma : null, 2)];
      }))));
    panel.replaceChildren(...children);
    panel.hidden = false;
    panel.scrollTop = 0;
    document.body.classList.add("inspecting");
    panel.querySelector("h3").focus({ preventScroll: true });
  }
  function focusBack() { // to where the row was chosen; the table has been made anew since
    const elsewhere = view.from?.isConnected && view.from !== document.body;
    (elsewhere ? view.from : table.querySelector("tr.chosen button"))?.focus({ preventScroll: true });
  }
  addEventListener("keydown", (event) => { if (event.key === "Escape" && !find("detail")?.hidden) find("close")?.click(); });

  function sketch(row) {
    const { truth_px: truth, mean_px: mean, sigma_px: sigma, correlation } = row;
    const all = [...(truth ?? []), ...(mean ?? [])];
    if (!truth || !all.every(known)) return null;
    const reach = sigma ? 2 * largest(sigma) : 0;
    const us = all.filter((_, i) => i % 2 === 0), vs = all.filter((_, i) => i % 2 === 1);
    const left = Math.min(...us), right = Math.max(...us), top = Math.min(...vs), bottom = Math.max(...vs);
    const margin = 0.06 * Math.max(right - left, bottom - top, 1) + reach;
    const box = [left - margin, top - margin, right - left + 2 * margin, bottom - top + 2 * margin];
    const outline = (points, name) => draw("polygon", { class: name, points: [0, 2, 4, 6].map((i) => `${points[i]},${points[i + 1]}`).join(" ") });
    const picture = draw("svg", { id: "sketch", viewBox: box.join(" "), role: "img", "aria-label": "True and predicted corners" }, outline(truth, "truth"));
    if (!mean) return picture;
    picture.append(outline(mean, "mean"));
    if (sigma) for (let i = 0; i < 4; i += 1) {
      // A unit circle through the Cholesky factor of the corner's 2 × 2 covariance, twice
      const a = sigma[2 * i], b = sigma[2 * i + 1], r = at(correlation, i) ?? 0;
      const matrix = [2 * a, 2 * b * r, 0, 2 * b * Math.sqrt(Math.max(0, 1 - r * r)), mean[2 * i], mean[2 * i + 1]];
      picture.append(draw("circle", { class: "ellipse", r: 1, transform: `matrix(${matrix.join(" ")})` }));
    }
    return picture;
  }

  // Stanford diagram: |error| across, protection level up, both logarithmic
  const chart = find("chart");
  const stanford = chart && makeStanford();
  function makeStanford() {
    const tip = find("tip");
    let axis = 0, points = [], marked = -1, svg = null, highlight = null, ring = null, width = 0;

    function render() {
      width = Math.max(280, chart.clientWidth);
      const height = Math.min(width, 560), left = 58, right = 26, top = 34, bottom = 46;
      const refused = find("with-refused").checked;
      const shown = rows.filter((r) => known(at(r.error_m, axis)) && at(r.level_m, axis) !== null && (refused || r.decision === "use"));
      const errors = shown.map((r) => Math.abs(r.error_m[axis])).filter((v) => v > 0).sort((a, b) => a - b);
      const levels = shown.map((r) => r.level_m[axis]).filter((v) => known(v) && v > 0);
      const limit = data.alert_limits_m ? data.alert_limits_m[axis] : null;
      const low = Math.max(-3, Math.floor(Math.log10(Math.min(errors[Math.floor(errors.length / 50)] ?? 0.1, ...levels, limit ?? 1))));
      const high = Math.ceil(Math.log10(Math.max(errors.at(-1) ?? 1, ...levels, limit ?? 1)) + 1e-9);
      const x = (v) => left + (width - left - right) * Math.min(1, Math.max(0, (Math.log10(Math.max(v, 1e-12)) - low) / (high - low)));
      const y = (v) => height - bottom - (height - top - bottom) * Math.min(1, Math.max(0, (Math.log10(Math.max(v, 1e-12)) - low) / (high - low)));
      const [x0, x1, y0, y1] = [left, width - right, height - bottom, top];
      const area = (name, corners) => draw("polygon", { class: name, points: corners.map((c) => c.join(",")).join(" ") });
      const line = (name, a, b, c, d) => draw("line", { class: name, x1: a, y1: b, x2: c, y2: d });
      const label = (text, a, b, attributes = {}) => draw("text", { x: a, y: b, ...attributes }, text);
      svg = draw("svg", {
        viewBox: `0 0 ${width} ${height}`, tabindex: 0, role: "application", "aria-label":
          `Stanford diagram, ${AXES[axis]}: ${shown.length} rows. Arrow keys step through the rows, from the largest error over level; Enter opens one.`,
        onpointermove: hover, onpointerleave: () => mark(-1), onclick: (event) => { hover(event); if (marked >= 0) choose(points[marked].row.row); },
        onkeydown: keys, onblur: () => mark(-1),
      });
      svg.append(area("misleading-area", [[x0, y0], [x1, y1], [x1, y0]]));
      if (limit !== null) svg.append(
        area("unavailable-area", [[x0, y1], [x1, y1], [x1, y(limit)], [x0, y(limit)]]),
        area("hazardous-area", [[x(limit), y0], [x(limit), y(limit)], [x1, y(limit)], [x1, y0]]));
      for (let power = low; power <= high; power += 1) {
        const value = 10 ** power, text = Number(value.toPrecision(1)).toLocaleString("en");
        svg.append(line("gridline", x(value), y0, x(value), y1), line("gridline", x0, y(value), x1, y(value)),
          label(text, x(value), y0 + 17, { "text-anchor": "middle" }), label(text, x0 - 6, y(value) + 4, { "text-anchor": "end" }));
      }
      svg.append(line("diagonal", x0, y0, x1, y1));
      if (limit !== null) svg.append(line("limit", x(limit), y0, x(limit), y1), line("limit", x0, y(limit), x1, y(limit)));
      points = shown.map((row) => {
        const level = row.level_m[axis], error = Math.abs(row.error_m[axis]);
        return { row, x: x(error), y: level === "inf" ? top - 12 : y(level), ratio: ratio(row, axis) ?? 0, used: row.decision === "use" };
      }).sort((a, b) => a.ratio - b.ratio); // the worst on top
      for (const p of points) {
        if (p.used) svg.append(draw("circle", { class: p.ratio > 1 ? "point misleading" : "point", cx: p.x, cy: p.y, r: p.ratio > 1 ? 5 : 3 }));
        else svg.append(draw("path", { class: "refused", d: `M${p.x - 3} ${p.y - 3}l6 6m0-6l-6 6` }));
      }
      if (points.some((p) => p.row.level_m[axis] === "inf")) svg.append(label("no level can be given", x0 + 4, top - 20));
      svg.append(label("misleading", (limit === null ? x1 : x(limit)) - 8, y0 - 10, { class: "region", "text-anchor": "end" }), label("covered", x0 + 8, limit === null ? y1 + 18 : y(limit) + 18, { class: "region" }));
      if (limit !== null) svg.append(label("hazardous", x1 - 8, y0 - 10, { class: "region", "text-anchor": "end" }), label(`not available: level over ${limit} m`, x0 + 8, y1 + 18, { class: "region" }));
      svg.append(label(`|${AXES[axis]} error|, m`, (x0 + x1) / 2, height - 8, { class: "axis", "text-anchor": "middle" }),
        label("protection level, m", 0, 0, { class: "axis", "text-anchor": "middle", transform: `translate(13 ${(y0 + y1) / 2}) rotate(-90)` }));
      ring = draw("circle", { class: "ring", r: 8, visibility: "hidden" });
      highlight = draw("circle", { class: "ring", r: 6, visibility: "hidden" });
      svg.append(ring, highlight);
      chart.querySelector("svg")?.remove();
      chart.prepend(svg);
      find("charted").textContent = `${shown.length.toLocaleString("en")} rows drawn, ${points.filter((p) => p.used && p.ratio > 1).length} of them accepted with an error over the level.`;
      tip.hidden = true;
      showRing();
    }

    function put(circle, point) {
      circle.setAttribute("visibility", point ? "visible" : "hidden");
      if (point) { circle.setAttribute("cx", point.x); circle.setAttribute("cy", point.y); }
    }
    function showRing() { put(ring, points.find((p) => p.row === view.chosen)); }

    function mark(index) {
      marked = index;
      const p = points[index];
      put(highlight, p);
      tip.hidden = !p;
      if (!p) return;
      const r = p.row;
      tip.replaceChildren(make("b", {}, r.picture), ...[
        word(r.source), `error ${show(r.error_m[axis])} m, level ${show(r.level_m[axis])}${known(r.level_m[axis]) ? " m" : ""}`,
        `${r.decision}${r.reason ? `: ${r.reason}` : ""}`].map((text) => make("span", {}, text)));
      const scale = svg.clientWidth / width || 1;
      tip.style.left = `${Math.max(0, Math.min(p.x * scale + 12, chart.clientWidth - tip.offsetWidth))}px`;
      tip.style.top = `${p.y * scale + 14}px`;
    }

    function hover(event) {
      const box = svg.getBoundingClientRect(), scale = width / box.width;
      const px = (event.clientX - box.left) * scale, py = (event.clientY - box.top) * scale;
      let best = -1, nearest = 18;
      points.forEach((p, i) => { const d = Math.hypot(p.x - px, p.y - py); if (d <= nearest) { nearest = d; best = i; } });
      mark(best);
    }

    function keys(event) {
      const by = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      if (by && points.length) { event.preventDefault(); mark(marked < 0 ? points.length - 1 : (marked - by + points.length) % points.length); }
      else if (event.key === "Enter" && marked >= 0) choose(points[marked].row.row);
    }

    for (const radio of document.querySelectorAll("input[name=axis]")) radio.addEventListener("change", () => { axis = Number(radio.value); render(); });
    find("with-refused").addEventListener("change", render);
    let last = 0;
    new ResizeObserver(() => { if (chart.clientWidth !== last) { last = chart.clientWidth; render(); } }).observe(chart);
    render();
    return { ring: showRing };
  }

  // Addresses: #row-17 opens a row, #airport-LFPO and #light-night filter the rows
  function follow() {
    const [, what, which] = /^#(row|airport|light)-(.*)$/.exec(decodeURIComponent(location.hash)) ?? [];
    if (what === "row") choose(Number(which));
    else if (what && table) {
      clearFilters();
      find(what === "airport" ? "by-airport" : "by-text").value = which;
      refresh();
      find("rows").scrollIntoView();
    }
  }
  addEventListener("hashchange", follow);
  document.addEventListener("click", (event) => { // the same address twice is no change of address
    const link = event.target.closest?.('a[href^="#"]');
    if (link && link.hash === location.hash) follow();
  });
  follow();
})();
