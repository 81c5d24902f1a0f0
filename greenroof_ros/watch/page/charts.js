// The charts: levels, pump, rain over one time axis. Times are those of the site, as if they were
// UTC: a reader's browser may stand elsewhere.

const HOUR = 3600_000;
const AHEAD = 12; // hours
// What an axis and its title take (px), so that all charts have the same time above one another.
const AXIS = 44;
const TITLE = 14;
const FEWEST = 60_000; // ms: what a zoom shows at least

// What each chart shows: its lines, by the names of the series, on the axis of the one that 'shown'
// names; those with 'right' have an axis of their own. 'steps' hold from a time until the next. A 'range'
// is that of the stretch that ends at the time of its row ('past'), or of the step that begins there.
const CHARTS = [
  {
    key: "roof", shown: "roof", title: "Roof level", height: 170, marks: ["target"], band: true,
    lines: [
      { name: "roof", label: "measured", colour: "--roof", range: "past" },
      { name: "roof_expected", label: "was expected an hour before", colour: "--roof", dash: [2, 3] },
      { name: "roof_planned", label: "expected by the controller", colour: "--roof", dash: [6, 4] },
    ],
  },
  {
    key: "cistern", shown: "cistern", title: "Cistern level", height: 120, marks: ["suction", "low_outlet", "outlet"],
    lines: [{ name: "cistern", label: "measured", colour: "--cistern", range: "past" }],
  },
  {
    key: "pump", shown: "flow", title: "Pump", height: 140, zero: true,
    right: "command", rightColour: "--command",
    lines: [
      { name: "flow", label: "flow", colour: "--flow", steps: true, range: "past", rangeLabel: "its range" },
      { name: "plan", label: "flow planned", colour: "--flow", steps: true, dash: [6, 4] },
      { name: "command", label: "command", colour: "--command", steps: true, right: true, dash: [2, 2] },
    ],
  },
  {
    key: "rain", shown: "rain", title: "Rain and evapotranspiration", height: 140, zero: true,
    right: "evapotranspiration", rightColour: "--evapotranspiration",
    lines: [
      { name: "rain", label: "rain", colour: "--rain", fill: "--rain-fill", steps: true },
      { name: "forecast", label: "rain forecast", colour: "--rain", steps: true, dash: [6, 4], range: "step", rangeLabel: "its range" },
      { name: "evapotranspiration", label: "evapotranspiration", colour: "--evapotranspiration", steps: true, right: true, dash: [10, 3, 2, 3] },
    ],
  },
];
const MARKS = { target: "target", suction: "suction level", low_outlet: "low outlet", outlet: "outlet" };

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const two = (number) => String(number).padStart(2, "0");
const atText = (ms) => {
  const at = new Date(ms);
  return `${at.getUTCFullYear()}-${two(at.getUTCMonth() + 1)}-${two(at.getUTCDate())} `
    + `${two(at.getUTCHours())}:${two(at.getUTCMinutes())}:${two(at.getUTCSeconds())}`;
};

export const element = (tag, name, text) => {
  const made = document.createElement(tag);
  if (name) made.className = name;
  if (text !== undefined) made.textContent = text;
  return made;
};

// The rows of a line's range.
const rangeOf = (line) => (line.range === "past" ? `${line.name}_range` : line.name);

// A short piece of a line, as in the chart.
const swatch = (line) => {
  const space = "http://www.w3.org/2000/svg";
  const drawn = document.createElementNS(space, "svg");
  drawn.setAttribute("class", "swatch");
  drawn.setAttribute("viewBox", "0 0 30 12");
  drawn.setAttribute("aria-hidden", "true");
  if (line.block) {
    const block = document.createElementNS(space, "rect");
    block.setAttribute("width", "30");
    block.setAttribute("height", "12");
    block.setAttribute("fill", colour(line.block));
    block.setAttribute("fill-opacity", "0.3");
    drawn.append(block);
    return drawn;
  }
  const stroke = document.createElementNS(space, "line");
  const set = { x1: 0, x2: 30, y1: 6, y2: 6, stroke: colour(line.colour), "stroke-width": 2.5 };
  if (line.dash) set["stroke-dasharray"] = line.dash.join(" ");
  for (const [key, value] of Object.entries(set)) stroke.setAttribute(key, value);
  drawn.append(stroke);
  return drawn;
};

