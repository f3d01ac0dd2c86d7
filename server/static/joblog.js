// The end of the engine's log, fetched when somebody opens it and whenever they ask for it anew.

import { notice } from "./api.js";
import { byId } from "./dom.js";

const LAST_BYTES = 65536;

export function showLogOf(url) {
  const read = async () => {
    try {
      const answer = await fetch(`${url}/log?last=${LAST_BYTES}`);
      if (!answer.ok) throw new Error(`The log cannot be read: the server answered ${answer.status}`);
      const pane = byId("log-text");
      const atEnd = pane.scrollTop + pane.clientHeight >= pane.scrollHeight - 4;
      pane.textContent = (await answer.text()) || "The engine has said nothing.";
      if (atEnd) pane.scrollTop = pane.scrollHeight;
    } catch (error) {
      notice(error.message);
    }
  };
  byId("log").addEventListener("toggle", () => byId("log").open && read());
  byId("log-again").addEventListener("click", read);
}
