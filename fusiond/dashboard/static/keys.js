// What the keyboard does; each key is also a button.
import { byId, element, fillRows } from "./text.js";

const PAN = 60; // pixels

export function bindKeys({ map, plots, theme }) {
  const dialog = byId("keys");
  const keys = {
    f: ["follow the vehicle", () => map.toggleFollow()],
    a: ["all of the track", () => map.all()],
    "+": ["map closer", () => map.zoom(1.5)],
    "-": ["map farther", () => map.zoom(1 / 1.5)],
    "[": ["plots shorter", () => plots.next(-1)],
    "]": ["plots longer", () => plots.next(1)],
    n: ["day, night, as the system", () => theme.next()],
    "?": ["these keys", () => (dialog.open ? dialog.close() : dialog.showModal())],
  };
  const moves = {
    ArrowLeft: [PAN, 0],
    ArrowRight: [-PAN, 0],
    ArrowUp: [0, PAN],
    ArrowDown: [0, -PAN],
  };
  fillRows(byId("keys-table").createTBody(), [
    ...Object.entries(keys).map(([key, [what]]) => [key, what]),
    ["arrows", "move the map, when it has the focus"],
  ]);
  byId("help").onclick = keys["?"][1];
  document.addEventListener("keydown", (event) => {
    if (
      event.ctrlKey ||
      event.metaKey ||
      event.altKey ||
      /^(SELECT|INPUT)$/.test(event.target.tagName)
    )
      return;
    const key = event.key === "=" ? "+" : event.key;
    if (keys[key]) keys[key][1]();
    else if (moves[key] && event.target === map.canvas) {
      map.move(...moves[key]);
      event.preventDefault();
    }
  });
}
