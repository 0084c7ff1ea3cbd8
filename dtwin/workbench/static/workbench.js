"use strict";
// Server-rendered pages; this draws figures, sends forms, and follows work in progress.

const byId = (id) => document.getElementById(id);
const all = (selector, within) => Array.from((within || document).querySelectorAll(selector));
const CONFIG = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["lasso2d", "select2d", "sendChartToCloud"], plotlyServerURL: "" };

async function ask(address, options) {
  const headers = { ...(options || {}).headers, "dtwin-key": localStorage.getItem("dtwin-key") || "" };
  const answer = await fetch(address, { credentials: "same-origin", ...options, headers }).catch(() => {
    throw new Error("the workbench does not answer: it was stopped, or the connection broke\n  try: dtwin ui, and open the address that it prints; what it had not finished is told there");
  });
  const kind = answer.headers.get("content-type") || "";
  const body = kind.includes("json") ? await answer.json() : { text: await answer.text() };
  if (!answer.ok) throw Object.assign(new Error(body.text || `the server answered ${answer.status}`), { refused: true });
  return body;
}

const send = (address, content, method) =>
  ask(address, { method: method || "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(content) });

// As `decimal` of the server: a single comma or point is the decimal sign.
function decimal(text) {
  const plain = text.replace(/[\s'\u2019]/g, "").replace("\u2212", "-");
  if (/^[+-]?(\d+[.,]?\d*|[.,]\d+)(e[+-]?\d{1,3})?$/i.test(plain)) return Number(plain.replace(",", "."));
  const grouped = /^[+-]?\d{1,3}((,\d{3})+(\.\d*)?|(\.\d{3})+(,\d*)?)$/.exec(plain);
  return grouped ? Number(plain.replaceAll(grouped[2] ? "," : ".", "").replace(",", ".")) : NaN;
}

// What is no number goes as it is: the refusal tells it.
const numberOr = (text) => (Number.isNaN(decimal(text)) ? text || null : decimal(text));

// ---- figures ---------------------------------------------------------------------------------

function chosen() {
  const form = byId("chooser");
  const query = new URLSearchParams();
  for (const box of all("input[name]:checked", form)) query.append(box.name, box.value);
  if (form.dataset.on) query.set("on", form.dataset.on);
  return query;
}

function addressOf(figure) {
  const address = figure.dataset.figure;
  if ("chooser" in figure.dataset) return `${address}?${chosen()}`;
  const by = byId(figure.dataset.by);
  return by ? `${address}?${new URLSearchParams({ [by.name]: by.value })}` : address;
}

// A browser that never drew before compiles Plotly for a second, and shows nothing meanwhile: it is asked for once
// the first figure of the page is painted, a polar plot as lines.
let running;
async function started() {
  await Promise.allSettled([all("[data-figure]")[0].asked]);
  await new Promise((painted) => requestAnimationFrame(() => setTimeout(painted, 20)));
  const script = Object.assign(document.createElement("script"), { src: document.querySelector("link[rel=preload]").href });
  await new Promise((done, failed) => {
    Object.assign(script, { onload: done, onerror: () => failed(new Error("plotly.js did not load\n  try: load the page again")) });
    document.head.append(script);
  });
}

const SVG = "http://www.w3.org/2000/svg";
const DASHES = { dot: "2 2", dash: "6 4", dashdot: "6 2 2 2" };

const TYPES = { i1: Int8Array, u1: Uint8Array, i2: Int16Array, u2: Uint16Array, i4: Int32Array, u4: Uint32Array, f4: Float32Array, f8: Float64Array };

// Plotly takes lists of numbers, and packed ones.
const numbers = (told) => ("bdata" in told ? new TYPES[told.dtype](Uint8Array.from(atob(told.bdata), (c) => c.charCodeAt(0)).buffer) : told);

function sketched(canvas, { data, layout }) {
  const { radialaxis: radial, angularaxis: angular } = layout.polar || {};
  if (!radial || !radial.range || !radial.tickvals) return;
  const { l, r, t } = layout.margin;
  const b = layout.margin.b + (window.innerWidth < 700 ? 58 : 18); // as high as the legend, which Plotly makes room for
  const [across, down] = [canvas.clientWidth, layout.height];
  const [x, y, radius] = [(l + across - r) / 2, (t + down - b) / 2, Math.min(across - l - r, down - t - b) / 2];
  const at = (theta, length) => {
    const out = (length * radius) / radial.range[1];
    return [x + out * Math.cos((theta * Math.PI) / 180), y - out * Math.sin((theta * Math.PI) / 180)].map((v) => v.toFixed(1));
  };
  const svg = document.createElementNS(SVG, "svg");
  const added = (name, values, text) => {
    const made = document.createElementNS(SVG, name);
    Object.entries(values).forEach(([key, value]) => made.setAttribute(key, value));
    made.textContent = text || "";
    svg.append(made);
  };
  const written = (text, [across, down], size) => added("text", { x: across, y: down, "font-size": size, "text-anchor": "middle", "dominant-baseline": "central", fill: "#2a3f5f" }, text);
  Object.entries({ width: across, height: down, fill: "none", "aria-hidden": "true", "font-family": "system-ui, sans-serif" }).forEach(([key, value]) => svg.setAttribute(key, value));
  radial.tickvals.forEach((ring, i) => {
    added("circle", { cx: x, cy: y, r: (ring * radius) / radial.range[1], stroke: "#ebf0f8" });
    written(radial.ticktext[i], at(radial.angle || 0, ring), 10);
  });
  ((angular || {}).ticktext || []).forEach((name, i) => written(name, at(angular.tickvals[i], 1.07 * radial.range[1]), 13));
  for (const { theta, r: lengths, line, mode } of data) {
    if (mode !== "lines" || !theta || !lengths) continue;
    const angles = numbers(theta);
    const points = Array.from(numbers(lengths), (length, i) => (Number.isFinite(length) ? at(angles[i], length).join() : ""));
    added("polyline", { points: points.join(" "), stroke: line.color, "stroke-width": line.width, "stroke-dasharray": DASHES[line.dash] || "" });
  }
  canvas.replaceChildren(svg);
}

async function draw(figure) {
  if (figure.dataset.by && !byId(figure.dataset.by).value) return;
  const canvas = figure.querySelector(".canvas");
  const turn = (figure.turn || 0) + 1;
  figure.turn = turn;
  figure.setAttribute("aria-busy", "true");
  try {
    figure.asked = ask(addressOf(figure));
    const found = await figure.asked;
    if (figure.turn !== turn) return;
    all(".refusal", figure).forEach((old) => old.remove());
    const magnified = "magnified" in figure.dataset;
    found.layout.autosize = true;
    if (!("map" in figure.dataset)) found.layout.height = Number(canvas.dataset.height);
    figure.querySelector("figcaption").textContent = (found.layout.title || {}).text || "";
    delete found.layout.title;
    canvas.hidden = !found.data.length;
    if (canvas.hidden) return;
    found.layout.margin = { ...found.layout.margin, t: 50 };
    if (window.innerWidth < 700) {
      found.layout.margin = { l: 48, r: found.layout.polar ? 48 : 12, t: 20, b: 60 };
      found.layout.legend = { orientation: "h", y: -0.18, yanchor: "top" };
    }
    canvas.style.minHeight = `${found.layout.height}px`;
    if (!window.Plotly) {
      sketched(canvas, found);
      await (running ||= started());
      if (figure.turn !== turn) return;
      if (!canvas.data) canvas.replaceChildren();
    }
    await Plotly.react(canvas, found.data, found.layout, CONFIG);
    if (magnified) keepMagnification(canvas);
    if ("map" in figure.dataset && !figure.listening) {
      figure.listening = true;
      canvas.on("plotly_click", (event) => showCondition(event.points[0].pointIndex[0]));
    }
  } catch (error) {
    if (figure.turn !== turn) return;
    all(".refusal", figure).forEach((old) => old.remove());
    const note = document.createElement("pre");
    note.className = "refusal";
    note.textContent = error.message;
    figure.append(note);
  } finally {
    figure.removeAttribute("aria-busy");
  }
}

// ---- magnification ---------------------------------------------------------------------------

let magnification = null; // chosen by the reader; null follows the figure

// Rings a round number of micrometres apart, as polar_rings draws them on the server.
function ringsOf(radius, factor) {
  const widest = (200 * radius) / factor;
  const power = 10 ** Math.floor(Math.log10(widest));
  const division = power * [5, 2, 1].find((m) => m * power <= widest * (1 + 1e-9));
  return [-3, -2, -1, 0, 1, 2, 3].map((step) => step * division).filter((um) => Math.abs(um) * factor <= 400 * radius);
}

function magnify(canvas, factor) {
  const radius = canvas.layout.meta.radius_mm;
  const drawn = canvas.data.map((trace) => trace.customdata.map((um) => (um === null ? null : radius + (um * factor) / 1000)));
  const rings = ringsOf(radius, factor);
  Plotly.update(canvas, { r: drawn }, { "polar.radialaxis.tickvals": rings.map((um) => radius + (um * factor) / 1000), "polar.radialaxis.ticktext": rings.map((um) => (um > 0 ? "+" : "") + Number(um.toPrecision(6))) });
  byId("magnification-text").value = String(Number(factor.toPrecision(3)));
  const slider = byId("magnification");
  slider.value = String(100 * Math.log10(factor / canvas.layout.meta.magnification));
  slider.setAttribute("aria-valuetext", `${Number(factor.toPrecision(3))} times`);
}

function keepMagnification(canvas) {
  magnify(canvas, magnification || canvas.layout.meta.magnification);
}

function watchMagnification() {
  const slider = byId("magnification");
  if (!slider) return;
  const canvas = byId("polar").querySelector(".canvas");
  const note = byId("magnification-note");
  slider.addEventListener("input", () => {
    if (!canvas.layout) return;
    magnification = canvas.layout.meta.magnification * 10 ** (Number(slider.value) / 100);
    magnify(canvas, magnification);
  });
  byId("magnification-text").addEventListener("change", (event) => {
    const factor = decimal(event.target.value);
    const good = factor > 0 && factor < 1e7;
    note.textContent = good ? "" : "not a magnification: for example 500 or 0,5";
    event.target.setAttribute("aria-invalid", String(!good));
    if (good) magnification = factor;
    if (good && canvas.layout) magnify(canvas, factor);
  });
}

// ---- what is drawn ---------------------------------------------------------------------------

function redraw() {
  const query = chosen().toString();
  history.replaceState(null, "", query ? `?${query}` : location.pathname);
  all("[data-chooser]").forEach(draw);
}

async function listRuns() {
  const form = byId("chooser");
  const place = byId("runs");
  const ticked = new Set([...all("input:checked", place).map((box) => box.value), ...new URLSearchParams(location.search).getAll("run")]);
  const query = chosen();
  query.delete("run");
  const found = await ask(`/api/twins/${form.dataset.twin}/runs?${query}`);
  place.replaceChildren(...found.runs.map((id) => {
    const label = document.createElement("label");
    const box = Object.assign(document.createElement("input"), { type: "checkbox", name: "run", value: id, checked: ticked.has(id) });
    const link = Object.assign(document.createElement("a"), { href: `/campaigns/${encodeURIComponent(found.campaign)}/runs/${encodeURIComponent(id)}`, textContent: "page" });
    link.setAttribute("aria-label", `page of run ${id}`);
    label.append(box, ` ${id} `);
    const both = document.createElement("span");
    both.append(label, link);
    return both;
  }));
}

async function changed() {
  await listRuns();
  redraw();
}

function showCondition(number) {
  all("#conditions input").forEach((box) => { box.checked = Number(box.value) === Number(number); });
  changed();
  byId("chooser").scrollIntoView({ behavior: matchMedia("(prefers-reduced-motion: reduce)").matches ? "auto" : "smooth", block: "start" });
}

function applyFilters() {
  const wanted = {};
  all("[data-filter]").forEach((select) => { if (select.value) wanted[select.dataset.filter] = select.value; });
  for (const label of all("#conditions label")) {
    const fits = Object.entries(wanted).every(([name, value]) => label.dataset[name] === value);
    label.hidden = !fits;
    if (!fits) label.querySelector("input").checked = false;
  }
  const visible = all("#conditions label:not([hidden]) input");
  if (!visible.some((box) => box.checked) && visible.length) visible[0].checked = true;
}

function watchChooser() {
  const form = byId("chooser");
  if (!form) return;
  const asked = new URLSearchParams(location.search);
  const numbers = asked.getAll("condition").length ? asked.getAll("condition") : form.dataset.worst.split(",");
  all("#conditions input").forEach((box) => { box.checked = numbers.includes(box.value); });
  if (asked.getAll("show").length) all("input[name=show]", form).forEach((box) => { box.checked = asked.getAll("show").includes(box.value); });
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("change", (event) => {
    if (event.target.dataset.filter) applyFilters();
    if (event.target.name === "condition" && all("#conditions input:checked").length > 6) event.target.checked = false;
    if (event.target.name === "run") redraw(); else changed();
  });
  all("[data-condition]").forEach((button) => button.addEventListener("click", () => showCondition(button.dataset.condition)));
}

// ---- work ------------------------------------------------------------------------------------

const pause = (ms) => new Promise((done) => setTimeout(done, ms));

function opened(title) {
  const dialog = byId("work");
  byId("work-title").textContent = title;
  byId("work-stage").textContent = "";
  byId("work-error").hidden = byId("work-close").hidden = true;
  byId("work-note").hidden = false;
  dialog.querySelector(".moving").hidden = false;
  if (!dialog.open) dialog.showModal();
  return dialog;
}

function failed(text) {
  byId("work-title").textContent = "That did not work";
  byId("work-error").textContent = text;
  byId("work-error").hidden = byId("work-close").hidden = false;
  byId("work-note").hidden = true;
  byId("work").querySelector(".moving").hidden = true;
  byId("work-stage").textContent = "";
  byId("work-close").focus();
}

async function follow(id) {
  const since = performance.now();
  for (;;) {
    const job = await ask(`/api/jobs/${id}`);
    byId("work-title").textContent = job.title;
    byId("work-stage").textContent = `${job.stage} (${Math.round((performance.now() - since) / 1000)} s)`;
    if (job.state === "done") { location.assign(job.address); return; }
    if (job.state === "failed" || job.state === "interrupted") { failed(job.error || job.stage); return; }
    await pause(400);
  }
}

async function start(title, begin) {
  opened(title);
  try {
    await follow((await begin()).job);
  } catch (error) {
    failed(error.message);
  }
}

// A file that takes a moment: what is wrong with it is said on the page, not saved as the file.
async function fetched(link) {
  opened(`Write ${link.textContent}`);
  byId("work-note").hidden = true;
  try {
    const answer = await fetch(link.href, { credentials: "same-origin" });
    if (!answer.ok) throw new Error((new DOMParser().parseFromString(await answer.text(), "text/html").querySelector("pre") || {}).textContent || `the server answered ${answer.status}`);
    const name = /filename="(.*)"/.exec(answer.headers.get("content-disposition"))[1];
    const file = Object.assign(document.createElement("a"), { href: URL.createObjectURL(await answer.blob()), download: name });
    file.click();
    byId("work").close();
  } catch (error) {
    failed(error.message);
  }
}

function contentOf(form) {
  const content = {};
  for (const field of all("[name]", form)) {
    // What stands there as it was read may be stated anew elsewhere meanwhile.
    if ("changes" in form.dataset && field.value === field.defaultValue) continue;
    if (field.type === "checkbox" && "list" in field.dataset) {
      content[field.name] = content[field.name] || [];
      if (field.checked) content[field.name].push(field.value);
    } else if (field.type === "checkbox") content[field.name] = field.checked;
    else content[field.name] = "number" in field.dataset ? numberOr(field.value.trim()) : field.value.trim();
  }
  return content;
}

// A file is sent as its text, with its name.
async function withFiles(form, content) {
  for (const field of all("[type=file][name]", form)) {
    content[field.name] = await field.files[0].text();
    content.file = field.files[0].name;
  }
  return content;
}

// Roles of who looks at the page, and which an address needs; the server decides, this only says so beforehand.
const mine = JSON.parse(document.body.dataset.may), needed = JSON.parse(document.body.dataset.needed);
function lacking(address) {
  const role = needed.find(([begin]) => new RegExp(`^${begin}`).test(address))[1];
  return mine.includes(role) ? "" : role;
}

// Names of machines, campaigns and twins are parts of addresses and files: what a keyboard gives is written so.
const WRITTEN = { ä: "ae", ö: "oe", ü: "ue", Ä: "Ae", Ö: "Oe", Ü: "Ue", ß: "ss" };
function watchNames() {
  for (const field of all('input[pattern^="[A-Za-z0-9]["]')) {
    field.title = "letters, digits and . _ + -, with a letter or digit first";
    field.addEventListener("change", () => { field.value = field.value.trim().replace(/[äöüÄÖÜß]/g, (letter) => WRITTEN[letter]).replace(/\s+/g, "-"); });
  }
}

function watchForms() {
  for (const form of all("form[data-post]")) {
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      const title = form.querySelector("[type=submit]").textContent;
      start(title, async () => send(form.dataset.post, await withFiles(form, contentOf(form))));
    });
  }
  for (const form of all("form[data-save]")) {
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      const note = byId("saved");
      try {
        const found = await send(form.dataset.save, { name: form.elements.name.value, source: form.elements.source.value });
        note.className = "wrap";
        note.textContent = `saved, and it can be fitted\n\n${found.text}`;
      } catch (error) {
        note.className = "refusal";
        note.textContent = error.message;
      }
      note.hidden = false;
    });
  }
  for (const form of all("form[data-simple]")) {
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      form.querySelector("[type=submit]").disabled = true;
      await send(form.dataset.simple, {}).catch((error) => { opened("Stop"); failed(error.message); });
    });
  }
  for (const button of all("[data-forget]")) {
    button.addEventListener("click", async () => {
      await send(`/api/jobs/${button.dataset.forget}`, {}, "DELETE");
      button.closest(".job").remove();
    });
  }
  byId("work-close").addEventListener("click", () => byId("work").close());
  const close = (part, address) => {
    const role = lacking(address);
    part.disabled = part.disabled || Boolean(role);
    if (role && mine.length) part.title = `This needs the role ${role}: dtwin people add NAME --role ${role}`;
  };
  for (const form of all("form[data-post], form[data-simple], form[data-save]")) {
    const address = form.dataset.post || form.dataset.simple || form.dataset.save;
    form.querySelectorAll("[type=submit]").forEach((part) => close(part, address));
  }
  all(".drop input").forEach((part) => close(part, "/api/trays"));
  all("[data-forget]").forEach((part) => close(part, "/api/jobs/"));
}

