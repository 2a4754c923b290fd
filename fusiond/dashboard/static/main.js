// Puts the page together: a frame comes, what it changes is drawn, ten times a second at most.
import { showAttitude } from "./attitude.js";
import { showHeader } from "./header.js";
import { bindKeys } from "./keys.js";
import { Socket } from "./link.js";
import { TrackMap } from "./map.js";
import { showMessages } from "./messages.js";
import { Plots } from "./plots.js";
import { showRdss } from "./rdss.js";
import { showSky } from "./sky.js";
import { showSolution } from "./solution.js";
import { showSources } from "./sources.js";
import { Store } from "./store.js";
import { bindCommands, showCalibration, showEvents, showSystem } from "./system.js";
import { byId, mark, put, stretch } from "./text.js";
import { Theme } from "./theme.js";
import { showVerdicts } from "./verdicts.js";

const DRAW_MS = 100;
const SLOW_EVERY = 5; // of the draws: what comes once a second needs no more than two a second

const store = new Store();
const socket = new Socket(store, () => schedule());
const map = new TrackMap(byId("map"), byId("map-tools"), store);
const theme = new Theme(byId("theme"), () => {
  plots.rebuild();
  draw(true);
});
const plots = new Plots(store, byId("sigma-plot"), byId("nis-plot"), byId("span-tools"));
bindKeys({ map, plots, theme });
bindCommands(store, socket);
byId("vehicles").onchange = (event) => socket.lookAt(event.target.value);

const EVERY = [showHeader, showSolution, showAttitude, () => map.draw()];
const SLOWER = [
  showSources,
  showVerdicts,
  showSky,
  showRdss,
  showMessages,
  showEvents,
  showCalibration,
  showSystem,
  () => plots.draw(),
];

let drawn = 0,
  timer = null,
  count = 0;

// Soon after a frame, and no sooner than DRAW_MS after the last drawing.
function schedule() {
  if (timer !== null) return;
  timer = setTimeout(
    () => {
      timer = null;
      draw(false);
    },
    Math.max(0, DRAW_MS - (performance.now() - drawn)),
  );
}

function ages() {
  for (const card of document.querySelectorAll(".card[data-topic]")) {
    const topic = card.dataset.topic,
      lost = document.body.classList.contains("lost");
    const latest = store.latest[topic];
    mark(card, "stale", lost || !latest || store.old(topic));
    const age = store.age(topic);
    put(card.querySelector(".age"), !latest ? "" : age === null ? "from before" : stretch(age));
  }
}

// A part that cannot be shown must not take the others with it.
const told = new Set();
function safely(show) {
  try {
    show(store);
  } catch (error) {
    const text = String(error);
    if (!told.has(text)) console.error(error);
    told.add(text);
  }
}

function draw(all) {
  drawn = performance.now();
  if (document.hidden) return;
  for (const show of EVERY) safely(show);
  if (all || count++ % SLOW_EVERY === 0) for (const show of SLOWER) safely(show);
  ages();
}

setInterval(() => draw(false), 250); // ages go on while nothing comes
document.addEventListener("visibilitychange", () => draw(true));
addEventListener("resize", () => {
  plots.resize();
  draw(true);
});
