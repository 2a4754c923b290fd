// How old a figure is, and whether it is too old to be shown as if it were live.
// Pure: no page, no clock of its own. Times in seconds of the hub's clock, as in `docs/dashboard.md`.

// The hub's clock between frames: `frame` is {now, arrived, speed}; `here` in s of the page's clock.
export function hubNow(frame, here) {
  return frame.now + (here - frame.arrived) * frame.speed;
}

// Seconds since a message came; null where nobody knows (the broker had kept it).
export function ageOf(latest, now) {
  return latest && latest.at !== null ? Math.max(0, now - latest.at) : null;
}

// Whether it is to be grey. What does not age (`limit` null) is never old by itself.
export function isOld(latest, now) {
  if (!latest) return true;
  if (latest.limit === null) return false;
  return latest.at === null || now - latest.at > latest.limit;
}

// The age of a figure that was `ageThen` old when its message came.
export function agedFurther(ageThen, latest, now) {
  const since = ageOf(latest, now);
  return ageThen === null || ageThen === undefined || since === null ? null : ageThen + since;
}

// Age from which a source's last measurement is old: five of its mean intervals, but never less
// than 2 s, so that a beat that is missed at 1 Hz does not flicker. `uptime` s, `received` in all.
export const LEAST_SOURCE_S = 2;
export const MISSED_BY_SOURCE = 5;
export function sourceLimit(received, uptime) {
  if (!(received > 0) || !(uptime > 0)) return LEAST_SOURCE_S;
  return Math.max(LEAST_SOURCE_S, (MISSED_BY_SOURCE * uptime) / received);
}

// No frame from the dashboard itself for so long: it sends one a second at least.
export const SILENT_S = 3;

// What is wrong with the way from the vehicle to this page, the nearest fault first; null: nothing.
// `socket` open or not, `silent` s since a frame, `link` of the hub, `online` and `status` as latest.
export function linkFault({ socket, silent, link, vehicle, online, status, now }) {
  if (!socket || silent > SILENT_S)
    return {
      kind: "page",
      since: silent,
      // The demo takes its page with it.
      text: vehicle === "demo" ? "the demo has ended" : "no word from the dashboard",
    };
  if (link.state === "lost")
    return {
      kind: "broker",
      since: now - link.since_s,
      text: `no connection to the broker: ${link.text}`,
    };
  if (link.state === "connecting")
    return { kind: "broker", since: now - link.since_s, text: "connecting to the broker" };
  if (link.state === "ended")
    return {
      kind: "ended",
      since: null,
      text: "the recording has ended" + (link.text ? `: ${link.text}` : ""),
    };
  if (vehicle === null)
    return { kind: "vehicle", since: now - link.since_s, text: "the broker has no vehicle yet" };
  if (online && online.said === "offline")
    return {
      kind: "vehicle",
      since: ageOf(online, now),
      text: `${vehicle} is offline: the daemon has ended or lost its broker`,
    };
  if (status && isOld(status, now))
    return {
      kind: "vehicle",
      since: ageOf(status, now),
      text: `no word from the daemon of ${vehicle}`,
    };
  return null;
}
