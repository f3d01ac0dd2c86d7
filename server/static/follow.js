// A job as it happens: one stream of its events and of its row, which goes on where it was after every cut.

import { listen } from "./stream.js";

// url: of the job. take(event), show(job), end(job): what to do with news. last(): number of the newest event taken.
// poll(): asks for all of it once, and tells in how many ms to ask again, or null; refused(error): it may not.
export function follow(url, { take, show, end, last, poll, refused }) {
  const close = listen(
    () => `${url}/events/stream?job=true&after=${last()}`,
    {
      message: take,
      job: show,
      end(job) {
        close();
        end(job);
      },
    },
    poll,
    refused,
  );
}