// Where the lines and words of some references stand on an axis, from the lowest on: beyond its ends in
// one line together, and between two lines that are near to one another each word on its own side.
const placed = (named, unit, low, high, height) => {
  const beyond = (some, v, arrow) => some.length
    ? [{ v, inside: false, above: v === high, text: `${some.map(({ text }) => text).join(", ")} ${unit} ${arrow}` }] : [];
  const inside = named.filter(({ value }) => low <= value && value <= high);
  const word = (16 / height) * (high - low);
  return [
    ...beyond(named.filter(({ value }) => value < low), low, "↓"),
    ...inside.map(({ value, text }, i) => ({
      v: value, inside: true, text: `${text} ${unit}`,
      above: value > high - 0.1 * (high - low) || inside[i + 1]?.value - value < word,
    })),
    ...beyond(named.filter(({ value }) => value > high), high, "↑"),
  ];
};

// Times of an axis: the day at midnight, else the time.
const CLOCK = "utcFormat(datum.value, utchours(datum.value) + utcminutes(datum.value) + utcseconds(datum.value) === 0"
  + " ? '%a %d %b' : utcseconds(datum.value) ? '%H:%M:%S' : '%H:%M')";

const x = (field = "t") => ({
  field, type: "temporal", title: null,
  scale: { type: "utc", domain: { signal: "[from, to]" }, nice: false },
  axis: { labelOverlap: true, tickCount: { expr: "max(3, floor(width / 110))" }, labelFlush: true, labelExpr: CLOCK },
});

// The specification of a chart, without data: those are given with each series.
const specification = (chart, units) => {
  const axis = (right) => ({
    title: right ? units(chart.right).title : units(chart.shown).title,
    orient: right ? "right" : "left", tickCount: chart.height > 150 ? 5 : 4, minExtent: AXIS, maxExtent: AXIS, format: "~f",
    ...(right ? { grid: false, titleColor: colour(chart.rightColour), labelColor: colour(chart.rightColour) } : {}),
  });
  const y = (line, field = "v") => ({
    field, type: "quantitative",
    scale: { domain: { signal: line?.right ? "[rightLow, rightHigh]" : "[low, high]" }, nice: false, zero: false },
    axis: axis(line?.right),
  });
  const data = (name) => ({ name });
  const left = [{
    data: data("now"), mark: { type: "rect", color: colour("--ahead"), clip: true },
    encoding: { x: x("t"), x2: { field: "end" } },
  }];
  if (chart.band) {
    left.push({
      data: data("band"), mark: { type: "rect", color: colour("--band"), opacity: 0.18, clip: true },
      encoding: { y: y(null, "low"), y2: { field: "high" } },
    });
  }
  const right = [];
  for (const line of chart.lines) {
    const layers = line.right ? right : left;
    const interpolate = line.steps ? "step-after" : "linear";
    if (line.range) {
      layers.push({
        data: data(rangeOf(line)),
        mark: {
          type: "area", color: colour(line.fill ?? line.colour), opacity: 0.3, clip: true,
          interpolate: line.range === "past" ? "linear" : "step-after",
        },
        encoding: { x: x(), y: y(line, "low"), y2: { field: "high" } },
      });
    }
    if (line.fill) {
      layers.push({
        data: data(line.name),
        mark: { type: "area", color: colour(line.fill), opacity: 0.45, interpolate, clip: true },
        encoding: { x: x(), y: { ...y(line), stack: null } },
      });
    }
    layers.push({
      data: data(line.name),
      mark: {
        type: "line", color: colour(line.colour), strokeWidth: 2.2, interpolate, clip: true,
        ...(line.dash ? { strokeDash: line.dash } : {}),
      },
      encoding: { x: x(), y: y(line) },
    });
  }
  if (chart.marks) {
    left.push(
      {
        data: data("marks"), mark: { type: "rule", color: colour("--reference"), strokeDash: [3, 2] },
        transform: [{ filter: "datum.inside" }], encoding: { y: y(null) },
      },
      {
        data: data("marks"),
        mark: { type: "text", align: "left", dx: 4, color: colour("--reference"), fontSize: 12,
          baseline: { expr: "datum.above ? 'top' : 'bottom'" }, dy: { expr: "datum.above ? 3 : -2" } },
        encoding: { x: { value: 0 }, y: y(null), text: { field: "text", type: "nominal" } },
      },
    );
  }
  left.push({
    data: data("now"), mark: { type: "rule", color: colour("--reference"), strokeWidth: 1.5, clip: true },
    encoding: { x: x() },
  });
  const names = ["now", "band", "marks", ...chart.lines.flatMap((line) => [line.name, rangeOf(line)])];
  return {
    $schema: "https://vega.github.io/schema/vega-lite/v6.json",
    width: "container", height: chart.height, autosize: { type: "fit-x", contains: "padding" },
    padding: { left: 4, right: chart.right ? 8 : 8 + AXIS + TITLE, top: 6, bottom: 4 },
    params: ["from", "to", "low", "high", "rightLow", "rightHigh"].map((name, i) => ({ name, value: i % 2 })),
    datasets: Object.fromEntries(names.map((name) => [name, []])),
    layer: right.length ? [{ layer: left }, { layer: right }] : left,
    resolve: right.length ? { scale: { y: "independent" } } : {},
    config: {
      mark: { invalid: "break-paths-show-domains" }, // a line has none in a gap
      font: "Arial, Helvetica, sans-serif", background: null, view: { stroke: colour("--edge") },
      axis: {
        labelFontSize: 12, titleFontSize: 12, titleFontWeight: "normal", labelColor: colour("--ink"),
        titleColor: colour("--ink"), titlePadding: 2, gridColor: colour("--grid"), domainColor: colour("--edge"), tickColor: colour("--edge"),
      },
    },
  };
};

