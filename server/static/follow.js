// A job as it happens: one stream of its events and of its row, which goes on where it was after every cut. Where no
// stream is to be had, it is asked for again and again.

import { keepFresh, setConnection } from "./api.js";

// url: of the job. take(event), show(job), end(job): what to do with news. last(): number of the newest event taken.
// poll(): asks for all of it once, and tells in how many ms to ask again, or null; refused(error): it may not.
export function follow(url, { take, show, end, last, poll, refused }) {
  let source = null;

  const open = () => {
    source = new EventSource(`${url}/events/stream?job=true&after=${last()}`);
    source.addEventListener("open", () => setConnection(true));
    source.addEventListener("message", ({ data }) => take(JSON.parse(data)));
    source.addEventListener("job", ({ data }) => show(JSON.parse(data)));
    source.addEventListener("end", ({ data }) => {
      close();
      document.removeEventListener("visibilitychange", rest);
      end(JSON.parse(data));
    });
    source.addEventListener("error", () => {
      setConnection(false); // the browser tries again by itself, and says what it has seen
      if (source.readyState !== EventSource.CLOSED) return;
      document.removeEventListener("visibilitychange", rest);
      keepFresh(poll, refused); // it was refused, or there are too many streams
    });
  };
  const close = () => source.close();

  // A browser opens few connections to one server: a page that nobody sees holds none.
  const rest = () => {
    close();
    if (!document.hidden) open();
  };

  if (typeof EventSource === "undefined") {
    keepFresh(poll, refused);
    return;
  }
  open();
  document.addEventListener("visibilitychange", rest);
}