async function watchJobs() {
  for (const note of all(".job")) {
    if (!["waiting", "running"].includes(note.dataset.state)) continue;
    for (;;) {
      const job = await ask(`/api/jobs/${note.dataset.job}`).catch(() => null);
      if (!job) break;
      note.querySelector(".stage").textContent = job.state === "failed" ? job.error : job.stage;
      if (job.state === "done") {
        const link = Object.assign(document.createElement("a"), { href: job.address, textContent: "done: show it" });
        note.querySelector(".stage").replaceChildren(link);
      }
      if (!["waiting", "running"].includes(job.state)) break;
      await pause(800);
    }
  }
}

// A workbench that is held up, or a computer that slept, answers nothing: for so long what is shown stays.
const ANSWER_MS = 4000;
const askNow = (address, failed) => ask(address, { signal: AbortSignal.timeout(ANSWER_MS) }).catch((error) => { if (failed) failed(error); return null; });

async function watchLive() {
  const followed = document.querySelector("[data-live]");
  if (!followed) return;
  all("[data-now]").forEach(watchNow);
  // What the page was made of: a change before the first question must be noticed, too.
  const seen = JSON.stringify(JSON.parse(followed.dataset.seen));
  const unanswered = byId("unanswered");
  const silent = unanswered.textContent;
  for (;;) {
    await pause(1500);
    let refusal = "";
    const now = await askNow(followed.dataset.live, (error) => { if (error.refused) refusal = error.message; });
    unanswered.hidden = Boolean(now);
    unanswered.textContent = refusal ? `The workbench refuses this page, which may no longer be true: ${refusal}` : silent;
    if (now && JSON.stringify(now) !== seen) { location.reload(); return; }
  }
}

