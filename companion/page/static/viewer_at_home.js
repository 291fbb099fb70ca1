// The Rerun viewer asks its makers for examples and newer versions, and tells them of its use. Nothing
// here goes to the internet: what is for another site is answered with an empty list, and not asked.
"use strict";

(() => {
  const fetched = window.fetch;
  const local = new Set([location.origin, "null"]);  // data and blobs have the origin "null"
  window.fetch = (asked, options) => {
    const { origin } = new URL(asked instanceof Request ? asked.url : asked, location.href);
    return local.has(origin)
      ? fetched.call(window, asked, options)
      : Promise.resolve(new Response("[]", { headers: { "Content-Type": "application/json" } }));
  };
})();
