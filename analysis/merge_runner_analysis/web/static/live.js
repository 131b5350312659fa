"use strict";
// Parts of a page that come anew from the server: what is computed, news, and lists as they are filtered.
window.live = (() => {
  const lost = (is) => {
    document.getElementById("lost").hidden = !is;
  };
  // Puts parts of a page in the place of those here; returns the reply, or nothing where there is none.
  const load = async (address, parts, options) => {
    const reply = await fetch(address, options).catch(({ name }) => {
      if (name !== "AbortError") lost(true);
    });
    if (!reply) return reply;
    lost(reply.status >= 500); // what is refused was answered
    if (reply.status === 404) location.reload(); // the page says what is not there
    if (reply.status !== 200) return reply;
    const text = await reply.text().catch(() => ""); // of a list that was given up
    if (options?.signal?.aborted) return reply;
    const page = new DOMParser().parseFromString(text, "text/html");
    const { id } = document.activeElement;
    for (const part of parts) {
      const [here, there] = [document, page].map((one) => one.querySelector(part));
      if (!here || !there) continue;
      here.replaceChildren(...there.childNodes);
      follow(here);
      label(here);
    }
    if (id && document.activeElement.id !== id) document.getElementById(id)?.focus({ preventScroll: true });
    return reply;
  };
  // What says so is asked for again and again, as long as it is on the page.
  const follow = (part) => {
    for (const one of part.querySelectorAll("[data-every]")) {
      const { from, every, parts } = one.dataset;
      const again = async () => {
        if (one.isConnected) await load(from || location.href, parts.split(" "));
        if (one.isConnected) setTimeout(again, 1000 * every);
      };
      setTimeout(again, 1000 * every);
    }
  };
  follow(document);

  // A list; a newer filter gives up the one before.
  let asking, typing;
  const list = (address, isNew) => {
    asking?.abort();
    asking = new AbortController();
    // A page that was left comes back as it is then.
    history.replaceState({ live: true }, "");
    history[isNew ? "pushState" : "replaceState"]({ live: true }, "", address);
    return load(address, ["#found", "#facets"], { signal: asking.signal });
  };
  const filters = document.getElementById("filters");
  const filter = (isNew) => {
    clearTimeout(typing);
    // What is not filtered by is not in the address.
    const given = new URLSearchParams([...new FormData(filters)].filter(([, value]) => value));
    list([filters.getAttribute("action"), String(given)].filter(Boolean).join("?"), isNew);
  };
  filters?.addEventListener("submit", (event) => {
    event.preventDefault();
    filter(false);
  });
  filters?.addEventListener("change", ({ target }) => target.id !== "search" && filter(true));
  filters?.addEventListener("input", ({ target }) => {
    clearTimeout(typing);
    if (target.id === "search") typing = setTimeout(filter, 300, false);
  });
  document.addEventListener("click", (event) => {
    const link = event.target.closest("[aria-sort] a");
    if (!link || event.ctrlKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    list(link.href, true);
  });
  addEventListener("popstate", ({ state }) => state?.live && location.reload());
  return load;
})();
