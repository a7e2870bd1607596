// How the page says things: times, ranges of frames, states, elements.

export const ENDED = new Set(["done", "failed", "cancelled"]);

// A letter of a job's frame map, see `FrameMap` of the API.
export const STATES = {
  ".": "waiting", p: "planning", r: "rendering", m: "merging", d: "done", f: "failed", c: "cancelled",
};

export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "";
  if (seconds < 60) return `${seconds < 10 ? seconds.toFixed(1) : Math.round(seconds)} s`;
  const minutes = Math.round(seconds / 60);
  if (minutes < 60) return `${minutes} min`;
  return `${Math.floor(minutes / 60)} h ${String(minutes % 60).padStart(2, "0")} min`;
}

export const percent = (share) => `${Math.floor(share * 100)} %`;

export const clock = (seconds) =>
  new Date(seconds * 1000).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });

export function millions(count) {
  if (count < 1e6) return `${Math.round(count / 1e3)} k`;
  if (count < 1e9) return `${(count / 1e6).toFixed(1)} M`;
  return `${(count / 1e9).toFixed(1)} G`;
}

// "1-10,20-30x2" as numbers, in rising order as the service gives the states.
export function frameNumbers(text) {
  const numbers = new Set();
  for (const part of text.split(",")) {
    const [, first, last, step] = part.trim().match(/^(\d+)(?:-(\d+)(?:x(\d+))?)?$/);
    for (let frame = +first; frame <= +(last ?? first); frame += +(step ?? 1)) numbers.add(frame);
  }
  return [...numbers].sort((a, b) => a - b);
}

export function element(tag, className = "", text = "") {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text) made.textContent = text;
  return made;
}

// Writes a text only where it changed, so that what a reader has selected stays selected.
export function say(where, text) {
  if (where.textContent !== text) where.textContent = text;
}

// Keeps one child for each item, by key: made once, shown anew each time, removed when gone.
export function keyed(parent, items, key, make, show) {
  const held = new Map([...parent.children].map((child) => [child.dataset.key, child]));
  items.forEach((item, index) => {
    const name = String(key(item));
    let child = held.get(name);
    held.delete(name);
    if (!child) {
      child = make(item);
      child.dataset.key = name;
    }
    show(child, item);
    if (parent.children[index] !== child) parent.insertBefore(child, parent.children[index] ?? null);
  });
  for (const child of held.values()) child.remove();
}
