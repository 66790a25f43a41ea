// Draws the charts of a page: each `figure.chart` names a run and a chart of its data file.
const phdExp = (() => {
  const runs = new Map();
  const drawn = new Set();
  const LOG = "log";

  /** Every data file calls it. */
  function receive(name, content) {
    runs.set(name, content);
    document.dispatchEvent(new CustomEvent("received", { detail: name }));
  }

  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const escaped = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");

  /** A copy with the colours of the current theme. */
  function themed(value) {
    if (typeof value === "string") {
      const name = /^var\((--[\w-]+)\)$/.exec(value);
      return name ? style(name[1]) : value;
    }
    if (Array.isArray(value)) return value.map(themed);
    if (value === null || typeof value !== "object") return value;
    return Object.fromEntries(Object.entries(value).map(([key, inner]) => [key, themed(inner)]));
  }

  function filters() {
    const chosen = {};
    for (const select of document.querySelectorAll("select[data-filter]")) {
      if (select.value) chosen[select.dataset.filter] = select.value;
    }
    return chosen;
  }

  /** Lines without the filtered fields, such as the diagonal, are always visible. */
  function visible(trace, chosen) {
    return Object.entries(chosen).every(([key, value]) => !(key in trace.meta) || trace.meta[key] === value);
  }

  const MOST = 8;  // labelled lines of a chart of all runs
  const COLOURS = 7;

  /** The runs labelled in the shared legend of a figure, in its order; the lines of the others are grey. */
  function labelled(figure) {
    const items = figure.closest("section")?.querySelectorAll(".legend.runs li[data-run]:not([hidden])") ?? [];
    return [...items].map((item) => item.dataset.run);
  }

  const stroke = (place) => ({ color: `var(--series-${place % COLOURS + 1})`, dash: Object.keys(DASHES)[Math.floor(place / COLOURS)], width: 1.75 });
  const GREY = { color: "var(--series-0)", dash: "solid", width: 1 };

  /** The visible lines of a figure, in the colours of a shared legend; grey ones first, below the others. */
  function coloured(figure, chart) {
    if (!figure.closest("[data-legend=shared]")) return shownOf(chart);
    const names = labelled(figure);
    const lines = shownOf(chart).map((trace) => {
      const place = names.indexOf(trace.text);
      return place >= 0 ? { ...trace, line: stroke(place) } : trace.text ? { ...trace, line: GREY, opacity: 0.5 } : trace;
    });
    return [...lines.filter((line) => line.line === GREY), ...lines.filter((line) => line.line !== GREY)];
  }

  const shownOf = (chart) => chart.data.filter((trace) => visible(trace, filters()));

  function traces(figure, chart) {
    return coloured(figure, chart).flatMap((trace) => {
      const line = { ...themed(trace), name: escaped(trace.name) };
      const place = trace.meta.role === "points" ? "%{y}: %{x:.4g}" : "%{x:.4g}, %{y:.4g}";
      line.hovertemplate = `${trace.text ? escaped(trace.text) + "<br>" : ""}${place}<extra>${escaped(trace.name)}</extra>`;
      delete line.text;
      if (trace.meta.role === "points") return [withBars(line, trace.meta)];
      return trace.meta.low ? [band(line, chart), line] : [line];
    });
  }

  /** Points with error bars, one per category of the vertical axis. */
  function withBars(line, { low, high }) {
    const x = line.x;
    line.y = line.y.map(escaped);
    line.error_x = {
      type: "data", symmetric: false, thickness: 1.5, width: 4,
      array: high.map((value, i) => value - x[i]), arrayminus: low.map((value, i) => x[i] - value),
    };
    return line;
  }

  function band(line, chart) {
    const { low, high } = line.meta;
    const floor = chart.layout.yaxis.type === LOG ? 0 : -Infinity;
    const keep = line.x.map((_, i) => i).filter((i) => low[i] !== null && high[i] !== null && low[i] > floor);
    return {
      type: "scatter", mode: "lines", hoverinfo: "skip",
      x: [...keep.map((i) => line.x[i]), ...keep.map((i) => line.x[i]).reverse()],
      y: [...keep.map((i) => high[i]), ...keep.map((i) => low[i]).reverse()],
      fill: "toself", fillcolor: faint(line.line.color), line: { width: 0 },
    };
  }

  function faint(colour) {
    const [r, g, b] = colour.slice(1).match(/../g).map((pair) => parseInt(pair, 16));
    return `rgba(${r}, ${g}, ${b}, 0.16)`;
  }

  const titled = ({ title, type }, name) => escaped(title.text) + (type === LOG ? `${name === "y" ? "<br>" : ", "}log scale` : "");

  function layout(chart) {
    const axis = (name) => {
      const given = chart.layout[`${name}axis`];
      return {
        ...given, title: { text: titled(given, name), font: { size: 12.5 }, standoff: 8 }, automargin: true,
        gridcolor: style("--grid"), linecolor: style("--rule"), zeroline: false, ticks: "outside", ticklen: 4, tickangle: 0,
        tickcolor: style("--rule"), ...(given.type === LOG ? logTicks(chart, name) : { exponentformat: "power" }),
      };
    };
    return {
      ...chart.layout, xaxis: axis("x"), yaxis: axis("y"), showlegend: false,
      font: { family: style("--sans"), size: 12.5, color: style("--ink") },
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      margin: { l: 8, r: 22, t: 12, b: 8 }, hovermode: "closest",
      hoverlabel: { bgcolor: style("--paper"), bordercolor: style("--rule"), font: { color: style("--ink") } },
      // on a touch screen a drag scrolls the page
      dragmode: window.matchMedia("(pointer: fine)").matches ? "zoom" : false,
    };
  }

  /** Ticks at powers of ten, with more between them for short axes, all as decimals or all as powers. */
  function logTicks(chart, name) {
    const values = chart.data.flatMap((trace) => [...trace[name], ...(trace.meta.low ?? [])]).filter((value) => value > 0);
    if (!values.length) return {};
    const [low, high] = [Math.min(...values), Math.max(...values)].map(Math.log10);
    const decades = Array.from({ length: Math.ceil(high) - Math.floor(low) + 1 }, (_, i) => Math.floor(low) + i);
    const every = Math.ceil(decades.length / 7);
    const length = (high - low) / (name === "x" ? 0.6 : 1);  // labels need more room side by side
    const steps = length > 2.5 ? [1] : length > 1.1 ? [1, 2, 5] : [1, 1.5, 2, 3, 4, 5, 7];
    const plain = low >= -3.5 && high <= 5;
    const ticks = decades.filter((_, i) => i % every === 0).flatMap((power) => steps.map((step) => [step, power]));
    const text = (step, power) => (plain ? Number((step * 10 ** power).toPrecision(2)).toLocaleString("en", { maximumFractionDigits: 5 }) : `${step === 1 ? "" : `${step}·`}10<sup>${power}</sup>`);
    return { tickvals: ticks.map(([step, power]) => step * 10 ** power), ticktext: ticks.map(([step, power]) => text(step, power)) };
  }

  const DASHES = { solid: "none", dash: "7 4", dot: "2 3", dashdot: "7 3 2 3" };

  /** The legend of a chart, unless its group shares one. */
  function legend(figure, chart) {
    const named = new Map(shownOf(chart).map((trace) => [trace.name, trace]));
    figure.querySelector(".legend")?.remove();
    if (figure.closest("[data-legend=shared]") || named.size < 2) return;
    const list = Object.assign(document.createElement("ul"), { className: "legend" });
    for (const [name, { line, marker }] of named) {
      const item = document.createElement("li");
      const sample = document.createElementNS("http://www.w3.org/2000/svg", "svg");
      sample.setAttribute("viewBox", "0 0 28 8");
      sample.setAttribute("aria-hidden", "true");
      const stroke = document.createElementNS("http://www.w3.org/2000/svg", "path");
      stroke.setAttribute("d", "M0,4H28");
      stroke.style.stroke = (line ?? marker).color;
      stroke.style.strokeDasharray = DASHES[line?.dash ?? "solid"];
      sample.append(stroke);
      item.append(sample, name);
      list.append(item);
    }
    figure.querySelector("figcaption").append(list);
  }

  const chartOf = (figure) => figure.chart ?? runs.get(figure.dataset.run)?.charts[figure.dataset.chart];

  function draw(figure) {
    const chart = chartOf(figure);
    if (!chart) return Promise.resolve();
    drawn.add(figure);
    legend(figure, chart);
    return Plotly.react(figure.querySelector(".plot"), traces(figure, chart), layout(chart), {
      responsive: true, displayModeBar: false, displaylogo: false,
    }).then(() => figure.classList.add("drawn"));
  }

  /** The numbers of the visible lines as a table and a file, made on demand. */
  function tabulate(figure) {
    const chart = chartOf(figure);
    const shown = shownOf(chart).filter((trace) => trace.meta.role !== "identity");
    const bounds = shown.some((trace) => trace.meta.low);
    const head = ["line", chart.layout.xaxis.title.text, chart.layout.yaxis.title.text, ...(bounds ? ["low", "high"] : [])];
    const rows = shown.flatMap((trace) => trace.x.map((x, i) => [
      trace.text ?? trace.name, x, trace.y[i], ...(bounds ? [trace.meta.low?.[i], trace.meta.high?.[i]] : []),
    ]));
    const details = figure.querySelector("details");
    details.querySelectorAll(":scope > :not(summary)").forEach((old) => old.remove());
    const box = document.createElement("div");
    box.className = "scroll tall";
    box.tabIndex = 0;
    box.setAttribute("role", "region");
    box.setAttribute("aria-label", `Numbers of ${chart.title}`);
    box.append(table(head, rows.slice(0, 2000)));
    details.append(download(figure, [head, ...rows]), box);
  }

  function download(figure, rows) {
    const quoted = (value) => `"${String(value ?? "").replace(/"/g, '""')}"`;
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([rows.map((row) => row.map(quoted).join(",")).join("\r\n")], { type: "text/csv" }));
    link.download = `${figure.dataset.run ?? "comparison"}-${figure.dataset.chart}.csv`;
    link.textContent = "Download as CSV";
    return link;
  }

  function table(head, rows) {
    const result = document.createElement("table");
    const line = (values, tag, parent) => {
      const row = parent.insertRow();
      for (const value of values) {
        const cell = document.createElement(tag);
        if (tag === "th") cell.scope = "col";
        if (typeof value === "number") cell.className = "n";
        cell.textContent = value ?? "";
        row.append(cell);
      }
    };
    line(head, "th", result.createTHead());
    const body = result.createTBody();
    rows.forEach((row) => line(row, "td", body));
    return result;
  }

  const watcher = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (entry.isIntersecting && !drawn.has(entry.target)) draw(entry.target);
    }
  }, { rootMargin: "300px" });

  const idle = () => new Promise((resolve) => (window.requestIdleCallback ?? setTimeout)(resolve));

  /** Draw the charts of an element: those in view at once, the others when the browser is idle. */
  async function watch(parent = document) {
    const figures = parent.querySelectorAll("figure.chart");
    for (const figure of figures) {
      watcher.observe(figure);
      figure.querySelector("details").addEventListener("toggle", (event) => event.target.open && tabulate(figure));
    }
    for (const figure of figures) {
      await idle();
      if (figure.clientWidth && !drawn.has(figure)) await draw(figure);  // inside closed details it has no width
    }
  }

  const all = () => [...document.querySelectorAll("figure.chart")];
  const drawAll = () => Promise.all(all().map(draw));
  const redraw = () => Promise.all(all().filter((figure) => drawn.has(figure)).map(draw));

  /** Sort a table by the column of a heading, numbers numerically; a second click reverses the order. */
  function sortBy(heading) {
    const table = heading.closest("table");
    const down = heading.getAttribute("aria-sort") === "ascending";
    const value = (row) => {
      const cell = row.cells[heading.cellIndex];
      const number = Number(cell.dataset.value ?? NaN);
      return Number.isNaN(number) ? cell.innerText.trim() : number;
    };
    const before = (x, y) => (typeof x === typeof y ? (typeof x === "number" ? x - y : x.localeCompare(y)) : typeof x === "number" ? -1 : 1);
    const rows = [...table.tBodies[0].rows].sort((a, b) => (down ? -1 : 1) * before(value(a), value(b)));
    table.tBodies[0].append(...rows);
    table.querySelectorAll("[aria-sort]").forEach((other) => other.removeAttribute("aria-sort"));
    heading.setAttribute("aria-sort", down ? "descending" : "ascending");
  }

  /** Show only the filtered runs in the list and in shared legends, which label the first ones. */
  function filterRuns() {
    const chosen = Object.entries(filters());
    for (const item of document.querySelectorAll("[data-preset][data-data]")) {
      item.hidden = chosen.some(([key, value]) => item.dataset[key] !== value);
    }
    for (const list of document.querySelectorAll(".legend.runs")) {
      const items = [...list.querySelectorAll("li[data-run]:not([hidden])")];
      items.forEach((item, place) => {
        item.hidden = place >= MOST;
        const { color, dash } = stroke(Math.min(place, MOST - 1));
        Object.assign(item.querySelector("path").style, { stroke: color, strokeDasharray: DASHES[dash] });
      });
      const more = list.querySelector(".more");
      more.hidden = items.length <= MOST;
      more.textContent = `Grey: ${items.length - MOST} more runs. Choose a preset or a data set above to label them.`;
    }
  }

  document.addEventListener("DOMContentLoaded", () => {
    filterRuns();  // a browser may keep the choice of a page that is loaded again
    watch();
    for (const button of document.querySelectorAll("table.sortable thead button")) {
      button.addEventListener("click", () => sortBy(button.parentElement));
    }
    for (const select of document.querySelectorAll("select[data-filter]")) {
      select.addEventListener("change", () => {
        filterRuns();
        redraw();
        all().filter((figure) => figure.querySelector("details").open).forEach(tabulate);
      });
    }
  });
  document.documentElement.addEventListener("themechange", redraw);
  window.addEventListener("beforeprint", drawAll);

  return { receive, runs, watch, drawAll, table, themed, style };
})();
