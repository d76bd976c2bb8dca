// Keys and buttons of the page. Viser carries every press: a button presses its key, and the key is
// bound on the server to the clip on screen. What this file adds is what only the browser can know:
// whether a key is being held, whether the clip's picture is there yet, which colours are preferred.
"use strict";

(() => {
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  document.cookie = `scheme=${dark.matches ? "dark" : "light"}; path=/; SameSite=Lax`;
  dark.addEventListener("change", () => location.reload());

  // Viser writes its server into the address bar when the page has a path; here that is always ours.
  const replaceState = history.replaceState.bind(history);
  history.replaceState = (state, title) => replaceState(state, title, location.pathname);

  const shown = (selector) => document.querySelector(selector);

  function typing(target) {
    return target instanceof Element && target.closest("input, textarea, select, [contenteditable=true]");
  }

  // No rating of a picture that is not there yet.
  function pictureReady() {
    const pictures = document.querySelectorAll(".od-side img");
    return pictures.length > 0 && [...pictures].every((p) => p.complete && p.naturalWidth > 0);
  }

  function press(combination) {
    const parts = combination.split("+");
    const key = parts.pop();
    const code = /^[0-9]$/.test(key) ? `Digit${key}` : `Key${key.toUpperCase()}`;
    const alt = parts.includes("alt");
    document.documentElement.dispatchEvent(
      new KeyboardEvent("keydown", { key, code, altKey: alt, bubbles: true, cancelable: true }),
    );
  }

  function replay() {
    // The same picture under another name starts from its first frame. It is swapped when it is
    // there, so that nothing flashes.
    const pictures = [...document.querySelectorAll(".od-side img")];
    if (!pictures.length) return;
    const source = `${pictures[0].src.split("?")[0]}?again=${Date.now()}`;
    const fresh = new Image();
    fresh.onload = () => pictures.forEach((p) => p.isConnected && (p.src = source));
    fresh.src = source;
  }

  function flash(key) {
    const button = shown(`.od-answers [data-key="${CSS.escape(key)}"]`);
    if (!button) return;
    button.classList.add("od-pressed");
    setTimeout(() => button.classList.remove("od-pressed"), 180);
  }

  window.addEventListener(
    "keydown",
    (event) => {
      if (typing(event.target) || event.ctrlKey || event.metaKey) return;
      if (/^Numpad[1-5]$/.test(event.code) && /^[1-5]$/.test(event.key)) {
        // Viser's keys are those above the letters.
        event.stopImmediatePropagation();
        event.preventDefault();
        if (!event.repeat) press(event.key);
        return;
      }
      const rating = /^[1-5sS]$/.test(event.key) && !event.altKey;
      const ours = rating || event.key === "u" || event.key === "U" || event.key === "Backspace";
      if (ours && (event.repeat || (rating && !pictureReady()))) {
        event.stopImmediatePropagation();
        event.preventDefault();
        return;
      }
      if (rating) flash(event.key.toLowerCase());
      if (event.key === " " && shown(".od-clip")) {
        // On a button too: the space bar always replays. Enter presses a button.
        event.preventDefault();
        event.stopImmediatePropagation();
        if (!event.repeat) replay();
      }
    },
    true,
  );
  window.addEventListener(
    "keyup",
    (event) => {
      if (event.key === " " && shown(".od-clip") && !typing(event.target)) event.preventDefault();
    },
    true,
  );

  document.addEventListener("click", (event) => {
    const button = event.target instanceof Element ? event.target.closest("button") : null;
    if (!button || button.disabled) return;
    if (button.dataset.key) press(button.dataset.key);
    else if ("replay" in button.dataset) replay();
    else if ("submit" in button.dataset) {
      // What is on screen is what is rated: slider messages are throttled and may come too late.
      const thumb = shown(".mantine-Slider-thumb");
      if (thumb) press(thumb.getAttribute("aria-valuenow"));
    }
  });

  // Viser gives its slider no name.
  document.addEventListener("focusin", (event) => {
    if (event.target.matches?.(".mantine-Slider-thumb")) event.target.setAttribute("aria-label", "Rating");
  });

  // Viser connects only with WebGL. Without it, say so instead of showing an empty page.
  function webgl() {
    try {
      const canvas = document.createElement("canvas");
      return Boolean(canvas.getContext("webgl2") || canvas.getContext("webgl"));
    } catch {
      return false;
    }
  }
  document.addEventListener("DOMContentLoaded", () => {
    if (webgl()) return;
    const note = document.createElement("p");
    note.className = "od-nowebgl";
    note.setAttribute("role", "alert");
    note.textContent =
      "This page needs WebGL, which is switched off in this browser. Please switch on hardware " +
      "acceleration in its settings, or open the link in another browser.";
    document.body.append(note);
  });
})();
