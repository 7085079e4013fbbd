// Tables and code that scroll can be reached by the keyboard.
document$.subscribe(() => {
  document.querySelectorAll("pre > code").forEach((part) => { part.tabIndex = 0; });
  const reach = () => document.querySelectorAll(".md-typeset__scrollwrap").forEach((part) => {
    part.tabIndex = 0;
    part.setAttribute("role", "region");
    part.setAttribute("aria-label", "Table");
  });
  reach();
  new MutationObserver(reach).observe(document.body, { childList: true, subtree: true });
});
