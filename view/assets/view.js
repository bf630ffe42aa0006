"use strict";
// The page of `cz view`. Everything it shows comes from `api/…` beside it; see view/src/server.rs.

const HEAD = 8, WORDS = 9, NONE = 0xffffffff, COMMANDED = 0x80;
const MODES = ["entered", "FE", "OCBF"];
const VERDICTS = ["as wished", "FE", "bound", "infeasible", "held", "held by shield"];
const EVENTS = { infeasible: "--v-3", missed: "--m-other", exited: "--m-other", replaced: "--accent", refused: "--v-5", skipped: "--quiet", steered: "--good" };
// Warm is slow, cool is fast: told apart with any kind of colour vision, and from what is behind.
const RAMPS = {
  light: [[150, 30, 0], [224, 96, 10], [244, 180, 10], [48, 170, 160], [28, 116, 204], [24, 60, 150]],
  dark: [[255, 84, 52], [255, 146, 46], [250, 208, 84], [84, 204, 186], [82, 172, 252], [120, 150, 255]],
};
const BINS = 24;

const $ = id => document.getElementById(id);
const el = (tag, attributes = {}, ...children) => {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "style") Object.assign(node.style, value);
    else if (name.startsWith("on")) node[name] = value;
    else if (value !== null && value !== undefined && value !== false) node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.filter(child => child !== null && child !== undefined));
  return node;
};
// Puts these in place of what is in a box.
const fill = (box, ...children) => box.replaceChildren(...children.flat().filter(child => child !== null && child !== undefined));
const clamp = (x, low, high) => Math.min(high, Math.max(low, x));
const fixed = (x, digits) => x === null || x === undefined || !Number.isFinite(x) ? "–" : x.toFixed(digits);
// What a row leaves at one step by sampling is not a margin that was not kept. What is owed at a merge or crossing
// need not be there before the vehicle comes to it.
const standing = duty => duty.margin_m > -0.005 ? "good" : duty.counts ? "bad" : "quiet";
const margin_m = (margin, digits) => fixed(Math.abs(margin) < 0.5 * 10 ** -digits ? 0 : margin, digits);
const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const query = params => Object.entries(params).map(([k, v]) => `${k}=${encodeURIComponent(v)}`).join("&");

async function ask(what, params = {}, as = "json") {
  const response = await fetch(`api/${what}?${query(params)}`);
  if (!response.ok) throw new Error((await response.text()).trim());
  return as === "json" ? response.json() : response.arrayBuffer();
}

/* ---------------------------------------------------------------- steps */

// One step: views of the words it came in.
class Frame {
  constructor(buffer, offset) {
    this.u32 = new Uint32Array(buffer, offset);
    this.f32 = new Float32Array(buffer, offset);
    this.u8 = new Uint8Array(buffer, offset);
    this.step = this.u32[0];
    this.count = this.u32[1];
    this.misses = this.u32[2] + this.u32[3] * 2 ** 32;
    this.hash = (BigInt(this.u32[6]) << 32n | BigInt(this.u32[5])).toString(16).padStart(16, "0");
    this.bytes = 4 * (HEAD + WORDS * this.count);
  }
  at(i) { return HEAD + WORDS * i; }
  // Index of a vehicle; frames of neighbouring steps list vehicles at almost the same places.
  find(vehicle, hint = 0) {
    for (let i = Math.max(0, hint - 2); i < Math.min(this.count, hint + 3); i++) {
      if (this.u32[this.at(i)] === vehicle) return i;
    }
    if (!this.places) {
      this.places = new Map();
      for (let i = 0; i < this.count; i++) this.places.set(this.u32[this.at(i)], i);
    }
    return this.places.get(vehicle) ?? -1;
  }
}

// Missing steps that are passed over at most.
const GAP = 200;
const CACHE_BYTES = 192 * 2 ** 20;

// The steps of one run, fetched when they are wanted.
class Frames {
  constructor(run) { this.run = run; this.known = new Map(); this.bytes = 0; this.asked = new Set(); this.absent = new Set(); this.busy = 0; }
  get(step) {
    const frame = this.known.get(step);
    if (frame) { this.known.delete(step); this.known.set(step, frame); }
    return frame;
  }
  want(step, ahead = 1) {
    const { first, last } = this.run.status;
    if (first === null || first === undefined) return;
    step = clamp(step, first, last);
    const most = clamp(Math.floor(2e6 / (this.each ?? 4000)), 2, 64);
    const until = clamp(step + Math.max(1, ahead), first, last);
    for (let from = step; from <= until; from++) {
      if (this.known.has(from) || this.asked.has(from) || this.absent.has(from)) continue;
      if (this.busy >= 3) return;
      let count = 0;
      while (count < most && from + count <= last && !this.known.has(from + count) && !this.asked.has(from + count)) count++;
      this.fetch(from, count);
      from += count;
    }
  }
  // The steps before and after an instant that are there: of a run that leaves some out, not the next ones.
  around(step) {
    let before = step, after = step + 1;
    while (before > step - GAP && this.absent.has(before)) before--;
    while (after < step + GAP && this.absent.has(after)) after++;
    if (before < step && !this.known.has(before)) this.want(before - 20, 20);
    if (after > step + 1 && !this.known.has(after)) this.want(after, 1);
    return [this.get(before), this.get(after)];
  }
  async fetch(from, count) {
    this.busy++;
    for (let i = 0; i < count; i++) this.asked.add(from + i);
    try {
      const buffer = await ask("frames", { run: this.run.index, from, count }, "binary");
      const got = new Set();
      for (let offset = 0; offset < buffer.byteLength;) {
        const frame = new Frame(buffer, offset);
        this.known.set(frame.step, frame);
        this.bytes += frame.bytes;
        got.add(frame.step);
        this.each = frame.bytes;
        offset += frame.bytes;
      }
      const end = got.size ? Math.max(...got) : from + count - 1;
      for (let i = from; i < Math.min(from + count, end); i++) if (!got.has(i)) this.absent.add(i);
      for (const [step, frame] of this.known) {
        if (this.bytes <= CACHE_BYTES) break;
        this.known.delete(step);
        this.bytes -= frame.bytes;
      }
    } catch { /* asked again when it is wanted again */ } finally {
      for (let i = 0; i < count; i++) this.asked.delete(from + i);
      this.busy--;
    }
  }
}

/* ---------------------------------------------------------------- geometry */

// A path or link as a polyline with the distance from its origin at each place.
class Course {
  constructor(pieces) {
    const points = [], marks = [];
    let before = 0;
    for (const { shape, length_m } of pieces) {
      const lengths = shape.slice(1).map((p, i) => Math.hypot(p[0] - shape[i][0], p[1] - shape[i][1]));
      const whole = lengths.reduce((a, b) => a + b, 0) || 1;
      let drawn = 0;
      shape.forEach((p, i) => {
        if (i > 0) drawn += lengths[i - 1];
        const mark = before + length_m * drawn / whole;
        if (points.length && mark - marks[marks.length - 1] < 1e-9) return;
        points.push(p[0], p[1]);
        marks.push(mark);
      });
      before += length_m;
    }
    this.points = Float64Array.from(points);
    this.marks = Float64Array.from(marks);
    this.length_m = before;
  }
  // The place at x, on a straight line before the first and behind the last.
  locate(x, out) {
    const { marks, points } = this;
    let low = 0, high = marks.length - 2;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (marks[middle] <= x) low = middle; else high = middle - 1;
    }
    const at = 2 * low, span = marks[low + 1] - marks[low] || 1, t = (x - marks[low]) / span;
    out[0] = points[at] + t * (points[at + 2] - points[at]);
    out[1] = points[at + 1] + t * (points[at + 3] - points[at + 1]);
    return out;
  }
}

class Geometry {
  constructor(network) {
    this.network = network;
    this.paths = network.zones.map(zone => zone.paths.map(path => new Course(path.segments.map(s => zone.segments[s]))));
    this.links = network.links.map(link => new Course([link]));
    this.between = new Path2D();
    let low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    const trace = (path, shape) => shape.forEach((p, i) => {
      if (i === 0) path.moveTo(p[0], p[1]); else path.lineTo(p[0], p[1]);
      low = [Math.min(low[0], p[0]), Math.min(low[1], p[1])];
      high = [Math.max(high[0], p[0]), Math.max(high[1], p[1])];
    });
    // A path per zone, so that those out of sight need not be drawn.
    this.lanes = network.zones.map(zone => {
      const path = new Path2D(), all = zone.segments.flatMap(s => s.shape);
      for (const segment of zone.segments) trace(path, segment.shape);
      const [xs, ys] = [all.map(p => p[0]), all.map(p => p[1])];
      return { path, left: Math.min(...xs), right: Math.max(...xs), bottom: Math.min(...ys), top: Math.max(...ys) };
    });
    for (const link of network.links) trace(this.between, link.shape);
    for (const join of network.joins) trace(this.between, join);
    this.low = low;
    this.high = high;
    this.middles = network.zones.map(zone => {
      const all = zone.segments.flatMap(s => s.shape), n = all.length;
      return [all.reduce((a, p) => a + p[0], 0) / n, all.reduce((a, p) => a + p[1], 0) / n];
    });
  }
  course(zone, path) { return zone === NONE ? this.links[path] : this.paths[zone]?.[path]; }
  // The zone nearest to a place, within so many metres.
  zoneAt(x, y, within) {
    let best = null, least = within * within;
    this.network.zones.forEach((zone, index) => {
      for (const { shape } of zone.segments) for (let i = 1; i < shape.length; i++) {
        const [ax, ay] = shape[i - 1], [bx, by] = shape[i], dx = bx - ax, dy = by - ay;
        const t = clamp(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1), 0, 1);
        const d = (x - ax - t * dx) ** 2 + (y - ay - t * dy) ** 2;
        if (d < least) { least = d; best = index; }
      }
    });
    return best;
  }
}

/* ---------------------------------------------------------------- state */

const state = {
  runs: [], time: 0, playing: false, follows: false, rate: 1, colour: "speed", keeps: false,
  vehicle: null, zone: null, run: 0, panel: 0, path: null, span: 120,
  view: null, detail: null, course: null, theme: {}, fps: 0, drawn: 0,
};
const RATES = [0.25, 0.5, 1, 2, 4, 8, 16, 32, 64];

