
"use strict";
// Pointing at a mark of a picture, or moving the slider below it, says what the mark is, and shows it in all pictures
// and tables. Without this script the titles of the marks say it.
const all = key => document.querySelectorAll(`[data-key="${CSS.escape(key)}"]`);
let shown = [];
function show(key) {
  for (const one of shown) one.classList.remove("on");
  shown = key === null ? [] : [...all(key)];
  for (const one of shown) one.classList.add("on");
}
for (const svg of document.querySelectorAll("svg")) {
  const marks = [...svg.querySelectorAll("g[data-key]")];
  if (!marks.length) continue;
  const names = marks.map(mark => mark.querySelector("title").textContent);
  for (const mark of marks) mark.querySelector("title").remove();
  const probe = document.createElement("div"), label = document.createElement("label");
  const slider = document.createElement("input"), said = document.createElement("output");
  probe.className = "probe";
  slider.type = "range";
  slider.min = 1;
  slider.max = marks.length;
  slider.value = 1;
  label.append(svg.dataset.kind || "Value", slider);
  said.textContent = "Point at a mark, or move the slider.";
  probe.append(label, said);
  svg.after(probe);
  const choose = i => {
    slider.value = i + 1;
    slider.setAttribute("aria-valuetext", names[i]);
    said.textContent = names[i];
    show(marks[i].dataset.key);
  };
  slider.addEventListener("input", () => choose(slider.value - 1));
  slider.addEventListener("focus", () => choose(slider.value - 1));
  marks.forEach((mark, i) => {
    mark.addEventListener("pointerenter", () => choose(i));
    mark.addEventListener("click", () => choose(i));
  });
}
