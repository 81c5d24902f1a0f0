// The page polls the state and the charts, and shows them. Every text is set as text, never as HTML, since
// some texts come from other devices.

import { draw, follow, plots, setZone, timeText } from "/charts.js";

const POLL = 1000; // ms between two states
const CHARTS_POLL = 10_000; // ms between two drawings of the charts
const SILENT = 6000; // ms after which the last state counts as old
const REPORTED = 3000; // ms after which the state contains the effect of an action
const LEVELS = { error: "Alarm", warn: "Warning" };
// Colours of the values, by their state; other states have none.
const TONES = { good: "ok", running: "ok", starting: "ok", low: "warn", high: "warn", held: "warn", doubtful: "warn", cold: "warn", open: "ok", opening: "ok", alarm: "error", fault: "error" };
// Of each action: what is done, and what is unknown if it fails. Those on the valve begin with valve_.
const ACTIONS = {
  stop: ["stop the pump", "the pump will stop"], release: ["release the pump", "the pump was released"],
  clear: ["clear the fault", "the fault was cleared"], dose: ["give a dose", "the dose was given"],
  valve_close: ["close the outlet valve", "the valve will close"], valve_release: ["release the outlet valve", "the valve was released"],
  valve_open: ["open the outlet valve for 30 minutes", "the valve was opened"],
};
const BUTTONS = Object.keys(ACTIONS).filter((name) => name !== "dose");

const byId = (id) => document.getElementById(id);
const setText = (id, text) => {
  if (byId(id).textContent !== text) byId(id).textContent = text;
};
const element = (tag, name, ...content) => {
  const made = document.createElement(tag);
  made.className = name;
  made.append(...content);
  return made;
};
// Fill a list anew if its content has changed; empty lists are hidden with their heading.
const fill = (id, rows, make) => {
  const list = byId(id);
  const content = JSON.stringify(rows);
  if (list.dataset.content === content) return;
  list.dataset.content = content;
  list.replaceChildren(...rows.map(make));
  const section = byId(`${id}-section`);
  if (section) section.hidden = rows.length === 0;
};

// The state

let state = null;
let receivedAt = -Infinity; // when it came (ms on the browser's clock, which may be wrong)
let answer = null; // of the last action: its text, whether it failed, when it came, and how the pump was then

const showSummary = ({ tiles: { summary } }) => {
  byId("summary").dataset.level = summary.level;
  setText("word", summary.word);
  setText("sentence", summary.sentence);
  document.title = `${summary.level === "ok" ? "" : `${summary.word || summary.sentence} `}Green roof`;
};

const showHead = ({ namespace, heading, time, contact }) => {
  setText("namespace", namespace && ` ${namespace}`);
  setText("heading", heading);
  setText("time", time.text);
  setText("contact", contact);
};

const showTiles = ({ tiles }) => {
  const rows = Object.entries(tiles).filter(([key]) => key !== "summary");
  fill("values", rows, ([key, { label, value, sentence, state: rated }]) => {
    const row = element("div", rated === "unknown" ? "stale" : "", element("dt", "", label), element("dd", "value", value), element("dd", "sentence", sentence));
    row.dataset.key = key;
    row.dataset.tone = TONES[rated] ?? "none";
    return row;
  });
};

// An advice that is in the box is not repeated; of a hold, the box states more.
const showAlarms = ({ alarms, advice }) => fill("alarms", alarms.map((alarm) => ({ ...alarm, told: (alarm.code === "hold" && alarm.role === "pump") || advice.includes(alarm.do) })), (alarm) => {
  const row = element("li", "", element("strong", "", `${LEVELS[alarm.level]}. `), element("span", "", alarm.what), ` since ${alarm.since_text}.`);
  row.dataset.level = alarm.level;
  row.dataset.code = alarm.code;
  if (!alarm.told) row.append(element("p", "", alarm.do));
  return row;
});

const showEvents = ({ events }) => fill("events", events, ({ at_text: at, what }) => (
  element("li", "", element("time", "", at), element("span", "", what))));

const showStop = ({ mode, stop }) => {
  byId("stop").hidden = !stop.possible && (mode !== "live" || !stop.needed);
  setText("stop-button", stop.stopped ? "The pump is already held off" : stop.label);
  byId("stop-button").classList.toggle("danger", !stop.stopped);
  for (const name of BUTTONS.slice(1)) byId(`${name}-button`).hidden = !(name in stop.actions);
  byId("dose").hidden = !("dose" in stop.actions);
  const { min, max, refusal } = stop.dose;
  Object.assign(byId("litres"), { min: 1000 * (min || 1e-6), max: 1000 * max });
  setText("dose-limits", `${Math.ceil(1000 * min)} to ${1000 * max} L`);
  setText("no-dose", refusal && !stop.hold ? `No dose is possible now: ${refusal}.` : ""); // of a hold the box states more
  // A question becomes outdated, except one about a stop.
  if (byId("ask").open && !["stop", "valve_close"].includes(asked.name) && asked.situation !== situation()) {
    byId("ask").close();
    setAnswer("Nothing was done: the situation has changed in the meantime.", true);
  }
};

