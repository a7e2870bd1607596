// The farm's JSON API as the page uses it. The token goes into a header, never into an address or
// a cookie, so that no other site's page can use it.

const KEPT = "pileus-token";

export class Refused extends Error {
  constructor(status, detail) {
    super(detail);
    this.status = status;
  }
}

export const keepToken = (token) => sessionStorage.setItem(KEPT, token);

export async function ask(path, options = {}) {
  const headers = new Headers(options.headers);
  const token = sessionStorage.getItem(KEPT);
  if (token) headers.set("Authorization", `Bearer ${token}`);
  let answer;
  try {
    answer = await fetch(path, { ...options, headers });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Refused(0, "The service does not answer; trying again");
  }
  if (answer.ok) return answer;
  const problem = await answer.json().catch(() => ({}));
  throw new Refused(answer.status, problem.detail ?? `The service answered ${answer.status}`);
}

export const get = async (path) => (await ask(path)).json();

export const send = async (method, path, body) => {
  const headers = body === undefined ? {} : { "Content-Type": "application/json" };
  return (await ask(path, { method, headers, body: body && JSON.stringify(body) })).json();
};

export const blob = async (path) => (await ask(path)).blob();

// Server-sent events through fetch: EventSource cannot send a token.
export async function* events(path, signal) {
  const answer = await ask(path, { signal });
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let held = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    held += value.replaceAll("\r", "");
    const messages = held.split("\n\n");
    held = messages.pop();
    for (const message of messages) {
      const data = message.split("\n").filter((line) => line.startsWith("data:"));
      if (data.length) yield JSON.parse(data.map((line) => line.slice(5)).join("\n"));
    }
  }
}
