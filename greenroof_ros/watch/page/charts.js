// The charts of levels, pump and rain over one time axis, drawn by uPlot. They show the site's clock,
// since the browser may be in another time zone.

const { uPlot } = window;

const HOUR = 3600_000;
const AHEAD = 12; // hours
const AXIS = 72; // width of an axis and its title (px), the same for all charts so that their times line up
const TOP = 10; // space above the plot (px), for the upper half of the axis's highest number
const FEWEST = 60_000; // shortest time that a zoom shows (ms)

// The lines of each chart, by the names of the series. They use the axis of the line 'shown'; lines with
// 'right' have an axis of their own. Values of lines with 'steps' hold from one time until the next. A line
// with 'range' has blocks where its values went beyond it.
const CHARTS = [
  {
    key: "roof", shown: "roof", title: "Roof level", height: 200, marks: ["target"], band: true,
    lines: [
      { name: "roof", label: "measured", colour: "--roof", range: true },
      { name: "roof_expected", label: "as expected an hour earlier", colour: "--roof", dash: [2, 3] },
      { name: "roof_planned", label: "expected by the controller", colour: "--roof", dash: [6, 4] },
    ],
  },
  {
    key: "cistern", shown: "cistern", title: "Cistern level", height: 150, marks: ["suction", "low_outlet", "overflow"],
    lines: [{ name: "cistern", label: "measured", colour: "--cistern", range: true }],
  },
  {
    key: "pump", shown: "flow", title: "Pump", height: 170, zero: true, right: "command", rightColour: "--command-words",
    lines: [
      { name: "flow", label: "flow", colour: "--flow", steps: true, range: true },
      { name: "plan", label: "planned flow", colour: "--flow", steps: true, dash: [6, 4] },
      { name: "command", label: "command", colour: "--command", steps: true, right: true, dash: [2, 2] },
    ],
  },
  {
    key: "rain", shown: "rain", title: "Rain and evapotranspiration", height: 195, zero: true,
    right: "evapotranspiration", rightColour: "--evapotranspiration-words",
    lines: [
      { name: "rain", label: "rain", colour: "--rain", fill: "--rain-fill", steps: true },
      { name: "forecast", label: "forecast rain", colour: "--rain", steps: true, dash: [6, 4], range: true },
      { name: "evapotranspiration", label: "evapotranspiration", colour: "--evapotranspiration", steps: true, right: true, dash: [10, 3, 2, 3] },
    ],
  },
];
const MARKS = { target: "target", suction: "suction level", low_outlet: "low outlet", overflow: "overflow" };
const DAYS = ["Sun", "Mon", "Tue", "Wed", "Thu", "Fri", "Sat"];
const MONTHS = ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"];

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const faint = (name) => `color-mix(in srgb, ${colour(name)} 30%, transparent)`;
const two = (number) => String(number).padStart(2, "0");
// The site's clock: times (s since 1970) from which on each offset from UTC (h) holds.
let offsets = [];
export const setClock = (clock) => { offsets = clock; };
// A time (ms since 1970) as a date whose UTC is the site's time.
const local = (ms) => {
  const [, offset] = offsets.findLast(([from]) => from * 1000 <= ms) ?? offsets[0] ?? [0, 0];
  return new Date(ms + offset * HOUR);
};
const clock = (at, seconds) => `${two(at.getUTCHours())}:${two(at.getUTCMinutes())}${seconds ? `:${two(at.getUTCSeconds())}` : ""}`;
export const atText = (ms) => {
  const at = local(ms);
  return `${at.getUTCFullYear()}-${two(at.getUTCMonth() + 1)}-${two(at.getUTCDate())} ${clock(at, true)}`;
};
// A time on the axis: the day at midnight, otherwise the time.
const tickText = (ms) => {
  const at = local(ms);
  if (at % (24 * HOUR) === 0) return `${DAYS[at.getUTCDay()]} ${two(at.getUTCDate())} ${MONTHS[at.getUTCMonth()]}`;
  return clock(at, at.getUTCSeconds() > 0);
};

export const element = (tag, name, text) => {
  const made = document.createElement(tag);
  if (name) made.className = name;
  if (text !== undefined) made.textContent = text;
  return made;
};

