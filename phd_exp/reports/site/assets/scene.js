// Draws a prediction in space: to scale with its camera, and a close-up whose axes have scales of their own.
(() => {
  const drawn = new Set();

  const LONGEST = 2.4;  // side of the box of axes, in plotly's unit

  /** The sides of the box of axes: to scale, or a cube. */
  function sides(traces, close) {
    const extents = ["x", "y", "z"].map((name) => {
      const values = traces.flatMap((trace) => trace[name]).filter((value) => value !== null);
      return Math.max(...values) - Math.min(...values);
    });
    const longest = Math.max(...extents);
    const [x, y, z] = extents.map((extent) => (close ? 1 : LONGEST * extent / longest));
    return { x, y, z };
  }

  /** The place of the viewer, behind the camera, whose y is down; further away for a plot that is narrow. */
  function viewpoint(plot, close) {
    const far = Math.max(1, 1.15 * plot.clientHeight / plot.clientWidth);
    const [x, y, z] = (close ? [-1.65, -1.1, -1.65] : [-2.0, -1.0, -1.2]).map((value) => far * value);
    return { up: { x: 0, y: -1, z: 0 }, eye: { x, y, z }, center: { x: 0, y: 0.12, z: 0 } };
  }

  function layout(plot, traces, close) {
    const axis = (name) => ({
      title: { text: `${name} (m)` }, color: phdExp.style("--ink"), gridcolor: phdExp.style("--grid"),
      zeroline: false, showspikes: false, nticks: 5,
    });
    return {
      scene: {
        xaxis: axis("x"), yaxis: axis("y"), zaxis: axis("z"), aspectmode: "manual", aspectratio: sides(traces, close),
        camera: viewpoint(plot, close),
        // on a touch screen a drag scrolls the page
        dragmode: window.matchMedia("(pointer: fine)").matches ? "orbit" : false,
      },
      font: { family: phdExp.style("--sans"), size: 11 }, showlegend: false,
      paper_bgcolor: "rgba(0,0,0,0)", margin: { l: 0, r: 0, t: 0, b: 0 },
      hoverlabel: { bgcolor: phdExp.style("--paper"), font: { color: phdExp.style("--ink") } },
    };
  }

  async function draw(figure) {
    const traces = phdExp.runs.get(figure.dataset.run)?.scene;
    if (!traces) return;
    drawn.add(figure);
    const named = phdExp.themed(traces).map((trace) => ({ ...trace, hovertemplate: "%{x:.4g}, %{y:.4g}, %{z:.4g}" }));
    for (const plot of figure.querySelectorAll(".plot")) {
      const close = plot.classList.contains("close");
      const shown = named.filter((trace) => !close || trace.meta.close);
      await Plotly.react(plot, shown, layout(plot, shown, close), {
        responsive: true, displayModeBar: false, displaylogo: false, scrollZoom: false,
      });
    }
    figure.classList.add("drawn");
  }

  const watcher = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (entry.isIntersecting && !drawn.has(entry.target)) draw(entry.target);
    }
  }, { rootMargin: "300px" });

  const all = () => document.querySelectorAll("figure.scene");
  document.addEventListener("DOMContentLoaded", () => all().forEach((figure) => watcher.observe(figure)));
  window.addEventListener("beforeprint", () => all().forEach(draw));
  document.documentElement.addEventListener("themechange", () => drawn.forEach(draw));
})();