const now = () => Math.floor(state.time + 1e-6);
const dt = () => state.runs[0]?.dt_s ?? 0.1;
const bounds = () => {
  const all = state.runs.filter(run => run.status.first !== null);
  return all.length ? [Math.min(...all.map(r => r.status.first)), Math.max(...all.map(r => r.status.last))] : [0, 0];
};

function setTime(time, follows = false) {
  const [first, last] = bounds();
  state.time = clamp(time, first, last);
  state.follows = follows && state.runs.some(run => run.is_live);
}
function pause() { state.playing = false; state.time = Math.round(state.time); }
function goto(step) { pause(); setTime(step); }
function play() {
  if (state.playing) return pause();
  const [first, last] = bounds();
  if (state.time >= last && !state.runs.some(run => run.status.live && !run.status.live.is_over)) setTime(first);
  state.playing = true;
}

function select({ vehicle = null, zone = null, run = state.run }) {
  const isOther = run !== state.run;
  Object.assign(state, { vehicle, zone, run, detail: null });
  if (isOther) showTabs();
  if (vehicle === null) state.course = null;
  else if (state.course?.vehicle !== vehicle || state.course?.run !== run) { state.course = null; fetchCourse(); }
  if (vehicle === null) state.keeps = false;
  state.asked = null;
  side.key = null;
  refreshDetail();
}

async function fetchCourse() {
  const { vehicle, run } = state;
  try {
    const course = await ask("course", { run, vehicle });
    if (state.vehicle === vehicle && state.run === run) { state.course = { ...course, run, at: performance.now() }; drawSpeed(); }
  } catch { /* it may not have been read yet */ }
}

// Zones that are told of when nothing is chosen, and how often while traffic moves.
const ZONES_TOLD = 12, ZONES_EVERY_MS = 250;
let detailIsAsked = false, detailAt = 0;
async function refreshDetail() {
  if (detailIsAsked) return;
  const isOverview = state.vehicle === null && state.zone === null, moves = state.playing || state.follows;
  if (isOverview && moves && state.detail?.zones && performance.now() - detailAt < ZONES_EVERY_MS) return;
  const { vehicle, zone, run } = state, step = clamp(now(), ...(state.runs[run] ? [state.runs[run].status.first ?? 0, state.runs[run].status.last ?? 0] : [0, 0]));
  const key = `${run} ${vehicle} ${zone} ${step}`;
  if (state.asked === key) return;
  state.asked = key;
  detailIsAsked = true;
  detailAt = performance.now();
  try {
    if (vehicle !== null) state.detail = await ask("vehicle", { run, step, vehicle });
    else if (zone !== null) state.detail = await ask("zone", { run, step, zone });
    else state.detail = { zones: await ask("zones", { run, step, count: ZONES_TOLD }) };
  } catch (error) {
    state.detail = { problem: error.message };
  }
  detailIsAsked = false;
  if (key !== `${state.run} ${state.vehicle} ${state.zone} ${step}`) { state.asked = null; return; }
  state.detail.step = step;
  followPath();
  showSide();
  document.documentElement.dataset.shown = String(step);
}

// The diagram shows the path of the vehicle that is chosen, until another is asked for.
function followPath() {
  const { vehicle, zone, path, problem } = state.detail, key = `${state.run} ${vehicle} ${zone}`;
  if (problem || vehicle === undefined || zone === NONE || state.followed === key) return;
  state.followed = key;
  state.path = `${zone},${path}`;
  if ($("path")) $("path").value = state.path;
  state.dirty = true;
}


/* ---------------------------------------------------------------- colours */

function ramp(t) {
  const RAMP = RAMPS[document.documentElement.dataset.theme] ?? RAMPS.light;
  const x = clamp(t, 0, 1) * (RAMP.length - 1), i = Math.min(RAMP.length - 2, Math.floor(x)), f = x - i;
  return RAMP[i].map((c, k) => Math.round(c + f * (RAMP[i + 1][k] - c)));
}
const rgb = c => `rgb(${c[0]} ${c[1]} ${c[2]})`;
let RAMP_CSS = [];

function readTheme() {
  const names = ["back", "pane", "ink", "quiet", "line", "lane", "lane-mark", "accent", "good", "bad", "grid", "ghost", "outline",
    "m-entered", "m-fe", "m-ocbf", "m-other", "v-0", "v-1", "v-2", "v-3", "v-4", "v-5"];
  state.theme = Object.fromEntries(names.map(name => [name, css(`--${name}`)]));
  const t = state.theme;
  RAMP_CSS = Array.from({ length: BINS }, (_, i) => rgb(ramp(i / (BINS - 1))));
  state.palettes = {
    speed: RAMP_CSS,
    mode: [t["m-entered"], t["m-fe"], t["m-ocbf"], t["m-other"]],
    verdict: [0, 1, 2, 3, 4, 5].map(i => t[`v-${i}`]).concat(t["m-entered"]),
  };
  showLegend();
}
// Which colour a vehicle has: an index in the palette.
function colourOf(frame, at, v, vMax) {
  const bytes = 4 * (at + 7);
  switch (state.colour) {
    case "mode": return frame.u8[bytes + 3] & COMMANDED ? Math.min(3, frame.u8[bytes]) : 0;
    case "verdict": return frame.u8[bytes + 3] & COMMANDED ? Math.min(5, frame.u8[bytes + 1]) : 6;
    default: return clamp(Math.round(v / vMax * (BINS - 1)), 0, BINS - 1);
  }
}
function showLegend() {
  const legend = $("legend");
  const key = (colour, text) => el("span", {}, el("i", { style: { background: colour } }), text);
  if (state.colour === "speed") {
    const vMax = Math.max(...state.runs.map(run => run.v_max_mps), 1);
    legend.replaceChildren("0", el("i", { class: "ramp", style: { background: `linear-gradient(90deg, ${RAMP_CSS.join(",")})` } }), `${vMax} m/s`);
  } else if (state.colour === "mode") {
    legend.replaceChildren(...["no command", "FE", "OCBF"].map((name, i) => key(state.palettes.mode[i], name)));
  } else {
    legend.replaceChildren(...VERDICTS.map((name, i) => key(state.palettes.verdict[i], name)));
  }
}

/* ---------------------------------------------------------------- vehicles */

// Of more vehicles than these outlines are not drawn, and where they are shorter than so many pixels they are dots.
const MANY = 2000, CAR_M = 4.5, DOT_PX = 6.5;

// The vehicles of a map as they were drawn last, pixels: what is drawn, and what a click finds.
class Drawn {
  constructor() { this.count = 0; this.room = 0; }
  begin(count) {
    this.count = 0;
    if (count <= this.room) return;
    this.room = 2 * count;
    this.id = new Uint32Array(this.room);
    this.colour = new Uint8Array(this.room);
    this.x = new Float32Array(this.room);
    this.y = new Float32Array(this.room);
    this.front = new Float32Array(2 * this.room);
    this.rear = new Float32Array(2 * this.room);
  }
  add(id, fx, fy, rx, ry, colour) {
    const i = this.count++;
    this.id[i] = id;
    this.colour[i] = colour;
    this.x[i] = (fx + rx) / 2;
    this.y[i] = (fy + ry) / 2;
    this.front[2 * i] = fx; this.front[2 * i + 1] = fy;
    this.rear[2 * i] = rx; this.rear[2 * i + 1] = ry;
  }
}

// Very many vehicles, as squares of pixels put there by hand: a tenth of what as many calls of the canvas cost.
class Dots {
  draw(context, { count, x, y, colour }, palette, ratio) {
    const { width, height } = context.canvas;
    if (this.image?.width !== width || this.image.height !== height) {
      this.image = new ImageData(width, height);
      this.words = new Uint32Array(this.image.data.buffer);
      this.palette = null;
    }
    if (this.palette !== palette) { this.palette = palette; this.inks = palette.map(inkOf); }
    const { words, inks } = this, size = Math.round(4 * ratio), half = size >> 1;
    words.fill(0);
    for (let i = 0; i < count; i++) {
      const left = Math.round(x[i] * ratio) - half, top = Math.round(y[i] * ratio) - half, ink = inks[colour[i]];
      const right = Math.min(width, left + size), bottom = Math.min(height, top + size), from = Math.max(0, left);
      if (from >= right) continue;
      for (let row = Math.max(0, top); row < bottom; row++) words.fill(ink, row * width + from, row * width + right);
    }
    context.putImageData(this.image, 0, 0);
  }
}
// A colour as the pixel has it.
function inkOf(colour) {
  const context = new OffscreenCanvas(1, 1).getContext("2d");
  context.fillStyle = colour;
  context.fillRect(0, 0, 1, 1);
  return new Uint32Array(context.getImageData(0, 0, 1, 1).data.buffer)[0];
}

/* ---------------------------------------------------------------- maps */

