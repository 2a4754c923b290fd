// One word for the state, why, since when, what to do; and the banner of a lost link.
import { linkFault } from "./age.js";
import { byId, element, hypot, known, mark, put, sigma, stretch, utc, whole } from "./text.js";

const banner = byId("banner"),
  header = byId("state"),
  todo = byId("todo");
let advised = "";

function showBanner(store) {
  const fault = linkFault({
    socket: store.socket,
    silent: store.silent,
    link: store.link,
    vehicle: store.vehicle,
    online: store.latest.online,
    status: store.latest.status,
    now: store.now,
  });
  banner.hidden = fault === null;
  mark(document.body, "lost", fault !== null && fault.kind !== "ended");
  if (fault === null) return null;
  mark(banner, "ended", fault.kind === "ended");
  const since = fault.since === null ? "" : ` for ${stretch(fault.since)}`;
  const stale = fault.kind === "ended" ? "" : ". What stands below is old.";
  put(banner, fault.text.charAt(0).toUpperCase() + fault.text.slice(1) + since + stale);
  return fault;
}

function showAdvice(store) {
  const steps = store.said("advice") || [];
  const key = JSON.stringify(steps);
  if (key === advised) return;
  advised = key;
  todo.replaceChildren(
    ...steps.slice(0, 3).map(([level, , text]) => element("span", `step ${level}`, text)),
  );
  if (steps.length > 3) todo.append(element("span", "step", `${steps.length - 3} more`));
  todo.title = steps.map((step) => step[2]).join("\n");
}

function sinceWhen(status, store) {
  if (!known(status.since_ms) || !known(status.t_ms)) return "";
  const age = store.age("status");
  return `for ${stretch((status.t_ms - status.since_ms) / 1000 + (age || 0))}, since ${utc(status.since_ms)}`;
}

function showVehicle(store) {
  const several = store.vehicles.length > 1,
    choice = byId("vehicles");
  byId("vehicle").hidden = several;
  choice.hidden = !several;
  put(byId("vehicle"), store.vehicle || "");
  const names = store.vehicles.join(" ");
  if (several && choice.dataset.names !== names) {
    choice.dataset.names = names;
    choice.replaceChildren(...store.vehicles.map((name) => element("option", "", name)));
  }
  if (several && document.activeElement !== choice) choice.value = store.vehicle;
}

// Messages that were not what their topic carries: how many, of which kind, why the last.
function showRefused(store) {
  const { count, kinds, last } = store.refused,
    note = byId("refused");
  note.hidden = count === 0;
  put(note, `${whole(count)} ${count === 1 ? "message" : "messages"} refused`);
  const parts = Object.entries(kinds).map(([kind, n]) => `${n} ${kind.replaceAll("_", " ")}`);
  note.title = `${parts.join(", ")}; the last: ${last}`;
}

export function showHeader(store) {
  const fault = showBanner(store),
    lost = fault !== null && fault.kind !== "ended";
  const status = store.said("status"),
    nav = store.said("nav");
  const mode = (nav && !store.old("nav") && nav.mode) || (status && status.mode) || "none";
  const word = mode === "none" ? "no data" : mode;
  header.style.setProperty("--mode", lost ? "var(--stale)" : `var(--m-${mode}, var(--quiet))`);
  put(byId("mode"), lost && mode !== "none" ? `was ${word}` : word);
  mark(header, "lost", lost);
  const since = status ? sinceWhen(status, store) : "";
  put(
    byId("why"),
    status ? [status.why, since].filter(Boolean).join(", ") : "Nothing has been received yet",
  );
  mark(byId("why"), "old", lost);
  mark(todo, "old", lost);
  const accuracy = nav ? hypot(nav.sd_n_m, nav.sd_e_m) : null;
  put(byId("accuracy"), known(accuracy) ? `${sigma(accuracy)} m` : "–");
  mark(byId("accuracy"), "old", lost || store.old("nav"));
  showAdvice(store);
  showVehicle(store);
  showRefused(store);
  put(byId("utc"), `${utc(store.utcMs)} UTC`);
  mark(byId("utc"), "old", lost);
  const origin = store.hello ? store.hello.origin : "";
  const speed =
    store.hello && store.hello.speed !== 1 ? `, ${store.hello.speed} times as fast` : "";
  put(byId("link"), origin + speed);
  byId("link").title = origin;
  mark(byId("link"), "lost", lost);
  document.title = `${lost ? "LOST " : ""}${word} - ${store.vehicle || "fusiond"}`;
}
