// Server-sent events for as long as somebody looks at the page. Where no stream is to be had, the caller polls.

import { keepFresh, setConnection } from "./api.js";

// address(): where the stream is, asked for at every opening. handlers: what to do with each kind of event. poll and
// refused: for `keepFresh`, where there is no stream. Returns what ends it.
export function listen(address, handlers, poll, refused) {
  if (typeof EventSource === "undefined") {
    keepFresh(poll, refused);
    return () => {};
  }
  let source = null;

  const open = () => {
    source = new EventSource(address());
    source.addEventListener("open", () => setConnection(true));
    for (const [kind, handle] of Object.entries(handlers)) {
      source.addEventListener(kind, ({ data }) => handle(JSON.parse(data)));
    }
    source.addEventListener("error", () => {
      setConnection(false); // the browser tries again by itself
      if (source.readyState !== EventSource.CLOSED) return;
      end();
      keepFresh(poll, refused); // it was refused, or there are too many streams
    });
  };

  // A browser opens few connections to one server: a page that nobody sees holds none.
  const rest = () => {
    source.close();
    if (!document.hidden) open();
  };

  const end = () => {
    source.close();
    document.removeEventListener("visibilitychange", rest);
  };

  open();
  document.addEventListener("visibilitychange", rest);
  return end;
}
