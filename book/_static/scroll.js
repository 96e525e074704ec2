// A box that scrolls is reached by the keyboard. The theme sees to code and tables; formulas and
// signatures are left.
(() => {
  const mark = () => document.querySelectorAll("div.math, mjx-container, dt.sig").forEach((box) => {
    const hidden = box.scrollWidth - box.clientWidth;
    const scrolls = hidden > 1 && getComputedStyle(box).overflowX === "auto";
    if (scrolls) box.tabIndex = 0;
    else box.removeAttribute("tabindex");
  });
  let waiting = 0;
  const markSoon = () => {
    clearTimeout(waiting);
    waiting = setTimeout(mark, 200);
  };
  addEventListener("resize", markSoon);
  // A folded part has no widths before it is opened. The event does not bubble.
  document.addEventListener("toggle", markSoon, true);
  addEventListener("load", () => {
    const formulas = window.MathJax && MathJax.startup ? MathJax.startup.promise : Promise.resolve();
    formulas.then(mark);
  });
})();