// A short piece of a line as in the chart; for a range, a block.
const swatch = ({ colour: stroke, dash, block }) => {
  const space = "http://www.w3.org/2000/svg";
  const drawn = document.createElementNS(space, "svg");
  drawn.setAttribute("class", "swatch");
  drawn.setAttribute("viewBox", "0 0 30 12");
  drawn.setAttribute("aria-hidden", "true");
  const made = document.createElementNS(space, block ? "rect" : "line");
  const set = block ? { width: 30, height: 12, fill: colour(block), "fill-opacity": 0.3 }
    : { x1: 0, x2: 30, y1: 6, y2: 6, stroke: colour(stroke), "stroke-width": 2.5, "stroke-dasharray": dash?.join(" ") ?? "none" };
  for (const [key, value] of Object.entries(set)) made.setAttribute(key, value);
  drawn.append(made);
  return drawn;
};

// The references on an axis, from the lowest upward. Those beyond an end of the axis share one line of words.
const onAxis = (named, unit, low, high) => {
  const beyond = (some, v, arrow) => some.length
    ? [{ v, inside: false, text: `${some.map(({ text }) => text).join(", ")} ${unit} ${arrow}` }] : [];
  return [
    ...beyond(named.filter(({ value }) => value < low), low, "↓"),
    ...named.filter(({ value }) => low <= value && value <= high)
      .map(({ value, text }) => ({ v: value, inside: true, text: `${text} ${unit}` })),
    ...beyond(named.filter(({ value }) => value > high), high, "↑"),
  ];
};

