// The page takes the document and the series from the server and shows them. Every text is set as
// text, never as HTML, since some texts come from other devices.

import { Charts, atText, element, setClock } from "/charts.js";

const SILENT = 12_000; // ms until the connection counts as lost; the server sends something every 5 s
const MAX_WAIT = 8_000; // longest wait between two attempts to connect (ms)
const WORDS = { error: "Alarm", warn: "Warning", stale: "Not responding" };
const TILES = ["roof", "cistern", "pump", "rain", "controller"];
// For each state of a tile: its word, its shape and its tone.
const STATES = {
  good: ["good", "ok", "ok"], low: ["too low", "low", "warn"], high: ["too high", "high", "warn"],
  alarm: ["alarm", "error", "error"], unknown: ["unknown", "stale", "none"],
  // States of the pump; the value of its tile is the word.
  off: ["", "off", "none"], starting: ["", "running", "ok"], running: ["", "running", "ok"],
  stopping: ["", "off", "none"], held: ["", "held", "warn"], fault: ["", "error", "error"],
};

// Rain is neither good nor bad, and a controller that is well "works".
const OTHERWISE = { rain: { good: ["", null, "none"] }, controller: { good: ["works", "ok", "ok"] } };

const byId = (id) => document.getElementById(id);
const setText = (node, text) => {
  const wanted = text ?? "";
  if (node.textContent !== wanted) node.textContent = wanted;
};
const shape = (name) => {
  const space = "http://www.w3.org/2000/svg";
  const drawn = document.createElementNS(space, "svg");
  drawn.setAttribute("class", "shape");
  drawn.setAttribute("aria-hidden", "true");
  const use = document.createElementNS(space, "use");
  use.setAttribute("href", `#shape-${name}`);
  drawn.append(use);
  return drawn;
};
const setShape = (drawn, name) => drawn.querySelector("use").setAttribute("href", `#shape-${name}`);

// Make the children of a list follow the rows. Each row keeps its element, and with it the focus.
// Rows with the same key, such as two equal events at the same time, are numbered.
const keep = (list, rows, keyOf, make, fill) => {
  const known = new Map([...list.children].map((node) => [node.dataset.key, node]));
  const times = new Map();
  const wanted = rows.map((row) => {
    const plain = keyOf(row);
    const time = times.get(plain) ?? 0;
    times.set(plain, time + 1);
    const key = time ? `${plain} ${time}` : plain;
    const node = known.get(key) ?? make(row);
    known.delete(key);
    node.dataset.key = key;
    fill(node, row);
    return node;
  });
  known.forEach((node) => node.remove());
  const focused = document.activeElement;
  wanted.forEach((node, i) => {
    if (list.children[i] !== node) list.insertBefore(node, list.children[i] ?? null);
  });
  // An element that was moved has lost the focus.
  if (list.contains(focused)) focused.focus({ preventScroll: true });
};

// Tiles

const makeTile = (key) => {
  const tile = element("article", "tile");
  tile.dataset.key = key;
  const title = element("h2");
  const state = element("span", "state");
  state.append(shape("stale"), " ", element("span"));
  title.append(element("span"), state);
  tile.append(title, element("p", "value"), element("p", "sentence"), element("p", "why"));
  if (key === "roof" || key === "cistern") {
    const gauge = element("div", "gauge");
    gauge.setAttribute("aria-hidden", "true");
    tile.querySelector(".value").after(gauge);
  }
  return tile;
};

const fillTile = (tile, data) => {
  const [word, form, tone] = OTHERWISE[tile.dataset.key]?.[data.state] ?? STATES[data.state] ?? ["", null, "none"];
  tile.dataset.tone = data.alarm ? "error" : tone;
  tile.dataset.state = data.state ?? "";
  tile.classList.toggle("stale", Boolean(data.stale));
  setText(tile.querySelector("h2 > span"), data.label);
  const state = tile.querySelector(".state");
  state.hidden = form === null;
  if (form !== null) setShape(state.firstChild, form);
  setText(state.lastChild, word);
  const value = tile.querySelector(".value");
  setText(value, data.value ?? "");
  value.classList.toggle("long", value.textContent.length > 10);
  value.style.setProperty("--length", value.textContent.length);
  value.classList.toggle("word", !/\d/.test(value.textContent));
  setText(tile.querySelector(".sentence"), data.sentence);
  const why = tile.querySelector(".why");
  setText(why, data.why);
  why.hidden = !data.why || data.sentence.includes(data.why);
  const gauge = tile.querySelector(".gauge");
  if (gauge) fillGauge(gauge, data);
};

