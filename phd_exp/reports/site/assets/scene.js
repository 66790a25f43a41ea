// Draws a prediction in space: to scale with its camera, and a close-up whose axes have scales of their own.
(() => {
  const drawn = new Set();

  function layout(close) {
    const axis = (name) => ({
      title: { text: `${name} (m)` }, color: phdExp.style("--ink"), gridcolor: phdExp.style("--grid"),
      zeroline: false, showspikes: false, nticks: 5,
    });
    return {
      scene: {
        xaxis: axis("x"), yaxis: axis("y"), zaxis: axis("z"), aspectmode: close ? "cube" : "data",
        // as seen from behind the camera, whose y is down
        camera: { up: { x: 0, y: -1, z: 0 }, eye: close ? { x: -1.4, y: -0.9, z: -1.4 } : { x: -1.5, y: -0.6, z: -0.5 } },
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
      await Plotly.react(plot, named.filter((trace) => !close || trace.meta.close), layout(close), {
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

  document.addEventListener("DOMContentLoaded", () => document.querySelectorAll("figure.scene").forEach((figure) => watcher.observe(figure)));
  document.documentElement.addEventListener("themechange", () => drawn.forEach(draw));
})();