// Adding 0 makes a zero that was rounded from below one without a sign.
const plain = (value, digits) => (value === null ? "–" : (Number(value.toPrecision(digits)) + 0).toString());
const fixed = (value, digits) => (Number(value.toFixed(digits)) + 0).toFixed(digits);

function tellNow(list, now) {
  const said = {
    ticks: String(now.ticks),
    late: (100 * now.late_or_missed).toFixed(2),
    limits: Object.entries(now.reasons).map(([name, n]) => `${name.replaceAll("_", " ")} ${n}`).join(", ") || "none",
  };
  if (now.age_ms) Object.assign(said, {
    rate: plain(now.rate_hz, 4),
    age: now.age_ms.map((ms) => plain(ms, 2)).join(" / "),
    jitter: plain(now.jitter_us_p99, 3),
    correction: now.correction_um.map((um) => fixed(um, 1)).join("  "),
    band: now.band_um.map((um) => (um === null ? "–" : fixed(um, 2))).join("  "),
  });
  for (const field of all("[data-key]", list)) field.textContent = said[field.dataset.key] || "–";
}

async function watchNow(list) {
  const section = list.closest("section");
  const figures = all("[data-moving] figure", section);
  for (;;) {
    if (!document.hidden) {
      const now = await askNow(list.dataset.now);
      const shown = Boolean(now && now.ticks);
      section.querySelector("[data-silent]").hidden = !now || shown;
      section.querySelector("[data-moving]").hidden = !shown;
      section.querySelector("h2").textContent = `${section.dataset.machineState} ${now ? now.state.said : "does not answer this page"}`;
      section.className = `verdict live-${now ? now.state.word : "silent"}`;
      if (shown) {
        tellNow(list, now);
        await Promise.race([Promise.all(figures.map(draw)), pause(ANSWER_MS)]);
      } else {
        // What was true a moment ago need not be true now.
        for (const field of all("[data-key]", list)) field.textContent = "–";
      }
    }
    await pause(1000);
  }
}