class CzMap {
  constructor(run) {
    this.run = run;
    // What lies still is a picture of its own behind what moves.
    this.ground = el("canvas", { class: "ground" });
    this.canvas = el("canvas", { tabindex: "0", "aria-label": `Map of ${run.name}` });
    this.name = el("div", { class: "name" });
    const button = (text, title, act) => el("button", { title, "aria-label": title, onclick: act }, text);
    this.box = el("div", { class: "map" }, this.ground, this.canvas, this.name, el("div", { class: "zoom" },
      button("+", "Zoom in (+)", () => zoom(1.5)), button("−", "Zoom out (−)", () => zoom(1 / 1.5)), button("⤢", "Show all (0)", fit)));
    this.shown = new Drawn();
    this.dots = new Dots();
    new ResizeObserver(() => this.resize()).observe(this.box);
    this.listen();
  }
  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas, ratio = devicePixelRatio || 1;
    this.width = width; this.height = height;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    if (!state.view || state.view.isFitted) fit();
    state.dirty = true;
  }
  px(x, y) { const v = state.view; return [this.width / 2 + (x - v.x) * v.scale, this.height / 2 - (y - v.y) * v.scale]; }
  world(px, py) { const v = state.view; return [v.x + (px - this.width / 2) / v.scale, v.y - (py - this.height / 2) / v.scale]; }
  listen() {
    const canvas = this.canvas;
    let drag = null;
    canvas.onpointerdown = event => {
      drag = { x: event.offsetX, y: event.offsetY, view: { ...state.view }, moved: false };
      canvas.setPointerCapture(event.pointerId);
    };
    canvas.onpointermove = event => {
      if (!drag) return;
      const dx = event.offsetX - drag.x, dy = event.offsetY - drag.y;
      if (Math.hypot(dx, dy) > 4) { drag.moved = true; canvas.classList.add("drags"); }
      if (drag.moved) {
        state.view = { ...state.view, x: drag.view.x - dx / state.view.scale, y: drag.view.y + dy / state.view.scale, isFitted: false };
        state.keeps = false;
        state.dirty = true;
      }
    };
    canvas.onpointerup = event => {
      canvas.classList.remove("drags");
      if (drag && !drag.moved) this.pick(event.offsetX, event.offsetY);
      drag = null;
    };
    canvas.onpointercancel = () => { drag = null; };
    canvas.ondblclick = fit;
    canvas.addEventListener("wheel", event => {
      event.preventDefault();
      zoom(Math.exp(-event.deltaY * 0.0015), this.world(event.offsetX, event.offsetY));
    }, { passive: false });
  }
  pick(px, py) {
    let best = null, least = 14 ** 2;
    const { count, id, x, y } = this.shown;
    for (let i = 0; i < count; i++) {
      const d = (x[i] - px) ** 2 + (y[i] - py) ** 2;
      if (d < least) { least = d; best = id[i]; }
    }
    if (best !== null) return select({ vehicle: best, run: this.run.index });
    const zone = this.run.geometry.zoneAt(...this.world(px, py), 14 / state.view.scale);
    select({ zone, run: this.run.index });
  }
  draw() {
    const { canvas } = this, ratio = devicePixelRatio || 1, context = canvas.getContext("2d"), v = state.view;
    if (!v || !this.width) return;
    this.drawGround(v, ratio);
    this.placeVehicles();
    const count = this.frame?.count ?? 0;
    if (count > MANY && v.scale * CAR_M < DOT_PX) {
      this.dots.draw(context, this.shown, state.palettes[state.colour], ratio);
      context.setTransform(ratio, 0, 0, ratio, 0, 0);
    } else {
      context.setTransform(1, 0, 0, 1, 0, 0);
      context.clearRect(0, 0, canvas.width, canvas.height);
      context.setTransform(ratio, 0, 0, ratio, 0, 0);
      this.drawVehicles(context);
    }
    this.drawDuties(context);
  }
  // Drawn once for each view of it.
  drawGround(v, ratio) {
    const { canvas, run } = this, t = state.theme, zone = state.run === run.index ? state.zone : null;
    const key = [v.x, v.y, v.scale, canvas.width, canvas.height, document.documentElement.dataset.theme, zone].join(" ");
    if (this.groundKey === key) return;
    this.groundKey = key;
    this.ground.width = canvas.width;
    this.ground.height = canvas.height;
    const context = this.ground.getContext("2d");
    // Lanes as they lie, in metres.
    context.save();
    context.setTransform(ratio * v.scale, 0, 0, -ratio * v.scale, ratio * (this.width / 2 - v.x * v.scale), ratio * (this.height / 2 + v.y * v.scale));
    context.lineCap = context.lineJoin = "round";
    const lane = Math.max(3.4, (run.network.zones.length > 200 ? 2 : 6.5) / v.scale);
    if (zone !== null) {
      context.strokeStyle = t.accent;
      context.globalAlpha = 0.45;
      context.lineWidth = lane + 9 / v.scale;
      context.stroke(run.geometry.lanes[zone].path);
      context.globalAlpha = 1;
    }
    context.strokeStyle = t.lane;
    context.lineWidth = lane;
    context.setLineDash([3 * lane, 2 * lane]);
    context.globalAlpha = 0.55;
    context.stroke(run.geometry.between);
    context.setLineDash([]);
    context.globalAlpha = 1;
    const [left, top] = this.world(-30, -30), [right, bottom] = this.world(this.width + 30, this.height + 30);
    for (const lanes of run.geometry.lanes) {
      if (lanes.right >= left && lanes.left <= right && lanes.top >= bottom && lanes.bottom <= top) context.stroke(lanes.path);
    }
    context.restore();
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (v.scale > 2) this.drawArrows(context);
    this.drawPoints(context);
    this.drawNames(context);
  }
  // Which way lanes lead, every sixty metres or so.
  drawArrows(context) {
    context.strokeStyle = state.theme["lane-mark"];
    context.lineWidth = clamp(0.25 * state.view.scale, 1, 3);
    const size = clamp(0.9 * state.view.scale, 2, 9);
    context.beginPath();
    for (const zone of this.run.network.zones) for (const { shape } of zone.segments) {
      let passed = 25;
      for (let i = 1; i < shape.length; i++) {
        const [ax, ay] = shape[i - 1], [bx, by] = shape[i], d = Math.hypot(bx - ax, by - ay);
        for (; passed < d; passed += 30) {
          const [x, y] = this.px(ax + (bx - ax) * passed / d, ay + (by - ay) * passed / d);
          if (x < 0 || y < 0 || x > this.width || y > this.height) continue;
          const ux = (bx - ax) / d, uy = -(by - ay) / d;
          context.moveTo(x - (ux + uy) * size, y - (uy - ux) * size);
          context.lineTo(x, y);
          context.lineTo(x - (ux - uy) * size, y - (uy + ux) * size);
        }
        passed -= d;
      }
    }
    context.stroke();
  }
  drawPoints(context) {
    const v = state.view, t = state.theme, size = clamp(1.1 * v.scale, 2.2, 6);
    if (this.run.network.zones.length > 200 && v.scale < 0.5) return;
    context.lineWidth = 1.3;
    for (const zone of this.run.network.zones) for (const point of zone.points) {
      if (!point.place) continue;
      const [x, y] = this.px(...point.place);
      if (x < -20 || y < -20 || x > this.width + 20 || y > this.height + 20) continue;
      context.beginPath();
      if (point.kind === "merge") { context.moveTo(x, y - size); context.lineTo(x + size, y); context.lineTo(x, y + size); context.lineTo(x - size, y); context.closePath(); }
      else context.arc(x, y, size * 0.8, 0, 7);
      context.fillStyle = t.pane;
      context.fill();
      context.strokeStyle = t.quiet;
      context.stroke();
      if (v.scale > 5) { context.fillStyle = t.quiet; context.font = "11px system-ui, 'DejaVu Sans', sans-serif"; context.textAlign = "left"; written(context, point.name, x + size + 3, y - size); context.lineWidth = 1.3; }
    }
  }
  drawNames(context) {
    const { zones } = this.run.network, v = state.view;
    this.taken = [];
    if (zones.length > 40 && v.scale < 1) return;
    context.textAlign = "center";
    context.fillStyle = state.theme.quiet;
    context.font = "11px system-ui, 'DejaVu Sans', sans-serif";
    if (zones.length <= 40) {
      for (const zone of zones) for (const segment of zone.segments) {
        if (segment.road) this.label(context, segment.road, segment.shape[0], segment.shape[1]);
      }
      // Where exits crowd around the middle of a zone their names would hide it.
      zones.forEach((zone, i) => {
        const [mx, my] = this.px(...this.run.geometry.middles[i]);
        for (const exit of zone.exits) {
          const [x, y] = this.px(...exit.place);
          if (exit.to === null && Math.hypot(x - mx, y - my) > 70) this.label(context, exit.name, exit.place, exit.place);
        }
      });
    }
    context.font = "600 12px system-ui, 'DejaVu Sans', sans-serif";
    if (zones.length > 1) zones.forEach((zone, i) => this.label(context, zone.name, this.run.geometry.middles[i], null));
  }
  // A name beside a place, pushed outward along the lane, unless another is there already.
  label(context, text, place, onward) {
    const [x, y] = this.px(...place), half = context.measureText(text).width / 2 + 4;
    // Below a lane that lies flat: numbers of vehicles are above.
    let [dx, dy] = [0, onward ? 1 : -1];
    if (onward && onward !== place) {
      const [ox, oy] = this.px(...onward), d = Math.hypot(ox - x, oy - y) || 1;
      if (Math.abs(oy - y) > Math.abs(ox - x)) [dx, dy] = [(x - ox) / d, (y - oy) / d];
    }
    const lx = clamp(x + dx * 14, half + 4, this.width - half - 4), ly = clamp(y + (dy > 0.5 ? 18 : dy * 12), 36, this.height - 10);
    const isOut = x < -20 || y < -20 || x > this.width + 20 || y > this.height + 20;
    if (isOut || this.taken.some(([tx, ty, th]) => Math.abs(tx - lx) < th + half && Math.abs(ty - ly) < 14)) return;
    this.taken.push([lx, ly, half]);
    written(context, text, lx, ly);
  }
  // Where everybody is at the instant that is shown.
  placeVehicles() {
    const { frame, next, run, shown } = this, v = state.view;
    shown.begin(frame?.count ?? 0);
    if (!frame) return;
    const since = Math.max(0, state.time - frame.step), share = next ? Math.min(1, since / (next.step - frame.step)) : Math.min(1, since);
    const ahead_s = share * (next ? next.step - frame.step : 1) * run.dt_s;
    const [left, top] = this.world(-30, -30), [right, bottom] = this.world(this.width + 30, this.height + 30);
    const { u32, f32 } = frame, front = [0, 0], rear = [0, 0], halfWidth = this.width / 2, halfHeight = this.height / 2;
    let hint = 0;
    for (let i = 0; i < frame.count; i++) {
      const at = frame.at(i), zone = u32[at + 1], path = u32[at + 2], course = run.geometry.course(zone, path);
      if (!course) continue;
      let x = f32[at + 3], speed = f32[at + 4];
      if (share > 0) {
        const j = next ? next.find(u32[at], hint) : -1, to = j < 0 ? -1 : next.at(j);
        hint = j < 0 ? hint : j + 1;
        if (to >= 0 && next.u32[to + 1] === zone && next.u32[to + 2] === path) {
          x += share * (next.f32[to + 3] - x);
          speed += share * (next.f32[to + 4] - speed);
        } else x += ahead_s * speed;
      }
      course.locate(x, front);
      if (front[0] < left || front[0] > right || front[1] > top || front[1] < bottom) continue;
      const length = f32[at + 6];
      course.locate(x - length, rear);
      let dx = front[0] - rear[0], dy = front[1] - rear[1];
      const d = Math.hypot(dx, dy) || 1, long = Math.max(length * v.scale, 6.5);
      dx /= d; dy /= d;
      const fx = halfWidth + (front[0] - v.x) * v.scale, fy = halfHeight - (front[1] - v.y) * v.scale;
      shown.add(u32[at], fx, fy, fx - dx * long, fy + dy * long, colourOf(frame, at, speed, run.v_max_mps));
    }
  }
  drawVehicles(context) {
    const { frame, shown, run } = this, v = state.view;
    if (!frame) return;
    const { count, id, colour, front, rear, x: middleX, y: middleY } = shown, palette = state.palettes[state.colour];
    const wide = Math.max(0.95 * v.scale, 2.3), isLarge = v.scale * CAR_M > 16;
    context.lineWidth = isLarge ? 1 : 0.8;
    context.strokeStyle = isLarge ? state.theme.outline : "rgb(10 16 28 / 60%)";
    palette.forEach((fill, which) => {
      context.fillStyle = fill;
      context.beginPath();
      let isAny = false;
      for (let i = 0; i < count; i++) {
        if (colour[i] !== which) continue;
        isAny = true;
        const fx = front[2 * i], fy = front[2 * i + 1], rx = rear[2 * i], ry = rear[2 * i + 1], d = Math.hypot(fx - rx, fy - ry) || 1;
        const ox = (ry - fy) / d * wide, oy = (fx - rx) / d * wide;
        context.moveTo(fx + ox, fy + oy); context.lineTo(fx - ox, fy - oy); context.lineTo(rx - ox, ry - oy); context.lineTo(rx + ox, ry + oy);
        context.closePath();
      }
      if (!isAny) return;
      context.fill();
      if (frame.count < MANY) context.stroke();
    });
    if (isLarge) {
      // Wind screens, so that it is seen where the front is.
      context.fillStyle = "rgb(255 255 255 / 55%)";
      context.beginPath();
      for (let i = 0; i < count; i++) {
        const lx = front[2 * i] - rear[2 * i], ly = front[2 * i + 1] - rear[2 * i + 1], d = Math.hypot(lx, ly) || 1;
        const ox = -ly / d * wide * 0.78, oy = lx / d * wide * 0.78, px = front[2 * i] - 0.28 * lx, py = front[2 * i + 1] - 0.28 * ly;
        context.moveTo(px + ox, py + oy); context.lineTo(px - ox, py - oy); context.lineTo(px - ox - 0.16 * lx, py - oy - 0.16 * ly); context.lineTo(px + ox - 0.16 * lx, py + oy - 0.16 * ly);
        context.closePath();
      }
      context.fill();
    }
    if (v.scale > 2.4 && frame.count < 400) {
      // The chosen vehicle and its partners get names of their own.
      const named = new Set(state.run === run.index ? state.detail?.duties?.map(duty => duty.partner) ?? [] : []).add(state.vehicle);
      context.font = "10px system-ui, 'DejaVu Sans', sans-serif";
      context.textAlign = "center";
      context.fillStyle = state.theme.quiet;
      for (let i = 0; i < count; i++) if (!named.has(id[i])) written(context, id[i], middleX[i], middleY[i] - wide - 5);
    }
  }
  placeOf(vehicle) {
    const { count, id, x, y } = this.shown;
    for (let i = 0; i < count; i++) if (id[i] === vehicle) return [x[i], y[i]];
    return null;
  }
  drawDuties(context) {
    if (state.vehicle === null) return;
    const own = this.placeOf(state.vehicle), t = state.theme;
    if (!own) return;
    context.save();
    const isOfRun = state.run === this.run.index, duties = isOfRun && state.detail?.vehicle === state.vehicle ? state.detail.duties ?? [] : [];
    const told = new Map();
    for (const duty of duties) {
      const partner = this.placeOf(duty.partner);
      if (!partner) continue;
      const colour = t[standing(duty)], dx = partner[0] - own[0], dy = partner[1] - own[1], d = Math.hypot(dx, dy) || 1;
      // Bent aside, so that lines along a lane can be told from it and from each other.
      const times = told.get(duty.partner) ?? 0, bend = (0.16 + 0.14 * times) * Math.min(d, 320);
      told.set(duty.partner, times + 1);
      const cx = (own[0] + partner[0]) / 2 + dy / d * bend, cy = (own[1] + partner[1]) / 2 - dx / d * bend;
      context.strokeStyle = colour;
      context.lineWidth = 2;
      context.setLineDash(duty.kind === "rear end" ? [] : duty.kind === "merge" ? [7, 4] : [2, 4]);
      context.beginPath();
      context.moveTo(...own);
      context.quadraticCurveTo(cx, cy, ...partner);
      context.stroke();
      context.setLineDash([]);
      const tx = 0.25 * own[0] + 0.5 * cx + 0.25 * partner[0], ty = 0.25 * own[1] + 0.5 * cy + 0.25 * partner[1];
      const text = `${duty.kind === "rear end" ? "" : `${duty.point_name ?? duty.kind} `}${margin_m(duty.margin_m, 1)} m`;
      context.font = "600 11px system-ui, 'DejaVu Sans', sans-serif";
      const half = context.measureText(text).width / 2 + 5;
      context.fillStyle = t.pane;
      context.globalAlpha = 0.88;
      context.beginPath(); context.roundRect(tx - half, ty - 9, 2 * half, 17, 5); context.fill();
      context.globalAlpha = 1;
      context.textAlign = "center";
      context.fillStyle = colour;
      context.fillText(text, tx, ty + 4);
      this.ring(context, partner, colour, 9, duty.partner);
    }
    for (const duty of duties) {
      const point = duty.point !== null && duty.point !== undefined ? run_zone(this.run, state.detail.zone)?.points[duty.point]?.place : null;
      if (!point) continue;
      const [x, y] = this.px(...point);
      context.strokeStyle = t.ink; context.lineWidth = 1.5;
      context.beginPath(); context.arc(x, y, 8, 0, 7); context.stroke();
    }
    this.ring(context, own, t.accent, 12, state.vehicle);
    context.restore();
  }
  ring(context, [x, y], colour, size, text) {
    const radius = Math.max(size, 2.9 * state.view.scale);
    context.strokeStyle = colour;
    context.lineWidth = 2.2;
    context.beginPath(); context.arc(x, y, radius, 0, 7); context.stroke();
    context.font = "600 12px system-ui, 'DejaVu Sans', sans-serif";
    context.textAlign = "center";
    context.lineWidth = 3;
    context.strokeStyle = state.theme.pane;
    // Above: names of zones and roads are below.
    context.strokeText(text, x, y - radius - 5);
    context.fillStyle = colour;
    context.fillText(text, x, y - radius - 5);
  }
}
// Text that can be read on anything.
function written(context, text, x, y) {
  context.lineWidth = 3;
  context.lineJoin = "round";
  context.strokeStyle = state.theme.pane;
  context.strokeText(text, x, y);
  context.fillText(text, x, y);
}
const run_zone = (run, zone) => run.network.zones[zone];

