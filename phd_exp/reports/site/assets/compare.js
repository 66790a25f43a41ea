// Any two runs: their data files are loaded when chosen, and their charts drawn over each other.
(() => {
  const NAMES = ["a", "b"];
  const ROLES = ["before", "test", "points", "line"];  // one line per run: on the test split, before recalibration
  const select = (name) => document.getElementById(`run-${name}`);
  const loading = new Map();

  function load(slug) {
    if (!loading.has(slug)) {
      loading.set(slug, new Promise((resolve, reject) => {
        const script = document.createElement("script");
        script.src = `data/${encodeURIComponent(slug)}.js`;
        script.onload = () => resolve(phdExp.runs.get(slug));
        script.onerror = () => { loading.delete(slug); reject(new Error(`${script.src} could not be loaded; run the report again`)); };
        document.head.append(script);
      }));
    }
    return loading.get(slug);
  }

  const label = (run) => [run.preset, run.data, run.model, run.run].join(" / ");

  /** Values in the format of the run pages. */
  const fixed = (value, digits) => (value === null ? "–" : value.toFixed(digits).replace("-", "−"));
  const band = (score, digits) => (score ? `${fixed(score.value, digits)} [${fixed(score.low, digits)}, ${fixed(score.high, digits)}]` : "–");

  /** B − A with the 95 % interval of its resamples: both runs were resampled on the same test images. */
  function paired(a, b, key, digits) {
    const difference = b.scores[key].value - a.scores[key].value;
    const draws = a.resampled[key].map((value, i) => b.resampled[key][i] - value).filter(Number.isFinite).sort((x, y) => x - y);
    const at = (share) => draws[Math.round(share * (draws.length - 1))];
    return draws.length ? band({ value: difference, low: at(0.025), high: at(0.975) }, digits) : "–";
  }

  function scores(a, b) {
    const known = JSON.parse(document.getElementById("scores").dataset.quantities);
    const keys = [...new Set([...Object.keys(a.scores), ...Object.keys(b.scores)])];
    const same = a.images && a.images === b.images;
    document.getElementById("paired").textContent = same
      ? "Both runs were tested on the same images: B − A is paired, with its 95 % bootstrap interval over these images. It does not say how another training would differ."
      : "The runs were not tested on the same images: there is no paired difference.";
    const rows = keys.map((key) => {
      const { label, unit, digits } = known[key] ?? { label: key.replaceAll("_", " "), unit: "", digits: 3 };
      const [of_a, of_b] = [a.scores[key], b.scores[key]];
      return [unit ? `${label} (${unit})` : label, band(of_a, digits), band(of_b, digits), same && of_a && of_b ? paired(a, b, key, digits) : "–"];
    });
    return phdExp.table(["Quantity", "A", "B", "B − A, paired"], rows);
  }

  function configuration(a, b) {
    const keys = [...new Set([...Object.keys(a.config), ...Object.keys(b.config)])];
    const rows = keys.filter((key) => a.config[key] !== b.config[key]).map((key) => [key, a.config[key] ?? "–", b.config[key] ?? "–"]);
    return rows.length ? phdExp.table(["Key", "A", "B"], rows) : Object.assign(document.createElement("p"), { textContent: "Nothing." });
  }

  const main = (chart) => chart.data.filter((trace) => ROLES.includes(trace.meta.role));

  /** Axes and diagonal that cover both runs. */
  function frame(known) {
    const layout = structuredClone(known[0].layout);
    const diagonals = known.flatMap((chart) => chart.data.filter((trace) => trace.meta.role === "identity"));
    if (!diagonals.length) return { layout, data: [] };
    for (const name of ["xaxis", "yaxis"]) {
      const ends = known.flatMap((chart) => chart.layout[name].range);
      layout[name].range = [Math.min(...ends), Math.max(...ends)];
    }
    const ends = diagonals.flatMap((trace) => trace.x);
    const reach = [Math.min(...ends), Math.max(...ends)];
    return { layout, data: [{ ...diagonals[0], x: reach, y: reach }] };
  }

  /** One chart of both runs; the lines of the second are dashed, to differ without colour too. */
  function overlaid(key, runs) {
    const charts = runs.map((run) => run.charts[key]);
    const known = charts.filter(Boolean);
    const { layout, data } = frame(known);
    charts.forEach((chart, place) => {
      if (!chart) return;
      const traces = main(chart);
      for (const trace of traces) {
        const letter = `${NAMES[place].toUpperCase()}: ${runs[place].title} ${runs[place].run}`;
        const name = traces.length > 1 ? `${letter}, ${trace.name}` : letter;
        const colour = `var(--series-${place + 1})`;
        data.push({
          ...trace, name, text: label(runs[place]),
          line: { ...trace.line, color: colour, dash: traces.length > 1 ? trace.line?.dash : place ? "dash" : "solid" },
          marker: { ...trace.marker, color: colour, symbol: place ? "diamond" : "circle", size: 8 },
        });
      }
    });
    const words = charts.map((chart, place) => `${NAMES[place].toUpperCase()}: ${chart ? chart.label : "not recorded"}`).join(" ");
    return { title: known[0].title, label: words, data, layout };
  }

  function figure(key, chart) {
    const element = document.createElement("figure");
    element.className = "chart";
    element.dataset.chart = key;
    element.chart = chart;
    const plot = Object.assign(document.createElement("div"), { className: "plot" });
    plot.setAttribute("role", "img");
    plot.setAttribute("aria-label", chart.label);
    const details = Object.assign(document.createElement("details"), { className: "numbers" });
    const summary = Object.assign(document.createElement("summary"), { textContent: "Numbers" });
    summary.append(Object.assign(document.createElement("span"), { className: "unseen", textContent: ` of “${chart.title}”` }));
    details.append(summary);
    element.append(Object.assign(document.createElement("figcaption"), { textContent: chart.title }), plot, details);
    return element;
  }

  function fill(id, ...children) {
    document.getElementById(id).replaceChildren(...children);
  }

  async function show() {
    const slugs = NAMES.map((name) => select(name).value);
    history.replaceState(null, "", `#a=${encodeURIComponent(slugs[0])}&b=${encodeURIComponent(slugs[1])}`);
    const status = document.getElementById("status");
    try {
      const runs = await Promise.all(slugs.map(load));
      if (slugs.some((slug, place) => slug !== select(NAMES[place]).value)) return;  // the choice has changed meanwhile
      status.hidden = true;
      fill("scores", scores(...runs));
      fill("config", configuration(...runs));
      const keys = [...new Set(runs.flatMap((run) => Object.keys(run.charts)))];
      fill("curves", ...keys.map((key) => figure(key, overlaid(key, runs))));
      phdExp.watch(document.getElementById("curves"));
    } catch (error) {
      status.textContent = error.message;
      status.hidden = false;
    }
  }

  /** Select the runs of the address, or the first two. */
  function fromAddress() {
    const asked = new URLSearchParams(location.hash.slice(1));
    NAMES.forEach((name, place) => {
      const options = [...select(name).options].map((option) => option.value);
      const other = place ? options.find((value) => value !== select("a").value) : options[0];
      select(name).value = options.includes(asked.get(name)) ? asked.get(name) : other ?? options[0] ?? "";
    });
  }

  document.addEventListener("DOMContentLoaded", () => {
    if (!select("a").options.length) return;
    fromAddress();
    NAMES.forEach((name) => select(name).addEventListener("change", show));
    document.getElementById("swap").addEventListener("click", () => {
      [select("a").value, select("b").value] = [select("b").value, select("a").value];
      show();
    });
    window.addEventListener("hashchange", () => { fromAddress(); show(); });
    show();
  });
})();
