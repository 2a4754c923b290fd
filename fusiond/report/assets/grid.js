// A table of many rows: sorted by a click on a heading, searched, drawn piece by piece.
"use strict";
const ROWS_AT_ONCE = 200;

function gridCell(value, link) {
  const text = typeof value === "number" ? (Number.isInteger(value) ? String(value) : figure(value)) : value ?? "";
  const cell = element("td", "", link ? undefined : text);
  if (link) {
    const a = cell.appendChild(element("a", "", text));
    if (link.startsWith("file:")) a.setAttribute("href", link);
  }
  return cell;
}

// Numbers before texts, what is missing last, whichever way.
function gridOrder(rows, column, down) {
  const rank = (v) => (v === null || v === "" ? 2 : typeof v === "number" ? 0 : 1);
  return (a, b) => {
    const v = rows[a][column], w = rows[b][column];
    if (rank(v) !== rank(w)) return rank(v) - rank(w);
    const order = rank(v) === 0 ? v - w : rank(v) === 1 ? v.localeCompare(w, "en", { numeric: true }) : 0;
    return (down ? -order : order) || a - b;
  };
}

function grid(item, parent) {
  parent.appendChild(element("h3", "", item.title));
  const tools = parent.appendChild(element("div", "tools"));
  const search = tools.appendChild(element("input"));
  search.type = "search";
  search.placeholder = "search in all columns";
  search.setAttribute("aria-label", "search in all columns");
  const count = tools.appendChild(element("span", "quiet"));
  const scroll = parent.appendChild(element("div", "scroll grid"));
  const t = scroll.appendChild(element("table"));
  const head = t.appendChild(element("thead")).appendChild(element("tr"));
  const body = t.appendChild(element("tbody"));
  const wrong = new Set(item.wrong);
  let order = item.rows.map((_, k) => k), sorted = -1, down = false, shown = 0;

  function more() {
    for (const k of order.slice(shown, shown + ROWS_AT_ONCE)) {
      const line = body.appendChild(element("tr", wrong.has(k) ? "wrong" : ""));
      item.rows[k].forEach((value, c) => line.appendChild(gridCell(value, c === 0 && item.links[k])));
      shown++;
    }
  }

  function draw() {
    const wanted = search.value.trim().toLowerCase();
    order = item.rows.map((_, k) => k);
    if (wanted) order = order.filter((k) => item.rows[k].some((v) => String(v ?? "").toLowerCase().includes(wanted)));
    if (sorted >= 0) order.sort(gridOrder(item.rows, sorted, down));
    [...head.children].forEach((th, c) =>
      th.setAttribute("aria-sort", c !== sorted ? "none" : down ? "descending" : "ascending"));
    count.textContent = `${order.length} of ${item.rows.length}`;
    body.replaceChildren();
    shown = 0;
    more();
    scroll.scrollTop = 0;
  }

  item.head.forEach((text, c) => {
    const button = head.appendChild(element("th")).appendChild(element("button", "", text));
    button.onclick = () => {
      down = sorted === c ? !down : false;
      sorted = c;
      draw();
    };
  });
  search.oninput = draw;
  scroll.onscroll = () => {
    if (scroll.scrollTop + scroll.clientHeight > scroll.scrollHeight - 400) more();
  };
  draw();
}
