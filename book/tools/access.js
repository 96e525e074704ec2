// What is wrong on an open page: the rules of axe-core, and three that it does not have.
const theme = arguments[0], done = arguments[arguments.length - 1];
document.documentElement.dataset.theme = document.documentElement.dataset.mode = theme;
const still = document.head.appendChild(document.createElement("style"));
still.textContent = "* { transition: none !important; animation: none !important; }";
const found = [];
const report = (rule, html) => found.push(rule + ": " + html.slice(0, 90));
const all = (query) => [...document.querySelectorAll(query)];

// A formula has hundreds of elements. A box as wide as it keeps the layout, and spares axe minutes.
for (const formula of all("mjx-container:not(.box)")) {
  const box = document.createElement("span");
  box.textContent = "f";
  box.style.display = "inline-block";
  box.style.width = formula.scrollWidth + "px";
  formula.replaceChildren(box);
  formula.classList.add("box");
}

// axe asks for headers only of tables that it takes for large ones.
for (const table of all("article table:not([role=presentation])"))
  if (!table.querySelector("th")) report("table without headers", table.outerHTML);

for (const list of all("dl"))
  if (list.children.length && !list.querySelector(":scope > dt"))
    report("definitions without a term", list.outerHTML);

// The keyboard's place has to be seen, on one control of each kind.
const kinds = new Map();
for (const control of all("a[href], button, input, summary"))
  if (control.checkVisibility()) kinds.set(control.tagName + control.className, control);
for (const control of [...kinds.values()].slice(0, 60)) {
  const look = () => {
    const style = getComputedStyle(control);
    return [style.outlineStyle, style.outlineWidth, style.outlineColor, style.boxShadow,
      style.backgroundColor, style.textDecorationLine].join();
  };
  const before = look();
  control.focus({preventScroll: true, focusVisible: true});
  if (document.activeElement === control && look() === before)
    report("focus is not seen", control.outerHTML);
  control.blur();
}

const options = {
  elementRef: false,
  resultTypes: ["violations"],
  // Visible words are part of a control's name: axe does not ask for it by itself.
  rules: {"label-content-name-mismatch": {enabled: true}},
};
axe.run(document, options).then((results) => {
  for (const violation of results.violations)
    for (const node of violation.nodes) report(violation.id, node.html);
  done(found);
});
