// The page of a capture. It gets events over a request that stays open, with the token of its address in a header: what
// follows # in an address is not sent by browsers. Texts of the sensor are set as text alone, never as markup.
"use strict";

const element = (id) => document.getElementById(id);
const token = window.location.hash.slice(1);
const globe = new Globe(element("globe"), element("turn"));
const seen = { moment: null, progress: null, ended: false, moments: 0, drawing: false, saved: null };

/** Set a text only where it changes, so that a screen reader says it once. */
function tell(id, text) {
  const target = element(id);
  if (target.textContent !== text) target.textContent = text;
}

/** How a pose is held, with minus signs at which no line breaks. */
const hold = (words) => words.replaceAll("-", "\u2212");

function classed(id, name) {
  if (element(id).className !== name) element(id).className = name;
}

/** A new element with a text. */
function made(tag, text = "", name = "") {
  const fresh = document.createElement(tag);
  fresh.textContent = text;
  if (name) fresh.className = name;
  return fresh;
}

function link(text, lost = false) {
  tell("link", text);
  classed("link", lost ? "lost" : "");
}

function request(path, options = {}) {
  const headers = { Authorization: `Bearer ${token}`, ...options.headers };
  return fetch(path, { ...options, headers, cache: "no-store", credentials: "omit" });
}

/** Ask for an action; the JSON of the answer, or null after saying what is wrong. */
async function act(path, stated = {}) {
  const headers = { "Content-Type": "application/json" };
  try {
    const answer = await request(path, { method: "POST", headers, body: JSON.stringify(stated) });
    const said = await answer.json();
    if (answer.ok) return said;
    tell("remark", said.error);
  } catch {
    tell("remark", "accelcal does not answer");
  }
  return null;
}

const figure = (value) => (value === null ? "-" : Number(value.toPrecision(5)).toString());

function showMoment(now) {
  seen.moment = now;
  seen.moments += 1;
  document.documentElement.dataset.moments = seen.moments;
  tell("state", now.words);
  classed("state", now.state);
  element("hold").value = now.state === "taken" ? 1 : now.progress;
  tell("held", `held: ${hold(now.hold)}`);
  const size = Math.hypot(...now.reading) || 1;
  const whole = 1.2 * Math.max(size / (now.length || 1), Math.max(...now.reading.map(Math.abs)) / 1.2);
  ["x", "y", "z"].forEach((axis, k) => {
    tell(axis, figure(now.reading[k]));
    element(`bar-${axis}`).style.transform = `scaleX(${now.reading[k] / whole})`;
  });
  tell("length", `${now.length.toFixed(4)} g`);
  tell("spread", now.spread.toPrecision(2));
  tell("limit", now.limit.toPrecision(2));
  globe.follow(now.direction);
  if (globe.scene.next !== now.next) {
    globe.scene.next = now.next;
    showNext();
  }
  mark();
  draw();
}

function showNext() {
  const { progress } = seen;
  const { next } = globe.scene;
  tell("next-words", progress && next !== null ? hold(progress.words[next]) : seen.progress ? "all poses are taken" : "-");
  if (progress && next !== null) globe.face(progress.planned[next]);
}

/** Mark in the list what is held and what is next. */
function mark() {
  const { next } = globe.scene;
  const held = seen.moment === null ? null : seen.moment.held;
  [...element("list").children].forEach((row, index) => {
    row.classList.toggle("held", index === held);
    row.classList.toggle("following", index === next);
  });
}

function showProgress(found) {
  seen.progress = found;
  globe.scene.planned = found.planned;
  globe.scene.numbers = found.numbers;
  globe.scene.taken = found.taken;
  if (seen.moment === null || found.missing === 0) globe.scene.next = found.missing ? found.numbers.indexOf(null) : null;
  tell("count", found.count);
  const rows = found.words.map((words, index) => {
    const number = found.numbers[index];
    return number === null ? made("li", hold(words)) : made("li", `${hold(words)}: pose ${number}`, "taken");
  });
  element("list").replaceChildren(...rows);
  showNext();
  mark();
  showSummary(found);
  draw();
}

function showSummary(found) {
  const summary = found.summary;
  tell("verdict", found.outlook);
  classed("verdict", summary ? summary.verdict : "");
  element("sentences").replaceChildren(...found.sentences.map((text) => made("li", text)));
  element("numbers").hidden = !summary;
  if (!summary) return;
  element("bias").replaceChildren(
    ...summary.bias.map(([value, spread], k) => {
      const row = made("tr");
      const head = made("th", ["x", "y", "z"][k]);
      head.scope = "row";
      row.append(head, made("td", spread ? `${value} \u00b1 ${spread}` : value));
      return row;
    }),
  );
  const figures = [["noise of one pose, s", summary.noise], ...summary.dop.map(([kind, size]) => [`DOP ${kind}`, size])];
  element("dop").replaceChildren(
    ...figures.map(([name, value]) => {
      const pair = made("div");
      pair.append(made("dt", name), made("dd", value));
      return pair;
    }),
  );
}