export class Charts {
  // 'box' takes the charts; 'changed' is called when the zoom has changed, 'speak' with what a
  // reader of the page cannot see.
  constructor(box, changed, speak) {
    this.box = box;
    this.changed = changed;
    this.speak = speak;
    this.hours = 12;
    this.zoomed = null;
    this.paused = false;
    this.drawing = null;
    this.series = null;
    this.rows = null;
    this.views = new Map();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.rebuild());
    let waiting;
    addEventListener("resize", () => {
      clearTimeout(waiting);
      waiting = setTimeout(() => this.views.forEach(({ view }) => view.resize().runAsync()), 150);
    });
  }

  get time() { return this.series && this.ms(this.series.now); }

  ms(seconds) { return (seconds + this.offset * 3600) * 1000; }

  units(name) {
    const { unit, factor, decimals, label } = this.series.display[name];
    return { unit, factor, decimals, title: unit ? `${label} (${unit})` : label };
  }

  // A new series: drawn at once, or kept while a reader has paused.
  async take(series, offset) {
    this.waiting = { series, offset };
    if (this.paused || this.building) return;
    await this.drawWaiting();
  }

  async drawWaiting() {
    if (!this.waiting || this.waiting.series.now === null) return;
    ({ series: this.series, offset: this.offset } = this.waiting);
    this.waiting = null;
    this.rows = this.rowsOf(this.series);
    if (!this.views.size) await this.rebuild();
    else await this.draw();
  }

  async rebuild() {
    if (!this.series || this.building) return;
    this.building = true;
    try {
      await import("/vega.js");
      this.views.forEach(({ view }) => view.finalize());
      this.views.clear();
      this.box.replaceChildren();
      for (const chart of CHARTS) await this.build(chart);
    } finally {
      this.building = false;
    }
    await this.draw();
  }

  async build(chart) {
    const part = element("section");
    const head = element("div", "head");
    head.append(element("h3", "", chart.title));
    for (const line of chart.lines) {
      const entry = element("span", "", line.label);
      entry.dataset.line = line.name;
      entry.prepend(swatch(line));
      head.append(entry);
      if (line.rangeLabel) {
        const range = element("span", "", line.rangeLabel);
        range.dataset.line = line.name;
        range.dataset.range = "";
        range.prepend(swatch({ block: line.colour }));
        head.append(range);
      }
    }
    if (chart.band) {
      const band = element("span", "", "good");
      band.dataset.line = "band";
      band.prepend(swatch({ block: "--band" }));
      head.append(band);
    }
    const frame = element("div", "frame");
    frame.tabIndex = 0;
    frame.setAttribute("role", "application");
    frame.setAttribute("aria-label", `${chart.title} over time. Arrow keys move, plus and minus zoom, Escape shows the whole time.`);
    const place = element("div", "view");
    const tip = element("div", "tip");
    tip.hidden = true;
    const cursor = element("div", "cursor");
    const drawn = element("div", "drawn");
    cursor.hidden = drawn.hidden = true;
    frame.append(place, drawn, cursor, tip);
    part.append(head, frame);
    this.box.append(part);
    const { view } = await window.vegaEmbed(place, specification(chart, (name) => this.units(name)), {
      mode: "vega-lite", ast: true, actions: false, renderer: "canvas", defaultStyle: false, tooltip: false,
      hover: false,
    });
    this.views.set(chart.key, { chart, view, frame, tip, cursor, drawn, head });
    this.listen(frame, view);
  }

  // Series as the charts' rows: SI units become the shown ones, and what ends has a row there.
  rowsOf(series) {
    const rows = {};
    const now = this.ms(series.now);
    const factor = (name) => this.units(name).factor;
    for (const chart of CHARTS) {
      for (const line of chart.lines) {
        const f = factor(line.right ? chart.right : chart.shown);
        const points = series.lines[line.name] ?? [];
        rows[line.name] = broken(points.map(([t, low, high, last]) => ({
          t: this.ms(t), ...(last === null ? NOTHING : { v: last * f, low: low * f, high: high * f }),
        })), series.gaps[line.name] * 1000, line.steps, now);
        if (line.range === "past") rows[rangeOf(line)] = beyond(rows[line.name], line.steps);
      }
    }
    const level = factor("roof");
    const flow = factor("flow");
    const rain = factor("rain");
    const plan = series.plan.filter(([, end]) => end > series.now);
    rows.plan = steps(plan.map(([t0, t1, one]) => [this.ms(Math.max(t0, series.now)), this.ms(t1), { v: one * flow }]));
    const ahead = plan.map(([, t1, , value]) => ({ t: this.ms(t1), v: value * level }));
    if (ahead.length) {
      const newest = rows.roof.at(-1);
      if (newest && now - newest.t <= series.gaps.roof * 1000) rows.roof_planned.push({ t: newest.t, v: newest.v });
      rows.roof_planned.push(...ahead);
    }
    const expected = series.forecast.filter(([, end]) => end > series.now);
    rows.forecast = steps(expected.map(([t0, t1, mean, low, high]) => [
      this.ms(Math.max(t0, series.now)), this.ms(t1), { v: mean * rain, low: low * rain, high: high * rain },
    ]));
    return rows;
  }

  // From the first value, or as far back as was chosen, to the end of what lies ahead.
  whole() {
    const { now, from } = this.series;
    const lines = Object.values(this.rows);
    const first = Math.min(...lines.map((rows) => rows[0]?.t ?? Infinity));
    const last = Math.max(...lines.map((rows) => rows.at(-1)?.t ?? -Infinity));
    const start = Math.max(this.ms(from), Math.min(first, this.ms(now)));
    const end = Math.min(last, this.ms(now) + Math.min(AHEAD, this.hours) * HOUR);
    return [start, Math.max(end, this.ms(now), start + FEWEST)];
  }

  // The range of an axis: that of what is seen, with the references that are near it.
  range(chart, right, [from, to], marks) {
    let low = Infinity;
    let high = -Infinity;
    const take = (value) => {
      if (!Number.isFinite(value)) return;
      low = Math.min(low, value);
      high = Math.max(high, value);
    };
    for (const line of chart.lines.filter((one) => Boolean(one.right) === right)) {
      const rows = this.rows[line.name];
      for (const [i, row] of rows.entries()) {
        const next = rows[i + 1]?.t ?? row.t;
        if (next < from || row.t > to) continue;
        take(row.v);
        take(row.low);
        take(row.high);
      }
    }
    if (right && chart.right === "command") [low, high] = [0, Math.max(100, high)];
    if (low > high) [low, high] = [0, 1];
    if (chart.zero) return [0, high > 0 ? high * 1.1 : 1];
    const span = Math.max(high - low, 0.02 * high, 1e-9);
    for (const value of marks) {
      if (low - 3 * span <= value && value <= high + 3 * span) take(value);
    }
    const margin = 0.12 * Math.max(high - low, span);
    return [Math.max(0, low - margin), high + margin];
  }

  async draw() {
    const whole = this.whole();
    // Of another run, or scrolled out on the left.
    if (this.zoomed && (this.zoomed[0] >= whole[1] || this.zoomed[1] <= whole[0])) this.zoomed = null;
    const seen = this.zoomed ?? whole;
    const [from, to] = seen;
    const now = this.time;
    for (const { chart, view, head } of this.views.values()) {
      const { factor, decimals, unit } = this.units(chart.shown);
      const known = this.series.marks;
      const marks = (chart.marks ?? []).filter((name) => Number.isFinite(known[name]));
      const band = chart.band && known.band ? known.band.map((one) => one * factor) : [];
      const [low, high] = this.range(chart, false, seen, [...marks.map((name) => known[name] * factor), ...band]);
      const [rightLow, rightHigh] = chart.right ? this.range(chart, true, seen, []) : [0, 1];
      const set = { from, to, low, high, rightLow, rightHigh };
      for (const [name, value] of Object.entries(set)) view.signal(name, value);
      for (const line of chart.lines) {
        for (const name of new Set([line.name, rangeOf(line)])) view.data(name, this.rows[name]);
      }
      for (const entry of head.querySelectorAll("[data-line]")) {
        const { line, range } = entry.dataset;
        const rows = this.rows[range === undefined ? line : rangeOf(chart.lines.find(({ name }) => name === line))];
        entry.hidden = line === "band" ? !band.length
          : range === undefined ? !rows.length : !rows.some((row) => row.high > row.low);
      }
      view.data("now", [{ t: now, end: Math.max(to, now) }]);
      if (chart.band) view.data("band", band.length ? [{ low: Math.max(low, band[0]), high: Math.min(high, band[1]) }] : []);
      if (chart.marks) {
        const named = marks.map((name) => {
          const value = known[name] * factor;
          return { value, text: `${MARKS[name]} ${value.toFixed(decimals)}` };
        });
        view.data("marks", placed(named, unit, low, high, chart.height));
      }
    }
    await Promise.all([...this.views.values()].map(({ view }) => view.runAsync()));
    if (this.pointed) this.point(this.pointed.key, this.pointed.t);
    this.changed();
  }

  setHours(hours) {
    this.hours = hours;
    this.zoomed = null;
  }

  pause(paused) {
    this.paused = paused;
    if (!paused && !this.building) this.drawWaiting();
  }

  // Show from one time to another; without times everything.
  zoom(range) {
    if (!this.series) return;
    if (range) {
      const [start, end] = this.whole();
      let [from, to] = range;
      if (to - from < FEWEST) [from, to] = [(from + to - FEWEST) / 2, (from + to + FEWEST) / 2];
      if (to - from >= end - start) range = null;
      else {
        const shift = Math.max(0, start - from) - Math.max(0, to - end);
        range = [from + shift, to + shift];
      }
    }
    this.zoomed = range;
    this.draw();
  }

  // Zoom in (below 1) or out about the middle, or about what is pointed at.
  scale(by) {
    if (!this.series) return;
    const [from, to] = this.zoomed ?? this.whole();
    const middle = this.pointed?.t ?? (from + to) / 2;
    this.zoom([middle - (middle - from) * by, middle + (to - middle) * by]);
  }

  // Where a time is in a chart's frame.
  pixel(view, t) {
    const [from, to] = this.zoomed ?? this.whole();
    return view.origin()[0] + view.padding().left + ((t - from) / (to - from)) * view.width();
  }

  listen(frame, view) {
    const key = [...this.views].find(([, one]) => one.view === view)[0];
    const at = (event) => {
      const left = frame.querySelector("canvas").getBoundingClientRect().left + view.origin()[0] + view.padding().left;
      const width = view.width();
      const share = Math.min(1, Math.max(0, (event.clientX - left) / width));
      const [from, to] = this.zoomed ?? this.whole();
      return from + share * (to - from);
    };
    const range = (event) => [this.drawing.start, at(event)].sort((a, b) => a - b);
    const end = () => {
      this.drawing = null;
      this.views.forEach(({ drawn }) => { drawn.hidden = true; });
    };
    frame.addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || event.pointerType === "touch") return;
      this.drawing = { start: at(event), pixel: event.clientX };
      frame.setPointerCapture(event.pointerId);
    });
    frame.addEventListener("pointermove", (event) => {
      this.point(key, at(event));
      if (!this.drawing) return;
      const [from, to] = range(event);
      for (const one of this.views.values()) {
        const left = this.pixel(one.view, from);
        one.drawn.hidden = false;
        one.drawn.style.left = `${left}px`;
        one.drawn.style.width = `${this.pixel(one.view, to) - left}px`;
      }
    });
    frame.addEventListener("pointerup", (event) => {
      if (!this.drawing) return;
      const chosen = range(event);
      const far = Math.abs(event.clientX - this.drawing.pixel) > 8;
      end();
      if (far) this.zoom(chosen);
    });
    frame.addEventListener("pointercancel", end);
    frame.addEventListener("pointerleave", () => this.point(null));
    frame.addEventListener("dblclick", () => this.zoom(null));
    frame.addEventListener("blur", () => this.point(null));
    frame.addEventListener("keydown", (event) => {
      const [from, to] = this.zoomed ?? this.whole();
      const step = (to - from) / 50;
      const t = this.pointed?.t ?? Math.min(this.time, to);
      const moves = { ArrowLeft: t - step, ArrowRight: t + step, Home: from, End: to };
      if (event.key in moves) {
        this.point(key, Math.min(to, Math.max(from, moves[event.key])), true);
      } else if (event.key === "+") this.scale(0.5);
      else if (event.key === "-") this.scale(2);
      else if (event.key === "Escape") this.zoom(null);
      else return;
      event.preventDefault();
    });
  }

  // Show the values at a time: a line through all charts, the numbers beside the one pointed at.
  point(key, t, aloud = false) {
    this.pointed = key === null ? null : { key, t };
    const [from, to] = this.zoomed ?? this.whole();
    for (const [name, { chart, view, frame, tip, cursor }] of this.views) {
      cursor.hidden = key === null || t < from || t > to;
      cursor.style.left = `${this.pixel(view, t)}px`;
      tip.hidden = name !== key;
      if (tip.hidden) continue;
      const lines = chart.lines.map((line) => [line, this.valueAt(chart, line, t)]).filter(([, text]) => text);
      tip.replaceChildren(element("strong", "", atText(t)));
      for (const [line, text] of lines) {
        const row = element("p", "", line.label);
        row.prepend(swatch(line));
        row.append(element("b", "", text));
        tip.append(row);
      }
      const place = this.pixel(view, t);
      const width = tip.offsetWidth;
      const left = place + 12 + width < frame.clientWidth ? place + 12 : Math.max(0, place - 12 - width);
      tip.style.left = `${left}px`;
      if (aloud) this.speak([atText(t), ...lines.map(([line, text]) => `${line.label} ${text}`)].join(", "));
    }
  }

  valueAt(chart, line, t) {
    const rows = this.rows[line.name];
    const after = rows.findIndex((row) => row.t > t);
    const before = after < 0 ? rows.length - 1 : after - 1;
    const row = rows[before];
    if (!row || row.v === null || (after < 0 && t - row.t > FEWEST)) return "";
    const { decimals, unit } = this.units(line.right ? chart.right : chart.shown);
    let value = row.v;
    const next = rows[before + 1];
    if (!line.steps && next && next.t > row.t) {
      value += ((next.v - row.v) * (t - row.t)) / (next.t - row.t);
    }
    const { low, high } = line.range === "past" && next && t > row.t ? next : row;
    const ranged = line.range && high - low > 0.5 * 10 ** -decimals;
    const range = ranged ? ` (${low.toFixed(decimals)} to ${high.toFixed(decimals)})` : "";
    return `${value.toFixed(decimals)}${range} ${unit}`;
  }
}

