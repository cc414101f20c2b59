// What the theme forgets: a name for its search, and that code and tables wider than the window are scrolled by keys.
document.querySelector(".md-search")?.setAttribute("aria-label", "Search");
for (const code of document.querySelectorAll("pre > code")) {
  const keep = () => { if (!code.hasAttribute("tabindex")) code.tabIndex = 0; }; // the theme takes it away again
  new MutationObserver(keep).observe(code, { attributes: true, attributeFilter: ["tabindex"] });
  keep();
}
addEventListener("load", () => {
  for (const wrap of document.querySelectorAll(".md-typeset__scrollwrap")) wrap.tabIndex = 0;
});
