// Two charts over one time axis, drawn by uPlot. They show the site's clock, since the browser may be in
// another time zone.

const { uPlot } = window;

// Of each chart: the quantities of its axes, and its lines with their names, labels, colours and dashes.
const CHARTS = [
  { left: "roof", right: "cistern", height: 240, lines: [
    ["roof", "roof", "--roof"], ["roof_planned", "planned", "--roof", [6, 4]],
    ["target", "target", "--target", [1, 3]],
    ["cistern", "cistern", "--cistern"],
  ] },
  { left: "flow", right: "rain", height: 200, steps: true, lines: [
    ["flow", "pump", "--flow"], ["flow_planned", "planned", "--flow", [6, 4]],
    ["rain", "rain", "--rain"], ["rain_forecast", "rain forecast", "--rain", [6, 4]],
  ] },
];
const DASHES = { 6: "dashed", 1: "dotted" }; // in the legend, by the length of a line's dashes
const FONT = "12px Arial, Helvetica, sans-serif";

export const plots = [];
let shown = null; // the series
let zoomed = null; // times between which it is shown (s since 1970)

// Writes a time as 2021-07-20 05:00:00, in UTC until the site's zone is known or if the browser does not know it.
const makeClock = (zone) => new Intl.DateTimeFormat("sv-SE", { timeZone: zone, dateStyle: "short", timeStyle: "medium" });
let clock = makeClock("UTC");
export const setZone = (zone) => { clock = makeClock(zone); };
export const timeText = (at) => clock.format(new Date(at * 1000));
// A time on the axis: the date at midnight, otherwise the time.
const tickText = (at) => {
  const [date, time] = timeText(at).split(" ");
  if (time === "00:00:00") return date.slice(5);
  return time.endsWith(":00") ? time.slice(0, 5) : time;
};

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const quantity = (name) => (name === "target" ? "roof" : name.split("_")[0]);

const options = (chart, width) => {
  const { display } = shown;
  const axis = (name, side) => ({
    scale: name, side, size: 52, gap: 3, labelSize: 16, label: `${display[name].label} (${display[name].unit})`,
    font: FONT, labelFont: FONT, stroke: colour("--ink"), space: 28, grid: { show: side === 3, stroke: colour("--grid") },
  });
  const range = chart.steps ? (_, low, high) => [0, high > 0 ? 1.1 * high : 1] : (_, low, high) => {
    const margin = Math.max(0.1 * (high - low), 0.05 * high, 1); // of levels that hardly change, too (mm)
    return [Math.max(0, low - margin), high + margin];
  };
  return {
    width, height: chart.height,
    tzDate: (at) => uPlot.tzDate(new Date(`${timeText(at).replace(" ", "T")}Z`), "Etc/UTC"),
    scales: { x: { range: () => zoomed ?? [shown.from, shown.to] }, [chart.left]: { range }, [chart.right]: { range } },
    axes: [
      { font: FONT, stroke: colour("--ink"), space: 60, grid: { stroke: colour("--grid") }, values: (_, splits) => splits.map(tickText) },
      axis(chart.left, 3), axis(chart.right, 1),
    ],
    series: [
      { label: "time", value: (_, at) => (at === null ? "" : timeText(at)) },
      ...chart.lines.map(([name, label, ink, dash]) => ({
        label, dash, scale: quantity(name), stroke: colour(ink), width: 2, points: { show: false },
        paths: chart.steps ? uPlot.paths.stepped({ align: 1 }) : uPlot.paths.linear(),
        value: (_, value) => (value == null ? "" : `${value.toFixed(display[quantity(name)].decimals)} ${display[quantity(name)].unit}`),
      })),
    ],
    legend: { markers: { dash: (_, i) => DASHES[chart.lines[i - 1]?.[3]?.[0]] ?? "solid" } },
    cursor: {
      y: false, points: { show: false }, sync: { key: "charts", setSeries: false }, drag: { setScale: false },
      // Of each line, the value at the pointer is its last one before, as lines have values at different times.
      dataIdx: (plot, line, at) => {
        let place = at;
        while (place > 0 && plot.data[line][place] === undefined) place -= 1;
        return place;
      },
      bind: { dblclick: () => () => zoom(null) },
    },
    hooks: {
      drawClear: [({ ctx, bbox, valToPos }) => { // the time ahead
        const left = Math.max(bbox.left, valToPos(shown.now, "x", true));
        ctx.fillStyle = colour("--ahead");
        ctx.fillRect(left, bbox.top, Math.max(0, bbox.left + bbox.width - left), bbox.height);
      }],
      setSelect: [(plot) => {
        const { left, width } = plot.select;
        if (width < 8) return;
        plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
        zoom([plot.posToVal(left, "x"), plot.posToVal(left + width, "x")]);
      }],
    },
  };
};

// The lines of a chart at all times of any of them. A line without a value at a time continues (undefined),
// and has a gap from an unknown value (null) to its next value.
const table = ({ lines }) => {
  const all = lines.map(([name]) => shown.lines[name] ?? []);
  return uPlot.join(all.map((line) => [line.map(([at]) => at), line.map(([, value]) => value)]), all.map((line) => line.map(() => 2)));
};

const fill = () => plots.forEach((plot, i) => plot.setData(table(CHARTS[i])));

const zoom = (times) => {
  zoomed = times;
  fill();
};

export const draw = (box, series) => {
  shown = series;
  if (series.now === null) return;
  if (zoomed && (zoomed[0] >= series.to || zoomed[1] <= series.from)) zoomed = null;
  if (!plots.length) build(box);
  fill();
};

const build = (box) => {
  plots.splice(0).forEach((plot) => plot.destroy());
  for (const chart of CHARTS) plots.push(new uPlot(options(chart, box.clientWidth), table(chart), box));
};

export const follow = (box) => {
  const rebuild = () => { if (shown?.now) build(box); };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", rebuild);
  new ResizeObserver(() => plots.forEach((plot) => plot.setSize({ width: box.clientWidth, height: plot.height }))).observe(box);
};
