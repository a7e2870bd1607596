// The frames of the job that is looked at, as a grid, and one of them with its picture, its facts
// and its log. Where none is chosen, the newest that is done is shown.

import { blob, get } from "/web/api.js";
import { STATES, duration, element, frameNumbers, say } from "/web/words.js";

const MOST_CELLS = 3000;
const MANY = 300;
const PICTURES_KEPT = 240;
const URGENCY = "f r m p . c d".split(" ");

const at = (selector) => document.querySelector(selector);
const held = { job: null, numbers: [], states: "", size: [16, 9], chosen: null, frame: null };
const pictures = new Map();
let playing = null;

export const chooseFrame = (frame) => { held.chosen = frame; };

export const frameOf = (target) => (target.dataset.frame ? Number(target.dataset.frame) : null);

const stateOf = (frame) => held.states[held.numbers.indexOf(frame)];

export async function showFrames(job) {
  const map = await get(`/v1/jobs/${job.id}/map`);
  if (held.job?.id !== job.id) {
    stop();
    forgetPictures();
    held.frame = null;
  }
  Object.assign(held, {
    job,
    numbers: frameNumbers(map.frames),
    states: map.states,
    size: [map.width, map.height],
  });
  showGrid();
  if (!playing) await showFrame(held.chosen ?? newest());
}

// A cell stands for one frame, or for several of a very long shot: then it has the state that
// wants looking at the most.
function showGrid() {
  const grid = at("#frames");
  const step = Math.ceil(held.numbers.length / MOST_CELLS);
  const count = Math.ceil(held.numbers.length / step);
  grid.classList.toggle("many", held.numbers.length > MANY);
  while (grid.children.length < count) grid.append(element("button"));
  while (grid.children.length > count) grid.lastElementChild.remove();
  for (let cell = 0; cell < count; cell += 1) {
    const states = held.states.slice(cell * step, (cell + 1) * step);
    const worst = URGENCY.find((state) => states.includes(state));
    const index = cell * step + states.indexOf(worst);
    const frame = held.numbers[index];
    const button = grid.children[cell];
    const name = STATES[worst];
    if (button.className !== name) button.className = name;
    button.dataset.frame = frame;
    button.title = `Frame ${frame}: ${name}`;
    button.setAttribute("aria-label", button.title);
    button.setAttribute("aria-pressed", String(frame === held.frame));
  }
}

function newest() {
  const last = held.states.lastIndexOf("d");
  if (last >= 0) return held.numbers[last];
  const first = [...held.states].findIndex((state) => "rmpf".includes(state));
  return held.numbers[Math.max(0, first)];
}

async function showFrame(frame) {
  const changed = frame !== held.frame;
  held.frame = frame;
  const id = held.job.id;
  at("#frame").hidden = false;
  at(".picture").style.aspectRatio = `${held.size[0]} / ${held.size[1]}`;
  for (const cell of at("#frames").children) {
    cell.setAttribute("aria-pressed", String(frameOf(cell) === frame));
  }
  const state = stateOf(frame);
  say(at("figcaption .what"), `Frame ${frame}, ${STATES[state]}`);
  at("#image").disabled = state !== "d";
  at("#play").disabled = !held.states.includes("d");
  if (changed) {
    at("#log").open = false;
    at("#log ol").replaceChildren();
  }
  await showPicture(frame);
  if (playing) return;
  const [view] = await get(`/v1/jobs/${id}/frames?limit=1&offset=${held.numbers.indexOf(frame)}`);
  if (view && held.frame === frame) showFacts(view);
}

function showFacts(view) {
  const facts = {
    State: view.state,
    Tasks: view.tasks ? `${view.tasks_done} of ${view.tasks}` : "",
    Took: duration(view.seconds),
    File: view.file,
    Why: view.state === "done" ? "" : view.reason,
    Noise: view.unmet_buckets ? `above the tolerance in ${view.unmet_buckets} of its buckets` : "",
    Warnings: view.warnings.join("; "),
  };
  const list = at("#frame dl");
  list.replaceChildren();
  for (const [name, value] of Object.entries(facts)) {
    if (value) list.append(element("dt", "", name), element("dd", "", value));
  }
}

