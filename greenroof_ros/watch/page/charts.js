// The charts: levels, pump, rain over one time axis, drawn by uPlot. They use the site's local time as if
// it were UTC, since the browser may be in another time zone.

const { uPlot } = window;

const HOUR = 3600_000;
const AHEAD = 12; // hours
const AXIS = 64; // width of an axis and its title (px), the same for all charts: their times line up
const TOP = 10; // px above the plot, for the upper half of the axis's highest number
const FEWEST = 60_000; // ms: the least that a zoom shows

// The lines of each chart, by the names of the series. They are on the axis of the line 'shown'; lines
// with 'right' have an axis of their own. 'steps' hold from a time until the next. A 'range' is over the
// stretch that ends at the time of its row ('past'), or over the step that begins there.
const CHARTS = [
  {
    key: "roof", shown: "roof", title: "Roof level", height: 200, marks: ["target"], band: true,
    lines: [
      { name: "roof", label: "measured", colour: "--roof", range: "past" },
      { name: "roof_expected", label: "was expected an hour before", colour: "--roof", dash: [2, 3] },
      { name: "roof_planned", label: "expected by the controller", colour: "--roof", dash: [6, 4] },
    ],
  },
  {
    key: "cistern", shown: "cistern", title: "Cistern level", height: 150, marks: ["suction", "low_outlet", "outlet"],
    lines: [{ name: "cistern", label: "measured", colour: "--cistern", range: "past" }],
  },
  {
    key: "pump", shown: "flow", title: "Pump", height: 170, zero: true, right: "command", rightColour: "--command-words",
    lines: [
      { name: "flow", label: "flow", colour: "--flow", steps: true, range: "past", rangeLabel: "its range" },
      { name: "plan", label: "flow planned", colour: "--flow", steps: true, dash: [6, 4] },
      { name: "command", label: "command", colour: "--command", steps: true, right: true, dash: [2, 2] },
    ],
  },
  {
    key: "rain", shown: "rain", title: "Rain and evapotranspiration", height: 195, zero: true,
    right: "evapotranspiration", rightColour: "--evapotranspiration-words",
    lines: [
      { name: "rain", label: "rain", colour: "--rain", fill: "--rain-fill", steps: true },
      { name: "forecast", label: "rain forecast", colour: "--rain", steps: true, dash: [6, 4], range: "step", rangeLabel: "its range" },
      { name: "evapotranspiration", label: "evapotranspiration", colour: "--evapotranspiration", steps: true, right: true, dash: [10, 3, 2, 3] },
    ],
  },
];
const MARKS = { target: "target", suction: "suction level", low_outlet: "low outlet", outlet: "outlet" };
const DAYS = ["Sun", "Mon", "Tue", "Wed", "Thu", "Fri", "Sat"];
const MONTHS = ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"];

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const faint = (name) => `color-mix(in srgb, ${colour(name)} 30%, transparent)`;
const two = (number) => String(number).padStart(2, "0");
const clock = (at, seconds) => `${two(at.getUTCHours())}:${two(at.getUTCMinutes())}${seconds ? `:${two(at.getUTCSeconds())}` : ""}`;
const atText = (ms) => {
  const at = new Date(ms);
  return `${at.getUTCFullYear()}-${two(at.getUTCMonth() + 1)}-${two(at.getUTCDate())} ${clock(at, true)}`;
};
// A time on the axis: the day at midnight, else the time.
const tickText = (ms) => {
  const at = new Date(ms);
  if (ms % (24 * HOUR) === 0) return `${DAYS[at.getUTCDay()]} ${two(at.getUTCDate())} ${MONTHS[at.getUTCMonth()]}`;
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

// The places of the lines and words of references on an axis, from the lowest up. References beyond an
// end of the axis share one line of words; the words of two lines that are close go on opposite sides.
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

export class Charts {
  // 'box' holds the charts; 'changed' is called when the zoom has changed, 'speak' with text for
  // readers who do not see the page.
  constructor(box, changed, speak) {
    this.box = box;
    this.changed = changed;
    this.speak = speak;
    this.hours = 12;
    this.zoomed = null;
    this.paused = false;
    this.series = null;
    this.rows = null;
    this.keyed = null; // the chart in which a reader moves by keys
    this.views = new Map();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.rebuild());
    new ResizeObserver(() => this.views.forEach(({ chart, plot, frame }) => {
      if (plot.width !== frame.clientWidth) plot.setSize({ width: frame.clientWidth, height: chart.height });
    })).observe(box);
  }

  get time() { return this.series && this.ms(this.series.now); }

  ms(seconds) { return (seconds + this.offset * 3600) * 1000; }

  units(name) {
    const { unit, factor, decimals, label } = this.series.display[name];
    return { unit, factor, decimals, title: unit ? `${label} (${unit})` : label };
  }

  // A new series: drawn at once, or kept while a reader has paused.
  take(series, offset) {
    this.waiting = { series, offset };
    if (!this.paused) this.drawWaiting();
  }

  drawWaiting() {
    if (!this.waiting || this.waiting.series.now === null) return;
    ({ series: this.series, offset: this.offset } = this.waiting);
    this.waiting = null;
    this.rows = this.rowsOf(this.series);
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
    const entry = (name, label, look, isRange) => {
      const made = element("span", "", label);
      made.dataset.line = name;
      if (isRange) made.dataset.range = "";
      made.prepend(swatch(look));
      head.append(made);
    };
    head.append(element("h3", "", chart.title));
    for (const line of chart.lines) {
      entry(line.name, line.label, line);
      if (line.rangeLabel) entry(line.name, line.rangeLabel, { block: line.colour }, true);
    }
    if (chart.band) entry("band", "good", { block: "--band" });
    const frame = element("div", "frame");
    frame.tabIndex = 0;
    frame.setAttribute("role", "application");
    frame.setAttribute("aria-label", `${chart.title} over time. Arrow keys move, plus and minus zoom, Escape shows the whole time.`);
    const tip = element("div", "tip");
    tip.hidden = true;
    part.append(head, frame);
    this.box.append(part);
    const view = { chart, frame, tip, head, marks: [], band: [], ranges: {} };
    view.plot = new uPlot(this.options(view), [[]], frame);
    frame.append(tip);
    this.views.set(chart.key, view);
    this.listen(view);
  }

  // How uPlot draws a chart. Of a line with a range there are two more series, its ends.
  options(view) {
    const { chart, frame } = view;
    const { linear, stepped } = uPlot.paths;
    const series = [{}];
    const bands = [];
    for (const line of chart.lines) {
      const scale = line.right ? "right" : "left";
      if (line.range) {
        const paths = line.range === "past" ? linear() : stepped({ align: 1 });
        series.push(...[1, 2].map(() => ({ scale, paths, width: 0, points: { show: false } })));
        bands.push({ series: [series.length - 1, series.length - 2], fill: faint(line.fill ?? line.colour) });
      }
      series.push({
        scale, paths: line.steps ? stepped({ align: 1 }) : linear(), stroke: colour(line.colour), width: 2.2,
        dash: line.dash, fill: line.fill && faint(line.fill),
        // A single value makes no line: it is a dot.
        points: { show: (plot, index) => plot.data[index].filter((value) => value != null).length === 1 },
      });
    }
    const axis = (scale, name, ink) => ({
      scale, side: scale === "right" ? 1 : 3, size: AXIS - 14, labelSize: 14, gap: 3, label: this.units(name).title,
      labelFont: "12px Arial, Helvetica, sans-serif", font: "12px Arial, Helvetica, sans-serif", stroke: colour(ink), space: 36,
      grid: { show: scale === "left", stroke: colour("--grid"), width: 1 }, ticks: { stroke: colour("--edge"), width: 1 },
      values: (_, splits) => splits.map((split) => String(Number(split.toPrecision(6)))),
    });
    const range = (name) => () => view.ranges[name] ?? [0, 1];
    return {
      width: frame.clientWidth, height: chart.height, ms: 1, legend: { show: false }, series, bands,
      padding: [TOP, chart.right ? 0 : AXIS, 0, 0],
      tzDate: (at) => uPlot.tzDate(new Date(at), "Etc/UTC"),
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
        drawAxes: [(plot) => this.drawMarks(plot, view)],
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

  // The background: the time ahead, and the band that counts as good.
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

  // The present time, and the references with their words, behind the series: no value is hidden.
  drawMarks(plot, { marks }) {
    const { ctx, bbox } = plot;
    const ratio = devicePixelRatio;
    const line = (x0, y0, x1, y1, dash) => {
      ctx.setLineDash(dash);
      ctx.beginPath();
      ctx.moveTo(x0, y0);
      ctx.lineTo(x1, y1);
      ctx.stroke();
    };
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = colour("--reference");
    ctx.lineWidth = 1.5 * ratio;
    const x = plot.valToPos(this.time, "x", true);
    if (bbox.left <= x && x <= bbox.left + bbox.width) line(x, bbox.top, x, bbox.top + bbox.height, []);
    ctx.lineWidth = ratio;
    ctx.font = `${12 * ratio}px Arial, Helvetica, sans-serif`;
    ctx.textAlign = "left";
    ctx.lineJoin = "round";
    for (const { v, inside, above, text } of marks) {
      const y = plot.valToPos(v, "left", true);
      if (inside) line(bbox.left, y, bbox.left + bbox.width, y, [3 * ratio, 2 * ratio]);
      ctx.textBaseline = above ? "top" : "bottom";
      // Neither the grid nor the line of the present time crosses the words.
      const place = [text, bbox.left + 4 * ratio, y + (above ? 3 : -2) * ratio];
      ctx.save();
      ctx.setLineDash([]);
      ctx.lineWidth = 4 * ratio;
      ctx.strokeStyle = colour("--card");
      ctx.strokeText(...place);
      ctx.restore();
      ctx.fillText(...place);
    }
    ctx.restore();
  }

  // The series as rows of the charts, in the shown units instead of SI; the end of a line has a row.
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
        if (line.range === "past") {
          const begin = Math.floor((points[0]?.[0] ?? 0) / series.stretch) * series.stretch;
          rows[`${line.name}_range`] = beyond(rows[line.name], line.steps, this.ms(begin));
        }
      }
    }
    const [level, flow, rain] = ["roof", "flow", "rain"].map(factor);
    const plan = series.plan.filter(([, end]) => end > series.now);
    rows.plan = steps(plan.map(([t0, t1, planned]) => [this.ms(Math.max(t0, series.now)), this.ms(t1), { v: planned * flow }]));
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

  rangeRows(line) { return this.rows[line.range === "past" ? `${line.name}_range` : line.name]; }

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

  // The range of an axis: from the visible values, and the references that are near them.
  range(chart, right, [from, to], marks) {
    let [low, high] = [Infinity, -Infinity];
    const take = (value) => {
      if (!Number.isFinite(value)) return;
      low = Math.min(low, value);
      high = Math.max(high, value);
    };
    for (const line of chart.lines.filter((other) => Boolean(other.right) === right)) {
      const rows = this.rows[line.name];
      for (const [i, row] of rows.entries()) {
        const next = rows[i + 1]?.t ?? row.t;
        if (next >= from && row.t <= to) [row.v, row.low, row.high].forEach(take);
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

  draw() {
    const whole = this.whole();
    // The zoom is from another run, or has scrolled out on the left.
    if (this.zoomed && (this.zoomed[0] >= whole[1] || this.zoomed[1] <= whole[0])) this.zoomed = null;
    const seen = this.zoomed ?? whole;
    const known = this.series.marks;
    for (const view of this.views.values()) {
      const { chart, plot, head } = view;
      const { factor, decimals, unit } = this.units(chart.shown);
      const named = (chart.marks ?? []).filter((name) => Number.isFinite(known[name])).map((name) => {
        const value = known[name] * factor;
        return { value, text: `${MARKS[name]} ${value.toFixed(decimals)}` };
      });
      view.band = chart.band && known.band ? known.band.map((level) => level * factor) : [];
      const left = this.range(chart, false, seen, [...named.map(({ value }) => value), ...view.band]);
      view.ranges = { x: seen, left, right: chart.right && this.range(chart, true, seen, []) };
      view.marks = placed(named, unit, ...left, chart.height - 24 - TOP);
      for (const entry of head.querySelectorAll("[data-line]")) {
        const line = chart.lines.find(({ name }) => name === entry.dataset.line);
        entry.hidden = !line ? !view.band.length
          : entry.dataset.range === undefined ? !this.rows[line.name].length : !this.rangeRows(line).some((row) => row.high > row.low);
      }
      plot.setData(this.table(chart), true);
    }
    this.changed();
  }

  // The rows of a chart for uPlot: all times, and the values of each series there. A line without a value
  // at a time goes on (undefined); it has a gap from an unknown value (null) to its next value.
  table(chart) {
    const parts = chart.lines.flatMap((line) => {
      const column = (rows, key) => [rows.map(({ t }) => t), rows.map((row) => row[key])];
      const ends = line.range ? ["low", "high"].map((key) => column(this.rangeRows(line), key)) : [];
      return [...ends, column(this.rows[line.name], "v")];
    });
    return uPlot.join(parts, parts.map((part) => part.map(() => 2)));
  }

  setHours(hours) {
    this.hours = hours;
    this.zoomed = null;
  }

  pause(paused) {
    this.paused = paused;
    if (!paused) this.drawWaiting();
  }

  // Show from one time to another; without a range, everything.
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

  // Zoom in (below 1) or out around the middle, or around the time that is pointed at.
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
    let value = row.v;
    const next = rows[before + 1];
    if (!line.steps && next && next.v !== null && next.t > row.t) {
      value += ((next.v - row.v) * (t - row.t)) / (next.t - row.t);
    }
    const { low, high } = line.range === "past" && next && t > row.t ? next : row;
    const ranged = line.range && high - low > 0.5 * 10 ** -decimals;
    const range = ranged ? ` (${low.toFixed(decimals)} to ${high.toFixed(decimals)})` : "";
    return `${value.toFixed(decimals)}${range} ${unit}`;
  }
}

// The values at a time when they are not known.
const NOTHING = { v: null, low: null, high: null };

// Adds a row without values to each gap of more than 'gap' (ms). A value that holds until the next one
// holds for 'gap' at most, not beyond a time when it is not known, and not beyond now; it has no range there.
const broken = (rows, gap, holds, now) => rows.flatMap((row, i) => {
  const next = rows[i + 1];
  if (next && next.v !== null && next.t - row.t <= gap) return [row];
  const t = holds ? Math.min(row.t + gap, next?.v === null ? next.t - 1 : now, now) : row.t;
  const end = t > row.t && row.v !== null ? [row, { t, v: row.v, low: row.v, high: row.v }] : [row];
  return next && row.v !== null && next.v !== null ? [...end, { t: t + 1, ...NOTHING }] : end;
});

// How far a value went beyond its line, from row to row; a value that only rises or falls has no band.
// No line leads to the first row: its whole range is drawn, from the begin of its stretch.
const beyond = (rows, holds, begin) => rows.flatMap((row, i) => {
  const before = rows[i - 1];
  if (row.v === null) return [row];
  if (!before) return [begin, row.t].map((t) => ({ t, low: row.low, high: row.high }));
  if (before.v === null) return [];
  const end = holds ? before.v : row.v;
  const under = Math.max(0, Math.min(before.v, end) - row.low);
  const over = Math.max(0, row.high - Math.max(before.v, end));
  return [[before.t + 1, before.v], [row.t, end]].map(([t, v]) => ({ t, low: v - under, high: v + over }));
});

// Points of steps [start, end, values]: each holds until its end.
const steps = (parts) => {
  const rows = parts.map(([t, , values]) => ({ t, ...values }));
  if (parts.length) rows.push({ t: parts.at(-1)[1], ...parts.at(-1)[2] });
  return rows;
};