function fit() {
  const all = state.maps ?? [];
  if (!all.length || !all[0].width) return;
  const low = [0, 1].map(k => Math.min(...state.runs.map(run => run.geometry.low[k])));
  const high = [0, 1].map(k => Math.max(...state.runs.map(run => run.geometry.high[k])));
  const { width, height } = all[0], scale = Math.min((width - 70) / Math.max(high[0] - low[0], 20), (height - 80) / Math.max(high[1] - low[1], 20));
  state.view = { x: (low[0] + high[0]) / 2, y: (low[1] + high[1]) / 2, scale, isFitted: true };
  state.keeps = false;
  state.dirty = true;
}
function zoom(factor, around = null) {
  const v = state.view;
  if (!v) return;
  const scale = clamp(v.scale * factor, 1e-3, 200), [x, y] = around ?? [v.x, v.y], f = v.scale / scale;
  state.view = { x: x - (x - v.x) * f, y: y - (y - v.y) * f, scale, isFitted: false };
  state.dirty = true;
}

/* ---------------------------------------------------------------- details */

const side = { key: null };
const chip = (text, colour) => el("span", { class: "chip", style: { background: colour } }, text);
const fact = (name, field, ...value) => el("tr", {}, el("td", {}, name), el("td", { "data-field": field, class: "num-left" }, ...value));
const modeColour = mode => state.palettes.mode[Math.max(0, MODES.indexOf(mode))] ?? state.theme["m-other"];
const verdictColour = text => {
  const i = text.startsWith("as wished") ? 0 : text.startsWith("braking") ? 1 : text.startsWith("bound") ? 2 : text.startsWith("infeasible") ? 3 : text.startsWith("held as") ? 5 : 4;
  return state.palettes.verdict[i];
};

function showSide() {
  const detail = state.detail, box = $("side");
  if (!detail) return;
  if (state.vehicle !== null) return showVehicle(box, detail);
  if (state.zone !== null && detail.name) return showZone(box, detail);
  if (detail.zones) showOverview(box, detail);
}
const closer = () => el("button", { title: "Nothing chosen (Esc)", "aria-label": "Close", onclick: () => select({}) }, "×");
const runName = () => state.runs.length > 1 ? el("span", { class: "quiet" }, state.runs[state.run].name) : null;