const showTile = (key, data) => {
  const tile = byId("tiles").querySelector(`[data-key=${key}]`) ?? makeTile(key);
  if (!tile.isConnected) byId("tiles").append(tile);
  fillTile(tile, data);
};

const fillGauge = (gauge, data) => {
  const known = Number.isFinite(data.low) && Number.isFinite(data.high) && data.high > data.low;
  gauge.hidden = !known;
  if (!known) return;
  const share = (value) => Math.min(1, Math.max(0, (value - data.low) / (data.high - data.low)));
  const percent = (value) => `${100 * share(value)}%`;
  const shown = JSON.stringify([data.low, data.high, data.band, data.marks]);
  if (gauge.dataset.shown !== shown) {
    gauge.dataset.shown = shown;
    const track = element("div", "track");
    track.append(element("div", "fill"));
    if (data.band) {
      const band = element("div", "band");
      band.style.left = percent(data.band[0]);
      band.style.width = `${100 * (share(data.band[1]) - share(data.band[0]))}%`;
      track.append(band);
    }
    gauge.replaceChildren(track);
    const marks = (data.marks ?? []).filter(({ at }) => Number.isFinite(at));
    // The lowest of three is labelled in a second line, where its mark crosses no other words.
    const sides = marks.length > 2 ? ["below second", "below", "above"] : ["below", "above"];
    if (marks.length > 2) marks.sort((a, b) => a.at - b.at);
    gauge.classList.toggle("three", marks.length > 2);
    marks.forEach(({ at, label }, i) => {
      const side = sides[i];
      const mark = element("div", `mark ${side}`);
      mark.style.left = percent(at);
      // The words begin at their mark, or end there in the right half; they move if they do not fit.
      const right = share(at) >= 0.5;
      const text = element("div", `text ${side} ${right ? "right" : ""}`, label);
      text.style.setProperty("--space", right ? `${100 * (1 - share(at))}%` : percent(at));
      gauge.append(mark, text);
    });
  }
  const fill = gauge.querySelector(".fill");
  fill.style.width = Number.isFinite(data.number) ? percent(data.number) : "0";
};

// Lists

const makeAlarm = () => {
  const row = element("li", "alarm");
  const text = element("div");
  const when = element("p", "when");
  when.append(element("span", "word"), " ", element("span"));
  text.append(element("p", "what"), element("p", "do"), when);
  row.append(shape("stale"), text);
  return row;
};

const fillAlarm = (row, alarm) => {
  row.dataset.level = alarm.level;
  row.dataset.alarm = alarm.id;
  row.dataset.code = alarm.code;
  row.toggleAttribute("data-over", alarm.over !== null);
  row.classList.toggle("over", alarm.over !== null);
  setShape(row.firstChild, alarm.level);
  // What an operator understands comes first, then the node's own words.
  const [what, todo] = [".what", ".do"].map((name) => row.querySelector(name));
  // What to do is shown only once: at the top, with the cause of this alarm, or no longer.
  todo.hidden = Boolean(alarm.follows) || alarm.over !== null || alarm.do === shown.advice;
  row.classList.toggle("plain", alarm.plain && !todo.hidden);
  row.classList.toggle("follows", Boolean(alarm.follows));
  const order = alarm.plain ? [todo, what] : [what, todo];
  if (what.parentNode.firstChild !== order[0]) what.parentNode.prepend(...order);
  setText(what, alarm.what);
  setText(todo, alarm.do);
  setText(row.querySelector(".word"), alarm.over === null ? WORDS[alarm.level] : "Over");
  const since = `since ${alarm.since_text}`;
  const when = alarm.over === null ? since : `${since}, over at ${alarm.over_text}`;
  const follows = alarm.follows ? `; caused by ${alarm.follows}` : "";
  setText(row.querySelector(".when").lastChild, `${alarm.id}, ${when}${follows}`);
};

// The document