// ---- files -----------------------------------------------------------------------------------

async function entriesOf(entry, path) {
  if (entry.isFile) {
    const file = await new Promise((done, no) => entry.file(done, no));
    return [[path + file.name, file]];
  }
  const reader = entry.createReader();
  const found = [];
  for (;;) {
    const part = await new Promise((done, no) => reader.readEntries(done, no));
    if (!part.length) break;
    for (const inner of part) found.push(...(await entriesOf(inner, `${path}${entry.name}/`)));
  }
  return found;
}

const wanted = ([name]) => !/(^|\/)(\.|__MACOSX\/|Thumbs\.db$)/.test(name);

function upload(gather) {
  if (lacking("/api/trays")) return;
  start("Upload", async () => {
    const files = (await gather()).filter(wanted);
    if (!files.length) throw new Error("nothing was dropped that is a file");
    const { tray } = await send("/api/trays", {});
    const tables = [];
    try {
      for (const [number, [name, file]] of files.entries()) {
        byId("work-stage").textContent = `${number + 1} of ${files.length}: ${name}`;
        await ask(`/api/trays/${tray}?${new URLSearchParams({ name })}`, { method: "PUT", body: file });
      }
      // One after the other: what holds for one file need not hold for the next.
      for (const name of await send(`/api/trays/${tray}/tables`, {})) tables.push(await understood(tray, name, tables.at(-1)));
    } catch (error) {
      await ask(`/api/trays/${tray}`, { method: "DELETE" }).catch(() => null);
      throw error;
    }
    return send(`/api/trays/${tray}/ingest`, { tables });
  });
}