function showVehicle(box, d) {
  if (d.problem) {
    fill(box, el("div", { class: "head" }, el("h2", {}, `Vehicle ${state.vehicle}`), runName(), closer()), el("p", { class: "quiet" }, d.problem), speedCanvas());
    return drawSpeed();
  }
  const c = d.command, duties = d.duties;
  const rows = (duties ?? []).map(duty => el("tr", { "data-vehicle": duty.partner, onclick: () => select({ vehicle: duty.partner }) },
    el("td", {}, duty.kind), el("td", {}, `${duty.partner}${duty.partner_has_left ? " (left)" : ""}`),
    el("td", {}, duty.point_name === null ? "ahead" : duty.point_name), el("td", { class: "num" }, duty.to_go_m === null ? "" : fixed(duty.to_go_m, 1)),
    el("td", { class: `num ${standing(duty)}` }, margin_m(duty.margin_m, 2))));
  fill(box,
    el("div", { class: "head" }, el("h2", {}, `Vehicle ${d.vehicle}`), el("span", { class: "quiet" }, d.kind === null ? "" : `${d.kind}, ${d.length_m} m`), runName(), closer()),
    el("table", { class: "facts" },
      fact("place", "place", d.place),
      fact("position x", "x_m", `${fixed(d.x_m, 3)} m`),
      fact("speed v", "v_mps", `${fixed(d.v_mps, 3)} m/s`),
      fact("acceleration u", "u_mps2", c ? `${fixed(c.u_mps2, 4)} m/s²` : "–"),
      fact("mode", "mode", c ? chip(c.mode, modeColour(c.mode)) : "–"),
      fact("verdict", "verdict", c ? chip(c.verdict, verdictColour(c.verdict)) : "–"),
      elsewhere(d.vehicle),
      fact("entered", "entered", `${fixed(d.entry_time_s, 2)} s at ${fixed(d.entry_speed_mps, 2)} m/s`),
      fact("plans to leave", "plan", c && c.planned_exit_time_s > 0 ? `${fixed(c.planned_exit_time_s, 2)} s at ${fixed(c.planned_exit_speed_mps, 2)} m/s` : "–")),
    el("h3", {}, "Duties"),
    duties === null ? el("p", { class: "quiet" }, "not known yet") : duties.length === 0 ? el("p", { class: "quiet" }, "owes nothing to anybody") :
      el("table", { class: "rows duties" }, el("tr", {}, el("th", {}, "what"), el("th", {}, "toward"), el("th", {}, "where"), el("th", { class: "num" }, "to go [m]"), el("th", { class: "num" }, "margin [m]")), ...rows),
    el("h3", {}, "Speed, as driven and as planned"), speedCanvas(), el("p", { class: "quiet" }, "dashed: its present plan; strip: verdicts"));
  drawSpeed();
}
// The same vehicle in the other run.
function elsewhere(vehicle) {
  const other = state.maps.find(map => map.run.index !== state.run), frame = other?.frame;
  if (!frame) return null;
  const i = frame.find(vehicle), at = frame.at(i);
  const text = i < 0 ? "not there" : `x ${fixed(frame.f32[at + 3], 1)} m, v ${fixed(frame.f32[at + 4], 2)} m/s`;
  return fact(`in ${other.run.name.replace(/\.czlog$/, "")}`, "elsewhere", text);
}
const speedCanvas = () => side.canvas ??= el("canvas", { onclick: event => {
  const chart = side.chart;
  if (chart) goto(Math.round(chart.xAt(event.offsetX) / dt()));
} });

function showZone(box, d) {
  const order = d.order;
  const rows = (order ?? []).map(m => el("tr", { "data-vehicle": m.vehicle, onclick: () => select({ vehicle: m.vehicle }) },
    el("td", { class: "num" }, m.rank + 1), el("td", {}, m.vehicle), el("td", {}, m.path), el("td", { class: "num" }, fixed(m.to_go_m, 1)), el("td", { class: "num" }, fixed(m.v_mps, 2))));
  const zone = state.runs[state.run].network.zones[d.zone];
  fill(box,
    el("div", { class: "head" }, el("h2", {}, d.name), runName(), closer()),
    el("table", { class: "facts" },
      fact("vehicles N", "n", String(d.n)),
      fact("passing order", "order_kind", zone.order),
      ...d.exits.map(exit => fact(`v_m, exit ${exit.name}`, "v_m", exit.v_m === null ? "–" : exit.v_m === "free" ? "free" : `${fixed(exit.v_m, 2)} m/s`)),
      fact("paths", "paths", String(zone.paths.length)), fact("conflict points", "points", String(zone.points.length))),
    el("h3", {}, "Passing order"),
    order === null ? el("p", { class: "quiet" }, "not known yet") : order.length === 0 ? el("p", { class: "quiet" }, "nobody is in the zone") :
      el("table", { class: "rows" }, el("tr", {}, el("th", { class: "num" }, "#"), el("th", {}, "vehicle"), el("th", {}, "path"), el("th", { class: "num" }, "to go [m]"), el("th", { class: "num" }, "v [m/s]")), ...rows));
}

function showOverview(box, d) {
  const run = state.runs[state.run], frame = state.maps[state.run]?.frame, status = run.status;
  const told = exit => exit.v_m === null ? "–" : exit.v_m === "free" ? "free" : fixed(exit.v_m, 1);
  const speeds = exits => {
    const all = exits.map(told);
    return all.length <= 3 ? all.join(" · ") : [...new Set(all)].filter(text => text !== "–").join(" · ") || "–";
  };
  const rows = d.zones.map(zone => el("tr", { "data-zone": zone.zone, onclick: () => select({ zone: zone.zone }) },
    el("td", {}, zone.name), el("td", { class: "num" }, String(zone.n)), el("td", { class: "num" }, speeds(zone.exits))));
  const more = run.network.zones.length - d.zones.length;
  const differs = state.runs[1]?.status.differs_at;
  fill(box,
    el("div", { class: "head" }, el("h2", {}, run.scenario), el("span", { class: "quiet" }, `seed ${run.seed}`)),
    state.runs.length < 2 ? null : el("p", { "data-field": "differs" }, differs === null || differs === undefined ? "The states of both are the same." :
      el("button", { onclick: () => goto(differs), title: "Go there" }, `the same before ${fixed(differs * run.dt_s, 1)} s, step ${differs}`)),
    el("table", { class: "facts" },
      fact("vehicles", "present", `${frame ? frame.count : 0} now, ${status.vehicles} so far`),
      fact("step", "dt", `${run.dt_s} s`),
      fact("processes", "processes", `${run.coordinators} coordinator${run.coordinators === 1 ? "" : "s"}, ${run.controllers} controller${run.controllers === 1 ? "" : "s"}`),
      run.overrides.length ? fact("changed", "overrides", run.overrides.join(" ")) : null,
      fact("state hash", "hash", frame ? frame.hash : "–"),
      fact("written by", "build", run.build),
      status.skipped ? fact("not seen", "skipped", el("span", { class: "bad" }, `${status.skipped} steps`), status.live?.left_out_steps ? `; ${status.live.left_out_steps} the run left out to lose no time` : null) : null),
    el("h3", {}, "Zones"),
    el("table", { class: "rows" }, el("tr", {}, el("th", {}, "zone"), el("th", { class: "num" }, "N"), el("th", { class: "num" }, "v_m [m/s]")), ...rows),
    more > 0 ? el("p", { class: "quiet" }, `and ${more} more; click one on the map`) : null,
    ...eventList());
}
function eventList() {
  const run = state.runs[state.run], events = run.events ?? [];
  if (!events.length) return [];
  const near = events.filter(event => event.step <= now()).slice(-6).reverse();
  if (!near.length) return [];
  const rows = near.map(event => el("tr", { "data-vehicle": event.vehicle ?? "", onclick: () => { goto(event.step); if (event.vehicle !== null) select({ vehicle: event.vehicle }); } },
    el("td", { class: "num" }, fixed(event.step * run.dt_s, 1)), el("td", {}, event.text)));
  return [el("h3", {}, "Events up to now"), el("table", { class: "rows" }, ...rows)];
}

/* ---------------------------------------------------------------- diagrams */

function ticks(low, high, count) {
  const raw = (high - low) / Math.max(1, count), power = 10 ** Math.floor(Math.log10(raw || 1)), step = [1, 2, 5, 10].find(m => m * power >= raw) * power || 1;
  const all = [];
  for (let x = Math.ceil(low / step) * step; x <= high + 1e-9; x += step) all.push(Math.abs(x) < step * 1e-6 ? 0 : x);
  return all;
}
function prepare(canvas) {
  const { clientWidth: width, clientHeight: height } = canvas, ratio = devicePixelRatio || 1;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  context.font = "11px system-ui, 'DejaVu Sans', sans-serif";
  return { context, width, height };
}
// Axes with ticks; returns how to place things in it.
function axes(canvas, { x0, x1, y0, y1, xName = "time [s]", yName, left = 46, right = 12, top = 8, bottom = 22, rows = 4 }) {
  const { context, width, height } = prepare(canvas), t = state.theme;
  if (!(x1 > x0)) x1 = x0 + 1;
  if (!(y1 > y0)) y1 = y0 + 1;
  const w = width - left - right, h = height - top - bottom;
  const X = x => left + (x - x0) / (x1 - x0) * w, Y = y => top + h - (y - y0) / (y1 - y0) * h;
  context.strokeStyle = t.grid;
  context.fillStyle = t.quiet;
  context.lineWidth = 1;
  context.textAlign = "center";
  // The axis is named in the line of its numbers, which leave room for it.
  const isBeside = right > 60, nameWidth = context.measureText(xName).width;
  for (const x of ticks(x0, x1, clamp(w / 90, 2, 14))) {
    context.beginPath(); context.moveTo(X(x), top); context.lineTo(X(x), top + h); context.stroke();
    const text = String(+x.toPrecision(6)), end = X(x) + context.measureText(text).width / 2 + 6;
    if (isBeside || end < left + w - nameWidth) context.fillText(text, X(x), top + h + 15);
  }
  context.textAlign = "right";
  for (const y of ticks(y0, y1, rows)) {
    context.beginPath(); context.moveTo(left, Y(y)); context.lineTo(left + w, Y(y)); context.stroke();
    context.fillText(String(+y.toPrecision(6)), left - 5, Y(y) + 4);
  }
  context.textAlign = isBeside ? "left" : "right";
  context.fillText(xName, left + w + (isBeside ? 22 : 0), top + h + 15);
  context.save(); context.translate(11, top + h / 2); context.rotate(-Math.PI / 2); context.textAlign = "center"; context.fillText(yName, 0, 0); context.restore();
  const clip = () => { context.save(); context.beginPath(); context.rect(left, top, w, h); context.clip(); };
  return { context, X, Y, clip, left, top, w, h, x0, x1, y0, y1, xAt: px => x0 + (px - left) / w * (x1 - x0), yAt: py => y0 + (top + h - py) / h * (y1 - y0) };
}
function line(chart, xs, ys, colour, { width = 1.6, dash = [], leap = Infinity } = {}) {
  const { context, X, Y } = chart;
  context.strokeStyle = colour; context.lineWidth = width; context.setLineDash(dash);
  context.beginPath();
  let pen = false;
  for (let i = 0; i < xs.length; i++) {
    if (ys[i] === null || ys[i] === undefined) { pen = false; continue; }
    if (pen && Math.abs(ys[i] - ys[i - 1]) < leap) context.lineTo(X(xs[i]), Y(ys[i])); else context.moveTo(X(xs[i]), Y(ys[i]));
    pen = true;
  }
  context.stroke(); context.setLineDash([]);
}
function dots({ context, X, Y }, xs, ys, colour) {
  context.fillStyle = colour;
  for (let i = 0; i < xs.length; i++) {
    if (ys[i] === null || ys[i] === undefined) continue;
    context.beginPath(); context.arc(X(xs[i]), Y(ys[i]), 2.4, 0, 7); context.fill();
  }
}
function cursor(chart, x) {
  const { context, X, top, h } = chart;
  if (x < chart.x0 || x > chart.x1) return;
  context.strokeStyle = state.theme.accent; context.lineWidth = 1.4;
  context.beginPath(); context.moveTo(X(x), top); context.lineTo(X(x), top + h); context.stroke();
}

