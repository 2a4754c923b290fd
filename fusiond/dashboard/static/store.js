// What the dashboard has sent: the last message of each topic, and rows of history by kind.
import { ageOf, hubNow, isOld } from "./age.js";

// A little more than the dashboard keeps: it is what ten minutes hold.
const MOST = { nav: 1300, nis: 4800, delay: 500, event: 200, message: 200 };
const MOST_INNOVATIONS = 12000;
const here = () => performance.now() / 1000;

export class Store {
  constructor() {
    this.frame = null;
    this.hello = null;
    this.socket = false;
    this.opened = here();
    this.clear();
    this.link = { state: "connecting", text: "", since_s: 0 };
    this.vehicle = null;
    this.vehicles = [];
    this.answers = [];
    this.refused = { count: 0, kinds: {}, last: "" };
  }

  clear() {
    this.latest = {};
    this.rows = Object.fromEntries(Object.keys(MOST).map((kind) => [kind, []]));
    this.innovations = new Map(); // by source and instant: after a rewind a measurement comes again
  }

  receive(frame) {
    if (frame.hello) {
      this.hello = frame.hello;
      return;
    }
    const speed = frame.link.state === "ended" ? 0 : this.hello ? this.hello.speed : 1;
    this.frame = { now: frame.now, arrived: here(), speed };
    this.link = frame.link;
    this.vehicles = frame.vehicles;
    this.refused = frame.refused;
    if (frame.vehicle !== this.vehicle || frame.first) this.clear();
    this.vehicle = frame.vehicle;
    Object.assign(this.latest, frame.messages);
    for (const [kind, rows] of Object.entries(frame.rows)) this.append(kind, rows);
    if (frame.answers && frame.answers.length) this.answers = frame.answers;
  }

  append(kind, rows) {
    if (kind === "innovation") {
      for (const row of rows) this.innovations.set(`${row[1]} ${row[0]}`, row);
      for (const key of this.innovations.keys()) {
        if (this.innovations.size <= MOST_INNOVATIONS) break;
        this.innovations.delete(key);
      }
      return;
    }
    const kept = this.rows[kind];
    if (!kept) return;
    kept.push(...rows);
    if (kept.length > MOST[kind]) kept.splice(0, kept.length - MOST[kind]);
  }

  get now() {
    return this.frame ? hubNow(this.frame, here()) : 0;
  }

  // Seconds since the dashboard was last heard; of this page's clock.
  get silent() {
    return here() - (this.frame ? this.frame.arrived : this.opened);
  }

  said(topic) {
    const latest = this.latest[topic];
    return latest ? latest.said : null;
  }

  // Where other vehicles are, the last of each card.
  get fleet() {
    return Object.entries(this.latest)
      .filter(([topic]) => topic.startsWith("fleet/"))
      .map(([topic, latest]) => ({ ...latest.said, age: this.age(topic) }));
  }

  age(topic) {
    return ageOf(this.latest[topic], this.now);
  }

  old(topic) {
    return isOld(this.latest[topic], this.now);
  }

  // UTC now in ms by the vehicle's own word; null while it knows none.
  get utcMs() {
    for (const topic of ["nav", "status", "health"]) {
      const latest = this.latest[topic];
      if (latest && latest.at !== null && typeof latest.said.t_ms === "number")
        return latest.said.t_ms + 1000 * (this.now - latest.at);
    }
    return null;
  }
}
