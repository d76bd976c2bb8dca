// The line to the server: what is said while it is down, and how the page comes back.
//
// Viser tries to reconnect once a second while the window has the focus, and gives each try up after that
// second; Chromium makes new sockets wait for longer after some failures. So a page that was cut off for half
// a minute stays dead. Requests are not made to wait: this asks the server over HTTP, and loads the page anew
// when it answers.
//
// Not a module, for the same reason as static/page.js.
const line = (() => {
  "use strict";
  const settings = {
    lookMs: 500, // between two looks at whether Viser is connected
    askMs: 2000, // between two requests while it is not
    graceMs: 3000, // that Viser has to come back by itself once the server answers
    openMs: 5000, // until a page without its first content says why
    lateMs: 3000, // until a press without an answer says so
    answerMs: 8000, // until a request without an answer is given up
    ...window.lineSettings, // of whoever embeds or tests the page
  };
  // Viser dims what it has drawn while it is not connected (DisconnectedGate).
  const DIMMED = 'div[style*="pointer-events: none"][style*="opacity: 0.5"]';
  const ENDED = "Your link was revoked, or its time is over. Please ask for another one.";
  const IN_PROXY = new Set([502, 503, 504]); // the server is down, says the proxy before it

  let began = Infinity; // when the page itself was there
  const grace = settings.graceMs * (1 + Math.random()); // not all pages at once
  const waiting = []; // of presses: called when the server answers, or will never
  let busy = 0; // requests that a reload would break
  let down = false; // whether the last request had no answer
  let backAt = null; // since when the server has answered while Viser has not come back
  let askedAt = -Infinity;
  let asking = false;
  let asked = false;
  let over = ""; // why the session has ended

  class Closed extends Error {}

  // Whether a request was not answered by the server itself: so it may be sent again.
  function unanswered(error) {
    return ["TypeError", "TimeoutError", "AbortError"].includes(error.name);
  }

  function fromServer(answer) {
    if (IN_PROXY.has(answer.status) && !answer.headers.has("X-Onedemo")) throw new TypeError("the server behind the proxy does not answer");
    return answer;
  }

  async function request(where, options = {}) {
    return fromServer(await fetch(where, { signal: AbortSignal.timeout(settings.answerMs), ...options }));
  }

  // Whether the server answers, and the session holds.
  async function ask() {
    askedAt = performance.now();
    try {
      const answer = await request("session", { cache: "no-store" });
      if (answer.status !== 204 && answer.status !== 401) throw new TypeError("the server cannot say");
      down = false;
      if (answer.status === 401) end((await reason(answer)) || ENDED);
    } catch (error) {
      if (!unanswered(error)) throw error;
      down = true;
    }
    asked = true;
    if (!down || over) for (const { resolve, reject } of waiting.splice(0)) over ? reject(new Closed(over)) : resolve();
  }

  async function reason(answer) {
    const text = answer.headers.get("Content-Type")?.startsWith("text/plain") ? await answer.text() : "";
    return text.trim();
  }

  // Something was refused because there is no session: the server is asked why.
  async function ended() {
    await ask();
    if (!over) end(ENDED);
  }

  // Resolves when the server answers again; rejected with the reason if the session has ended.
  function answers() {
    return new Promise((resolve, reject) => (over ? reject(new Closed(over)) : waiting.push({ resolve, reject })));
  }

  // The session has ended: nothing that is pressed here counts any more, and nothing is tried.
  function end(text) {
    over = text;
    card("This page is closed", [text, "What you have answered so far is kept."]);
  }

  // Whether nothing that is pressed now would reach anybody.
  const lost = () => Boolean(over || document.querySelector(DIMMED));

  async function look() {
    document.documentElement.toggleAttribute("data-lost", lost());
    if (over) return;
    const now = performance.now();
    const opened = document.querySelector(".od-header");
    const dimmed = opened && document.querySelector(DIMMED);
    if (opened && !dimmed) {
      backAt = null;
      show(null);
      if (!waiting.length) return;
    }
    if (!opened && now - began < settings.openMs) return;
    if (!asking && now - askedAt >= settings.askMs) {
      asking = true;
      const before = down;
      await ask().finally(() => (asking = false));
      if (over) return;
      if (down) backAt = null;
      else if (dimmed || before) backAt ??= performance.now();
    }
    const back = backAt !== null && performance.now() - backAt;
    if (!opened) {
      if (down) pill("There is no answer from the server. Trying again.");
      else if (back === false) asked && unconnected();
      else if (back < settings.openMs) pill("The server is back. Loading the page.");
      else reload();
    } else if (dimmed) {
      pill(down || back === false ? "Connection lost. Trying again; nothing is lost." : "The server is back. Reconnecting.");
      if (!down && back !== false && back >= grace) reload();
    }
  }

  function unconnected() {
    if (document.querySelector(".od-nowebgl")) return; // that is why, and is said (static/page.js)
    const base = location.pathname.split(/\/r\/\d+/)[0];
    card("The page is here, but its live connection is not", [
      "If a proxy stands before onedemo, it must pass WebSockets and the Host header on. This prints the lines for nginx (or caddy):",
      element("code", "", `onedemo proxy nginx --host-name ${location.hostname}${base && ` --base-path ${base}`}`),
      "Without a proxy: close other pages of onedemo in this browser, then reload.",
    ]);
  }

  function reload() {
    if (!busy) location.reload();
  }

  // What is shown

  function element(tag, className, text = "") {
    const made = document.createElement(tag);
    made.className = className;
    made.textContent = text;
    return made;
  }

  function show(made, key = "") {
    const there = document.querySelector("body > .od-line");
    if (there?.dataset.says === key) return;
    there?.remove();
    if (!made) return;
    made.classList.add("od-line");
    made.dataset.says = key;
    document.body.append(made);
  }

  function reloadButton(className) {
    const button = element("button", className, "Reload");
    button.type = "button";
    button.addEventListener("click", () => location.reload());
    return button;
  }

  // At the bottom edge: what passes by itself.
  function pill(text) {
    const made = element("div", "od-pill");
    made.setAttribute("role", "status");
    made.append(element("i", "od-busy"), element("span", "", text), reloadButton("od-pill-button"));
    show(made, text);
  }

  // Over the page: what somebody must do something about; paragraphs are texts or elements.
  function card(title, paragraphs) {
    const made = element("div", "od-card-back");
    const inside = element("section", "od-card");
    inside.setAttribute("role", "alertdialog");
    inside.setAttribute("aria-label", title);
    inside.append(element("h2", "", title), ...paragraphs.map((one) => (typeof one === "string" ? element("p", "", one) : one)));
    inside.append(reloadButton("od-button od-primary"));
    made.append(inside);
    show(made, title);
  }

  // Keeps the page from being loaded anew until something is done.
  async function during(promise) {
    busy += 1;
    return promise.finally(() => (busy -= 1));
  }

  document.addEventListener("DOMContentLoaded", () => {
    began = performance.now();
    setInterval(look, settings.lookMs);
    for (const event of ["online", "focus"])
      window.addEventListener(event, () => {
        askedAt = -Infinity;
        look();
      });
  });

  return { Closed, answers, during, ended, lost, request, settings, unanswered };
})();
