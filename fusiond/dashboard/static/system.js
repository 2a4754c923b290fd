// Events, calibration, and the computer: clock, scheduler, recording, outputs; and commands.
import { token } from "./link.js";
import { byId, element, fillRows, fixed, known, put, short, stretch, utc, whole } from "./text.js";

const events = byId("events").createTBody(),
  system = byId("system").createTBody();
const calibration = byId("calibration");
const MOST_EVENTS = 60;
let eventsShown = "";

export function showEvents(store) {
  const rows = store.rows.event,
    last = rows[rows.length - 1];
  const key = `${store.vehicle} ${rows.length} ${last ? last[0] + last[1].text : ""}`;
  if (key === eventsShown) return;
  eventsShown = key;
  const lines = rows
    .slice(-MOST_EVENTS)
    .reverse()
    .map(([, e]) => {
      const said = `${e.code.replaceAll("_", " ")}: ${e.text}`;
      const line = [utc(e.t_ms), e.source, e.advice ? `${said}. ${e.advice}` : said];
      line.rowClass = `level-${e.level}`;
      return line;
    });
  fillRows(
    events,
    lines.length
      ? lines
      : [[{ text: "No events.", className: "none", span: 3 }]],
  );
}

const STATES = { not_observed: "not observed", observed: "observed", settled: "settled" };
const UNITS = [
  ["_deg", "\u00b0"],
  ["_m", "m"],
  ["_ms", "ms"],
  ["_s", "s"],
];

function parameter([name, p]) {
  const [ending, unit] = UNITS.find(([end]) => name.endsWith(end)) || ["", ""];
  const label = name.slice(0, name.length - ending.length).replaceAll("_", " ");
  const digits = p.sd < 0.001 ? 5 : p.sd < 0.1 ? 3 : 2;
  return [
    label,
    { text: `${fixed(p.value, digits)} ${unit}`, className: "n" },
    { text: `\u00b1 ${fixed(p.sd, digits)}`, className: "n" },
    STATES[p.state] || p.state,
  ];
}

export function showCalibration(store) {
  const said = store.said("calibration");
  if (!said) {
    if (!calibration.firstChild)
      calibration.append(
        element("p", "none", "No calibration yet: it begins with navigation, if a parameter is estimated."),
      );
    return;
  }
  let table = calibration.querySelector("table");
  if (!table) {
    table = element("table");
    const head = table.createTHead().insertRow();
    for (const [text, name] of [
      ["", ""],
      ["estimate", "n"],
      ["1 sigma", "n"],
      ["", ""],
    ])
      head.append(element("th", name, text));
    table.createTBody();
    calibration.replaceChildren(table);
  }
  fillRows(table.tBodies[0], Object.entries(said.parameters).map(parameter));
}

function clockWords(h) {
  const off = known(h.system_clock_error_s)
    ? `, system clock ${h.system_clock_error_s >= 0 ? "+" : "\u2212"}${short(Math.abs(h.system_clock_error_s))}`
    : "";
  return `UTC from ${h.utc_source}${h.utc_settled ? "" : ", not settled"}${off}`;
}

function recordingWords(s) {
  const file = s.recording_file ? `, ${s.recording_file.split("/").pop()}` : "";
  const free = known(s.disk_free_mb) ? `, ${(s.disk_free_mb / 1000).toFixed(1)} GB free` : "";
  const lost = s.recording_dropped ? `, ${whole(s.recording_dropped)} lost` : "";
  return s.recording + file + lost + free;
}

export function showSystem(store) {
  const h = store.said("health"),
    s = store.said("status");
  const rows = [];
  if (h) {
    const late = `p50 ${fixed(h.lateness_p50_ms, 2)}, p99 ${fixed(h.lateness_p99_ms, 2)}, max ${fixed(h.lateness_max_ms, 1)} ms`;
    rows.push([
      "CPU, memory",
      `${fixed(h.cpu_percent, 1)} % of a core, ${fixed(h.memory_mb, 0)} MB`,
    ]);
    rows.push(["ticks", `${whole(h.ticks)}, ${whole(h.overruns)} overruns`]);
    rows.push(["tick delay", late], ["clock", clockWords(h)]);
  }
  if (s) {
    rows.push(["recording", recordingWords(s)]);
    rows.push([
      "daemon",
      `fusiond ${s.version}, configuration ${s.config_digest}, up ${stretch(s.uptime_s)}`,
    ]);
    rows.push([
      "to the broker",
      `${whole(s.mqtt_published)} sent, ${whole(s.mqtt_dropped)} dropped, ${whole(s.mqtt_reconnects)} reconnects`,
    ]);
    if (s.protection !== "off") rows.push(["integrity", s.protection]);
    if (s.injected && s.injected.length) rows.push(["simulated faults", s.injected.join(", ")]);
  }
  if (h) {
    for (const [name, o] of Object.entries(h.outputs || {}))
      if (!["mqtt", "recording"].includes(name))
        rows.push([name, [o.state, o.detail].filter(Boolean).join(", ")]);
  }
  fillRows(system, rows);
  showAnswers(store);
}

// ------------------------------------------------------------------ commands

const WORDS = {
  request_fix: "request a fix",
  start_recording: "start recording",
  stop_recording: "stop recording",
  reset_filter: "align again",
};
const holder = byId("commands"),
  answer = element("span", "notes");
let made = "";

export function bindCommands(store, socket) {
  const key = token();
  holder.make = () => {
    const offered = key && store.hello ? store.hello.commands : [];
    if (offered.join() === made) return;
    made = offered.join();
    holder.hidden = !offered.length;
    holder.replaceChildren(
      ...offered.map((name) => {
        const button = element("button", "", WORDS[name] || name);
        button.onclick = () => {
          if (name === "reset_filter" && !confirm("Forget position and heading, and align again?"))
            return;
          put(answer, "");
          socket.ask({ command: name, token: key });
        };
        return button;
      }),
      answer,
    );
  };
}

function showAnswers(store) {
  holder.make();
  const reply = store.said("reply"),
    last = store.answers[store.answers.length - 1];
  if (reply && String(reply.id).startsWith("dashboard-"))
    put(answer, `${reply.command}: ${reply.text}`);
  else if (last) put(answer, last.text);
}