function drawSpeed() {
  const canvas = side.canvas, course = state.course, run = state.runs[state.run];
  if (!canvas?.isConnected || !course || !course.step.length) return;
  const seconds = course.step.map(step => step * run.dt_s), plan = state.detail?.plan ?? [];
  const x1 = Math.max(seconds[seconds.length - 1], ...plan.map(p => Math.min(p[0], seconds[seconds.length - 1] + 15)));
  const chart = axes(canvas, { x0: seconds[0], x1, y0: 0, y1: Math.max(...course.v_mps, ...plan.map(p => p[2])) * 1.1 + 0.5, yName: "v [m/s]", left: 34, bottom: 22, rows: 3 });
  side.chart = chart;
  const { context, X, top, h } = chart;
  // A piece for as long as the verdict is the same.
  for (let i = 0; i < seconds.length;) {
    let end = i + 1;
    while (end < seconds.length && course.verdict[end] === course.verdict[i]) end++;
    const from = Math.round(X(seconds[i])), to = Math.round(X(seconds[Math.min(end, seconds.length - 1)]));
    if (course.verdict[i] !== null) {
      context.fillStyle = state.palettes.verdict[Math.min(5, course.verdict[i])];
      context.fillRect(from, top + h - 5, Math.max(1, to - from), 5);
    }
    i = end;
  }
  for (const visit of course.visits.slice(1)) {
    context.strokeStyle = state.theme.ghost; context.setLineDash([2, 3]); context.lineWidth = 1;
    context.beginPath(); context.moveTo(X(visit.time_s), top); context.lineTo(X(visit.time_s), top + h); context.stroke(); context.setLineDash([]);
  }
  chart.clip();
  line(chart, seconds, course.v_mps, state.theme.ink);
  if (plan.length) line(chart, plan.map(p => p[0]), plan.map(p => p[2]), state.theme.accent, { dash: [5, 4], width: 2 });
  context.restore();
  cursor(chart, state.time * run.dt_s);
}

const PANELS = [["Time–space", drawSpaceTime], ["Margins", drawMargins], ["Traffic", drawTraffic], ["Step latency", drawLatency]];
// `version` counts what has come, `isWhole` is said by what is drawn: whether more will come by itself.
const plot = { chart: null, traces: new Map(), lines: null, version: 0, isWhole: true, key: null, kept: null };

function showTabs() {
  $("tabs").replaceChildren(...PANELS.map(([name], i) => el("button", { class: i === state.panel ? "is-on" : null, title: `${name} (${i + 1})`, onclick: () => { state.panel = i; showTabs(); } }, name)));
  const options = $("options"), run = state.runs[state.run] ?? state.runs[0];
  if (!run) return;
  if (state.panel === 0) {
    const paths = run.network.zones.slice(0, 60).flatMap((zone, z) => zone.paths.map((path, p) => [`${z},${p}`, `${zone.name}.${path.name}`]));
    state.path ??= paths[0][0];
    const spans = [[60, "1 min"], [120, "2 min"], [300, "5 min"], [0, "all"]];
    const choose = (values, value, act) => { const node = el("select", { onchange: event => act(event.target.value) }, ...values.map(([v, text]) => el("option", { value: v }, text))); node.value = value; return node; };
    const pathSelect = choose(paths, state.path, value => { state.path = value; });
    pathSelect.id = "path";
    options.replaceChildren("path", pathSelect, "span", choose(spans, state.span, value => { state.span = +value; }));
  } else if (state.panel === 1) options.replaceChildren(legend("toward leaders", "ink"), legend("at merges", "m-fe"), legend("at crossings", "m-other"), ...behind(), "least of all vehicles");
  else if (state.panel === 2) options.replaceChildren(legend("vehicles", "ink"), legend("bound by rows", "v-2"), legend("FE", "v-1"), legend("infeasible", "v-3"), ...behind());
  else options.replaceChildren(legend("longest step", "ink"), legend("controllers not in time", "m-other"));
}
const behind = () => state.runs.filter(run => run.index !== state.run).map(run => legend(run.name.replace(/\.czlog$/, ""), "ghost"));
function legend(text, name) {
  return el("span", {}, el("i", { style: { display: "inline-block", width: "14px", height: "3px", background: state.theme[name], marginRight: "5px", verticalAlign: "3px" } }), text);
}

function window_s() {
  const [first, last] = bounds(), x = state.time * dt();
  if (!state.span || (last - first) * dt() <= state.span) return [first * dt(), Math.max(last * dt(), first * dt() + 1)];
  // It moves on by a quarter at a time, and is drawn again only then.
  const jump = state.span / 4, from = clamp(Math.floor((x - state.span / 2) / jump) * jump, first * dt(), last * dt() - state.span);
  return [from, from + state.span];
}
// Traces of a zone in blocks of steps, fetched once when they are complete.
const BLOCK = 600;
function tracesOf(run, zone, from, to) {
  const all = [];
  for (let block = Math.floor(from / BLOCK); block <= Math.floor(to / BLOCK); block++) {
    const key = `${run.index} ${zone} ${block}`, end = (block + 1) * BLOCK - 1;
    let entry = plot.traces.get(key);
    const isStale = entry && !entry.isWhole && !entry.busy && (run.status.known ?? -1) > entry.known && performance.now() - entry.at > 700;
    if (!entry || isStale) {
      const known = run.status.known ?? -1;
      entry = { vehicles: entry?.vehicles ?? new Map(), known, isWhole: known >= end || run.status.is_complete, at: performance.now(), busy: true };
      plot.traces.set(key, entry);
      if (plot.traces.size > 400) plot.traces.delete(plot.traces.keys().next().value);
      const mine = entry;
      ask("traces", { run: run.index, zone, from: block * BLOCK, to: end }, "binary").then(buffer => {
        const u32 = new Uint32Array(buffer), f32 = new Float32Array(buffer), vehicles = new Map();
        for (let i = 0; i < u32.length; i += 5) {
          // A vehicle that comes again, around a circle, begins another line.
          let trace = vehicles.get(u32[i]);
          const last = trace ? trace.step.length - 1 : 0;
          if (!trace || trace.path !== u32[i + 2] || f32[i + 3] < trace.x[last] - 1) {
            if (trace) vehicles.set(`${u32[i]} until ${u32[i + 1]}`, trace);
            vehicles.set(u32[i], trace = { vehicle: u32[i], path: u32[i + 2], step: [], x: [], v: [] });
          }
          trace.step.push(u32[i + 1]); trace.x.push(f32[i + 3]); trace.v.push(f32[i + 4]);
        }
        mine.vehicles = vehicles;
        plot.version++;
      }).catch(() => plot.traces.delete(key)).finally(() => { mine.busy = false; });
    }
    plot.isWhole &&= entry.isWhole;
    all.push(entry.vehicles);
  }
  return all;
}