export class Charts {
  // 'box' contains the charts; 'changed' is called when the zoom has changed, 'speak' with text for
  // readers who do not see the page.
  constructor(box, changed, speak) {
    this.box = box;
    this.changed = changed;
    this.speak = speak;
    this.hours = 12;
    this.zoomed = null;
    this.series = null;
    this.rows = null;
    this.blocks = null;
    this.keyed = null; // the chart in which a reader moves with the keys
    this.views = new Map();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.rebuild());
    new ResizeObserver(() => this.views.forEach(({ chart, plot, frame }) => {
      if (plot.width !== frame.clientWidth) plot.setSize({ width: frame.clientWidth, height: chart.height });
    })).observe(box);
  }

  get time() { return this.series && this.ms(this.series.now); }

  ms(seconds) { return seconds * 1000; }

  units(name) {
    const { unit, factor, decimals, label } = this.series.display[name];
    return { unit, factor, decimals, title: unit ? `${label} (${unit})` : label };
  }

  // A new series is drawn immediately.
  take(series) {
    if (series.now === null) return;
    this.series = series;
    this.read();
    if (this.views.size) this.draw();
    else this.rebuild();
  }

  rebuild() {
    if (!this.series) return;
    this.views.forEach(({ plot }) => plot.destroy());
    this.views.clear();
    this.box.replaceChildren();
    CHARTS.forEach((chart) => this.build(chart));
    this.draw();
  }

  build(chart) {
    const part = element("section");
    const head = element("div", "head");
    const frame = element("div", "frame");
    frame.tabIndex = 0;
    frame.setAttribute("role", "application");
    frame.setAttribute("aria-label", `${chart.title} over time. Move with the arrow keys; zoom with plus and minus; press Escape to show the whole time span.`);
    const tip = element("div", "tip");
    tip.hidden = true;
    part.append(head, frame);
    this.box.append(part);
    const view = { chart, frame, tip, legend: [], marks: [], band: [], ranges: {} };
    const entry = (label, look, shown) => {
      const made = element("span", "", label);
      made.prepend(swatch(look));
      head.append(made);
      view.legend.push([made, shown]);
    };
    head.append(element("h3", "", chart.title));
    for (const line of chart.lines) {
      entry(line.label, line, () => this.rows[line.name].length > 0);
      if (line.range) entry("its range", { block: line.colour }, () => this.blocks[line.name].length > 0);
    }
    entry("good", { block: "--band" }, () => view.band.length > 0);
    view.plot = new uPlot(this.options(view), [[]], frame);
    frame.append(tip);
    this.views.set(chart.key, view);
    this.listen(view);
  }

  // How uPlot draws a chart.
  options(view) {
    const { chart, frame } = view;
    const { linear, stepped } = uPlot.paths;
    const series = [{}, ...chart.lines.map((line) => ({
      scale: line.right ? "right" : "left", paths: line.steps ? stepped({ align: 1 }) : linear(),
      stroke: colour(line.colour), width: 2.2, dash: line.dash, fill: line.fill && faint(line.fill),
      // A single value makes no line, so it is drawn as a dot.
      points: { show: (plot, index) => plot.data[index].filter((value) => value != null).length === 1 },
    }))];
    const axis = (scale, name, ink) => ({
      scale, side: scale === "right" ? 1 : 3, size: AXIS - 14, labelSize: 14, gap: 3, label: this.units(name).title,
      labelFont: "12px Arial, Helvetica, sans-serif", font: "12px Arial, Helvetica, sans-serif", stroke: colour(ink), space: 28,
      grid: { show: scale === "left", stroke: colour("--grid"), width: 1 }, ticks: { stroke: colour("--edge"), width: 1 },
      values: (_, splits) => splits.map((split) => String(Number(split.toPrecision(6)))),
    });
    const range = (name) => () => view.ranges[name] ?? [0, 1];
    return {
      width: frame.clientWidth, height: chart.height, ms: 1, legend: { show: false }, series,
      padding: [TOP, chart.right ? 0 : AXIS, 0, 0],
      tzDate: (at) => uPlot.tzDate(local(at), "Etc/UTC"),
      scales: { x: { range: range("x") }, left: { range: range("left") }, right: { range: range("right") } },
      axes: [
        {
          stroke: colour("--ink"), font: "12px Arial, Helvetica, sans-serif", size: 24, gap: 2, space: 90,
          grid: { stroke: colour("--grid"), width: 1 }, ticks: { stroke: colour("--edge"), width: 1 },
          values: (_, splits) => splits.map(tickText),
        },
        axis("left", chart.shown, "--ink"),
        ...(chart.right ? [axis("right", chart.right, chart.rightColour)] : []),
      ],
      cursor: {
        y: false, points: { show: false }, sync: { key: "charts", setSeries: false },
        drag: { x: true, y: false, setScale: false, dist: 8 },
        bind: { dblclick: () => () => this.zoom(null) },
      },
      hooks: {
        drawClear: [(plot) => this.drawBehind(plot, view)],
        drawAxes: [(plot) => this.drawMarks(plot, view), (plot) => this.drawBlocks(plot, chart)],
        setSelect: [(plot) => {
          const { left, width } = plot.select;
          if (width < 1) return;
          plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
          this.zoom([plot.posToVal(left, "x"), plot.posToVal(left + width, "x")]);
        }],
        setCursor: [(plot) => this.point(view, plot)],
      },
    };
  }

  // The background: the time ahead and the band of good values.
  drawBehind(plot, { band }) {
    const { ctx, bbox } = plot;
    const x = Math.min(bbox.left + bbox.width, Math.max(bbox.left, plot.valToPos(this.time, "x", true)));
    ctx.fillStyle = colour("--ahead");
    ctx.fillRect(x, bbox.top, bbox.left + bbox.width - x, bbox.height);
    if (!band.length) return;
    const [top, bottom] = [band[1], band[0]].map((level) => Math.min(bbox.top + bbox.height, Math.max(bbox.top, plot.valToPos(level, "left", true))));
    ctx.fillStyle = `color-mix(in srgb, ${colour("--band")} 18%, transparent)`;
    ctx.fillRect(bbox.left, top, bbox.width, bottom - top);
  }

  // The present time and the references with their words, behind the series so that no value is hidden.
  drawMarks(plot, { marks }) {
    const { ctx, bbox } = plot;
    const ratio = devicePixelRatio;
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = colour("--reference");
    ctx.font = `${12 * ratio}px Arial, Helvetica, sans-serif`;
    ctx.textAlign = "left";
    ctx.textBaseline = "top";
    ctx.lineJoin = "round";
    const x = plot.valToPos(this.time, "x", true);
    if (bbox.left <= x && x <= bbox.left + bbox.width) ctx.fillRect(x - 0.75 * ratio, bbox.top, 1.5 * ratio, bbox.height);
    ctx.lineWidth = ratio;
    ctx.setLineDash([3 * ratio, 2 * ratio]);
    ctx.beginPath();
    for (const y of marks.filter(({ inside }) => inside).map(({ v }) => plot.valToPos(v, "left", true))) {
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
    }
    ctx.stroke();
    // Neither the grid nor the line of the present time crosses the words.
    ctx.setLineDash([]);
    ctx.lineWidth = 4 * ratio;
    ctx.strokeStyle = colour("--card");
    for (const { text, left, top } of this.placed(plot, marks)) {
      ctx.strokeText(text, left, top);
      ctx.fillText(text, left, top);
    }
    ctx.restore();
  }

  // Where the words of references go: each above its line, or below it at the top, and none over another.
  placed({ ctx, bbox, valToPos }, marks) {
    let left = bbox.left + 4 * devicePixelRatio;
    return marks.map(({ text, v }) => {
      const above = valToPos(v, "left", true) - 14 * devicePixelRatio;
      const place = { text, left, top: above < bbox.top ? above + 17 * devicePixelRatio : above };
      left += ctx.measureText(text).width + 12 * devicePixelRatio;
      return place;
    });
  }

  // The ranges of lines, behind the series and at least a pixel wide, however many values there are.
  drawBlocks({ ctx, bbox, valToPos }, chart) {
    const clip = new Path2D();
    clip.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.save();
    ctx.clip(clip);
    for (const line of chart.lines.filter(({ range }) => range)) {
      ctx.fillStyle = faint(line.colour);
      ctx.beginPath();
      for (const { from, to, low, high } of this.blocks[line.name]) {
        const [left, right] = [Math.floor(valToPos(from, "x", true)), Math.ceil(valToPos(to, "x", true))];
        const [top, bottom] = [high, low].map((value) => valToPos(value, "left", true));
        ctx.rect(left, top, Math.max(devicePixelRatio, right - left), bottom - top);
      }
      ctx.fill();
    }
    ctx.restore();
  }

  // Read the series as rows and blocks of the charts, in the shown units instead of SI.
  read() {
    [this.rows, this.blocks] = [{}, {}];
    const { series, rows, blocks } = this;
    const now = this.ms(series.now);
    const factor = (name) => this.units(name).factor;
    for (const chart of CHARTS) {
      for (const line of chart.lines) {
        const { factor: f, decimals } = this.units(line.right ? chart.right : chart.shown);
        const points = (series.lines[line.name] ?? []).map(([t, low, high, last]) => (
          { t: this.ms(t), v: last === null ? null : last * f, low: low * f, high: high * f }
        ));
        rows[line.name] = broken(points, series.gap * 1000, line.steps);
        if (line.range) blocks[line.name] = beyond(points, series.stretch * 1000, this.ms(0), 0.5 * 10 ** -decimals);
      }
    }
    const [level, flow, rain] = ["roof", "flow", "rain"].map(factor);
    const coming = (parts) => parts.filter(([, end]) => end > series.now)
      .map(([start, end, ...values]) => [this.ms(Math.max(start, series.now)), this.ms(end), ...values]);
    const [plan, forecast] = [coming(series.plan), coming(series.forecast)];
    rows.plan = steps(plan, flow);
    rows.forecast = steps(forecast, rain);
    blocks.forecast = forecast.filter(([, , , low, high]) => low < high)
      .map(([from, to, , low, high]) => ({ from, to, low: low * rain, high: high * rain }));
    if (plan.length) {
      const newest = rows.roof.at(-1);
      if (newest && now - newest.t <= series.gap * 1000) rows.roof_planned.push({ t: newest.t, v: newest.v });
      rows.roof_planned.push(...plan.map(([, t, , expected]) => ({ t, v: expected * level })));
    }
  }

  // From the first value, or from the chosen time back, to the end of the forecast and the plan.
  whole() {
    const { now, from } = this.series;
    const lines = Object.values(this.rows);
    const first = Math.min(...lines.map((rows) => rows[0]?.t ?? Infinity));
    const last = Math.max(...lines.map((rows) => rows.at(-1)?.t ?? -Infinity));
    const start = Math.max(this.ms(from), Math.min(first, this.ms(now)));
    const end = Math.min(last, this.ms(now) + Math.min(AHEAD, this.hours) * HOUR);
    return [start, Math.max(end, this.ms(now), start + FEWEST)];
  }

  // The minimum and the maximum value on an axis from one time to another.
  extent(chart, right, from, to) {
    const seen = (begin, end) => begin <= to && end >= from;
    const values = chart.lines.filter((line) => Boolean(line.right) === right).flatMap(({ name }) => [
      ...this.rows[name].flatMap(({ t, v }, i, rows) => seen(rows[i - 1]?.t ?? t, rows[i + 1]?.t ?? t) && v !== null ? [v] : []),
      ...(this.blocks[name] ?? []).flatMap((block) => seen(block.from, block.to) ? [block.low, block.high] : []),
    ]);
    return [Math.min(...values), Math.max(...values)];
  }

  // The range of an axis, from the visible values and the references that are near them.
  range(chart, right, seen, marks) {
    let [low, high] = this.extent(chart, right, ...seen);
    if (right && chart.right === "command") [low, high] = [0, Math.max(100, high)];
    if (low > high) [low, high] = [0, 1];
    if (chart.zero) return [0, high > 0 ? high * 1.1 : 1];
    const span = Math.max(high - low, 0.02 * high, 1e-9);
    for (const value of marks) {
      if (low - 3 * span <= value && value <= high + 3 * span) [low, high] = [Math.min(low, value), Math.max(high, value)];
    }
    const margin = 0.2 * Math.max(high - low, span); // room for the words of references beyond an end
    return [Math.max(0, low - margin), high + margin];
  }

  draw() {
    const whole = this.whole();
    // The zoom is from another run, or has scrolled out on the left.
    if (this.zoomed && (this.zoomed[0] >= whole[1] || this.zoomed[1] <= whole[0])) this.zoomed = null;
    const seen = this.zoomed ?? whole;
    const known = this.series.marks;
    for (const view of this.views.values()) {
      const { chart, plot } = view;
      const { factor, decimals, unit } = this.units(chart.shown);
      const named = (chart.marks ?? []).filter((name) => Number.isFinite(known[name])).map((name) => {
        const value = known[name] * factor;
        return { value, text: `${MARKS[name]} ${value.toFixed(decimals)}` };
      });
      view.band = chart.band && known.band ? known.band.map((level) => level * factor) : [];
      const left = this.range(chart, false, seen, [...named.map(({ value }) => value), ...view.band]);
      view.ranges = { x: seen, left, right: chart.right && this.range(chart, true, seen, []) };
      view.marks = onAxis(named, unit, ...left);
      for (const [entry, shown] of view.legend) entry.hidden = !shown();
      plot.setData(this.table(chart), true);
    }
    this.changed();
  }

  // The rows of a chart for uPlot: all times, and the values of each series there. A line without a value
  // at a time continues (undefined); it has a gap from an unknown value (null) to its next value.
  table(chart) {
    const parts = chart.lines.map(({ name }) => [this.rows[name].map(({ t }) => t), this.rows[name].map(({ v }) => v)]);
    return uPlot.join(parts, parts.map(() => [2, 2]));
  }

  setHours(hours) {
    this.hours = hours;
    this.zoomed = null;
  }

  // Show from one time to another, or everything without a range.
  zoom(range) {
    if (!this.series) return;
    if (range) {
      const [start, end] = this.whole();
      let [from, to] = range;
      if (to - from < FEWEST) [from, to] = [(from + to - FEWEST) / 2, (from + to + FEWEST) / 2];
      const shift = Math.max(0, start - from) - Math.max(0, to - end);
      range = to - from >= end - start ? null : [from + shift, to + shift];
    }
    this.zoomed = range;
    this.draw();
  }

  // Zoom in (below 1) or out, around the middle or around the time that is pointed at.
  scale(by) {
    if (!this.series) return;
    const [from, to] = this.zoomed ?? this.whole();
    const middle = this.pointed ?? (from + to) / 2;
    this.zoom([middle - (middle - from) * by, middle + (to - middle) * by]);
  }

  listen(view) {
    const { frame, plot } = view;
    frame.addEventListener("pointermove", () => { this.keyed = null; });
    frame.addEventListener("blur", () => {
      this.keyed = null;
      plot.setCursor({ left: -10, top: -10 }, true, true);
    });
    frame.addEventListener("keydown", (event) => {
      const [from, to] = this.zoomed ?? this.whole();
      const t = this.pointed ?? Math.min(this.time, to);
      const step = (to - from) / 50;
      const moves = { ArrowLeft: t - step, ArrowRight: t + step, Home: from, End: to };
      if (event.key in moves) {
        this.aloud = true;
        this.keyed = frame;
        plot.setCursor({ left: plot.valToPos(Math.min(to, Math.max(from, moves[event.key])), "x"), top: 10 }, true, true);
      } else if (event.key === "+") this.scale(0.5);
      else if (event.key === "-") this.scale(2);
      else if (event.key === "Escape") this.zoom(null);
      else return;
      event.preventDefault();
    });
  }

  // Show the values at a time: a line through all charts, and the numbers in the one pointed at.
  point({ chart, frame, tip }, plot) {
    const { left } = plot.cursor;
    const own = left >= 0 && (this.keyed ? this.keyed === frame : frame.matches(":hover"));
    tip.hidden = !own;
    if (!own) {
      if (left < 0) this.pointed = null;
      return;
    }
    const t = plot.posToVal(left, "x");
    this.pointed = t;
    const lines = chart.lines.map((line) => [line, this.valueAt(chart, line, t)]).filter(([, text]) => text);
    tip.replaceChildren(element("strong", "", atText(t)));
    for (const [line, text] of lines) {
      const row = element("p", "", line.label);
      row.prepend(swatch(line));
      row.append(element("b", "", text));
      tip.append(row);
    }
    const place = left + AXIS;
    const width = tip.offsetWidth;
    tip.style.left = `${place + 12 + width < frame.clientWidth ? place + 12 : Math.max(0, place - 12 - width)}px`;
    if (this.aloud) this.speak([atText(t), ...lines.map(([line, text]) => `${line.label} ${text}`)].join(", "));
    this.aloud = false;
  }

  valueAt(chart, line, t) {
    const rows = this.rows[line.name];
    const after = rows.findIndex((row) => row.t > t);
    const before = after < 0 ? rows.length - 1 : after - 1;
    const row = rows[before];
    if (!row || row.v === null || (after < 0 && t - row.t > FEWEST)) return "";
    const { decimals, unit } = this.units(line.right ? chart.right : chart.shown);
    const next = rows[before + 1] ?? row;
    const value = line.steps || next.v === null ? row.v : between(row, next, t);
    const blocks = (this.blocks[line.name] ?? []).filter(({ from, to }) => from <= t && t < to);
    const ends = [Math.min(value, ...blocks.map(({ low }) => low)), Math.max(value, ...blocks.map(({ high }) => high))];
    const range = blocks.length ? ` (${ends.map((end) => end.toFixed(decimals)).join(" to ")})` : "";
    return `${value.toFixed(decimals)}${range} ${unit}`;
  }
}