let shown = null;
let shownAt = 0; // on the browser's clock (ms), which may be wrong
let announced = { text: "", at: 0 };

const showSummary = (document_) => {
  const { summary } = document_.tiles;
  byId("summary").dataset.level = summary.level;
  byId("summary-shape").setAttribute("href", `#shape-${summary.level}`);
  setText(byId("summary-word"), summary.word);
  setText(byId("summary-sentence"), summary.sentence);
  setText(byId("advice"), document_.advice);
  document.title = `${summary.level === "ok" ? "" : `${summary.word} `}Green roof`;
  announce(`${summary.word} ${summary.sentence}`);
};

const showEvents = (events) => {
  keep(byId("events"), events, (event) => JSON.stringify([event.at, event.what]), (event) => {
    const row = element("li");
    row.append(element("time", "", event.at_text), element("span", "", event.what));
    return row;
  }, () => {});
  byId("no-events").hidden = events.length > 0;
};

const showHead = (document_) => {
  setText(byId("namespace"), document_.namespace ? ` ${document_.namespace}` : "");
  setText(byId("heading"), document_.heading);
  setText(byId("time"), document_.time.text);
};

const showAlarms = (document_) => {
  // Alarms that are over share one line.
  const past = document_.alarms.filter((alarm) => alarm.over !== null);
  const listed = document_.alarms.filter((alarm) => !past.includes(alarm));
  const keyOf = (alarm) => JSON.stringify([alarm.id, alarm.since]);
  keep(byId("alarms"), listed, keyOf, makeAlarm, fillAlarm);
  keep(byId("past-alarms"), past, keyOf, makeAlarm, fillAlarm);
  byId("past").hidden = past.length === 0;
  setText(byId("past-word"), past.length === 1 ? "1 alarm is over" : `${past.length} alarms are over`);
  byId("no-alarms").hidden = listed.length > 0;
};

// The stop comes first; a part that cannot be shown hides no other part.
const show = (document_) => {
  shown = document_;
  shownAt = Date.now();
  const failed = [];
  for (const [name, part] of [
    ["the stop", () => showStop(document_.stop)],
    ["the clock", () => setClock(document_.time.clock)],
    ["the summary", () => showSummary(document_)],
    ["the heading", () => showHead(document_)],
    ...TILES.map((key) => [`the ${key} tile`, () => showTile(key, document_.tiles[key])]),
    ["the alarms", () => showAlarms(document_)],
    ["the events", () => showEvents(document_.events)],
  ]) {
    try {
      part();
    } catch (error) {
      failed.push(`This browser cannot show ${name} (${error.message}).`);
    }
  }
  keep(byId("notes"), [...failed, ...(document_.notes ?? [])], (note) => note, () => element("li"), setText);
};

// For a screen reader: the summary when it changes, but not more often than it can be read aloud.
const announce = (text) => {
  if (text === announced.text || performance.now() - announced.at < 5000) return;
  announced = { text, at: performance.now() };
  setText(byId("announced"), text);
};

// Stopping the pump

let answered = ""; // the action whose answer is shown
let shownDose = "-"; // the last shown answer about a dose
let stopBefore = { held: false, warning: "" };

