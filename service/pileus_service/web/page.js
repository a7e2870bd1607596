// The page: the list of jobs, the job that is looked at, the workers. The job comes by its event
// stream, the rest is asked for every two seconds while the page is seen. The address after # is
// JOB or JOB/FRAME, so that what one looks at can be sent to another.

import { Refused, ask, events, get, keepToken, send } from "/web/api.js";
import { chooseFrame, frameOf, showBuckets, showFrames } from "/web/frame.js";
import { ENDED, clock, duration, element, keyed, millions, percent, say } from "/web/words.js";

const PAGE = 50;
const at = (selector) => document.querySelector(selector);
const shown = { jobs: [], count: PAGE, job: null, stream: null, workers: [] };


function left(job) {
  if (job.seconds_left !== null) return `${duration(job.seconds_left)} left`;
  if (job.finished && job.started) return `took ${duration(job.finished - job.started)}`;
  return "";
}

function showBar(bar, share, kind) {
  bar.className = `bar ${kind}`;
  bar.firstElementChild.style.width = `${100 * share}%`;
}

function newBar() {
  const bar = element("div", "bar");
  bar.append(element("div"));
  return bar;
}

// The list of jobs.

function newJobItem(job) {
  const item = element("li");
  const button = element("button");
  button.append(element("strong"), element("span", "state"), newBar(), element("small"));
  button.addEventListener("click", () => { location.hash = job.id; });
  item.append(button);
  return item;
}

function showJobItem(item, job) {
  const button = item.firstElementChild;
  const [name, state, bar, small] = button.children;
  say(name, job.name);
  say(state, job.state);
  state.className = `state ${job.state}`;
  showBar(bar, ENDED.has(job.state) && job.state !== "cancelled" ? 1 : job.progress, job.state);
  const parts = [`${job.frames_done} of ${job.frames}`, `priority ${job.priority}`, left(job)];
  say(small, parts.filter(Boolean).join(" · "));
  button.toggleAttribute("aria-current", job.id === shown.job?.id);
}

function showJobs() {
  const wanted = at("#filter").value.toLowerCase();
  const jobs = shown.jobs.filter((job) => `${job.name} ${job.id}`.toLowerCase().includes(wanted));
  keyed(at("#jobs"), jobs, (job) => job.id, newJobItem, showJobItem);
  at("#older").hidden = shown.jobs.length < shown.count;
  at("#empty").hidden = shown.jobs.length > 0;
}

// The job that is looked at.

function showJob(job) {
  shown.job = job;
  document.title = `${percent(job.progress)} ${job.name} · Pileus`;
  at("#job").hidden = false;
  say(at("#job h1"), job.name);
  say(at("#job .state"), job.state);
  at("#job .state").className = `state ${job.state}`;
  const facts = [
    job.id,
    `${job.frames_done} of ${job.frames} frames` +
      (job.frames_failed ? `, ${job.frames_failed} failed` : ""),
    `${millions(job.samples)} samples`,
    `sent ${clock(job.created)}`,
    left(job),
  ];
  say(at("#job .facts"), facts.filter(Boolean).join(" · "));
  showBar(at("#job > .bar"), job.progress, job.state);
  at("#job .reason").hidden = !job.reason;
  say(at("#job .reason"), job.reason ?? "");
  const ended = ENDED.has(job.state);
  at('[data-verb="pause"]').hidden = ended || job.state === "paused";
  at('[data-verb="resume"]').hidden = job.state !== "paused";
  at('[data-verb="cancel"]').hidden = ended;
  at('[data-verb="retry"]').hidden = !job.frames_failed || job.state === "cancelled";
  at(".actions label").hidden = ended;
  if (document.activeElement !== at("#priority")) at("#priority").value = job.priority;
  showJobs();
}

async function follow(id) {
  shown.stream?.abort();
  const stream = (shown.stream = new AbortController());
  while (!stream.signal.aborted) {
    try {
      for await (const job of events(`/v1/jobs/${id}/events`, stream.signal)) {
        showJob(job);
        await showFrames(job);
        showBuckets(shown.workers);
        if (ENDED.has(job.state)) return;
      }
    } catch (error) {
      if (stream.signal.aborted) return;
      trouble(error);
      if (error.status === 404) return;
    }
    await new Promise((resolve) => setTimeout(resolve, 2000));
  }
}