const CONDITIONS = ["machine", "campaign", "started", "plane", "radius_mm", "feed_mm_min", "direction", "axis", "kind", "instrument"];

async function understood(tray, name, before) {
  const dialog = byId("told");
  const form = dialog.querySelector("form");
  form.reset();
  let shown = new Map();
  let kept = {};
  let remembered = {};
  const told = () => {
    const content = contentOf(form);
    const answers = {};
    for (const field of all("[data-head]", form)) {
      if (field.value.trim() !== shown.get(field.dataset.head)) answers[field.dataset.head] = field.value.trim();
    }
    const conditions = {};
    // What only an earlier file tells is not told for this one: it is confirmed, or written anew.
    for (const key of CONDITIONS) if (content[key] !== "" && !Number.isNaN(content[key]) && content[key] !== remembered[key]) conditions[key] = content[key];
    return { file: name, told: conditions, answers: { ...kept, ...answers }, decimal: content.decimal, confirmed: content.confirmed };
  };
  const look = async () => {
    const asked = told();
    kept = asked.answers;
    const found = await send(`/api/trays/${tray}/understand`, asked);
    shown = tellTable(form, name, found);
    return found;
  };
  const first = await look();
  for (const key of first.unconfirmed) remembered[key] = first.conditions[key];
  for (const key of CONDITIONS) if (first.conditions[key] !== undefined) form.elements[key].value = first.conditions[key];
  // Files that are dropped at once are of one machine and day, as a rule; it is shown, and can be changed.
  for (const key of ["machine", "campaign", "started"].filter((one) => before?.told[one])) {
    form.elements[key].value = before.told[key];
    delete remembered[key];
  }
  form.elements.decimal.value = first.decimal || "";
  byId("work").close();
  dialog.showModal();
  const say = (error) => { const place = form.querySelector("[data-refused]"); place.textContent = error.message; place.hidden = false; };
  form.querySelector("[data-again]").onclick = () => look().catch(say);
  return new Promise((done, no) => {
    form.onsubmit = async (event) => {
      if (!event.submitter || event.submitter.value !== "ok") return;
      event.preventDefault();
      try {
        const found = await look();
        if (found.refused) return;
        if (found.missing.length) throw new Error(`still to be told: ${found.missing.join(", ")}`);
        if (found.unconfirmed.length && !form.elements.confirmed.checked) throw new Error(`say whether the conditions of ${found.remembered_of} hold for this file, too`);
        dialog.close("ok");
      } catch (error) { say(error); }
    };
    dialog.addEventListener("close", () => {
      if (dialog.returnValue !== "ok") { no(new Error("nothing was ingested: the table was not explained")); return; }
      dialog.returnValue = "";
      opened("Upload");
      done(told());
    }, { once: true });
  });
}