// The value between two rows, at a time (ms).
const between = (row, next, t) => next.t > row.t ? row.v + ((next.v - row.v) * (t - row.t)) / (next.t - row.t) : row.v;

// The rows of a line, with a row without a value in each gap of more than 'gap' (ms). A value that holds
// until the next one holds for 'gap' at most, and not beyond a time at which it is unknown.
const broken = (points, gap, holds) => points.flatMap(({ t, v }, i) => {
  const next = points[i + 1];
  if (v === null || !next || (next.v !== null && next.t - t <= gap)) return [{ t, v }];
  const end = holds ? Math.max(t, Math.min(t + gap, next.t - 1)) : t;
  return [{ t, v }, ...(end > t ? [{ t: end, v }] : []), ...(next.v === null ? [] : [{ t: end + 1, v: null }])];
});

// Where values went beyond their line by more than 'minimum': blocks below and above it for each stretch (ms,
// counted from 'zero'), from the first value on. A value that only rises or falls has none.
const beyond = (points, stretch, zero, minimum) => points.flatMap(({ t, v, low, high }, i) => {
  if (v === null || i === 0) return []; // no line leads to the first value
  const line = [points[i - 1].v ?? v, v];
  const begin = t - ((t - zero) % stretch);
  const [from, to] = [Math.max(begin, points[0].t), Math.min(begin + stretch, points.at(-1).t)];
  return [[low, Math.min(...line)], [Math.max(...line), high]].filter(([under, over]) => over - under > minimum)
    .map(([under, over]) => ({ from, to, low: under, high: over }));
});

// Rows of steps [start, end, value], each of which holds until its end.
const steps = (parts, factor) => [
  ...parts.map(([t, , value]) => ({ t, v: value * factor })),
  ...parts.slice(-1).map(([, t, value]) => ({ t, v: value * factor })),
];
