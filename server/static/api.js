// Calls to the API of this very server, and the loop that keeps a page fresh.

import { byId, setText } from "./dom.js";

let csrf = null; // what shows the server that a request is this page's own; null where there is no session

export async function session() {
  const mine = await call("/v1/session");
  csrf = mine.csrf;
  return mine;
}

export async function signIn(key) {
  const body = JSON.stringify({ key });
  const headers = { Accept: "application/json", "Content-Type": "application/json" };
  const response = await fetch("/v1/session", { method: "POST", headers, body });
  if (!response.ok) throw await problem(response);
}

export async function call(path, init = {}) {
  const headers = { Accept: "application/json" };
  if (init.body) headers["Content-Type"] = "application/json";
  if (init.method) {
    if (csrf === null) await session();
    if (csrf !== null) headers["X-CSRF-Token"] = csrf;
  }
  const response = await fetch(path, { headers, ...init });
  if (response.status === 401) location.assign(`/sign-in?next=${encodeURIComponent(location.pathname)}`);
  if (!response.ok) throw await problem(response);
  return response.status === 204 ? null : response.json();
}

async function problem(response) {
  let body = {};
  try {
    body = await response.json();
  } catch {
    // not problem+json: the status line must do
  }
  const listed = (body.errors ?? []).map((error) => `${error.where}: ${error.what}`);
  const text = [body.detail || body.title || `The server answered ${response.status}`, ...listed].join("; ");
  return Object.assign(new Error(text), { status: response.status });
}

export function setConnection(there, why = "The server does not answer") {
  setText(byId("connection"), there ? "" : `${why.replace(/\.$/, "")}; trying again`);
}

// Runs `refresh` again and again; it returns the pause in ms, or null to stop. A hidden page rests.
export function keepFresh(refresh, onRefused) {
  let failures = 0;
  const turn = async () => {
    if (document.hidden) {
      document.addEventListener("visibilitychange", turn, { once: true });
      return;
    }
    let pause = 2000;
    try {
      pause = await refresh();
      failures = 0;
      setConnection(true);
    } catch (error) {
      const busy = error.status === 429;
      if (error.status && error.status < 500 && !busy) {
        onRefused(error);
        return;
      }
      failures += 1;
      setConnection(false, busy ? error.message : undefined);
      pause = Math.min(2000 * failures, 15000);
    }
    if (pause !== null) setTimeout(turn, pause);
  };
  turn();
}

export function notice(text) {
  const box = byId("notice");
  setText(box, text);
  box.hidden = text === "";
}