const situation = () => JSON.stringify([Object.keys(state?.stop.actions ?? {}), state?.tiles.pump.state]);

// The one box: the answer to the last action until the state contains its effect, otherwise what to do.
const showBox = () => {
  if (answer && (answer.failed ? answer.situation !== situation() : receivedAt - answer.at > REPORTED)) answer = null;
  byId("box").classList.toggle("failed", Boolean(answer?.failed));
  setText("box", answer?.text ?? state?.advice ?? "");
};

const setAnswer = (text, failed, at = Date.now()) => {
  const now = state?.time.now == null ? "" : `${timeText(state.time.now + (Date.now() - receivedAt) / 1000).slice(-8)}: `;
  answer = { text: `${now}${text}`, failed, at, situation: situation() };
  showBox();
};

// The stop comes first; a part that cannot be shown hides no other part.
const show = (received) => {
  state = received;
  receivedAt = Date.now();
  const failed = [];
  const parts = {
    "the stop": showStop, "the clock": ({ time }) => setZone(time.zone), "what to do": showBox, "the summary": showSummary,
    "the heading": showHead, "the values": showTiles, "the alarms": showAlarms, "the events": showEvents,
  };
  for (const [name, part] of Object.entries(parts)) {
    try {
      part(state);
    } catch (error) {
      failed.push(`This browser cannot show ${name} (${error.message}).`);
    }
  }
  fill("notes", [...failed, ...(state.notes ?? [])], (note) => element("li", "", note));
};

// The actions

let asked = { name: "stop" };

const headers = () => {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  return { "X-Greenroof": "1", "Content-Type": "application/json", ...(token ? { Authorization: `Bearer ${token}` } : {}) };
};

const ask = (name, body = {}) => {
  const what = name === "dose" ? `give a dose of ${byId("litres").value} L` : ACTIONS[name][0];
  asked = { name, body, situation: situation() };
  setText("question", `${what[0].toUpperCase()}${what.slice(1)}?`);
  setText("yes", `Yes, ${what}`);
  setText("effect", state?.stop.actions[name] ?? "A stop holds the pump off until someone releases it.");
  byId("ask").showModal();
};

const act = async ({ name, body }) => {
  const button = byId(`${name}-button`);
  button.disabled = true;
  setAnswer("Asking the site ...", false, Infinity);
  try {
    const response = await fetch(`/${name}`, {
      method: "POST", headers: headers(), body: JSON.stringify(body), signal: AbortSignal.timeout(10_000),
    });
    const { ok, sentence } = await response.json();
    if (response.status >= 500) throw new Error(sentence);
    setAnswer(response.ok ? sentence : `Nothing was done: ${sentence}.`, !ok);
  } catch (error) {
    const how = name === "stop" ? " Try again, or stop it at the pump itself." : "";
    setAnswer(`It is unknown whether ${ACTIONS[name][1]}: ${error.message}.${how}`, true);
  } finally {
    button.disabled = false;
  }
};

for (const name of BUTTONS) byId(`${name}-button`).addEventListener("click", () => ask(name));
byId("dose").addEventListener("submit", (event) => {
  event.preventDefault();
  ask("dose", { volume: byId("litres").valueAsNumber / 1000, asked_at: state.time.now });
});
byId("no").addEventListener("click", () => byId("ask").close());
byId("yes").addEventListener("click", () => {
  byId("ask").close();
  act(asked);
});

// Polling

let why = ""; // there is no newer state
let hours = 12;

const read = async (path) => {
  const response = await fetch(path, { headers: headers(), signal: AbortSignal.timeout(5000) });
  const content = await response.json();
  if (!response.ok) throw new Error(`The server reports: ${content.sentence}.`);
  return content;
};

const poll = async () => {
  try {
    show(await read("/state"));
    why = "";
  } catch (error) {
    why = error.message;
    if (!state) byId("stop").hidden = false; // a stop needs no state
  }
  showAge();
  setTimeout(poll, POLL);
};

// By the time of day, which goes on while the computer sleeps.
const showAge = () => {
  const lost = state ? Date.now() - receivedAt > SILENT : why !== "";
  byId("lost").hidden = !lost;
  document.body.classList.toggle("lost-link", lost);
  if (!lost) return;
  document.title = "Not connected: Green roof";
  const old = state ? `the values shown are from ${state.time.text}.` : "there is nothing to show yet.";
  setText("lost", `Not connected: ${old} ${why} Trying again ...`);
};

const pollCharts = async () => {
  try {
    draw(byId("charts"), await read(`/charts?hours=${hours}`));
    setText("charts-note", "");
    document.documentElement.dataset.drawn = "yes";
  } catch (error) {
    setText("charts-note", `The charts cannot be drawn: ${error.message}`);
  }
};

byId("hours").addEventListener("click", ({ target }) => {
  if (!target.value) return;
  hours = target.value;
  for (const button of byId("hours").children) button.setAttribute("aria-pressed", String(button === target));
  pollCharts();
});
window.plots = plots; // for the console
follow(byId("charts"));
setInterval(showAge, POLL);
setInterval(pollCharts, CHARTS_POLL);
poll().then(pollCharts);