function look() {
  const [id, frame] = location.hash.slice(1).split("/");
  if (!id) {
    shown.stream?.abort();
    shown.job = null;
    at("#job").hidden = true;
    document.title = "Pileus";
    if (shown.jobs.length) history.replaceState(null, "", `#${shown.jobs[0].id}`);
    if (shown.jobs.length) look();
    return;
  }
  chooseFrame(frame ? Number(frame) : null);
  if (shown.job?.id !== id) follow(id);
  else showFrames(shown.job).catch(trouble);
}

async function act(verb) {
  const { id, name } = shown.job;
  if (verb === "cancel" && !confirm(`Cancel ${name} for good?`)) return;
  try {
    showJob(await send("POST", `/v1/jobs/${id}/${verb}`));
    follow(id);
  } catch (error) {
    trouble(error);
  }
}

// The workers, and the farm in a line.

function newWorker() {
  const box = element("div");
  box.append(element("strong"), element("small"), element("small"), newBar());
  return box;
}

function showWorker(box, worker) {
  const [name, task, where, bar] = box.children;
  const { doing } = worker;
  box.classList.toggle("gone", !worker.alive);
  say(name, worker.name);
  const job = shown.jobs.find((each) => each.id === doing?.job);
  const aside = worker.aside ?? "idle";
  const words = doing ? `${doing.kind} ${job?.name ?? doing.job}, frame ${doing.frame}` : aside;
  say(task, worker.alive ? words : `last seen ${clock(worker.seen)}`);
  say(where, doing?.bucket ? bucketWords(doing) : worker.threads === 1 ? "1 thread" : `${worker.threads} threads`);
  showBar(bar, doing?.progress ?? 0, worker.alive ? "running" : "cancelled");
}

function bucketWords({ bucket: [x0, y0, x1, y1], samples: [first, last] }) {
  return `pixels ${x0},${y0} – ${x1},${y1} · samples ${first} – ${last}`;
}

function showFarm() {
  const alive = shown.workers.filter((worker) => worker.alive);
  const busy = alive.filter((worker) => worker.task);
  const running = shown.jobs.filter((job) => !ENDED.has(job.state));
  const farm = at("#farm");
  farm.className = "";
  say(farm, `${alive.length} worker${alive.length === 1 ? "" : "s"}, ${busy.length} at work · ${running.length} jobs to do`);
  keyed(at("#workers"), shown.workers, (worker) => worker.name, newWorker, showWorker);
}

// Asking, and what can go wrong.

function trouble(error) {
  if (!(error instanceof Refused)) throw error;
  if (error.status === 401) {
    shown.stream?.abort();
    at("#sign-in").hidden = false;
    at("main").hidden = true;
    return;
  }
  at("#farm").className = "trouble";
  say(at("#farm"), error.message);
}

async function refresh() {
  if (document.hidden || !at("#sign-in").hidden) return;
  try {
    [shown.jobs, shown.workers] = await Promise.all([
      get(`/v1/jobs?limit=${shown.count}`),
      get("/v1/workers"),
    ]);
    at("main").hidden = false;
    showJobs();
    showFarm();
    showBuckets(shown.workers);
    if (!location.hash.slice(1)) look();
  } catch (error) {
    trouble(error);
  }
}

at("#sign-in").addEventListener("submit", async (event) => {
  event.preventDefault();
  keepToken(at("#token").value.trim());
  try {
    await ask("/v1/jobs?limit=1");
  } catch (error) {
    say(at(".wrong"), error.message);
    return;
  }
  at("#sign-in").hidden = true;
  await refresh();
  look();
});
at("#filter").addEventListener("input", showJobs);
at("#older").addEventListener("click", () => {
  shown.count = Math.min(1000, shown.count + PAGE);
  refresh();
});
at("#priority").append(...Array.from({ length: 10 }, (_, n) => new Option(String(9 - n))));
at("#priority").addEventListener("change", async (event) => {
  const priority = Number(event.target.value);
  await send("PATCH", `/v1/jobs/${shown.job.id}`, { priority }).then(showJob, trouble);
});
for (const button of document.querySelectorAll("[data-verb]")) {
  button.addEventListener("click", () => act(button.dataset.verb));
}
addEventListener("hashchange", look);
document.addEventListener("visibilitychange", refresh);
at("#frames").addEventListener("click", (event) => {
  const frame = frameOf(event.target);
  if (frame !== null) location.hash = `${shown.job.id}/${frame}`;
});

setInterval(refresh, 2000);
await refresh();
look();