function showTable({ title, heads, rows, notes }) {
  const holder = made("div", "", "scroll");
  holder.tabIndex = 0;
  holder.setAttribute("role", "region");
  holder.setAttribute("aria-label", title);
  const table = made("table");
  const top = made("tr");
  for (const head of heads) {
    const cell = made("th", head);
    cell.scope = "col";
    top.append(cell);
  }
  const head = made("thead");
  head.append(top);
  const body = made("tbody");
  for (const cells of rows) {
    const row = made("tr");
    row.append(...cells.map((text) => made("td", text)));
    body.append(row);
  }
  table.append(made("caption", title), head, body);
  holder.append(table, ...notes.map((note) => made("p", note, "quiet")));
  return holder;
}

function showEnd({ said, tables, exports }) {
  seen.ended = true;
  tell("said", said);
  element("tables").replaceChildren(...tables.map(showTable));
  element("to").replaceChildren(...exports.map((name) => made("option", name)));
  element("end").hidden = false;
  element("stop").disabled = true;
  document.querySelector("main").className = "ended";
  tell("calibration-title", "Calibration");
  element("end-title").focus();
  link("the capture has ended");
}

function draw() {
  if (seen.drawing) return;
  seen.drawing = true;
  window.requestAnimationFrame(() => {
    seen.drawing = false;
    globe.draw();
    const tones = colours();
    const { next } = globe.scene;
    element("box-next").parentElement.hidden = next === null;
    drawBox(element("box-next"), seen.progress && next !== null ? seen.progress.planned[next] : null, tones.accent);
    drawBox(element("box-now"), seen.moment && seen.moment.direction, tones.quiet);
  });
}

const SHOW = { moment: showMoment, progress: showProgress, end: showEnd };

function receive(block) {
  const lines = block.split("\n");
  const name = lines.find((line) => line.startsWith("event: "));
  const data = lines.find((line) => line.startsWith("data: "));
  if (name && data) SHOW[name.slice(7)]?.(JSON.parse(data.slice(6)));
}

/** Listen until the connection ends; whether it makes sense to try again. */
async function listen() {
  const answer = await request("/events");
  if (answer.status === 401) {
    link("this address lacks the token: open the one that accelcal printed", true);
    return false;
  }
  if (!answer.ok) {
    link(answer.status === 503 ? "too many pages are open: close one" : `refused (${answer.status})`, true);
    return answer.status === 503;
  }
  link(seen.ended ? "the capture has ended" : "live");
  const reader = answer.body.getReader();
  const decoder = new TextDecoder();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return true;
    const blocks = (rest + decoder.decode(value, { stream: true })).split("\n\n");
    rest = blocks.pop();
    blocks.forEach(receive);
  }
}

async function stay() {
  for (;;) {
    try {
      if (!(await listen())) return;
    } catch {
      // the connection was lost: said below
    }
    if (element("link").textContent.startsWith("too many")) {
      await new Promise((resolve) => setTimeout(resolve, 3000));
      continue;
    }
    link(seen.ended ? "accelcal has ended" : "connection lost: trying again", !seen.ended);
    if (seen.ended) return;
    await new Promise((resolve) => setTimeout(resolve, 1000));
  }
}

element("stop").addEventListener("click", async () => {
  const button = element("stop");
  const missing = seen.progress ? seen.progress.missing : 0;
  if (missing && !button.classList.contains("sure")) {
    button.classList.add("sure");
    button.textContent = `End it with ${missing} ${missing === 1 ? "pose" : "poses"} missing`;
    return;
  }
  await act("/stop");
});

element("stop").addEventListener("blur", () => {
  element("stop").classList.remove("sure");
  element("stop").textContent = "End the capture";
});

element("form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const said = await act("/export", { to: element("to").value });
  element("text").hidden = !said;
  element("save").disabled = !said;
  seen.saved = said;
  if (!said) return;
  tell("remark", said.warnings.map((text) => `Warning: ${text}.`).join(" ") || said.name);
  tell("text", said.text);
});

element("save").addEventListener("click", () => {
  const address = URL.createObjectURL(new Blob([seen.saved.text], { type: "text/plain" }));
  const anchor = made("a");
  anchor.href = address;
  anchor.download = seen.saved.name;
  anchor.click();
  setTimeout(() => URL.revokeObjectURL(address), 1000);
});

element("close").addEventListener("click", async () => {
  if (await act("/close")) link("accelcal has ended");
});

window.addEventListener("resize", draw);
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
stay();