const showStop = (stop) => {
  byId("stop").hidden = !stop.possible;
  setText(byId("stop-button"), stop.label);
  setText(byId("release-call"), stop.release);
  byId("release").hidden = !stop.release;
  setText(byId("hold"), stop.hold ?? "");
  byId("release-by-hand").hidden = stop.release_here;
  byId("release-button").hidden = !stop.release_here;
  byId("clear").hidden = !stop.clear_here && !stop.clear_call;
  setText(byId("clear-call"), stop.clear_call);
  byId("clear-by-hand").hidden = stop.clear_here || !stop.clear_call;
  setText(byId("no-clear"), stop.no_clear && `The fault cannot be cleared from here: ${stop.no_clear}.`);
  byId("clear-button").hidden = !stop.clear_here;
  byId("dose").hidden = stop.max_dose === null;
  byId("dose-volume").max = stop.max_dose ?? 0;
  byId("dose-volume").min = stop.min_dose ?? 0;
  setText(byId("dose-limits"), stop.dose_limits);
  byId("dose-limits").hidden = !stop.dose_here;
  // The answer to a request follows the dose until it is delivered.
  if (answered === "dose" && stop.dose && !stop.dose.startsWith(shownDose)) {
    shownDose = stop.dose;
    answer(`${stop.dose[0].toUpperCase()}${stop.dose.slice(1)}.`, false);
  }
  setText(byId("no-dose"), stop.no_dose && `No dose is possible now: ${stop.no_dose}.`);
  byId("dose-label").hidden = byId("dose-button").hidden = !stop.dose_here;
  setText(byId("stop-warning"), stop.warning);
  byId("stop-warning").hidden = !stop.warning;
  // An answer becomes outdated: it goes when the pump is released or finally stops.
  const place = byId("answer");
  const unsure = place.classList.contains("failed") || stopBefore.warning;
  if (stop.stopped !== stopBefore.stopped && (!stop.stopped || unsure)) place.hidden = true;
  stopBefore = stop;
  // So does a question, except the one about a stop, which is always valid.
  const still = stop[`${asked}_here`] && stop[ACTIONS[asked].then] === byId("ask-sentence").textContent;
  if (byId("ask").open && asked !== "stop" && !still) {
    byId("ask").close();
    answer("Nothing was done: the situation has changed in the meantime.", true);
  }
};

// A stop needs no document, so it works before the first one arrives and if none can be made.
const LOCK_OUT = byId("release-lock").textContent;
const showBareStop = () => {
  byId("stop").hidden = false;
};

const answer = (text, failed) => {
  const place = byId("answer");
  const now = shown?.time.now ?? null;
  const at = now === null ? "" : `${atText(now * 1000 + Date.now() - shownAt).slice(-8)}: `;
  place.hidden = false;
  place.classList.toggle("failed", failed);
  setText(place, `${at}${text}`);
};

const headers = () => {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  return { "X-Greenroof": "1", ...(token ? { Authorization: `Bearer ${token}` } : {}) };
};

const post = async (path, body) => {
  const response = await fetch(path, {
    method: "POST", headers: { ...headers(), "Content-Type": "application/json" },
    body: JSON.stringify(body), signal: AbortSignal.timeout(10_000),
  });
  const reply = await response.json();
  if (response.ok) return reply;
  if (response.status >= 500) throw new Error(reply.sentence);
  return { ok: false, sentence: `Nothing was done: ${reply.sentence}.` };
};

// Each action asks once, then shows the result.
const ACTIONS = {
  stop: { title: "Stop the pump?", yes: "Yes, stop the pump", then: "sentence", doubt: "the pump will stop" },
  release: { title: "Release the pump?", yes: "Yes, release the pump", then: "release_then", doubt: "the pump was released" },
  clear: { title: "Clear the fault?", yes: "Yes, clear the fault", then: "clear_then", doubt: "the fault was cleared" },
  dose: { title: "Give a dose?", yes: "Yes, give the dose", then: "dose_then", doubt: "the dose was given" },
};

const act = async (name, body) => {
  const button = byId(`${name}-button`);
  button.disabled = true;
  answered = "";
  answer("Asking the pump node ...", false);
  // A browser opens six connections to a server, and every open page holds one, so release this page's.
  stream.close();
  try {
    const { ok, sentence } = await post(`/${name}`, body);
    answer(sentence, !ok);
    [answered, shownDose] = [ok ? name : "", "-"];
  } catch (error) {
    const how = name === "stop" ? " Try again, or stop it at the pump itself." : "";
    answer(`It is unknown whether ${ACTIONS[name].doubt}: ${error.message}.${how}`, true);
  } finally {
    button.disabled = false;
    stream.open();
  }
};

let asked = "stop";
let askedBody = {};
for (const [name, { title, yes, then }] of Object.entries(ACTIONS)) {
  byId(`${name}-button`).addEventListener("click", () => {
    const volume = byId("dose-volume").valueAsNumber;
    if (name === "dose" && !(volume > 0 && volume >= shown.stop.min_dose && volume <= shown.stop.max_dose)) {
      answer(`A dose must be ${shown.stop.dose_limits}.`, true);
      return;
    }
    asked = name;
    askedBody = name === "dose" ? { volume } : {};
    setText(byId("ask-title"), name === "dose" ? `${title.slice(0, -1)} of ${volume} m³?` : title);
    setText(byId("ask-yes"), yes);
    setText(byId("ask-sentence"), shown?.stop[then] ?? `A stop holds the pump off until someone releases it. ${LOCK_OUT}`);
    byId("ask").showModal();
  });
}
byId("ask-no").addEventListener("click", () => byId("ask").close());
byId("ask-yes").addEventListener("click", () => {
  byId("ask").close();
  act(asked, asked === "dose" ? { ...askedBody, asked_at: shown.stop.asked_at } : askedBody);
});