function drawSpaceTime(canvas) {
  const run = state.runs[state.run], [zone, path] = (state.path ?? "0,0").split(",").map(Number), shape = run.network.zones[zone], own = shape?.paths[path];
  if (!own) return null;
  const [x0, x1] = window_s(), chart = axes(canvas, { x0, x1, y0: 0, y1: own.length_m + 20, yName: "x [m]", right: 96 });
  const { context, X, Y } = chart;
  let named = Infinity;
  for (const [point, at] of own.uses.toReversed()) {
    context.strokeStyle = state.theme.ghost; context.lineWidth = 1; context.setLineDash([4, 3]);
    context.beginPath(); context.moveTo(chart.left, Y(at)); context.lineTo(chart.left + chart.w, Y(at)); context.stroke(); context.setLineDash([]);
    context.fillStyle = state.theme.quiet; context.textAlign = "left";
    if (Math.abs(Y(at) - named) < 11) continue;
    named = Y(at);
    context.fillText(`${shape.points[point].kind} ${shape.points[point].name}`.slice(0, 17), chart.left + chart.w + 5, Y(at) + 4);
  }
  // Where a place of another path is on this one: as far from the merge both pass.
  const shifts = shape.paths.map((other, p) => {
    if (p === path) return 0;
    for (const [point, at] of own.uses) if (shape.points[point].kind === "merge") {
      const theirs = other.uses.find(([q]) => q === point);
      if (theirs) return at - theirs[1];
    }
    return null;
  });
  plot.near = [];
  chart.clip();
  const bins = Array.from({ length: BINS }, () => new Path2D()), ghosts = new Path2D(), chosen = new Path2D();
  for (const vehicles of tracesOf(run, zone, Math.floor(x0 / run.dt_s), Math.ceil(x1 / run.dt_s))) for (const trace of vehicles.values()) {
    const shift = shifts[trace.path];
    if (shift === null || shift === undefined) continue;
    const isOwn = trace.path === path, n = trace.step.length, every = Math.max(1, Math.floor(n / 300));
    for (let i = every; i < n + every - 1; i += every) {
      const j = Math.min(i, n - 1), k = i - every;
      const ax = X(trace.step[k] * run.dt_s), ay = Y(trace.x[k] + shift), bx = X(trace.step[j] * run.dt_s), by = Y(trace.x[j] + shift);
      const target = trace.vehicle === state.vehicle ? chosen : isOwn ? bins[clamp(Math.round(trace.v[j] / run.v_max_mps * (BINS - 1)), 0, BINS - 1)] : ghosts;
      target.moveTo(ax, ay); target.lineTo(bx, by);
      if (isOwn && i % 4 === 0) plot.near.push(trace.vehicle, bx, by);
    }
  }
  context.lineWidth = 1.1; context.strokeStyle = state.theme.ghost; context.setLineDash([3, 3]); context.stroke(ghosts); context.setLineDash([]);
  context.lineWidth = 1.5;
  bins.forEach((bin, i) => { context.strokeStyle = RAMP_CSS[i]; context.stroke(bin); });
  context.lineWidth = 3.4; context.strokeStyle = state.theme.ink; context.stroke(chosen);
  const plan = state.vehicle !== null && state.detail?.zone === zone && state.detail?.path === path ? state.detail.plan : null;
  if (plan) { context.strokeStyle = state.theme.accent; line(chart, plan.map(p => p[0]), plan.map(p => p[1]), state.theme.accent, { width: 2, dash: [6, 4] }); }
  context.restore();
  return chart;
}
function wholeRun(yName, y0, y1, canvas, right = 12) {
  const [first, last] = bounds();
  return axes(canvas, { x0: first * dt(), x1: Math.max(last * dt(), first * dt() + 1), y0, y1, yName, right });
}
// What is drawn behind the chosen run: the same of the others, grey.
const others = () => (plot.lines ?? []).filter((_, i) => i !== state.run);
const at = lines => lines.step.map(step => step * dt());
// Another pair's margin, not a change of this one's.
const LEAP_M = 6;
const values = list => list.filter(x => x !== null && x !== undefined);
function drawMargins(canvas) {
  const all = plot.lines?.[state.run];
  if (!all) return null;
  const seen = values([...all.rear_end_m, ...all.merge_m, ...all.cross_m]);
  const chart = wholeRun("least margin [m]", clamp(Math.min(-2, ...seen), -15, 0), 20, canvas), seconds = at(all);
  chart.clip();
  const { context, Y } = chart;
  context.fillStyle = state.theme.bad; context.globalAlpha = 0.09; context.fillRect(chart.left, Y(0), chart.w, chart.h); context.globalAlpha = 1;
  for (const other of others()) line(chart, at(other), other.rear_end_m, state.theme.ghost, { width: 1.2, leap: LEAP_M });
  line(chart, seconds, all.rear_end_m, state.theme.ink, { width: 1.2, leap: LEAP_M });
  dots(chart, seconds, all.cross_m, state.theme["m-other"]);
  dots(chart, seconds, all.merge_m, state.theme["m-fe"]);
  context.strokeStyle = state.theme.bad; context.lineWidth = 1; context.beginPath(); context.moveTo(chart.left, Y(0)); context.lineTo(chart.left + chart.w, Y(0)); context.stroke();
  context.restore();
  return chart;
}
function drawTraffic(canvas) {
  const all = plot.lines?.[state.run];
  if (!all) return null;
  const most = Math.max(4, ...plot.lines.flatMap(lines => lines.vehicles));
  const chart = wholeRun("vehicles", 0, most * 1.08, canvas), seconds = at(all);
  chart.clip();
  for (const other of others()) line(chart, at(other), other.vehicles, state.theme.ghost, { width: 2 });
  line(chart, seconds, all.bound, state.theme["v-2"]);
  line(chart, seconds, all.fe, state.theme["v-1"]);
  line(chart, seconds, all.infeasible, state.theme["v-3"]);
  line(chart, seconds, all.vehicles, state.theme.ink, { width: 2 });
  chart.context.restore();
  return chart;
}
function drawLatency(canvas) {
  const all = plot.lines?.[state.run];
  if (!all) return null;
  const times = all.latencies, longest = times ? Math.max(10, ...times.map(p => p[1])) : 1;
  const chart = wholeRun("step [µs]", 0, longest * 1.05, canvas), { context } = chart;
  chart.clip();
  const seconds = all.step.map(step => step * dt());
  all.misses.forEach((misses, i) => {
    if (!misses) return;
    context.fillStyle = state.theme["m-other"];
    context.fillRect(chart.X(seconds[i]) - 1, chart.top, 2.5, chart.h * Math.min(1, misses / 4 + 0.2));
  });
  if (times) line(chart, times.map(p => p[0] * dt()), times.map(p => p[1]), state.theme.ink, { width: 1.1 });
  context.restore();
  if (!times) { context.fillStyle = state.theme.quiet; context.textAlign = "center"; context.fillText("A recording does not hold how long steps took; deadlines that were missed are marked.", chart.left + chart.w / 2, chart.top + 18); }
  return chart;
}
function drawPanel() {
  if ($("panels").classList.contains("is-off") || !state.runs.length) return;
  const canvas = $("plot").firstElementChild, more = plot.isWhole ? "" : Math.floor(performance.now() / 700);
  const key = [
    state.panel, canvas.clientWidth, canvas.clientHeight, devicePixelRatio, document.documentElement.dataset.theme, state.run,
    state.path, state.vehicle, state.vehicle === null ? "" : state.detail?.step, ...window_s(), plot.version, more,
    ...state.runs.flatMap(run => [run.status.first, run.status.last, run.status.known, run.status.is_complete]),
  ].join(" ");
  // But for the cursor it is what it was, mostly.
  if (key !== plot.key) {
    plot.key = key;
    plot.isWhole = true;
    plot.chart = PANELS[state.panel][1](canvas);
    plot.kept ??= document.createElement("canvas");
    plot.kept.width = canvas.width;
    plot.kept.height = canvas.height;
    if (canvas.width && canvas.height) plot.kept.getContext("2d").drawImage(canvas, 0, 0);
  } else {
    const { context } = prepare(canvas);
    if (canvas.width && canvas.height) context.drawImage(plot.kept, 0, 0, canvas.clientWidth, canvas.clientHeight);
  }
  if (plot.chart) cursor(plot.chart, state.time * dt());
}
let linesAt = 0, linesOf = "";
async function refreshLines() {
  const key = state.runs.map(run => `${run.status.known} ${run.status.is_complete}`).join(";");
  if (key === linesOf || performance.now() - linesAt < 600) return;
  linesOf = key; linesAt = performance.now();
  try {
    plot.lines = await Promise.all(state.runs.map(run => ask("lines", { run: run.index, bins: 900 })));
    for (const run of state.runs) if (run.status.events !== run.events?.length) run.events = (await ask("events", { run: run.index })).events;
    drawTicks();
    plot.version++;
    state.dirty = true;
  } catch { linesOf = ""; }
}

// The time line: how many vehicles, and what happened.
function drawTicks() {
  const { context, width, height } = prepare($("ticks")), [first, last] = bounds(), X = step => 8 + (step - first) / Math.max(1, last - first) * (width - 16);
  const all = plot.lines?.[0];
  if (all && all.step.length) {
    const most = Math.max(1, ...all.vehicles);
    context.fillStyle = state.theme.line;
    context.beginPath();
    context.moveTo(X(all.step[0]), height);
    all.step.forEach((step, i) => context.lineTo(X(step), height - all.vehicles[i] / most * (height - 4)));
    context.lineTo(X(all.step[all.step.length - 1]), height);
    context.fill();
  }
  for (const run of state.runs) for (const event of run.events ?? []) {
    context.fillStyle = css(EVENTS[event.kind]);
    context.fillRect(X(event.step) - 1, 2, 2, event.kind === "infeasible" ? 9 : height - 4);
  }
}

/* ---------------------------------------------------------------- the loop */

let lastTick = 0, frames = 0, since = 0, lastPanel = 0;
function tick(at) {
  requestAnimationFrame(tick);
  const passed = clamp((at - lastTick) / 1000, 0, 0.25);
  lastTick = at;
  const [first, last] = bounds();
  if (state.follows) {
    // A little behind the newest step, so that there is always one to move on to.
    const target = Math.max(first, last - 1), away = target - state.time;
    state.time = Math.abs(away) > 200 ? target : clamp(state.time + away * Math.min(1, passed * 5), first, Math.max(first, last));
  } else if (state.playing) {
    const waits = state.maps.some(map => map.waits);
    if (!waits) state.time = Math.min(last, state.time + passed * state.rate / dt());
    if (state.time >= last && !state.runs.some(run => run.status.live && !run.status.live.is_over)) pause();
  }
  const step = now(), ahead = state.playing || state.follows ? clamp(Math.ceil(state.rate / dt()), 2, 60) : 1;
  for (const map of state.maps) {
    const { frames: steps, status } = map.run;
    if (status.first === null || status.first === undefined) continue;
    const own = clamp(step, status.first, status.last);
    steps.want(own, ahead);
    const [before, after] = steps.around(own), frame = before ?? (steps.absent.has(own) ? map.frame : null);
    map.waits = !frame;
    const next = own === step ? after : null;
    if (frame && (frame !== map.frame || next !== map.next)) { map.frame = frame; map.next = next; state.dirty = true; }
  }
  if (state.keeps) keep();
  if (state.dirty || state.time !== state.shownTime) {
    state.dirty = false;
    state.shownTime = state.time;
    for (const map of state.maps) map.draw();
    state.drawn++;
    frames++;
    showClock();
    if (at - lastPanel > (state.playing || state.follows ? 80 : 0)) { lastPanel = at; drawPanel(); drawSpeed(); }
  } else if (at - lastPanel > 500) { lastPanel = at; drawPanel(); }
  if (at - since > 1000) { state.fps = frames * 1000 / (at - since); frames = 0; since = at; }
  refreshDetail();
}
function keep() {
  const map = state.maps[state.run], place = map?.placeOf(state.vehicle);
  if (!place) return;
  const [x, y] = map.world(...place);
  state.view = { ...state.view, x, y, isFitted: false };
}
// Whether this is news: what the page says already is not put there again sixty times a second.
const saidOf = new Map();
function told(what, text) {
  if (saidOf.get(what) === text) return false;
  saidOf.set(what, text);
  return true;
}
function showClock() {
  const step = now();
  const instant = `${(state.time * dt()).toFixed(1)} s`;
  if (told("clock", `${instant} ${step}`)) $("clock").replaceChildren(el("b", {}, instant), ` step ${step}`);
  const scrub = $("scrub"), [first, last] = bounds();
  if (told("range", `${first} ${last}`)) { scrub.min = first; scrub.max = last; }
  if (document.activeElement !== scrub || state.playing || state.follows) { if (told("scrub", `${step} ${first} ${last}`) || +scrub.value !== step) scrub.value = step; }
  if (told("play", state.playing)) $("play").textContent = state.playing ? "❚❚" : "▶";
  $("follow").classList.toggle("is-on", state.follows);
  for (const map of state.maps) {
    const text = `${map.frame?.count ?? 0} vehicles`;
    if (told(`map ${map.run.index}`, text)) map.name.replaceChildren(state.runs.length > 1 ? map.run.name : map.run.scenario, el("span", {}, text));
  }
  const set = (field, text) => { const cell = document.querySelector(`#side [data-field=${field}]`); if (cell && text) cell.textContent = text; };
  const own = state.maps[state.run]?.frame;
  if (own && state.vehicle === null && state.zone === null) {
    set("present", `${own.count} now, ${state.runs[state.run].status.vehicles} so far`);
    set("hash", own.hash);
  }
}