function tellTable(form, name, found) {
  form.querySelector("[data-file]").textContent = name;
  form.querySelector("[data-form]").textContent = found.parted_by ? `${found.encoding}, columns parted by ${found.parted_by}${found.lines_skipped ? `, ${found.lines_skipped} ${found.lines_skipped === 1 ? "line" : "lines"} above the heads` : ""}; kind ${found.kind}` : "";
  const table = form.querySelector("[data-columns]");
  table.hidden = !found.columns.length;
  form.querySelector("[data-own]").hidden = found.columns.length > 0;
  byId("told-names").replaceChildren(...(found.names || []).map((value) => Object.assign(document.createElement("option"), { value })));
  const shown = new Map();
  table.tBodies[0].replaceChildren(...found.columns.map((column, place) => {
    const row = document.createElement("tr");
    const input = document.createElement("input");
    Object.assign(input, { value: column.name, placeholder: column.why_not || "left out", size: 16 });
    input.setAttribute("list", "told-names");
    input.setAttribute("aria-label", `${column.head} is here`);
    input.dataset.head = column.head;
    shown.set(column.head, column.name);
    const values = (found.first_rows || []).map((cells) => cells[place] || "").join("  ");
    const less = column.zero ? `− ${plain(column.zero, 6)}, × ` : "";
    const factor = column.factor === 1 ? "" : less + plain(column.factor, 6);
    for (const part of [column.head, values, column.unit, input, factor]) {
      const cell = document.createElement("td");
      cell.append(part);
      row.append(cell);
    }
    return row;
  }));
  const remembered = form.querySelector("[data-remembered]");
  const said = found.unconfirmed.map((key) => `${key} ${found.conditions[key]}`).join(", ");
  remembered.querySelector("span").textContent = `${said}, as for ${found.remembered_of}: this file was measured so, too`;
  remembered.hidden = !found.unconfirmed.length;
  const refused = form.querySelector("[data-refused]");
  refused.textContent = found.refused;
  refused.hidden = !found.refused;
  return shown;
}