// Charts

const charts = new Charts(
  byId("charts"),
  () => {
    byId("zoom-all").disabled = charts.zoomed === null;
  },
  (text) => setText(byId("announced"), text),
);
window.charts = charts; // for the console
const zoom = { "zoom-in": () => charts.scale(0.5), "zoom-out": () => charts.scale(2), "zoom-all": () => charts.zoom(null) };
for (const [id, act] of Object.entries(zoom)) byId(id).addEventListener("click", act);
for (const button of document.querySelectorAll("[data-hours]")) {
  button.addEventListener("click", () => {
    for (const other of document.querySelectorAll("[data-hours]")) other.setAttribute("aria-pressed", String(other === button));
    charts.setHours(Number(button.dataset.hours));
    stream.close();
    stream.open();
  });
}

const takeSeries = (series) => {
  try {
    if (series.problem) throw new Error(series.problem);
    charts.take(series);
    document.documentElement.dataset.drawn = "yes";
  } catch (error) {
    setText(byId("charts-note"), `The charts cannot be drawn: ${error.message}`);
  }
};

// The stream: server-sent events, read with fetch so that the token can be a header.

class Refused extends Error {}

const stream = {
  controller: null,
  wait: 500,
  timer: null,

  open() {
    clearTimeout(this.timer);
    if (this.controller) return;
    const controller = new AbortController();
    this.controller = controller;
    this.read(controller).catch((error) => error).then((reason) => {
      if (this.controller !== controller) return; // closed on purpose
      this.controller = null;
      this.ended(reason);
    });
  },

  close() {
    clearTimeout(this.timer);
    const { controller } = this;
    this.controller = null;
    controller?.abort();
  },

  async read(controller) {
    // Measured by the time of day, which goes on while the computer sleeps.
    let heard = Date.now();
    const watchdog = setInterval(() => {
      if (Date.now() - heard > SILENT) controller.abort();
    }, 1000);
    try {
      const response = await fetch(`/events?hours=${charts.hours}`, { headers: headers(), signal: controller.signal, cache: "no-store" });
      if (!response.ok) throw new Refused((await response.json()).sentence);
      const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
      let text = "";
      for (;;) {
        const { done, value } = await reader.read();
        if (done) return null;
        heard = Date.now();
        text += value;
        const parts = text.split("\n\n");
        text = parts.pop();
        parts.forEach((part) => this.take(part, controller));
      }
    } finally {
      clearInterval(watchdog);
    }
  },

  take(part, controller) {
    if (this.controller !== controller) return;
    const lines = part.split("\n");
    const name = lines.find((line) => line.startsWith("event: "))?.slice(7);
    const data = lines.filter((line) => line.startsWith("data: ")).map((line) => line.slice(6)).join("\n");
    if (!["state", "series"].includes(name)) return;
    this.wait = 500;
    const received = JSON.parse(data);
    byId("lost").hidden = true;
    document.body.classList.remove("lost-link");
    if (name === "state") show(received);
    else takeSeries(received);
  },

  // Until the next event, the page shows old values.
  lost(why) {
    const of = shown ? `the values shown are from ${shown.time.text}.` : "there is nothing to show yet.";
    setText(byId("lost"), `Not connected: ${of}${why} Trying again ...`);
    byId("lost").hidden = false;
    document.body.classList.add("lost-link");
  },

  ended(reason) {
    if (!shown) showBareStop();
    document.title = "Not connected: Green roof";
    this.lost(reason instanceof Refused ? ` The server reports: ${reason.message}.` : "");
    this.timer = setTimeout(() => this.open(), this.wait);
    this.wait = Math.min(2 * this.wait, MAX_WAIT);
  },
};

addEventListener("online", () => stream.open());
addEventListener("hashchange", () => {
  stream.close();
  stream.open();
});
stream.open();
