"use strict";
(() => {
const $ = id => document.getElementById(id);
const given = JSON.parse($("data").textContent);
const {flight, live} = given;
const camera = flight.camera, runway = flight.runway, limits = flight.alert_limits || {};
const settings = flight.settings || {};
const WORDS = {"use": "USE", "do-not-use": "DO NOT USE", "not-monitored": "NOT MONITORED"};
const MARKS = {"use": "M4 13l5 5L20 6", "do-not-use": "M5 5l14 14M19 5L5 19", "not-monitored": "M12 4v10M12 19.5v.01"};
// On the picture, which is dark or light as it comes: the colours of the package's own overlays.
const DRAWN = {"use": "#40dc6e", "do-not-use": "#ff483c", "not-monitored": "#ffb22c", ellipse: "#ffec6e", truth: "#ff50ff", pose: "#5cb8ff", crop: "#ffffff"};
const GAP_S = 1, LONGEST_S = 30; // a curve breaks over a longer gap; the time axis shows none longer
const PICTURES_KEPT = 80, AHEAD = 8;
const DEG = Math.PI / 180;
const LOC_FULL_DEG = given.full_scale_deg.lateral, GS_FULL_DEG = given.full_scale_deg.vertical;

// --- the flight as columns; a live one grows

const wide = new Set(given.wide);
const numbers = {}, texts = given.texts;
let count = given.count;
for (const [name, packed] of Object.entries(given.numbers)) {
  const bytes = Uint8Array.fromBase64 ? Uint8Array.fromBase64(packed) : Uint8Array.from(atob(packed), c => c.charCodeAt(0));
  numbers[name] = wide.has(name) ? new Float64Array(bytes.buffer) : new Float32Array(bytes.buffer);
}
for (const column of Object.values(texts))
  for (let i = 1; i < column.length; i++) if (column[i] === null) column[i] = column[i - 1];
const at = (name, i) => { const column = numbers[name]; return column === undefined || i < 0 || i >= column.length ? NaN : column[i]; };
const has = name => numbers[name] !== undefined;

/** Seconds since the first frame; a clock that jumps back or far ahead does not bend the axis. */
let clock = new Float64Array(Math.max(count, 64));
const changes = []; // frames whose verdict or state is another than the one before
const runs = {decision: [], state: []}; // {from, to, value}
const tally = {"use": 0, "do-not-use": 0, "not-monitored": 0};

function note(i) {
  if (i >= clock.length) { const old = clock; clock = new Float64Array(2 * i); clock.set(old); }
  const step = i ? at("t", i) - at("t", i - 1) : 0;
  clock[i] = (i ? clock[i - 1] : 0) + Math.min(Math.max(step, 0), LONGEST_S);
  let changed = false;
  for (const name of ["decision", "state"]) {
    const value = texts[name][i], last = runs[name][runs[name].length - 1];
    if (last && last.value === value) last.to = i;
    else { runs[name].push({from: i, to: i, value}); changed = changed || i > 0; }
  }
  if (changed) changes.push(i);
  tally[texts.decision[i]]++;
}
for (let i = 0; i < count; i++) note(i);

function append(row) {
  for (const name of Object.keys(row.numbers)) {
    const column = numbers[name];
    if (column && count < column.length) continue;
    const larger = new (wide.has(name) ? Float64Array : Float32Array)(Math.max(256, 2 * count)).fill(NaN);
    if (column) larger.set(column);
    numbers[name] = larger;
  }
  for (const name in row.numbers) numbers[name][count] = row.numbers[name] === null ? Infinity : row.numbers[name];
  for (const name in texts) texts[name][count] = row.texts[name] || "";
  note(count++);
}

let stages = [], columnsThen = -1;
/** Names of the columns that hold timings. */
function stageColumns() {
  const names = Object.keys(numbers);
  if (names.length !== columnsThen) { stages = names.filter(name => name.startsWith("ms_")); columnsThen = names.length; }
  return stages;
}
function totalMs(i) {
  let sum = NaN;
  for (const stage of stageColumns()) { const ms = at(stage, i); if (stage === "ms_total" && ms === ms) return ms; if (ms === ms) sum = (sum === sum ? sum : 0) + ms; }
  return sum;
}
/** Which pose is flown by: the track's while it is kept, else the frame's own. */
const flown = i => at("track_x", i) === at("track_x", i) && (texts.state[i] === "tracking" || texts.state[i] === "degraded") ? "track_" : "";
const isUse = i => texts.decision[i] === "use";

// --- colours

const probe = document.createElement("span");
probe.hidden = true;
document.body.append(probe);
let palette = {};
function readPalette() {
  palette = {};
  for (const name of ["paper", "panel", "ink", "soft", "grid", "use", "do-not-use", "not-monitored", "track", "truth", "on-verdict"]) {
    probe.style.color = `var(--${name})`;
    palette[name] = getComputedStyle(probe).color;
  }
  palette.searching = palette.soft; palette.tracking = palette.track;
  palette.degraded = palette["not-monitored"]; palette.lost = palette["do-not-use"];
}
const dark = () => (document.documentElement.dataset.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
function themed() { readPalette(); $("theme").textContent = dark() ? "Light" : "Dark"; redraw(); }

function fitted(canvas, height) {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = height || canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    if (height) canvas.style.height = h + "px";
    canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
  }
  const ctx = canvas.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.clearRect(0, 0, w, h);
  return {ctx, w, h};
}

// --- the camera: runway frame to pixels, as geometry.py

const [K1 = 0, K2 = 0, P1 = 0, P2 = 0, K3 = 0, K4 = 0, K5 = 0, K6 = 0] = camera.distortion || [];
function poseAt(prefix, i) {
  const [x, y, z, yaw, pitch, roll] = ["x", "y", "z", "yaw", "pitch", "roll"].map(name => at(prefix + name, i));
  if (!(x + y + z + yaw + pitch + roll === x + y + z + yaw + pitch + roll)) return null;
  const [cy, sy, cp, sp, cr, sr] = [yaw, pitch, roll].flatMap(a => [Math.cos(a * DEG), Math.sin(a * DEG)]);
  // Rz(-yaw) Ry(-pitch) Rx(roll), the columns: the body's axes in the runway frame.
  return {at: [x, y, z], forward: [cy * cp, -sy * cp, sp],
    left: [sy * cr - cy * sp * sr, cy * cr + sy * sp * sr, cp * sr],
    up: [-sy * sr - cy * sp * cr, -cy * sr + sy * sp * cr, cp * cr]};
}
/** Pixel of a point, or null behind the camera or where the distortion folds back. */
function project(pose, point) {
  const d = [0, 1, 2].map(k => point[k] - pose.at[k]), dot = axis => d[0] * axis[0] + d[1] * axis[1] + d[2] * axis[2];
  const depth = dot(pose.forward);
  if (!(depth > 0.5)) return null;
  const x = -dot(pose.left) / depth, y = -dot(pose.up) / depth, r = x * x + y * y;
  const up = 1 + r * (K1 + r * (K2 + r * K3)), down = 1 + r * (K4 + r * (K5 + r * K6)), radial = up / down;
  const slope = (K1 + r * (2 * K2 + r * 3 * K3) - radial * (K4 + r * (2 * K5 + r * 3 * K6))) / down;
  const xx = radial + 2 * x * x * slope + 2 * P1 * y + 6 * P2 * x, yy = radial + 2 * y * y * slope + 6 * P1 * y + 2 * P2 * x;
  const xy = 2 * x * y * slope + 2 * P1 * x + 2 * P2 * y;
  if (!(xx * yy - xy * xy > 0)) return null;
  return [camera.fx * (x * radial + 2 * P1 * x * y + P2 * (r + 2 * x * x)) + camera.cx,
    camera.fy * (y * radial + P1 * (r + 2 * y * y) + 2 * P2 * x * y) + camera.cy];
}
const OUTLINE = runway.corners_m.flatMap((a, k) => {
  const b = runway.corners_m[(k + 1) % 4];
  return Array.from({length: 32}, (_, j) => a.map((v, axis) => v + (b[axis] - v) * j / 32));
});

// --- pictures

const kept = new Map();
function pictureOf(i) {
  const path = texts.image[i];
  if (!path || i < 0 || i >= count) return null;
  let image = kept.get(path);
  if (!image) {
    if (live && i < count - 2) return null; // the server keeps only the newest
    image = new Image();
    image.onload = image.onerror = () => { if (texts.image[current] === path) drawPictures(); };
    image.src = path;
  }
  kept.delete(path); kept.set(path, image);
  if (kept.size > PICTURES_KEPT) kept.delete(kept.keys().next().value);
  return image;
}
const LAYERS = [
  ["crop", "where it looked", "crop", true], ["outline", "keypoints’ outline", "use", false], ["ellipse", "2σ ellipses", "ellipse", false],
  ["pose", "runway from the pose", "pose", true], ["truth", "truth", "truth", false]];
const shown = {};
for (const [layer, label, colour, dashed] of LAYERS) {
  if (layer === "truth" && !live && !has("true_x")) continue;
  const box = document.createElement("input"), line = document.createElement("span"), text = document.createElement("label");
  box.type = "checkbox"; box.checked = shown[layer] = true; box.id = "layer-" + layer;
  box.onchange = () => { shown[layer] = box.checked; drawPictures(); };
  line.className = dashed ? "line dashed" : "line"; line.id = "swatch-" + layer;
  line.style.setProperty("--of", layer === "crop" ? "var(--soft)" : DRAWN[colour]);
  text.append(box, line, label);
  $("legend").append(text);
}
$("layer-pose").parentElement.title = "Dashed: the runway as the track's pose has it, or this frame's where there is no track";

/** A window of the frame [left, top, width, height], pixel edges, drawn into a canvas. */
function drawWindow(canvas, height, view, thick) {
  const {ctx, w, h} = fitted(canvas, height), i = current, s = w / view[2];
  const u = px => (px + 0.5 - view[0]) * s, v = px => (px + 0.5 - view[1]) * s;
  ctx.fillStyle = "#222932";
  ctx.fillRect(0, 0, w, h);
  const image = pictureOf(i);
  if (image && image.complete && image.naturalWidth) {
    ctx.imageSmoothingEnabled = s * camera.width / image.naturalWidth < 6;
    ctx.drawImage(image, u(-0.5), v(-0.5), camera.width * s, camera.height * s);
  } else {
    ctx.strokeStyle = "#3a444f"; ctx.lineWidth = 1;
    ctx.strokeRect(u(-0.5), v(-0.5), camera.width * s, camera.height * s);
    ctx.fillStyle = "#8b97a4"; ctx.font = "12px system-ui, sans-serif"; ctx.textAlign = "left";
    if (canvas === $("frame")) ctx.fillText(texts.image[i] && !(image && image.complete) && !live ? "loading" : "no picture of this frame", 10, h - 10);
  }
  const path = (points, colour, dash, closed) => {
    ctx.beginPath();
    let pen = false;
    for (const p of points) { if (!p) { pen = false; continue; } ctx[pen ? "lineTo" : "moveTo"](u(p[0]), v(p[1])); pen = true; }
    if (closed) ctx.closePath();
    ctx.setLineDash(dash);
    for (const [width, style] of [[thick + 2, "rgba(0,0,0,.45)"], [thick, colour]]) { ctx.lineWidth = width; ctx.strokeStyle = style; ctx.stroke(); }
    ctx.setLineDash([]);
  };
  if (shown.crop) {
    const [left, top, width, tall] = ["left", "top", "width", "height"].map(name => at("crop_" + name, i));
    if (width > 0) {
      const [l, t] = [left - 0.5, top - 0.5];
      path([[l, t], [l + width, t], [l + width, t + tall], [l, t + tall]], DRAWN.crop, [6, 4], true);
    }
  }
  const runwayBy = (prefix, colour, dash) => {
    const pose = poseAt(prefix, i);
    if (pose) { const points = OUTLINE.map(point => project(pose, point)); path([...points, points[0]], colour, dash, false); }
  };
  if (shown.truth) runwayBy("true_", DRAWN.truth, []);
  if (shown.pose) runwayBy(flown(i), DRAWN.pose, [7, 5]);
  const points = [];
  for (let k = 0; has(`k${k}_u`); k++) if (at(`k${k}_u`, i) === at(`k${k}_u`, i)) points.push(k);
  if (shown.outline && points.length >= 4) path(points.slice(0, 4).map(k => [at(`k${k}_u`, i), at(`k${k}_v`, i)]), DRAWN[texts.decision[i]], [], true);
  if (shown.ellipse) for (const k of points) {
    const [a, b, c] = ["uu", "uv", "vv"].map(name => at(`k${k}_${name}`, i));
    if (!(a > 0)) continue;
    const mid = (a + c) / 2, turn = Math.hypot((a - c) / 2, b);
    ctx.beginPath();
    ctx.ellipse(u(at(`k${k}_u`, i)), v(at(`k${k}_v`, i)), 2 * s * Math.sqrt(mid + turn), 2 * s * Math.sqrt(Math.max(mid - turn, 0)), Math.atan2(2 * b, a - c) / 2, 0, 2 * Math.PI);
    ctx.lineWidth = 1.5; ctx.strokeStyle = DRAWN.ellipse; ctx.stroke();
  }
}
/** Square around the runway: where the network looked, else where it was found or should be. */
function closeUp(i) {
  const [left, top, width, height] = ["left", "top", "width", "height"].map(name => at("crop_" + name, i));
  if (width > 0) {
    const u = [left, left + width], v = [top, top + height], reach = Math.max(width, height) / 2;
    for (let k = 0; has(`k${k}_u`); k++) for (const [span, px, middle] of [[u, at(`k${k}_u`, i), left + width / 2], [v, at(`k${k}_v`, i), top + height / 2]]) {
      if (px !== px || Math.abs(px - middle) > 2 * reach) continue; // a corner found outside the crop
      span[0] = Math.min(span[0], px); span[1] = Math.max(span[1], px);
    }
    const side = 1.06 * Math.max(u[1] - u[0], v[1] - v[0]);
    return [(u[0] + u[1] - side) / 2, (v[0] + v[1] - side) / 2, side, side];
  }
  const pose = poseAt(flown(i), i), points = pose ? runway.corners_m.map(c => project(pose, c)).filter(Boolean) : [];
  if (points.length < 2) return null;
  const us = points.map(p => p[0]), vs = points.map(p => p[1]), mid = a => (Math.min(...a) + Math.max(...a)) / 2;
  const side = 1.5 * Math.max(Math.max(...us) - Math.min(...us), Math.max(...vs) - Math.min(...vs), 16);
  return [mid(us) - side / 2, mid(vs) - side / 2, side, side];
}
function drawPictures() {
  if (current < 0) return;
  const w = $("frame").clientWidth, tall = Math.min(w * camera.height / camera.width, Math.max(innerHeight - 240, 320));
  const extent = Math.max(camera.height, tall / w * camera.width), across = extent * w / tall;
  drawWindow($("frame"), tall, [(camera.width - across) / 2, (camera.height - extent) / 2, across, extent], 1.5);
  const view = closeUp(current), side = $("zoom").clientWidth;
  if (view) drawWindow($("zoom"), side, view, 1.5);
  else {
    const {ctx, w, h} = fitted($("zoom"), side);
    ctx.fillStyle = "#222932"; ctx.fillRect(0, 0, w, h);
    ctx.fillStyle = "#8b97a4"; ctx.font = "12px system-ui, sans-serif"; ctx.textAlign = "center";
    ctx.fillText("nowhere to look", w / 2, h / 2);
  }
}

// --- words and figures

const fixed = (v, digits) => v === v ? (Math.abs(v) === Infinity ? "none" : v.toFixed(digits).replace("-", "−")) : "–";
const lengthOf = v => fixed(v, Math.abs(v) < 1000 ? 1 : 0);
const brief = v => v !== v ? "–" : v >= 0.01 ? v.toPrecision(2) : v === 0 ? "0" : v.toExponential(0).replace("e-", "·10⁻").replace(/⁻(\d+)/, (_, d) => "⁻" + [...d].map(c => "⁰¹²³⁴⁵⁶⁷⁸⁹"[c]).join(""));
const side = (v, digits, plus, minus) => v !== v ? "–" : `${Math.abs(v).toFixed(digits)} ${v >= 0 ? plus : minus}`;
const ROWS = [
  {name: "Along-track", column: "x", level: "along_m", unit: "m", show: v => lengthOf(v), title: "along the landing direction, from the threshold: negative before it"},
  {name: "Cross-track", column: "y", level: "cross_m", unit: "m", show: v => side(v, 1, "L", "R"), title: "from the centreline"},
  {name: "Height", column: "z", level: "vertical_m", unit: "m", show: v => lengthOf(v), title: "above the threshold"},
  {name: "Localizer", column: "lateral", level: "lateral_deg", unit: "°", show: v => side(v, 2, "L", "R"), title: "from the centreline, at the runway's far end"},
  {name: "Glide path", column: "vertical", level: "vertical_deg", unit: "°", show: v => side(v, 2, "above", "below"), title: "from 3°, at 300 m past the threshold"}];
for (const row of ROWS) {
  const line = document.createElement("tr");
  line.title = row.title;
  line.innerHTML = `<th scope="row">${row.name} <small>${row.unit}</small></th><td></td><td class="of-track"></td><td></td><td class="of-truth"></td>`;
  row.cells = [...line.querySelectorAll("td")];
  $("rows").append(line);
}
function setCell(cell, main, more, kind) {
  cell.textContent = main;
  if (more) { const small = document.createElement("small"); small.textContent = more; cell.append(" ", small); }
  cell.className = cell.className.replace(/ ?(refused|unchecked|over|void)/g, "") + (kind ? " " + kind : "");
}
function showFigures(i) {
  const decision = texts.decision[i], kind = decision === "use" ? "" : decision === "do-not-use" ? "refused" : "unchecked";
  for (const row of ROWS) {
    const digits = row.unit === "m" ? 1 : 2, value = at(row.column, i), level = at("level_" + row.level, i), limit = limits[row.level];
    const given2 = prefix => at(prefix + "s" + row.column, i) === at(prefix + "s" + row.column, i) ? "± " + fixed(2 * at(prefix + "s" + row.column, i), digits) : "";
    setCell(row.cells[0], row.show(value), given2(""), value === value ? kind : "");
    setCell(row.cells[1], row.show(at("track_" + row.column, i)), given2("track_"));
    setCell(row.cells[2], fixed(level, digits), limit ? "/ " + limit : "", !isUse(i) && level === level ? "void" : limit && level > limit ? "over" : "");
    const error = at(flown(i) + row.column, i) - at("true_" + row.column, i), bound = isUse(i) ? level : NaN;
    const own = value - at("true_" + row.column, i), missed = Math.abs(own) > bound;
    setCell(row.cells[3], error === error ? (error >= 0 ? "+" : "−") + Math.abs(error).toFixed(digits) : "–", "", missed ? "over" : "");
  }
  const p = at("p_value", i), present = at("present", i);
  $("test").textContent = `p ${brief(p)}` + (settings.false_alarm_rate ? `, refused below ${brief(settings.false_alarm_rate)}` : "")
    + (at("statistic", i) === at("statistic", i) ? ` · residual χ² ${at("statistic", i).toFixed(1)}` : "")
    + (present === present ? ` · runway in view ${(100 * present).toFixed(0)} %` : "") + ` · ${fixed(totalMs(i), 1)} ms`;
}
function showVerdict(i) {
  const decision = texts.decision[i], state = texts.state[i];
  $("verdict").className = "panel " + decision;
  $("word").textContent = $("chip").textContent = WORDS[decision];
  $("chip").className = decision;
  $("mark").setAttribute("d", MARKS[decision]);
  $("reason").textContent = texts.reason[i] || "no reason given";
  const over = ROWS.filter(row => limits[row.level] && at("level_" + row.level, i) > limits[row.level]);
  $("available").hidden = !flight.alert_limits;
  $("available").className = decision === "use" && over.length ? "exceeds" : "";
  $("available").textContent = decision !== "use" ? "No protection level holds for a frame that is not for use" : !over.length ? "All protection levels within the alert limits"
    : "Over the alert limit: " + over.map(row => { const level = at("level_" + row.level, i); return `${row.name.toLowerCase()} ${level === Infinity ? "without a level" : fixed(level, row.unit === "m" ? 0 : 2) + " " + row.unit}`; }).join(", ");
  $("swatch-outline").style.setProperty("--of", `var(--${decision})`);
  $("when").textContent = `frame ${frameName(i)} · t ${at("t", i).toFixed(2)} s`;
  $("where").textContent = `${i + 1} of ${count} · ${clock[i].toFixed(1)} of ${clock[count - 1].toFixed(1)} s`;
  $("track").hidden = !runs.state.some(run => run.value);
  $("state").textContent = state ? state.toUpperCase() : "NO TRACK";
  $("state").className = state || "searching";
  const coasting = at("coasting_s", i), p = at("innovation_p", i);
  $("state-reason").textContent = [texts.state_reason[i], state && at("taken", i) === 1 ? "measurement taken in" : "", state && at("taken", i) === 0 ? "measurement not taken in" : "",
    coasting > 0 ? `coasting ${coasting.toFixed(1)} s` : "", p === p ? `innovation p ${brief(p)}` : ""].filter(Boolean).join(" · ");
  const timeline = $("timeline");
  timeline.setAttribute("aria-valuemax", count);
  timeline.setAttribute("aria-valuenow", i + 1);
  timeline.setAttribute("aria-valuetext", `frame ${frameName(i)}, ${WORDS[decision].toLowerCase()}${state ? ", " + state : ""}`);
}
const frameName = i => at("frame", i) === at("frame", i) ? at("frame", i) : i;

// --- the instrument

function drawIls(i) {
  const size = $("cdi").clientWidth, {ctx} = fitted($("cdi"), size), prefix = flown(i);
  const c = size / 2, reach = 0.36 * size, lateral = at(prefix + "lateral", i), vertical = at(prefix + "vertical", i);
  const tracked = prefix === "track_", bad = !(lateral === lateral) || (!tracked && !isUse(i));
  ctx.strokeStyle = palette.grid; ctx.lineWidth = 1;
  ctx.strokeRect(c - reach * 1.2, c - reach * 1.2, reach * 2.4, reach * 2.4);
  for (const dot of [-2, -1, 1, 2]) for (const [x, y] of [[c + dot / 2 * reach, c], [c, c + dot / 2 * reach]]) {
    ctx.beginPath(); ctx.arc(x, y, 3.2, 0, 7); ctx.strokeStyle = palette.soft; ctx.lineWidth = 1.3; ctx.stroke();
  }
  // Fly to the needle: left of the centreline it stands to the right, above the path it stands below.
  const along = [[lateral / LOC_FULL_DEG, 2 * at(prefix + "slateral", i) / LOC_FULL_DEG, true], [vertical / GS_FULL_DEG, 2 * at(prefix + "svertical", i) / GS_FULL_DEG, false]];
  const colour = bad ? palette[texts.decision[i]] : tracked ? palette[texts.state[i]] : palette.use;
  ctx.save();
  ctx.beginPath(); ctx.rect(c - reach * 1.2, c - reach * 1.2, reach * 2.4, reach * 2.4); ctx.clip();
  for (const [off, spread, upright] of along) {
    if (!(off === off)) continue;
    const where = c + Math.max(-1.1, Math.min(1.1, off)) * reach, half = Math.min(spread || 0, 3) * reach;
    ctx.fillStyle = colour; ctx.globalAlpha = 0.2;
    if (upright) ctx.fillRect(where - half, c - reach * 1.2, 2 * half, reach * 2.4); else ctx.fillRect(c - reach * 1.2, where - half, reach * 2.4, 2 * half);
    ctx.globalAlpha = 1; ctx.strokeStyle = colour; ctx.lineWidth = 3; ctx.setLineDash(bad ? [5, 4] : []);
    ctx.beginPath();
    if (upright) { ctx.moveTo(where, c - reach * 1.05); ctx.lineTo(where, c + reach * 1.05); } else { ctx.moveTo(c - reach * 1.05, where); ctx.lineTo(c + reach * 1.05, where); }
    ctx.stroke(); ctx.setLineDash([]);
    if (Math.abs(off) > 1.1) { // beyond the scale
      const sign = Math.sign(off), tip = c + sign * 1.18 * reach, root = c + sign * 1.06 * reach;
      ctx.fillStyle = colour; ctx.beginPath();
      if (upright) { ctx.moveTo(tip, c); ctx.lineTo(root, c - 8); ctx.lineTo(root, c + 8); } else { ctx.moveTo(c, tip); ctx.lineTo(c - 8, root); ctx.lineTo(c + 8, root); }
      ctx.fill();
    }
  }
  ctx.restore();
  const truth = [at("true_lateral", i) / LOC_FULL_DEG, at("true_vertical", i) / GS_FULL_DEG];
  if (truth[0] === truth[0]) {
    const [x, y] = truth.map(v => c + Math.max(-1.15, Math.min(1.15, v)) * reach);
    ctx.strokeStyle = palette.truth; ctx.lineWidth = 2; ctx.beginPath();
    ctx.moveTo(x, y - 7); ctx.lineTo(x + 7, y); ctx.lineTo(x, y + 7); ctx.lineTo(x - 7, y); ctx.closePath(); ctx.stroke();
  }
  ctx.strokeStyle = palette.ink; ctx.lineWidth = 2; // the aircraft
  ctx.beginPath(); ctx.moveTo(c - 12, c); ctx.lineTo(c - 4, c); ctx.moveTo(c + 4, c); ctx.lineTo(c + 12, c); ctx.moveTo(c, c - 4); ctx.lineTo(c, c - 9); ctx.stroke();
  if (bad) {
    ctx.font = "700 12px system-ui, sans-serif"; ctx.textAlign = "center"; ctx.textBaseline = "middle";
    for (const [flag, x, y] of [["LOC", c - reach * 0.72, c - reach * 0.9], ["G/S", c + reach * 0.72, c - reach * 0.9]]) {
      ctx.fillStyle = palette[texts.decision[i]]; ctx.fillRect(x - 20, y - 9, 40, 18);
      ctx.fillStyle = palette["on-verdict"]; ctx.fillText(flag, x, y + 0.5);
    }
    ctx.textBaseline = "alphabetic";
  }
  const dots = (v, full) => `${(2 * Math.abs(v) / full).toFixed(1)} dots`, spread = name => fixed(2 * at(prefix + "s" + name, i), 2);
  $("ils-source").textContent = lateral !== lateral ? "flagged: no pose" : bad ? "flagged: not for use" : tracked ? (texts.state[i] === "tracking" ? "from the track" : "from the degraded track") : "from this frame";
  $("loc").textContent = lateral === lateral ? `LOC ${side(lateral, 2, "° left", "° right").replace(" °", "°")} ± ${spread("lateral")}° (${dots(lateral, LOC_FULL_DEG)})` : "LOC –";
  $("gs").textContent = vertical === vertical ? `G/S ${side(vertical, 2, "° above", "° below").replace(" °", "°")} ± ${spread("vertical")}° (${dots(vertical, GS_FULL_DEG)})` : "G/S –";
}

// --- the timeline

const LANES = [["decision", 4, 21, "verdict"], ["state", 28, 15, "track"]], GUTTER = 46;
const RANK = {"use": 0, "tracking": 0, "": 0, "searching": 1, "degraded": 2, "not-monitored": 1, "lost": 3, "do-not-use": 2};
const xTime = (i, w) => GUTTER + (clock[count - 1] > 0 ? clock[i] / clock[count - 1] : count > 1 ? i / (count - 1) : 0) * (w - GUTTER - 1);
/** Where frame i begins on the timeline: half-way from the one before. */
const edge = (i, w) => i <= 0 ? GUTTER : i >= count ? w : (xTime(i - 1, w) + xTime(i, w)) / 2;
function drawTimeline() {
  const canvas = $("timeline"), {ctx, w, h} = fitted(canvas);
  for (const [name, top, tall, title] of LANES) {
    ctx.font = "11px system-ui, sans-serif"; ctx.textBaseline = "middle"; ctx.textAlign = "left"; ctx.fillStyle = palette.soft;
    if (runs[name].some(run => run.value)) ctx.fillText(title, 0, top + tall / 2 + 1);
    ctx.font = "600 10px system-ui, sans-serif"; ctx.textBaseline = "middle"; ctx.textAlign = "center";
    for (const run of [...runs[name]].sort((a, b) => RANK[a.value] - RANK[b.value])) {
      if (!run.value) continue;
      const a = edge(run.from, w), b = Math.max(edge(run.to + 1, w), a + 1.5);
      // Not by colour alone: what may be used stands low, what may not stands full height.
      const low = run.value === "use" || run.value === "tracking" ? 0.25 : run.value === "searching" || run.value === "not-monitored" ? 0.12 : 0;
      ctx.fillStyle = palette[run.value];
      ctx.fillRect(a, top + low * tall, b - a, (1 - low) * tall);
      const label = name === "decision" ? WORDS[run.value] : run.value.toUpperCase();
      if (b - a > 7 * label.length + 8) { ctx.fillStyle = palette["on-verdict"]; ctx.fillText(label, (a + b) / 2, top + (1 + low) / 2 * tall + 0.5); }
    }
  }
  ctx.fillStyle = palette.soft; ctx.font = "10px system-ui, sans-serif"; ctx.textBaseline = "alphabetic";
  const total = clock[Math.max(count - 1, 0)], step = niceStep(total / Math.max((w - GUTTER) / 90, 2));
  for (let t = 0; total > 0 && t <= total; t += step) {
    const x = GUTTER + t / total * (w - GUTTER - 1), label = `${+t.toFixed(2)} s`;
    ctx.textAlign = x > w - 16 ? "right" : "center";
    ctx.fillText(label, x, h - 3); ctx.fillRect(Math.min(x, w - 1), h - 18, 1, 4);
  }
}
const putCursor = (cursor, x) => { cursor.hidden = false; cursor.style.transform = `translateX(${x}px)`; };
function nearestTime(t) {
  let low = 0, high = count - 1;
  while (low < high) { const mid = (low + high) >> 1; if (clock[mid] < t) low = mid + 1; else high = mid; }
  return low > 0 && t - clock[low - 1] <= clock[low] - t ? low - 1 : low;
}
function scrubbed(canvas, frameAt) {
  const go = event => { pause(); show(frameAt(event.clientX - canvas.getBoundingClientRect().left, canvas.clientWidth)); };
  canvas.addEventListener("pointerdown", event => { if (event.button) return; canvas.setPointerCapture(event.pointerId); go(event); });
  canvas.addEventListener("pointermove", event => { if (canvas.hasPointerCapture(event.pointerId)) go(event); });
}
scrubbed($("timeline"), (x, w) => {
  const share = Math.max(0, Math.min(1, (x - GUTTER) / (w - GUTTER - 1)));
  return clock[count - 1] > 0 ? nearestTime(share * clock[count - 1]) : Math.round(share * (count - 1));
});

// --- charts

let byDistance = false, along = null; // along: metres before the threshold, of each frame
function distances() {
  const out = new Float64Array(count);
  let last = -1;
  for (let i = 0; i < count; i++) {
    const own = isUse(i) ? at("x", i) : NaN, track = at("track_x", i), truth = at("true_x", i);
    const x = truth === truth ? truth : track === track ? track : own;
    out[i] = -x;
    if (x !== x) continue;
    for (let k = last + 1; k < i; k++) out[k] = last < 0 ? -x : out[last] + (out[i] - out[last]) * (clock[k] - clock[last]) / Math.max(clock[i] - clock[last], 1e-9);
    last = i;
  }
  for (let k = last + 1; k < count; k++) out[k] = last < 0 ? NaN : out[last];
  return out;
}
function niceStep(rough) {
  const power = 10 ** Math.floor(Math.log10(Math.max(rough, 1e-9)));
  return power * [1, 2, 5, 10].find(m => m * power >= rough * 0.999);
}
/** Smallest and largest of numbers, without the farthest 1 % where there are many. */
function extent(values) {
  const all = values.filter(Number.isFinite).sort((a, b) => a - b);
  if (!all.length) return null;
  const cut = all.length > 200 ? Math.floor(all.length / 200) : 0;
  return [all[cut], all[all.length - 1 - cut]];
}
function sampled(f, only) {
  const out = [], step = Math.max(1, Math.floor(count / 3000));
  for (let i = 0; i < count; i += step) if (!only || only(i)) { const v = f(i); if (v === v) out.push(v); }
  return out;
}
const ABS = {along_m: "x", cross_m: "y", vertical_m: "z"};
const pathHeight = i => along && (given.glide_path.origin_m + along[i]) > 0 ? (given.glide_path.origin_m + along[i]) * Math.tan(given.glide_path.deg * DEG) : NaN;

function positionChart(id, title, column, sign, options = {}) {
  const value = prefix => { const name = prefix + column; return i => sign * at(name, i); };
  const spread = {"": "s" + column, "track_": "track_s" + column}, centre = {"": column, "track_": "track_" + column};
  return {id, title, unit: "m", ...options,
    range: () => {
      const sound = [...sampled(value("track_")), ...sampled(value("true_")), ...sampled(value(""), isUse)];
      return extent(sound.length ? [...sound, ...(options.zero ? [0] : [])] : sampled(value("")));
    },
    draw(c) {
      const of = i => { const prefix = flown(i); return prefix || isUse(i) ? prefix : null; };
      const band = s => i => { const prefix = of(i); return prefix === null ? NaN : sign * at(centre[prefix], i) + s * 2 * at(spread[prefix], i); };
      c.band(band(-1), band(1), has("track_x") ? palette.track : palette.use);
      if (options.path) c.line(pathHeight, palette.soft, [5, 4], 1);
      if (options.zero === "line") c.level(0, palette.soft, [5, 4]);
      c.dots(value(""), i => palette[texts.decision[i]], i => isUse(i) ? 0 : 1);
      c.line(value("true_"), palette.truth, [], 1.5);
      c.line(value("track_"), palette.track, [], 1.7);
    },
    now: i => { const prefix = flown(i), v = value(prefix)(i); return v === v ? `${fixed(v, 1)} ± ${fixed(2 * at(prefix + "s" + column, i), 1)} m` : "–"; }};
}
function levelChart(axis, title) {
  const column = ABS[axis], limit = limits[axis], levelName = "level_" + axis, sigmaName = "s" + column, truthName = "true_" + column;
  const level = i => at(levelName, i), error = i => Math.abs(at(column, i) - at(truthName, i));
  return {id: "chart-" + axis, title: `${title}: protection level`, unit: "m", log: true,
    range: () => {
      const found = extent([...sampled(level), ...sampled(i => 2 * at(sigmaName, i)), ...sampled(i => Math.max(error(i), 0.1), isUse), ...(limit ? [limit] : [])]);
      return found && [Math.max(found[0] / 1.5, 0.05), found[1] * 1.5];
    },
    draw(c) {
      if (limit) c.above(limit, palette["do-not-use"]);
      c.line(i => 2 * at(sigmaName, i), palette.soft, [2, 3], 1.2);
      c.dots(error, i => isUse(i) && error(i) > level(i) ? palette["do-not-use"] : isUse(i) ? palette.truth : palette[texts.decision[i]], i => isUse(i) ? 0 : 1);
      c.line(level, palette.ink, [], 1.8);
      c.none(i => level(i) === Infinity);
    },
    now: i => (Number.isFinite(level(i)) ? `${fixed(level(i), 1)}${limit ? ` / ${limit}` : ""} m` : level(i) === Infinity ? "no level" : "–") + (error(i) === error(i) ? `, error ${fixed(error(i), 1)}` : "")};
}
const charts = [
  positionChart("chart-height", "Height above the threshold", "z", 1, {path: true, zero: true}),
  positionChart("chart-distance", "Distance to the threshold, along-track", "x", -1, {timeOnly: true}),
  positionChart("chart-cross", "Cross-track, left positive", "y", 1, {zero: "line"}),
  levelChart("along_m", "Along-track"), levelChart("cross_m", "Cross-track"), levelChart("vertical_m", "Vertical"),
  {id: "chart-p", title: "p-value of the residual", unit: "", log: true, range: () => [1e-8, 1.5],
    draw(c) {
      if (settings.false_alarm_rate) c.below(settings.false_alarm_rate, palette["do-not-use"]);
      c.dots(i => Math.max(at("innovation_p", i), 1.5e-8), () => palette.track, () => 2);
      c.dots(i => Math.max(at("p_value", i), 1.5e-8), i => palette[texts.decision[i]], i => isUse(i) ? 0 : 1);
    },
    now: i => brief(at("p_value", i)) + (at("innovation_p", i) === at("innovation_p", i) ? `, innovation ${brief(at("innovation_p", i))}` : "")},
  {id: "chart-ms", title: "Time per frame", unit: "ms",
    range: () => { const found = extent([...sampled(totalMs), ...(flight.budget_ms ? [flight.budget_ms] : [])]); return found && [0, found[1] * 1.15]; },
    draw(c) {
      if (flight.budget_ms) c.above(flight.budget_ms, palette["do-not-use"]);
      c.line(totalMs, palette.ink, [], 1.4);
    },
    now: i => `${fixed(totalMs(i), 1)} ms` + (flight.budget_ms ? ` of ${flight.budget_ms}` : "")},
];
const PAD = {left: 44, right: 8, top: 7, bottom: 19};
for (const chart of charts) {
  const panel = document.createElement("div");
  panel.className = "panel"; panel.id = chart.id;
  panel.innerHTML = `<h3>${chart.title} <span></span></h3><div class="plot"><canvas role="img" aria-label="${chart.title}"></canvas><i hidden></i></div>`;
  chart.panel = panel; chart.canvas = panel.querySelector("canvas"); chart.value = panel.querySelector("span"); chart.cursor = panel.querySelector("i");
  $("charts").append(panel);
  scrubbed(chart.canvas, (x, w) => {
    const share = (x - PAD.left) / (w - PAD.left - PAD.right), [from, to] = span, wanted = from + share * (to - from);
    if (!byDistance) return nearestTime(wanted);
    let best = 0;
    for (let i = 1; i < count; i++) if (Math.abs(along[i] - wanted) < Math.abs(along[best] - wanted)) best = i;
    return best;
  });
}
function domain() {
  if (!byDistance) return [0, clock[count - 1] || 1];
  const found = extent([...along]) || [0, 1];
  return [Math.max(...sampled(i => along[i]), found[1]), Math.min(...sampled(i => along[i]), found[0])];
}
let longGap = GAP_S, span = [0, 1];
function drawChart(chart) {
  chart.stale = false;
  const {ctx, w, h} = fitted(chart.canvas), wide = w - PAD.left - PAD.right, tall = h - PAD.top - PAD.bottom;
  if (wide < 20) return;
  const [from, to] = span;
  const xOf = i => PAD.left + ((byDistance ? along[i] : clock[i]) - from) / (to - from) * wide;
  let range = chart.range() || (chart.log ? [0.1, 10] : [0, 1]);
  if (!chart.log) { const room = Math.max(0.06 * (range[1] - range[0]), 0.5); range = [range[0] - (chart.id === "chart-ms" ? 0 : room), range[1] + room]; }
  const map = chart.log ? Math.log10 : v => v, low = map(range[0]), high = map(range[1]);
  const yOf = v => PAD.top + tall - Math.max(-0.02, Math.min(1.02, (map(v) - low) / (high - low))) * tall;
  ctx.font = "10px system-ui, sans-serif"; ctx.fillStyle = palette.soft; ctx.strokeStyle = palette.grid; ctx.lineWidth = 1;
  ctx.textAlign = "right"; ctx.textBaseline = "middle";
  const tick = (v, label) => { const y = Math.round(yOf(v)) + 0.5; ctx.beginPath(); ctx.moveTo(PAD.left, y); ctx.lineTo(w - PAD.right, y); ctx.stroke(); ctx.fillText(label, PAD.left - 5, y); };
  if (chart.log) for (let e = Math.ceil(low), every = Math.max(1, Math.ceil((high - low) / 5)); e <= high; e += every) tick(10 ** e, Math.abs(e) <= 3 ? String(+(10 ** e).toPrecision(1)) : brief(10 ** e).replace("1·", ""));
  else { const step = niceStep((range[1] - range[0]) / 4.5); for (let v = Math.ceil(range[0] / step) * step; v <= range[1]; v += step) tick(v, String(+v.toFixed(6)).replace("-", "−")); }
  ctx.textBaseline = "alphabetic"; ctx.textAlign = "center";
  const step = niceStep(Math.abs(to - from) / Math.max(wide / 70, 2));
  for (let v = Math.ceil(Math.min(from, to) / step) * step; v <= Math.max(from, to); v += step) {
    const x = PAD.left + (v - from) / (to - from) * wide;
    ctx.fillText(String(+v.toFixed(6)).replace("-", "−") + (byDistance ? " m" : " s"), Math.min(x, w - 16), h - 5);
  }
  ctx.save();
  ctx.beginPath(); ctx.rect(PAD.left, PAD.top - 3, wide, tall + 6); ctx.clip();
  chart.draw(plotter(ctx, xOf, yOf, {left: PAD.left, right: w - PAD.right, top: PAD.top, bottom: PAD.top + tall}));
  ctx.restore();
  chart.xOf = xOf;
}
/** Draws columns, of many frames in one pixel only their extremes. */
function plotter(ctx, xOf, yOf, box) {
  /** Per pixel column [x, lowest, highest]; null where the curve breaks. */
  const columns = (f, g) => {
    const buckets = [], size = Math.ceil(box.right - box.left) + 1, slots = new Array(size);
    for (let i = 0; i < count; i++) {
      const at2 = Math.round(xOf(i) - box.left);
      if (!(at2 >= 0 && at2 < size)) continue;
      const a = f(i), b = g ? g(i) : a, fine = Number.isFinite(a) && Number.isFinite(b);
      const slot = slots[at2] || (slots[at2] = {x: xOf(i), low: Infinity, high: -Infinity, first: i, last: i, broken: true});
      slot.last = i;
      if (fine) { slot.low = Math.min(slot.low, a, b); slot.high = Math.max(slot.high, a, b); slot.broken = false; }
    }
    let before = null;
    for (const slot of slots) {
      if (!slot) continue;
      if (before !== null && slot.first > before && clock[slot.first] - clock[before] > longGap) buckets.push(null);
      before = slot.last;
      buckets.push(slot.broken ? null : slot);
    }
    return buckets;
  };
  const stretches = list => { const out = [[]]; for (const slot of list) if (slot) out[out.length - 1].push(slot); else if (out[out.length - 1].length) out.push([]); return out.filter(part => part.length); };
  const level = (v, colour, dash) => { ctx.strokeStyle = colour; ctx.lineWidth = 1.2; ctx.setLineDash(dash); ctx.beginPath(); ctx.moveTo(box.left, yOf(v)); ctx.lineTo(box.right, yOf(v)); ctx.stroke(); ctx.setLineDash([]); };
  const shade = (top, bottom, colour) => { ctx.fillStyle = colour; ctx.globalAlpha = 0.12; ctx.fillRect(box.left, top, box.right - box.left, Math.max(bottom - top, 0)); ctx.globalAlpha = 1; };
  return {
    level,
    above(v, colour) { shade(box.top - 3, yOf(v), colour); level(v, colour, [6, 3]); },
    below(v, colour) { shade(yOf(v), box.bottom + 3, colour); level(v, colour, [6, 3]); },
    line(f, colour, dash, width) {
      ctx.strokeStyle = colour; ctx.lineWidth = width; ctx.setLineDash(dash); ctx.lineJoin = "round"; ctx.beginPath();
      for (const part of stretches(columns(f))) {
        ctx.moveTo(part[0].x - (part.length === 1 ? 0.7 : 0), yOf(part[0].low));
        for (const slot of part) { ctx.lineTo(slot.x, yOf(slot.low)); if (slot.high > slot.low) ctx.lineTo(slot.x, yOf(slot.high)); }
        if (part.length === 1) ctx.lineTo(part[0].x + 0.7, yOf(part[0].low));
      }
      ctx.stroke(); ctx.setLineDash([]);
    },
    band(f, g, colour) {
      ctx.fillStyle = colour; ctx.globalAlpha = 0.2;
      for (const part of stretches(columns(f, g))) {
        ctx.beginPath();
        for (const slot of part) ctx.lineTo(slot.x, yOf(slot.low));
        for (const slot of part.reverse()) ctx.lineTo(slot.x, yOf(slot.high));
        ctx.fill();
      }
      ctx.globalAlpha = 1;
    },
    /** kind 0: a dot, 1: a cross, for what may not be used; 2: a small ring. */
    dots(f, colour, kind) {
      const taken = new Set(), small = count > 4000 ? 0.8 : count > 400 ? 1.3 : 2;
      for (const wanted of [2, 0, 1]) for (let i = 0; i < count; i++) {
        const what = kind(i), v = f(i);
        if (what !== wanted || !(v === v) || v === Infinity) continue;
        const x = xOf(i), y = yOf(v), key = (Math.round(x) * 4096 + Math.round(y)) * 4 + what;
        if (taken.has(key)) continue;
        taken.add(key);
        ctx.fillStyle = ctx.strokeStyle = colour(i);
        if (what === 0) ctx.fillRect(x - small, y - small, 2 * small, 2 * small);
        else { ctx.lineWidth = 1.4; ctx.beginPath(); if (what === 2) ctx.arc(x, y, 2.2, 0, 7); else { ctx.moveTo(x - 3, y - 3); ctx.lineTo(x + 3, y + 3); ctx.moveTo(x + 3, y - 3); ctx.lineTo(x - 3, y + 3); } ctx.stroke(); }
      }
    },
    /** A strip at the top over frames for which there is no level. */
    none(is) {
      let any = null;
      ctx.fillStyle = palette.ink;
      for (let i = 0; i < count; i++) if (is(i)) {
        const next = i + 1 < count && clock[i + 1] - clock[i] < longGap ? xOf(i + 1) : xOf(i) + 2;
        ctx.fillRect(Math.min(xOf(i), next), box.top - 3, Math.max(Math.abs(next - xOf(i)), 1), 4);
        any = any === null ? xOf(i) : any;
      }
      if (any !== null) { 
        const x = Math.max(box.left, Math.min(any, box.right - 48));
        ctx.font = "10px system-ui, sans-serif"; ctx.textAlign = "left";
        ctx.fillStyle = palette.panel; ctx.fillRect(x, box.top + 3, 46, 12);
        ctx.fillStyle = palette.ink; ctx.fillText("no level", x + 2, box.top + 12);
      }
    },
  };
}
function drawCharts() {
  if (!count) return;
  along = distances();
  const steps = []; // the usual time between frames says what a gap is
  for (let i = 1; i < Math.min(count, 400); i++) steps.push(clock[i] - clock[i - 1]);
  longGap = Math.max(GAP_S, 4 * (steps.sort((a, b) => a - b)[steps.length >> 1] || 0));
  span = domain();
  for (const chart of charts) {
    chart.panel.hidden = Boolean(chart.timeOnly && byDistance);
    chart.stale = true;
    if (chart.seen && !chart.panel.hidden) drawChart(chart);
  }
  drawCursors();
}
/** Charts are drawn when they come into view. */
const watcher = new IntersectionObserver(entries => {
  for (const {target, isIntersecting} of entries) {
    const chart = charts.find(each => each.panel === target);
    chart.seen = isIntersecting;
    if (isIntersecting && chart.stale && count) drawChart(chart);
  }
  drawCursors();
}, {rootMargin: "150px"});
for (const chart of charts) watcher.observe(chart.panel);
function drawCursors() {
  if (current < 0) return;
  for (const chart of charts) if (chart.seen && chart.xOf) { putCursor(chart.cursor, chart.xOf(current)); chart.value.textContent = chart.now(current); }
}
for (const [button, distance] of [["by-time", false], ["by-distance", true]]) $(button).onclick = () => {
  byDistance = distance;
  $("by-time").setAttribute("aria-pressed", String(!distance)); $("by-distance").setAttribute("aria-pressed", String(distance));
  drawCharts();
};
function chartKey() {
  const items = [["dot", "use", "frame, use"], ["", "do-not-use", "× frame, not for use"], ["band", has("track_x") ? "track" : "use", "± 2σ"]];
  if (has("track_x") || live) items.push(["", "track", "track"]);
  if (has("true_x")) items.push(["", "truth", "truth, true error"]);
  items.push(["", "ink", "protection level"]);
  if (flight.alert_limits) items.push(["dashed", "do-not-use", "alert limit"]);
  $("key").replaceChildren(...items.map(([kind, colour, label]) => {
    const item = document.createElement("li"), line = document.createElement("span");
    line.className = "line " + kind; line.style.setProperty("--of", `var(--${colour})`);
    if (!label.startsWith("×")) item.append(line, label);
    else { const cross = document.createElement("b"); cross.textContent = "×"; cross.style.color = `var(--${colour})`; item.append(cross, label.slice(1)); }
    return item;
  }));
}

// --- what is said of the whole flight

function facts() {
  const rows = [["source", flight.source], ["camera", `${camera.width} × ${camera.height} px, f ${fixed(camera.fx, 0)} px${(camera.distortion || []).some(Boolean) ? ", with distortion" : ""}`],
    ["runway", `${runway.ident || "unnamed"}, ${fixed(runway.length_m, 0)} × ${fixed(runway.width_m, 0)} m`],
    ["model", flight.model && `${flight.model.name || ""} ${(flight.model.sha256 || "").slice(0, 12)}`],
    ["false-alarm rate", settings.false_alarm_rate && brief(settings.false_alarm_rate)], ["integrity risk", settings.integrity_risk && brief(settings.integrity_risk)],
    ["fault prior", settings.fault_prior && brief(settings.fault_prior)],
    ["alert limits", flight.alert_limits ? ["along_m", "cross_m", "vertical_m"].map(k => limits[k] ? limits[k] + " m" : "none").join(" along, ").replace(/ along, ([^,]*) along, /, " along, $1 across, ") + " vertical" : "none given"],
    ["frames dropped", flight.dropped], ["over the budget", flight.budget_ms && `${flight.misses || 0} frames over ${flight.budget_ms} ms`]];
  $("facts").replaceChildren(...rows.filter(([, v]) => v !== undefined && v !== null && v !== "").flatMap(([name, value]) => {
    const dt = document.createElement("dt"), dd = document.createElement("dd");
    dt.textContent = name; dd.textContent = value;
    return [dt, dd];
  }));
}
function showStages(i) {
  const known = flight.stages || {}, names = [...new Set([...stageColumns().map(name => name.slice(3)), ...Object.keys(known).map(name => name.replace(/_ms$/, ""))])];
  const line = (cells, tag) => { const tr = document.createElement("tr"); cells.forEach((text, n) => { const cell = document.createElement(n ? tag : "th"); cell.textContent = text; tr.append(cell); }); return tr; };
  const head = document.createElement("thead"), body = document.createElement("tbody");
  head.append(line(["", "this frame", "p50", "p95", "p99"], "th"));
  for (const name of names) {
    const all = known[name] || known[name + "_ms"] || {};
    body.append(line([name, ...[at("ms_" + name, i), all.p50, all.p95, all.p99].map(v => Number.isFinite(v) ? v.toFixed(1) : "–")], "td"));
  }
  $("stages").replaceChildren(head, body);
}
function showWhole() {
  const total = Math.max(count, 1);
  $("about").textContent = [flight.source, flight.model && flight.model.name, count ? `${count} frames, ${clock[count - 1].toFixed(1)} s` : ""].filter(Boolean).join(" · ");
  $("tally").replaceChildren(...Object.entries(tally).map(([decision, n]) => {
    const item = document.createElement("span");
    item.innerHTML = `<b style="color: var(--${decision})">${n}</b> ${WORDS[decision].toLowerCase()} <small>${(100 * n / total).toFixed(n && n < total && n / total < 0.005 ? 2 : 0)} %</small>`;
    return item;
  }));
  for (const [name, known] of [["track", has("track_x")], ["truth", has("true_x")]]) for (const cell of document.querySelectorAll(".of-" + name)) cell.hidden = !known;
  chartKey();
}

// --- moving through it

let current = -1, playing = null, following = live;
function show(i) {
  if (!count) return;
  current = Math.max(0, Math.min(count - 1, i));
  showVerdict(current); showFigures(current); drawIls(current); putCursor($("cursor"), xTime(current, $("timeline").clientWidth)); drawCursors(); showStages(current); drawPictures();
  if (!live) for (let k = 1; k <= AHEAD && current + k < count; k++) pictureOf(current + k);
  $("follow").setAttribute("aria-pressed", String(following));
}
function move(to) { following = false; pause(); show(to); }
function pause() {
  if (live) following = false;
  if (!playing) return;
  cancelAnimationFrame(playing.request); playing = null;
  $("play").setAttribute("aria-label", "Play (space)"); $("play-mark").setAttribute("d", "M4 2.5v11l9-5.5z");
}
function play() {
  if (!count) return;
  if (live) { following = !following; if (following) show(count - 1); return; }
  if (playing) { pause(); return; }
  if (current >= count - 1) show(0);
  playing = {from: clock[current], since: performance.now(), request: 0};
  $("play").setAttribute("aria-label", "Pause (space)"); $("play-mark").setAttribute("d", "M4 3h2.5v10H4zM9.5 3H12v10H9.5z");
  const tick = () => {
    const t = playing.from + (performance.now() - playing.since) / 1000 * Number($("speed").value);
    let i = current;
    while (i + 1 < count && clock[i + 1] <= t) i++;
    if (i !== current) show(i);
    if (i >= count - 1) pause(); else playing.request = requestAnimationFrame(tick);
  };
  playing.request = requestAnimationFrame(tick);
}
function change(forward) {
  const found = forward ? changes.find(i => i > current) : changes.filter(i => i < current).pop();
  if (found !== undefined) move(found);
  else move(forward ? count - 1 : 0);
}
const KEYS = {ArrowLeft: e => move(current - (e.shiftKey ? 10 : 1)), ArrowRight: e => move(current + (e.shiftKey ? 10 : 1)), " ": () => play(),
  Home: () => move(0), End: () => { pause(); following = live; show(count - 1); }, n: () => change(true), p: () => change(false)};
document.addEventListener("keydown", event => {
  if (event.altKey || event.ctrlKey || event.metaKey || !count) return;
  const on = event.target.tagName, key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (on === "SELECT" || !KEYS[key] || (key === " " && (on === "BUTTON" || on === "INPUT"))) return;
  event.preventDefault();
  KEYS[key](event);
});
$("previous").onclick = () => change(false); $("next").onclick = () => change(true);
$("back").onclick = () => move(current - 1); $("forward").onclick = () => move(current + 1);
$("play").onclick = play;
$("speed").onchange = () => { if (playing) { playing.from = clock[current]; playing.since = performance.now(); } };
$("theme").onclick = () => { document.documentElement.dataset.theme = dark() ? "light" : "dark"; themed(); };
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", themed);

function redraw() {
  if (!count) return;
  drawTimeline(); drawCharts(); show(current < 0 ? (live ? count - 1 : 0) : current);
}
let resizing = 0;
window.addEventListener("resize", () => { cancelAnimationFrame(resizing); resizing = requestAnimationFrame(redraw); });

$("notes").replaceChildren(...given.notes.map(text => { const line = document.createElement("p"); line.textContent = text; return line; }));
facts(); showWhole();
if (live) {
  $("play").hidden = true; $("speed").hidden = true; $("follow").hidden = false;
  $("follow").onclick = play;
  $("reason").textContent = "waiting for the first frame";
  $("word").textContent = "NO FRAME"; $("verdict").className = "panel not-monitored";
  let due = 0, whole = 0;
  const refresh = () => {
    due = 0;
    if (performance.now() - whole > 500) { whole = performance.now(); showWhole(); drawTimeline(); drawCharts(); }
    if (following) show(count - 1); else show(current < 0 ? count - 1 : current);
  };
  const events = new EventSource("events"), say = text => { const line = document.createElement("p"); line.textContent = text; $("notes").replaceChildren(...(text ? [line] : [])); };
  events.onmessage = event => { say(""); append(JSON.parse(event.data)); if (!due) due = requestAnimationFrame(refresh); };
  events.onerror = () => say("No connection to the flight: what is shown is old.");
  events.addEventListener("end", () => { events.close(); say("The flight has ended. `shortfinal view` replays it whole."); whole = 0; if (count) refresh(); });
}
themed();
})();
