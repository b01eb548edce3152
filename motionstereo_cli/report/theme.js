"use strict";
// Light and dark: as the system has it, until the button says otherwise.
(() => {
  const system = matchMedia("(prefers-color-scheme: dark)");
  const paint = (dark) => {
    document.documentElement.classList.toggle("dark", dark);
    document.dispatchEvent(new Event("theme"));
  };
  paint(system.matches);
  system.addEventListener("change", () => paint(system.matches));
  document.getElementById("theme").addEventListener("click",
    () => paint(!document.documentElement.classList.contains("dark")));
})();
