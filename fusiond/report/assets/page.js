// Puts the page together from the document.
"use strict";
const drawn = []; // what has to be drawn anew when colours or width change

// A sentence; what stands between backticks is a name.
function sentence(tag, className, text) {
  const e = element(tag, className);
  text.split("`").forEach((part, k) => e.appendChild(element(k % 2 ? "code" : "span", "", part)));
  return e;
}

function table(item, parent) {
  parent.appendChild(element("h3", "", item.title));
  const scroll = parent.appendChild(element("div", "scroll"));
  const t = scroll.appendChild(element("table"));
  if (item.head.some((text) => text)) {
    const head = t.appendChild(element("thead")).appendChild(element("tr"));
    for (const text of item.head) head.appendChild(element("th", "", text));
  }
  const body = t.appendChild(element("tbody"));
  item.rows.forEach((row, k) => {
    const line = body.appendChild(element("tr", item.wrong.includes(k) ? "wrong" : ""));
    for (const text of row) line.appendChild(element("td", "", text));
  });
}

function cell(item, run, pair, parent) {
  const box = parent.appendChild(element("div", "cell"));
  if (item === null) {
    box.classList.add("empty");
    box.appendChild(element("span", "quiet", "Not in this run."));
    return;
  }
  if (item.kind === "sentence") {
    box.classList.add("empty");
    box.appendChild(sentence("span", "quiet", item.text));
    return;
  }
  if (item.kind === "table") table(item, box);
  else if (item.kind === "grid") grid(item, box);
  else {
    box.appendChild(element("h3", "", item.title));
    const holder = box.appendChild(element("div", item.kind));
    if (item.kind === "plot") drawn.push({ item, run, pair, holder, u: plot(item, run, pair, holder) });
    else new Track(item, run, holder).draw();
  }
  if (item.good) box.appendChild(sentence("p", "good", item.good));
}

function banner(run, parent) {
  const wrong = run.problems;
  const worst = wrong.some((p) => p[0] === "error") ? "error" : wrong.length ? "warning" : "fine";
  const box = parent.appendChild(element("div", "banner " + worst));
  if (!wrong.length) {
    box.textContent = timed ? "Recording complete and undamaged. How good the drive was stands below." : "Every drive has its figures.";
    return;
  }
  box.appendChild(element("b", "", `What is wrong with ${run.name}`));
  const list = box.appendChild(element("ul"));
  for (const [, text] of wrong) list.appendChild(sentence("li", "", text));
}

function heading(parent) {
  parent.appendChild(element("h1", "", doc.title));
  parent.appendChild(element("p", "quiet", doc.made));
  const runs = parent.appendChild(element("div", "runs"));
  for (const run of doc.runs) {
    const box = runs.appendChild(element("div"));
    if (two) box.appendChild(element("h3", "", run.name));
    banner(run, box);
    if (run.zero) box.appendChild(element("p", "quiet", run.zero));
  }
  if (doc.note) parent.appendChild(element("p", "quiet", doc.note));
  const chips = parent.appendChild(element("div", "chips"));
  const present = new Set(doc.runs.flatMap((run) => run.modes.map((m) => m[2])));
  for (const mode of doc.modes.filter((m) => present.has(m))) {
    chips.appendChild(element("span", "chip", mode)).style.setProperty("--chip", `var(--m-${mode})`);
  }
}

function build() {
  if (two) document.body.classList.add("two");
  if (!timed) document.body.classList.add("many");
  const main = document.querySelector("main"), nav = document.querySelector("nav");
  heading(document.querySelector("header"));
  doc.sections.forEach((section, number) => {
    const h = main.appendChild(element("h2", "", section.title));
    h.id = "section-" + number;
    nav.appendChild(element("a", "", section.title)).setAttribute("href", "#section-" + number);
    for (const row of section.rows) {
      const line = main.appendChild(element("div", row.length > 1 ? "row pair" : "row"));
      if (!timed && row[0].kind === "plot") line.classList.add("half");
      const pair = row.filter((item) => item && item.kind === "plot");
      row.forEach((item, k) => cell(item, doc.runs[row.length > 1 ? k : doc.runs.length - 1], pair, line));
    }
  });
  if (timed) nav.appendChild(element("button", "", "all of the time")).onclick = () => view.all();
  hover.hidden = !timed;
}

function redraw() {
  timePlots.length = 0;
  for (const d of drawn) {
    d.u.destroy();
    d.u = plot(d.item, d.run, d.pair, d.holder);
  }
  redrawTracks();
}

build();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
let width = document.body.clientWidth;
addEventListener("resize", () => {
  if (document.body.clientWidth === width) return;
  width = document.body.clientWidth;
  for (const d of drawn) d.u.setSize({ width: Math.max(260, d.holder.clientWidth), height: HEIGHT });
  redrawTracks();
});
