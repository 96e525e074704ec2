// What is wrong on an open page: names, headings, landmarks, tables, contrast, focus.
document.documentElement.dataset.theme = document.documentElement.dataset.mode = arguments[0];
const still = document.head.appendChild(document.createElement("style"));
still.textContent = "* { transition: none !important; animation: none !important; }";
const found = [], told = (rule, e) => found.push(rule + ": " + e.outerHTML.slice(0, 90));
const all = (query) => [...document.querySelectorAll(query)];
const seen = (e) => e.getClientRects().length > 0 && getComputedStyle(e).visibility !== "hidden";
const name = (e) => (e.getAttribute("aria-label") || e.textContent || e.title || "").trim()
  || [...e.querySelectorAll("img, svg")].map(i => i.alt || i.getAttribute("aria-label") || "").join("")
  || [...(e.labels || [])].map(l => l.textContent).join("") || e.placeholder || "";
const words = (text) => text.toLowerCase().replace(/\s+/g, " ").trim();
if (!document.documentElement.lang) found.push("no language");
if (!document.title.trim()) found.push("no title");
for (const e of all("img:not([alt])")) told("picture without words", e);
for (const e of all("a[href], button, input:not([type=hidden]), select, summary, [role=button]"))
  if (seen(e) && !name(e)) told("control without a name", e);
for (const e of all("a[aria-label], button[aria-label], summary[aria-label]")) {
  const shown = [...e.querySelectorAll("*"), e].filter(seen).flatMap(p => [...p.childNodes])
    .filter(n => n.nodeType === 3 && /\w/.test(n.data)).map(n => words(n.data));
  if (shown.some(text => !words(e.getAttribute("aria-label")).includes(text)))
    told("called otherwise than shown", e);
}
for (const e of all("th")) if (!e.textContent.trim()) told("empty header", e);
for (const e of all("article table:not([role=presentation])")) if (!e.querySelector("th")) told("table without headers", e);
for (const e of all("dl")) if (e.children.length && !e.querySelector(":scope > dt"))
  told("list of words without a word", e);
for (const e of all("[role=img]")) if (e.querySelector("a, button")) told("link in a picture", e);
const heads = all("article :is(h1, h2, h3, h4, h5, h6)").filter(seen).map(e => +e.tagName[1]);
heads.forEach((h, k) => { if (h > (k ? heads[k - 1] : 0) + 1) found.push("heading skips to h" + h); });
if (all("main, [role=main]").filter(seen).length !== 1) found.push("not one main part");
const marks = "main, nav, header, footer, aside, dialog, [role=main], [role=navigation], "
  + "[role=banner], [role=search], [role=complementary], [role=contentinfo], .skip-link, button";
const once = (make) => { const known = new Map();
  return (e) => { if (!known.has(e)) known.set(e, make(e)); return known.get(e); }; };
const within = (query) => {
  const is = once((e) => e !== null && (e.matches(query) || is(e.parentElement)));
  return is;
};
const [unseen, part, exempt] = ["script, style, noscript, template, mjx-assistive-mml", marks,
  "svg, [disabled], .MathJax_Preview"].map(within);
const paint = document.createElement("canvas").getContext("2d", {willReadFrequently: true});
const rgb = once((colour) => {
  paint.clearRect(0, 0, 1, 1); paint.fillStyle = colour; paint.fillRect(0, 0, 1, 1);
  return [...paint.getImageData(0, 0, 1, 1).data];
});
const over = (top, low) => low.map((v, k) => k < 3 ? (top[k] * top[3] + v * (255 - top[3])) / 255 : 255);
const back = once((e) => e ? over(rgb(getComputedStyle(e).backgroundColor), back(e.parentElement))
  : [255, 255, 255, 255]);
const light = (c) => c.slice(0, 3).map(v => v / 255)
  .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
  .reduce((s, v, k) => s + v * [0.2126, 0.7152, 0.0722][k], 0);
const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
const holders = new Set(), outside = new Set();
while (texts.nextNode()) if (texts.currentNode.data.trim()) holders.add(texts.currentNode.parentElement);
for (const e of holders) {
  if (unseen(e) || !seen(e)) continue;
  if (!part(e)) {
    const top = [...document.body.children].find(c => c.contains(e));
    if (!outside.has(top)) { outside.add(top); told("outside of all parts", e); }
  }
  if (exempt(e)) continue;
  const style = getComputedStyle(e), size = parseFloat(style.fontSize);
  const [x, y] = [light(over(rgb(style.color), back(e))), light(back(e))].sort((p, q) => q - p);
  const large = size >= 24 || size >= 18.66 && +style.fontWeight >= 700;
  if ((x + 0.05) / (y + 0.05) < (large ? 3 : 4.5)) told("faint " + style.color + " on " + back(e), e);
}
const kinds = new Map();
for (const e of all("a[href], button, input, summary")) if (seen(e) && !kinds.has(e.tagName + e.className))
  kinds.set(e.tagName + e.className, e);
for (const e of [...kinds.values()].slice(0, 60)) {
  const look = () => { const s = getComputedStyle(e);
    return [s.outlineStyle, s.outlineWidth, s.outlineColor, s.boxShadow, s.backgroundColor, s.textDecorationLine].join(); };
  const before = look();
  e.focus({preventScroll: true, focusVisible: true});
  if (document.activeElement === e && look() === before) told("focus is not seen", e);
  e.blur();
}
return [...new Set(found)];