async function picture(frame) {
  const key = `${held.job.id}/${frame}`;
  if (!pictures.has(key)) {
    const file = await blob(`/v1/jobs/${held.job.id}/frames/${frame}/preview.png`);
    pictures.set(key, URL.createObjectURL(file));
    if (pictures.size > PICTURES_KEPT) {
      const [oldest] = pictures.keys();
      URL.revokeObjectURL(pictures.get(oldest));
      pictures.delete(oldest);
    }
  }
  return pictures.get(key);
}

function forgetPictures() {
  for (const url of pictures.values()) URL.revokeObjectURL(url);
  pictures.clear();
}

async function showPicture(frame) {
  const image = at(".picture img");
  if (stateOf(frame) !== "d") {
    image.hidden = true;
    return;
  }
  const url = await picture(frame).catch(() => null);
  if (frame !== held.frame) return;
  image.hidden = url === null;
  if (url) image.src = url;
  image.alt = `Frame ${frame}`;
}

// The buckets of the frame that workers have in hand, filled as far as their samples are.
export function showBuckets(workers) {
  const [width, height] = held.size;
  const here = workers.filter(
    ({ doing }) => doing?.bucket && doing.job === held.job?.id && doing.frame === held.frame,
  );
  at(".buckets").replaceChildren(
    ...here.map(({ name, doing: { bucket: [x0, y0, x1, y1], progress } }) => {
      const box = element("div");
      box.title = name;
      Object.assign(box.style, {
        left: `${(100 * x0) / width}%`,
        top: `${(100 * y0) / height}%`,
        width: `${(100 * (x1 - x0)) / width}%`,
        height: `${(100 * (y1 - y0)) / height}%`,
        backgroundSize: `${100 * progress}% 100%`,
      });
      return box;
    }),
  );
}

async function showLog() {
  if (!at("#log").open) return;
  const lines = await get(`/v1/jobs/${held.job.id}/frames/${held.frame}/log?limit=500`);
  at("#log ol").replaceChildren(
    ...lines.map((line) => {
      const told = [line.time.slice(11, 19), line.worker, line.task, line.event];
      if (line.seconds !== null) told.push(`in ${duration(line.seconds)}`);
      if (line.reason) told.push(line.reason);
      return element("li", line.level, [told.join("  "), line.output].filter(Boolean).join("\n"));
    }),
  );
}

function stop() {
  clearTimeout(playing);
  playing = null;
  say(at("#play"), "Play");
}

async function playNext() {
  const done = held.numbers.filter((_, index) => held.states[index] === "d");
  const next = done.find((frame) => frame > held.frame) ?? done[0];
  const due = performance.now() + 1000 / 24;
  await showFrame(next);
  if (playing) playing = setTimeout(playNext, Math.max(0, due - performance.now()));
}

function step(by) {
  stop();
  const frame = held.numbers[held.numbers.indexOf(held.frame) + by];
  if (frame !== undefined) location.hash = `${held.job.id}/${frame}`;
}

at("#play").addEventListener("click", () => {
  if (playing) {
    stop();
    return;
  }
  say(at("#play"), "Stop");
  playing = setTimeout(playNext, 0);
});
at("#back").addEventListener("click", () => step(-1));
at("#forth").addEventListener("click", () => step(1));
at("#log").addEventListener("toggle", showLog);
at("#image").addEventListener("click", async () => {
  const link = element("a");
  const file = await blob(`/v1/jobs/${held.job.id}/frames/${held.frame}/image.exr`);
  link.href = URL.createObjectURL(file);
  link.download = `${held.job.name}.${String(held.frame).padStart(4, "0")}.exr`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
});
