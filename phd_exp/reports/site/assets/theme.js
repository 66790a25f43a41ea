// Runs before the page is painted: applies the last chosen theme, or that of the system.
(() => {
  const root = document.documentElement;
  const system = window.matchMedia("(prefers-color-scheme: dark)");

  const stored = () => {
    try { return localStorage.getItem("phd_exp.theme"); } catch { return null; }  // storage may be forbidden
  };
  const remember = (theme) => {
    try { localStorage.setItem("phd_exp.theme", theme); } catch { /* then the choice lasts for this page */ }
  };

  const apply = (theme) => {
    root.dataset.theme = theme;
    document.getElementById("theme")?.setAttribute("aria-pressed", String(theme === "dark"));
    root.dispatchEvent(new CustomEvent("themechange"));
  };
  const initial = () => stored() || (system.matches ? "dark" : "light");

  apply(initial());
  system.addEventListener("change", () => apply(initial()));
  document.addEventListener("DOMContentLoaded", () => {
    apply(root.dataset.theme);
    document.getElementById("theme").addEventListener("click", () => {
      const theme = root.dataset.theme === "dark" ? "light" : "dark";
      remember(theme);
      apply(theme);
    });
  });
})();
