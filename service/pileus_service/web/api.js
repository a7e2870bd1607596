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

// A connection may break at any time: as well while the body of an answer is read.
function broken(error) {
  if (error.name === "AbortError") throw error;
  throw new Refused(0, "The service does not answer; trying again");
}

export async function ask(path, options = {}) {
  const headers = new Headers(options.headers);
  const token = sessionStorage.getItem(KEPT);
  if (token) headers.set("Authorization", `Bearer ${token}`);
  const answer = await fetch(path, { ...options, headers }).catch(broken);
  if (answer.ok) return answer;
  const problem = await answer.json().catch(() => ({}));
  throw new Refused(answer.status, problem.detail ?? `The service answered ${answer.status}`);
}

export const get = async (path) => (await ask(path)).json().catch(broken);

export const send = async (method, path, body) => {
  const headers = body === undefined ? {} : { "Content-Type": "application/json" };
  const answer = await ask(path, { method, headers, body: body && JSON.stringify(body) });
  return answer.json().catch(broken);
};

export const blob = async (path) => (await ask(path)).blob().catch(broken);

// Server-sent events through fetch: EventSource cannot send a token.
export async function* events(path, signal) {
  const answer = await ask(path, { signal });
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let held = "";
  for (;;) {
    const { value, done } = await reader.read().catch(broken);
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