/* ---------------------------------------------------------------- the run */

async function refreshStatus() {
  try {
    const all = await ask("status");
    all.forEach((status, i) => {
      const run = state.runs[i], before = run.status;
      run.status = status;
      if (before.last !== status.last || before.known !== status.known) state.dirty = true;
    });
    showStatus();
    refreshLines();
    if (state.vehicle !== null && state.runs[state.run].status.live?.is_over === false && performance.now() - (state.course?.at ?? 0) > 1000) fetchCourse();
    if (state.vehicle !== null && !state.course) fetchCourse();
  } catch { showBadge("no answer", "warn"); }
  const goesOn = state.runs.some(run => !run.status.is_complete);
  setTimeout(refreshStatus, goesOn ? 150 : 1500);
}
function showBadge(text, kind = "") {
  const badge = $("badge");
  badge.hidden = !text;
  badge.textContent = text;
  badge.className = `badge ${kind}`;
}
function showStatus() {
  const run = state.runs[0], live = run.status.live;
  if (live) {
    const skipped = run.status.skipped ? `, ${run.status.skipped} steps not seen` : "";
    showBadge((live.is_over ? "over" : live.is_paused ? "paused" : "live") + skipped, live.is_over ? "over" : run.status.skipped ? "warn" : "");
    $("steer").hidden = !live.is_steered || live.is_over;
    $("hold").textContent = live.is_paused ? "resume run" : "pause run";
    $("onestep").disabled = !live.is_paused;
    if (document.activeElement !== $("pace") && live.pace !== undefined) $("pace").value = String(live.pace);
  } else showBadge(state.runs.some(r => !r.status.is_complete) ? "reading" : "", "over");
  $("follow").hidden = !state.runs.some(r => r.is_live);
}
async function steer(order) {
  const response = await fetch("api/steer?run=0", { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(order) });
  if (!response.ok) showBadge((await response.text()).trim(), "warn");
}

/* ---------------------------------------------------------------- hands */

function setRate(rate) { state.rate = rate; $("speed").value = String(rate); }
function cycleColour() { const all = ["speed", "mode", "verdict"]; setColour(all[(all.indexOf(state.colour) + 1) % 3]); }
function setColour(colour) { state.colour = colour; $("colour").value = colour; showLegend(); state.dirty = true; }
function setTheme(theme) { document.documentElement.dataset.theme = theme; readTheme(); showTabs(); drawTicks(); side.key = null; showSide(); state.dirty = true; }
function nextVehicle(by) {
  const frame = state.maps[state.run]?.frame;
  if (!frame || !frame.count) return;
  const ids = Array.from({ length: frame.count }, (_, i) => frame.u32[frame.at(i)]).sort((a, b) => a - b), at = ids.indexOf(state.vehicle);
  select({ vehicle: ids[at < 0 ? 0 : (at + by + ids.length) % ids.length] });
}
function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
  const by = event.shiftKey ? 10 : 1, [first, last] = bounds();
  const act = {
    " ": play, ArrowLeft: () => goto(Math.ceil(state.time) - by), ArrowRight: () => goto(now() + by), Home: () => goto(first),
    End: () => { if (state.runs.some(r => r.is_live)) setTime(last, true); else goto(last); },
    "[": () => setRate(RATES[Math.max(0, RATES.indexOf(state.rate) - 1)]), "]": () => setRate(RATES[Math.min(RATES.length - 1, RATES.indexOf(state.rate) + 1)]),
    "+": () => zoom(1.5), "=": () => zoom(1.5), "-": () => zoom(1 / 1.5), 0: fit, c: cycleColour, d: toggleTheme, Escape: () => select({}),
    n: () => nextVehicle(1), b: () => nextVehicle(-1), f: () => { state.keeps = state.vehicle !== null && !state.keeps; if (state.keeps && state.view.scale < 4) zoom(4 / state.view.scale); },
    p: () => { $("panels").classList.toggle("is-off"); }, "?": () => $("help").showModal(),
    1: () => panel(0), 2: () => panel(1), 3: () => panel(2), 4: () => panel(3),
  }[event.key];
  if (!act || (event.target.tagName === "BUTTON" && event.key === " ") || $("help").open) return;
  event.preventDefault();
  act();
}
function panel(i) { state.panel = i; $("panels").classList.remove("is-off"); showTabs(); state.dirty = true; }
function toggleTheme() {
  const theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  setTheme(theme);
  try { localStorage.setItem("theme", theme); } catch { /* nothing is kept then */ }
}
function hands() {
  $("play").onclick = play;
  $("back").onclick = () => goto(Math.ceil(state.time) - 1);
  $("forth").onclick = () => goto(now() + 1);
  $("follow").onclick = () => { if (state.follows) state.follows = false; else setTime(bounds()[1], true); };
  $("scrub").oninput = event => goto(+event.target.value);
  $("speed").append(...RATES.map(rate => el("option", { value: rate }, `${rate}×`)));
  $("speed").onchange = event => setRate(+event.target.value);
  $("pace").append(...[[0, "as fast as it can"], [0.25, "¼ of real time"], [0.5, "½ of real time"], [1, "real time"], [2, "2× real time"], [5, "5× real time"], [20, "20× real time"]].map(([v, text]) => el("option", { value: v }, text)));
  $("pace").onchange = event => steer({ pace: +event.target.value });
  $("hold").onclick = () => steer(state.runs[0].status.live?.is_paused ? "resume" : "pause");
  $("onestep").onclick = () => steer({ step: 1 });
  $("colour").onchange = event => setColour(event.target.value);
  $("theme").onclick = toggleTheme;
  $("keys").onclick = () => $("help").showModal();
  addEventListener("keydown", onKey);
  const canvas = $("plot").firstElementChild, tip = $("tip");
  canvas.onmousemove = event => {
    const chart = plot.chart, all = plot.lines?.[state.run];
    if (!chart) return;
    const x = chart.xAt(event.offsetX);
    let text = `${x.toFixed(1)} s`;
    if (state.panel === 0) { const vehicle = nearest(event); text += vehicle === null ? ` · ${chart.yAt(event.offsetY).toFixed(0)} m` : `\nvehicle ${vehicle}`; }
    else if (all && all.step.length) {
      const i = clamp(all.step.findIndex(step => step * dt() >= x), 0, all.step.length - 1);
      if (state.panel === 1) text += `\nleader ${fixed(all.rear_end_m[i], 2)} m (vehicle ${all.rear_end_of[i] ?? "–"})\nmerge ${fixed(all.merge_m[i], 2)} m\ncrossing ${fixed(all.cross_m[i], 2)} m`;
      if (state.panel === 2) text += `\n${all.vehicles[i]} vehicles\n${all.bound[i]} bound, ${all.fe[i]} FE, ${all.infeasible[i]} infeasible`;
    }
    tip.hidden = false;
    tip.textContent = text;
    tip.style.left = `${clamp(event.offsetX + 14, 0, canvas.clientWidth - 190)}px`;
    tip.style.top = `${Math.max(4, event.offsetY - 50)}px`;
  };
  canvas.onmouseleave = () => { tip.hidden = true; };
  canvas.onclick = event => {
    const chart = plot.chart;
    if (!chart) return;
    const vehicle = state.panel === 0 ? nearest(event) : null, all = plot.lines?.[state.run];
    goto(Math.round(chart.xAt(event.offsetX) / dt()));
    if (vehicle !== null) select({ vehicle });
    else if (state.panel === 1 && all) {
      const i = clamp(all.step.findIndex(step => step >= now()) , 0, all.step.length - 1);
      if (all.rear_end_of[i] !== null) select({ vehicle: all.rear_end_of[i] });
    }
  };
}
function nearest(event) {
  let best = null, least = 12 ** 2;
  for (let i = 0; i < (plot.near?.length ?? 0); i += 3) {
    const d = (plot.near[i + 1] - event.offsetX) ** 2 + (plot.near[i + 2] - event.offsetY) ** 2;
    if (d < least) { least = d; best = plot.near[i]; }
  }
  return best;
}

/* ---------------------------------------------------------------- begin */

async function begin() {
  let theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
  try { theme = localStorage.getItem("theme") ?? theme; } catch { /* then what the system says */ }
  document.documentElement.dataset.theme = theme;
  const [runs, status] = await Promise.all([ask("runs"), ask("status")]);
  state.runs = runs.map((run, index) => {
    const whole = { ...run, index, status: status[index], geometry: new Geometry(run.network) };
    whole.frames = new Frames(whole);
    return whole;
  });
  readTheme();
  state.maps = state.runs.map(run => new CzMap(run));
  const { low, high } = state.runs[0].geometry, isWide = high[0] - low[0] > 2.2 * (high[1] - low[1]);
  $("maps").className = state.runs.length > 1 ? isWide ? "stacked" : "across" : "";
  $("maps").replaceChildren(...state.maps.map(map => map.box));
  const run = state.runs[0];
  document.title = `${run.scenario} – Control Zones`;
  $("title").textContent = state.runs.length > 1 ? `${run.name} and ${state.runs[1].name}` : run.name;
  $("facts").textContent = `${run.scenario}, seed ${run.seed}, ${run.network.zones.length} zone${run.network.zones.length === 1 ? "" : "s"}`;
  hands();
  setRate(1);
  const [first, last] = bounds(), isLive = state.runs.some(r => r.is_live);
  setTime(isLive ? last : first, isLive);
  if (!isLive) state.playing = true;
  showTabs();
  showStatus();
  requestAnimationFrame(tick);
  refreshStatus();
  ask("begin").catch(() => {});
}
begin().catch(error => { document.body.textContent = `Cannot be shown: ${error.message}`; });

// For tests and pictures.
window.view = { state, goto, select, setTheme, setColour, panel, play, fit, zoom, placeOf: vehicle => state.maps[state.run].placeOf(vehicle) };
