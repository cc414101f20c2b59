// What the theme forgets: a name for its search, and that code and tables wider than the window are scrolled by keys.
document.querySelector(".md-search")?.setAttribute("aria-label", "Search");
for (const code of document.querySelectorAll("pre > code")) {
  const keep = () => { if (!code.hasAttribute("tabindex")) code.tabIndex = 0; }; // the theme takes it away again
  new MutationObserver(keep).observe(code, { attributes: true, attributeFilter: ["tabindex"] });
  keep();
}
addEventListener("load", () => {
  const wide = '.md-typeset__scrollwrap, .md-typeset p:has(> img[src$=".svg"])';
  for (const wrap of document.querySelectorAll(wide)) wrap.tabIndex = 0;
});
