// Addresses of tabs: /r/N/data is the tab Data of N's page; /r/N/ becomes that of the tab that the server shows
// first. Back, reload and a link lead there, and the window is called after the tab and the run. Which runs are
// compared follows behind "#": /r/N/runs#compare=hop-1,hop-2.
//
// Not a module: it must have run before Viser, which begins while the page is still being read.
const address = (() => {
  "use strict";
  const { viserKey } = page; // static/page.js

  const behind = () => new URLSearchParams(location.hash.slice(1)).get("compare");
  let compared = behind(); // by whoever sent the address, until the tab is there

  // Viser writes its server into the address bar when the page has a path; here that is always ours.
  const replaceState = history.replaceState.bind(history);
  history.replaceState = (state, title) => replaceState(state, title, location.pathname);
  if (location.hash) history.replaceState(null, ""); // it would become part of the address of Viser's socket

  // Viser's palette of commands: nothing in it is for people. The browser's own key is left alone.
  window.addEventListener(
    "keydown",
    (event) => {
      if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "k") event.stopImmediatePropagation();
    },
    true,
  );

  const inAddress = () => location.pathname.split("/").at(-1);

  // The button of the tab that the address names.
  const named = () => document.querySelector(`.od-tabs [data-tab="${CSS.escape(inAddress())}"]`);

  // Asks for that tab until it is there: Viser listens to its key a moment after the header is drawn.
  async function follow() {
    for (let tries = 0; tries < 10; tries += 1) {
      const button = named();
      if (!button || button.matches("[aria-current]")) return;
      viserKey(button.dataset.key);
      await new Promise((go) => setTimeout(go, 500));
    }
  }

  let before = {};
  function look() {
    const header = document.querySelector(".od-header");
    const { page: name, tab } = header?.dataset ?? {};
    if (!header || (name === before.page && tab === before.tab)) return;
    const came = name !== before.page; // Viser connected, it may be anew: with the tab that it began with
    before = { page: name, tab };
    document.title = `${header.dataset.title} - onedemo`;
    if (inAddress() === tab) return;
    if (!inAddress()) replaceState(null, "", tab);
    else if (came) follow();
    else history.pushState(null, "", tab);
  }
  new MutationObserver(look).observe(document.documentElement, { childList: true, subtree: true });
  window.addEventListener("popstate", follow);

  return {
    // Names of runs that the address says are compared, with commas between them; null if it says nothing.
    get compared() {
      return compared ?? behind();
    },
    // From now on it says these; null: nothing.
    set compared(names) {
      compared = null;
      replaceState(null, "", location.pathname + (names === null ? "" : `#compare=${names}`));
    },
  };
})();