// Of a time at which a value is not known.
const NOTHING = { v: null, low: null, high: null };

// Rows with one of no values where nothing came for longer than 'gap' (ms). What holds until the next
// message holds for no longer than that, until it is not known any more, and until now at most.
const broken = (rows, gap, holds, now) => rows.flatMap((row, i) => {
  const next = rows[i + 1];
  if (next && next.v !== null && next.t - row.t <= gap) return [row];
  const t = holds ? Math.min(row.t + gap, next?.v === null ? next.t : now, now) : row.t;
  const end = t > row.t && row.v !== null ? [row, { t, v: row.v, low: row.v, high: row.v }] : [row];
  return next ? [...end, { t, ...NOTHING }] : end;
});

// How far a value went beyond its line, from row to row: what merely rises or falls has no band.
const beyond = (rows, holds) => rows.flatMap((row, i) => {
  const before = rows[i - 1];
  if (row.v === null) return [row];
  if (!before || before.v === null) return [];
  const end = holds ? before.v : row.v;
  const under = Math.max(0, Math.min(before.v, end) - row.low);
  const over = Math.max(0, row.high - Math.max(before.v, end));
  return [[before.t, before.v], [row.t, end]].map(([t, v]) => ({ t, low: v - under, high: v + over }));
});

// Points of steps [start, end, values]: each holds until its end.
const steps = (parts) => {
  const rows = parts.map(([t, , values]) => ({ t, ...values }));
  if (parts.length) rows.push({ t: parts.at(-1)[1], ...parts.at(-1)[2] });
  return rows;
};
