// Keys and buttons of the page. Viser carries every press: a button presses its key, and the key is
// bound on the server to the clip on screen. What this file adds is what only the browser can know:
// whether a key is being held, whether the clip's picture is there yet, which colours are preferred;
// and what concerns nobody else, such as slow motion (static/player.js).
//
// Not a module: it must have run before Viser, which begins while the page is still being read.
(() => {
  "use strict";
  const { main, toggleSlow, watchPlayers } = clips; // static/player.js

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

  function press(combination) {
    const parts = combination.split("+");
    const key = parts.pop();
    const code = /^[0-9]$/.test(key) ? `Digit${key}` : `Key${key.toUpperCase()}`;
    const alt = parts.includes("alt");
    document.documentElement.dispatchEvent(
      new KeyboardEvent("keydown", { key, code, altKey: alt, bubbles: true, cancelable: true }),
    );
  }

  function flash(key) {
    const button = shown(`.od-answers [data-key="${CSS.escape(key)}"]`);
    if (!button) return;
    button.classList.add("od-pressed");
    setTimeout(() => button.classList.remove("od-pressed"), 180);
  }

  // What is said of a clip besides its rating goes another way than presses, and must be there first.
  let noting = null;
  async function post(where, what) {
    const answer = await fetch(`${location.pathname}/${where}`, {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(what),
    });
    if (!answer.ok) throw new Error(await answer.text());
  }
  const note = (what) => post("note", what);

  function noteMark(player) {
    if (!player.clip) return;
    const mine = note({ clip: player.clip, mark: player.mark })
      .then(
        () => (player.unsent = false),
        (error) => {
          // It stays on screen: the next press tries it again, and rates only once it is kept.
          player.unsent = true;
          player.say(`Your mark could not be saved (${error.message}). Rate again to try once more, or clear it.`);
        },
      )
      .finally(() => {
        if (noting === mine) noting = null;
      });
    noting = mine;
  }

  function sayWhy(box, reason) {
    note({ clip: Number(box.dataset.clip), reason }).then(
      () => (box.textContent = "Noted. Thank you."), // as the server is about to say
      (error) => (box.textContent = error.message),
    );
  }

  // Keys that concern this browser alone. True if the key was one of them.
  function local(key) {
    const player = main();
    if (key === "?") shown(".od-help")?.showModal();
    else if (!player) return false;
    else if (key === " ") player.replay();
    else if (key === "f" || key === "F") toggleSlow();
    else if (key === "ArrowLeft") player.seek(player.frame - 1);
    else if (key === "ArrowRight") player.seek(player.frame + 1);
    else if ((key === "m" || key === "M") && player.clip) {
      player.markByKey();
      if (player.marking === null) noteMark(player);
    } else return false;
    return true;
  }

  window.addEventListener(
    "keydown",
    (event) => {
      if (typing(event.target) || event.ctrlKey || event.metaKey) return;
      // Another tab begins at its top.
      if (event.altKey && /^[0-9]$/.test(event.key)) shown(".mantine-Paper-root:has(.od-header)")?.scrollTo(0, 0);
      // A browser clicks a button anew with each repeat of a held Enter.
      if (event.key === "Enter" && event.repeat) return event.preventDefault();
      const stop = () => {
        event.stopImmediatePropagation();
        event.preventDefault();
      };
      if (shown(".od-help[open]")) {
        // Nobody sees the clip now. Escape, Enter and Tab belong to the dialog.
        if (event.key === "?") shown(".od-help").close();
        if (!["Escape", "Enter", "Tab"].includes(event.key)) stop();
        return;
      }
      if (/^Numpad[1-5]$/.test(event.code) && /^[1-5]$/.test(event.key)) {
        // Viser's keys are those above the letters.
        stop();
        if (!event.repeat) press(event.key);
        return;
      }
      const arrows = event.key.startsWith("Arrow");
      if (arrows && event.target.closest?.("[role=slider], [role=tablist]")) return;
      const rating = /^[1-5sS]$/.test(event.key) && !event.altKey;
      const ours = rating || event.key === "u" || event.key === "U" || event.key === "Backspace";
      if (ours && (event.repeat || (rating && !main()?.ready))) return stop(); // no rating of what is not there yet
      const player = main();
      if (/^[1-5]$/.test(event.key) && rating && player && (noting || player.unsent)) {
        stop();
        if (!noting) noteMark(player);
        noting.then(() => main() === player && !player.unsent && press(event.key));
        return;
      }
      if (rating) flash(event.key.toLowerCase());
      if (event.key === "Enter" && shown("[data-go]") && !event.target.closest?.("button, a")) {
        stop();
        if (!event.repeat) press("g");
        return;
      }
      // On a button too: the space bar always replays. Enter presses a button.
      if (!event.altKey && (arrows || !event.repeat ? local(event.key) : event.key === " ")) stop();
    },
    true,
  );
  window.addEventListener(
    "keyup",
    (event) => {
      if (event.key === " " && main() && !typing(event.target)) event.preventDefault();
    },
    true,
  );

  document.addEventListener("click", (event) => {
    const button = event.target instanceof Element ? event.target.closest("button") : null;
    if (!button || button.disabled) return;
    const data = button.dataset;
    if (data.key) press(data.key);
    else if ("replay" in data) local(" ");
    else if ("slow" in data) local("f");
    else if ("step" in data) local(data.step === "1" ? "ArrowRight" : "ArrowLeft");
    else if ("mark" in data) local("m");
    else if ("help" in data) local("?");
    else if ("unmark" in data) {
      main()?.setMark(null);
      if (main()) noteMark(main());
    } else if (data.video) {
      const film = shown(".od-film");
      const video = film.querySelector("video");
      video.src = data.video;
      film.showModal();
      video.play().catch(() => {});
      film.addEventListener("close", () => video.pause(), { once: true });
    } else if (data.do) {
      button.disabled = true; // until the page is drawn anew
      const { do: action, ...fields } = data;
      if (fields.rater) fields.rater = Number(fields.rater);
      post("do", { do: action, ...fields }).catch((error) => {
        button.disabled = false;
        button.textContent = error.message;
      });
    } else if (data.compare) compare(data.compare);
    else if ("reason" in data) sayWhy(button.closest(".od-notice"), data.reason);
    else if ("submit" in data) {
      // What is on screen is what is rated: slider messages are throttled and may come too late.
      const thumb = shown(".mantine-Slider-thumb");
      if (thumb) press(thumb.getAttribute("aria-valuenow"));
    }
  });

  // A run on or off the charts: what is written in the field says which are there.
  function compare(run) {
    const field = shown("div:has(> .od-runs) ~ div input");
    const on = [...document.querySelectorAll('[data-compare][aria-pressed="true"]')].map((b) => b.dataset.compare);
    const runs = on.includes(run) ? on.filter((name) => name !== run) : [...on, run];
    // React sees a change only through the element's own setter.
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(field, runs.join(", "));
    field.dispatchEvent(new Event("input", { bubbles: true }));
  }

  // A reason of one's own, by Enter.
  document.addEventListener("keydown", (event) => {
    const box = event.target instanceof Element ? event.target.closest(".od-notice") : null;
    if (box && event.key === "Enter" && event.target.value?.trim()) sayWhy(box, event.target.value.trim());
  });

  // Marks by dragging over the time bar; a tap shows that moment.
  document.addEventListener("pointerdown", (event) => {
    const track = event.target instanceof Element ? event.target.closest("[data-track]") : null;
    const player = track && main();
    if (!player?.ready) return;
    event.preventDefault();
    const box = track.getBoundingClientRect();
    const at = (e) => Math.max(0, Math.min(player.frames - 1e-6, ((e.clientX - box.left) / box.width) * player.frames));
    const start = at(event);
    let dragged = false;
    const move = (e) => {
      dragged ||= Math.abs(e.clientX - event.clientX) > 4;
      player.seek(Math.floor(at(e)));
      if (!dragged) return;
      const ends = [start, at(e)].sort((a, b) => a - b);
      player.setMark([Math.floor(ends[0]), Math.floor(ends[1]) + 1]);
    };
    const up = () => {
      removeEventListener("pointermove", move);
      removeEventListener("pointerup", up);
      removeEventListener("pointercancel", up);
      if (dragged) noteMark(player);
    };
    player.seek(Math.floor(start));
    addEventListener("pointermove", move);
    addEventListener("pointerup", up);
    addEventListener("pointercancel", up);
  });

  // The Data tab's filter: the preview, and the same choice for the download.
  function query(form) {
    const fields = new URLSearchParams(new FormData(form));
    if (fields.get("run-which") === "all") fields.delete("run");
    fields.delete("run-which");
    for (const [name, value] of [...fields]) if (!value.trim()) fields.delete(name);
    return `?${fields}`;
  }
  document.addEventListener("submit", (event) => {
    const form = event.target.closest?.("[data-filter]");
    if (!form) return;
    event.preventDefault();
    const place = form.parentElement.querySelector(".od-preview");
    fetch(`/preview${query(form)}`)
      .then((answer) => answer.text())
      .then((html) => (place.innerHTML = html));
  });
  // A form that is an action.
  document.addEventListener("submit", (event) => {
    const form = event.target.closest?.("[data-act]");
    if (!form) return;
    event.preventDefault();
    const place = form.parentElement.querySelector(".od-form-note");
    const fields = Object.fromEntries(new FormData(form));
    for (const input of form.querySelectorAll("[type=number]")) fields[input.name] = Number(input.value);
    place.textContent = "One moment: the run at hand ends its iteration first.";
    post("do", { do: form.dataset.act, ...fields }).catch((error) => (place.textContent = error.message));
  });
  // A video on its way: fetch tells nothing of how far it is, hence the older request.
  document.addEventListener("submit", (event) => {
    const form = event.target.closest?.("[data-upload]");
    if (!form) return;
    event.preventDefault();
    const place = form.parentElement.querySelector(".od-form-note");
    const button = form.querySelector("button");
    const done = (text) => {
      place.textContent = text;
      button.disabled = false;
    };
    const request = new XMLHttpRequest();
    request.upload.onprogress = ({ loaded, total }) => {
      const share = Math.floor((100 * loaded) / total);
      place.textContent = share < 100 ? `Uploading: ${share} %` : "The video is there and is being looked at.";
    };
    request.onload = () => {
      if (request.status !== 200) return done(request.responseText);
      const choice = document.querySelector(".od-new-run select[name=demo]");
      choice?.add(new Option(form.elements.name.value));
      form.reset();
      done(request.responseText);
    };
    request.onerror = () => done("The connection broke off before the video had arrived. Please try again.");
    request.open("POST", form.dataset.upload);
    button.disabled = true;
    place.textContent = "Uploading";
    request.send(new FormData(form));
  });
  document.addEventListener("input", (event) => {
    const form = event.target.closest?.("[data-filter]");
    if (!form) return;
    for (const link of form.parentElement.querySelectorAll("[data-filtered]"))
      link.href = link.dataset.filtered + query(form);
    const run = new URLSearchParams(query(form)).get("run");
    for (const link of form.parentElement.querySelectorAll("[data-of-run]"))
      link.href = link.dataset.ofRun + (run ? `?run=${encodeURIComponent(run)}` : "");
  });

  // Viser gives its slider no name.
  new MutationObserver(() =>
    shown('.mantine-Slider-thumb:not([aria-label="Rating"])')?.setAttribute("aria-label", "Rating"),
  ).observe(document.documentElement, { childList: true, subtree: true });

  watchPlayers();

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