function watchDrop() {
  const place = byId("drop");
  if (!place) return;
  for (const kind of ["dragenter", "dragover"]) {
    document.addEventListener(kind, (event) => { event.preventDefault(); place.classList.add("over"); });
  }
  document.addEventListener("dragleave", (event) => { if (!event.relatedTarget) place.classList.remove("over"); });
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    place.classList.remove("over");
    const entries = Array.from(event.dataTransfer.items).map((item) => item.webkitGetAsEntry && item.webkitGetAsEntry()).filter(Boolean);
    const plain = Array.from(event.dataTransfer.files).map((file) => [file.name, file]);
    upload(async () => (entries.length ? (await Promise.all(entries.map((entry) => entriesOf(entry, "")))).flat() : plain));
  });
  for (const id of ["pick-files", "pick-folder"]) {
    byId(id).addEventListener("change", (event) => {
      const files = Array.from(event.target.files).map((file) => [file.webkitRelativePath || file.name, file]);
      if (files.length) upload(async () => files);
    });
  }
}

// ---- machines: what the tests of each say ----------------------------------------------------------
const WORST = ["outside", "overdue", "changed", "cannot say", "inside"];

function sparkline(values, unit) {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const place = (value, n) => `${(n * 96) / Math.max(values.length - 1, 1) + 2},${22 - ((value - low) / (high - low || 1)) * 20}`;
  const points = values.map(place);
  const ns = "http://www.w3.org/2000/svg";
  const picture = document.createElementNS(ns, "svg");
  picture.setAttribute("viewBox", "0 0 100 24");
  picture.setAttribute("class", "spark");
  picture.setAttribute("role", "img");
  picture.setAttribute("aria-label", `${values.length} values from ${values[0].toFixed(1)} to ${values[values.length - 1].toFixed(1)} ${unit}`);
  const line = document.createElementNS(ns, "polyline");
  line.setAttribute("points", (points.length > 1 ? points : [points[0], points[0]]).join(" "));
  picture.append(line);
  return picture;
}

