// A table that sorts by its headings and shows one page at a time, so that ten thousand rows stay quick.

// columns: [{name, title, hint, number, value(row), text(row) or node(row), head}]; rows: any list.
function makeGrid(host, { label, columns, rows, size = 50, sort = null, caption = null }) {
  let shown = rows, page = 0, by = sort, visible = columns;
  const head = element("tr"), body = element("tbody");
  const table = element("table", {}, element("thead", {}, head), body);
  const region = element("div", { class: "grid", tabindex: "0", role: "region", "aria-label": label }, table);
  const where = element("span", { role: "status", "aria-live": "polite" });
  const turn = (text, name, act) => element("button", { type: "button", "aria-label": name, onclick: () => { act(); fill(); } }, text);
  const last = () => Math.max(0, Math.ceil(shown.length / size) - 1);
  const turns = [
    turn("\u00ab", "First page", () => (page = 0)), turn("\u2039 Previous", "Previous page", () => page--),
    turn("Next \u203a", "Next page", () => page++), turn("\u00bb", "Last page", () => (page = last())),
  ];
  const many = element("select", { "aria-label": "Rows on a page", onchange: (event) => { size = Number(event.target.value); page = 0; fill(); } },
    ...[25, 50, 100, 250].map((n) => element("option", { value: n, selected: n === size }, `${n} rows`)));
  const pager = element("div", { class: "pager", role: "group", "aria-label": `Pages: ${label}` }, turns[0], turns[1], where, turns[2], turns[3], many);
  host.replaceChildren(region, ...(caption ? [element("p", { class: "lead small" }, caption)] : []), pager);

  function headings() {
    head.replaceChildren(...visible.map((column) => {
      const sorted = by && by.name === column.name ? (by.descending ? "descending" : "ascending") : null;
      return element("th", { scope: "col", class: column.number ? null : "text", "aria-sort": sorted, title: column.hint },
        element("button", { type: "button", "data-column": column.name, onclick: () => order(column.name) }, column.title));
    }));
  }

  function order(name) {
    const first = columns.find((column) => column.name === name).descending || false;
    by = by && by.name === name ? { name, descending: !by.descending } : { name, descending: first };
    page = 0;
    arrange();
    for (const cell of head.children) {
      const button = cell.firstChild;
      cell.removeAttribute("aria-sort");
      if (button.dataset.column === name) cell.setAttribute("aria-sort", by.descending ? "descending" : "ascending");
    }
    fill();
  }

  // Rows without a value come last in either direction; equal ones keep their order.
  function arrange() {
    shown = [...rows];
    const column = by && columns.find((one) => one.name === by.name);
    if (!column) return;
    const sign = by.descending ? -1 : 1;
    const keyed = shown.map((row) => [column.value(row), row]);
    const none = (v) => v === null || v === undefined || v === "";
    keyed.sort(([a], [b]) => {
      if (none(a) || none(b)) return none(a) - none(b);
      return a < b ? -sign : a > b ? sign : 0;
    });
    shown = keyed.map(([, row]) => row);
  }

  function fill() {
    page = Math.min(Math.max(0, page), last());
    const part = shown.slice(page * size, (page + 1) * size);
    body.replaceChildren(...part.map((row) => element("tr", {}, ...visible.map((column) => {
      const content = column.node ? column.node(row) : column.text(row);
      const text = typeof content === "string" && content.length > 40 ? content : null;
      return element(column.head ? "th" : "td", { scope: column.head ? "row" : null, class: column.number ? null : "text", title: text },
        text && text.length > 240 ? text.slice(0, 240) + "…" : content);
    }))));
    if (!part.length) body.append(element("tr", {}, element("td", { class: "text", colspan: visible.length }, "Nothing here.")));
    where.textContent = `Page ${page + 1} of ${last() + 1}`;
    turns.forEach((button, k) => { button.disabled = k < 2 ? page === 0 : page === last(); });
    pager.hidden = shown.length <= 25;
    pager.style.display = pager.hidden ? "none" : "";
  }

  function update(next) { rows = next; page = 0; arrange(); fill(); }
  function show(names) { visible = names ? names.map((name) => columns.find((column) => column.name === name)) : columns; headings(); fill(); }
  headings();
  arrange();
  fill();
  return { update, show, rows: () => shown };
}
