// The sign-in form: a key goes in, a cookie that scripts cannot read comes back.

import { notice, signIn } from "./api.js";
import { byId } from "./dom.js";

// Where to go on: a path of this very server, whatever the address bar was made to say.
function onward() {
  const wanted = new URL(new URLSearchParams(location.search).get("next") || "/", location.origin);
  return wanted.origin === location.origin ? wanted.pathname : "/";
}

byId("form").addEventListener("submit", async (event) => {
  event.preventDefault();
  byId("submit").disabled = true;
  try {
    await signIn(byId("key").value);
    location.replace(onward());
  } catch (error) {
    notice(error.message);
    byId("submit").disabled = false;
    byId("key").select();
  }
});
byId("key").focus();