async function fillMachine(row) {
  const cell = (name) => row.querySelector(`[data-cell=${name}]`);
  try {
    const found = await ask(`/api/machines/${encodeURIComponent(row.dataset.machine)}/summary`);
    cell("champion").textContent = found.champion;
    if (!found.worst) return;
    cell("figure").textContent = `${found.worst.figure} ${found.worst.shown} ${found.unit}`;
    if (found.values.length > 1) cell("values").append(sparkline(found.values, found.unit));
    const words = [found.worst.decision, found.overdue && "overdue", found.changed && "changed"].filter(Boolean);
    for (const word of words) {
      const tag = document.createElement("span");
      tag.className = `tag ${{ inside: "good", outside: "error" }[word] || "warning"}`;
      tag.textContent = word;
      if (word === "changed") tag.title = found.changed;
      cell("decision").append(tag, " ");
    }
    if (!found.worst.decision) cell("decision").append(Object.assign(document.createElement("small"), { textContent: "no limits" }));
    if (words.length) row.dataset.order = Math.min(...words.map((word) => WORST.indexOf(word)));
  } catch (error) {
    cell("decision").textContent = error.message.split("\n")[0];
  }
}

async function fillMachines() {
  const rows = all("[data-machine]");
  const judged = document.querySelector("[data-judged]");
  const unread = document.querySelector("[data-unread]");
  if (unread) {
    judged.textContent = `; ${unread.dataset.unread} campaigns are being read, once`;
    const days = await ask("/api/machines").catch(() => ({}));
    for (const row of rows.filter((one) => one.dataset.machine in days)) {
      row.querySelector('[data-cell="last"]').textContent = days[row.dataset.machine] || "not stated";
    }
  }
  for (const [done, row] of rows.entries()) {
    judged.textContent = `; by name until all are judged: ${done} of ${rows.length}`;
    await fillMachine(row);
  }
  if (judged) judged.textContent = "";
  const order = (row) => Number(row.dataset.order || WORST.length);
  rows.sort((one, other) => order(one) - order(other)).forEach((row) => row.parentElement.append(row));
}

// Chromium takes a second to compile Plotly and keeps the result at its second run: the first page without
// figures, of a version of dtwin, spends that second while it is read.
async function compilePlotly() {
  const address = (document.querySelector("link[rel=prefetch]") || {}).href;
  if (!address || localStorage.getItem("dtwin-compiled") === address) return;
  for (let run = 0; run < 2; run += 1) {
    const script = Object.assign(document.createElement("script"), { src: address });
    await new Promise((done) => { script.onload = done; document.head.append(script); });
  }
  localStorage.setItem("dtwin-compiled", address);
}

async function begin() {
  watchForms();
  watchNames();
  all("a[data-pdf]").forEach((link) => link.addEventListener("click", (event) => { event.preventDefault(); fetched(link); }));
  watchDrop();
  watchJobs();
  watchLive();
  watchMagnification();
  watchChooser();
  all("select[data-submit]").forEach((select) => select.addEventListener("change", () => select.form.submit()));
  all("[data-by]").forEach((figure) => byId(figure.dataset.by).addEventListener("change", () => draw(figure)));
  (window.requestIdleCallback || setTimeout)(compilePlotly);
  if (byId("chooser")) await listRuns().catch(() => {});
  await Promise.all([...all("[data-figure]").map(draw), fillMachines()]);
  document.body.dataset.drawn = "yes";
}

begin();
