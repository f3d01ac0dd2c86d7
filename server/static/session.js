// Whose session this is, and the button that ends it. Nothing shows where there are no keys.

import { call, notice, session } from "./api.js";
import { byId, setText } from "./dom.js";

async function show() {
  const mine = await session();
  if (mine.key_id === null) return;
  setText(byId("who"), mine.tenant);
  byId("session").hidden = false;
}

async function signOut() {
  try {
    await call("/v1/session", { method: "DELETE" });
    location.assign("/sign-in");
  } catch (error) {
    notice(error.message);
  }
}

byId("sign-out").addEventListener("click", signOut);
show().catch(() => {}); // the page's own calls tell what is wrong
