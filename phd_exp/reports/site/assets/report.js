// Draws the charts of a page: each `figure.chart` names a run and a chart of its data file.
const phdExp = (() => {
  const runs = new Map();
  const drawn = new Set();
  const LOG = "log";

  /** Called by every data file. */
  function receive(name, content) {
    runs.set(name, content);
    document.dispatchEvent(new CustomEvent("received", { detail: name }));
  }

  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const escaped = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");

  /** A copy in which colours named by the style sheet are those of the present theme. */
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

  /** Lines without filtered fields, such as the diagonal, always stay. */
  function visible(trace, chosen) {
    return Object.entries(chosen).every(([key, value]) => !(key in trace.meta) || trace.meta[key] === value);
  }

  function traces(chart) {
    const groups = new Set();
    const shown = chart.data.filter((trace) => visible(trace, filters()));
    return shown.flatMap((trace) => {
      const group = trace.legendgroup ?? trace.name;
      const line = { ...themed(trace), name: escaped(trace.name), showlegend: !groups.has(group) };
      groups.add(group);
      line.hovertemplate = `${trace.text ? escaped(trace.text) + "<br>" : ""}%{x:.4g}, %{y:.4g}<extra>${escaped(trace.name)}</extra>`;
      delete line.text;
      if (trace.legendgroup) line.legendgroup = escaped(trace.legendgroup);
      if (trace.meta.role === "points") return [withBars(line, trace.meta)];
      return trace.meta.low ? [band(line, chart), line] : [line];
    });
  }

  function withBars(line, { low, high }) {
    const y = line.y;
    line.x = line.x.map(escaped);
    line.error_y = {
      type: "data", symmetric: false, thickness: 1.5, width: 4,
      array: high.map((value, i) => value - y[i]), arrayminus: low.map((value, i) => y[i] - value),
    };
    return line;
  }

  function band(line, chart) {
    const { low, high } = line.meta;
    const floor = chart.layout.yaxis.type === LOG ? 0 : -Infinity;
    const keep = line.x.map((_, i) => i).filter((i) => low[i] !== null && high[i] !== null && low[i] > floor);
    return {
      type: "scatter", mode: "lines", hoverinfo: "skip", showlegend: false, legendgroup: line.legendgroup,
      x: [...keep.map((i) => line.x[i]), ...keep.map((i) => line.x[i]).reverse()],
      y: [...keep.map((i) => high[i]), ...keep.map((i) => low[i]).reverse()],
      fill: "toself", fillcolor: faint(line.line.color), line: { width: 0 },
    };
  }

  function faint(colour) {
    const [r, g, b] = colour.slice(1).match(/../g).map((pair) => parseInt(pair, 16));
    return `rgba(${r}, ${g}, ${b}, 0.16)`;
  }

  function layout(chart, named) {
    const axis = (given) => ({
      ...given, title: { text: escaped(given.title.text), font: { size: 13 }, standoff: 8 }, automargin: true,
      gridcolor: style("--grid"), linecolor: style("--rule"), zeroline: false, ticks: "outside", ticklen: 4,
      tickcolor: style("--rule"), exponentformat: "power", ...(given.type === LOG ? { dtick: logStep(chart, given) } : {}),
    });
    return {
      ...chart.layout, xaxis: axis(chart.layout.xaxis), yaxis: axis(chart.layout.yaxis),
      showlegend: named > 1, legend: { orientation: "h", x: 0, y: -0.24, yanchor: "top", font: { size: 12 } },
      font: { family: style("--sans"), size: 12.5, color: style("--ink") },
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      margin: { l: 8, r: 12, t: 8, b: 8 }, hovermode: "closest",
      hoverlabel: { bgcolor: style("--paper"), bordercolor: style("--rule"), font: { color: style("--ink") } },
      // on a touch screen a drag scrolls the page
      dragmode: window.matchMedia("(pointer: fine)").matches ? "zoom" : false,
    };
  }

  /** Whole decades where the values span several, else 1, 2 and 5. */
  function logStep(chart, given) {
    const key = given === chart.layout.xaxis ? "x" : "y";
    const values = chart.data.flatMap((trace) => trace[key]).filter((value) => value > 0);
    const spread = values.length ? Math.log10(Math.max(...values) / Math.min(...values)) : 0;
    return spread > 1.5 ? (spread > 8 ? 2 : 1) : "D2";
  }

  const chartOf = (figure) => figure.chart ?? runs.get(figure.dataset.run)?.charts[figure.dataset.chart];

  function draw(figure) {
    const chart = chartOf(figure);
    if (!chart) return Promise.resolve();
    const data = traces(chart);
    const named = new Set(data.filter((trace) => trace.showlegend !== false).map((trace) => trace.name)).size;
    drawn.add(figure);
    return Plotly.react(figure.querySelector(".plot"), data, layout(chart, named), {
      responsive: true, displayModeBar: false, displaylogo: false,
    }).then(() => figure.classList.add("drawn"));
  }

  /** Numbers of the shown lines, as a table and as a file, made when asked for. */
  function tabulate(figure) {
    const chart = chartOf(figure);
    const shown = chart.data.filter((trace) => visible(trace, filters()) && trace.meta.role !== "identity");
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

  /** Draw the charts below an element when they come into view. */
  function watch(parent = document) {
    for (const figure of parent.querySelectorAll("figure.chart")) {
      watcher.observe(figure);
      figure.querySelector("details").addEventListener("toggle", (event) => event.target.open && tabulate(figure));
    }
  }

  const all = () => [...document.querySelectorAll("figure.chart")];
  const drawAll = () => Promise.all(all().map(draw));
  const redraw = () => Promise.all(all().filter((figure) => drawn.has(figure)).map(draw));

  document.addEventListener("DOMContentLoaded", () => {
    watch();
    for (const select of document.querySelectorAll("select[data-filter]")) {
      select.addEventListener("change", () => {
        redraw();
        all().filter((figure) => figure.querySelector("details").open).forEach(tabulate);
      });
    }
  });
  document.documentElement.addEventListener("themechange", redraw);
  window.addEventListener("beforeprint", drawAll);

  return { receive, runs, watch, drawAll, table };
})();
