// What a result shows of a page is from its text: menus and lists of contents are left out.
if (typeof Search !== "undefined") {
  Search.htmlToText = (page, anchor) => {
    const tree = new DOMParser().parseFromString(page, "text/html");
    const text = tree.querySelector("article.bd-article") || tree.body;
    text.querySelectorAll(".headerlink, .notebook, script, style").forEach((part) => part.remove());
    return ((anchor && text.querySelector(anchor)) || text).textContent;
  };
  // A title that holds all that was asked for comes first.
  const asked = (new URLSearchParams(location.search).get("q") || "").trim().toLowerCase();
  Scorer.score = ([page, title, anchor, told, score]) =>
    score + (asked && title.toLowerCase().includes(asked) ? 50 : 0);
}
