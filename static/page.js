// Keys and buttons of the page. An answer is one request, which names what was on screen when it was
// pressed; what comes next the server draws by Viser. What concerns nobody else, such as slow motion,
// is done here (static/player.js). Keys with Alt, such as those of the tabs, are Viser's. What only a
// researcher has is in static/forms.js.
//
// Not a module: it must have run before Viser.
const page = (() => {
  "use strict";
  const { forget, main, toggleSlow, toggleTrail, watchPlayers } = clips; // static/player.js
  const { answers, settings } = line; // static/line.js

  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  document.documentElement.toggleAttribute("data-dark", dark.matches);
  document.cookie = `scheme=${dark.matches ? "dark" : "light"}; path=/; SameSite=Lax`;
  dark.addEventListener("change", () => location.reload());

  // Viser loads two things with every page that are of no use here, and wait for their data for ever: a sorter
  // of Gaussian splats, which makes functions of text, as the policy of the page forbids, and the picture that
  // would light the robot (it has lamps: app/tabs/watch.py), dear to prepare without a GPU.
  const fetchAnything = window.fetch.bind(window);
  window.fetch = (what, ...options) =>
    /^data:(application\/wasm|image\/jpeg)/.test(what.url ?? what) ? new Promise(() => {}) : fetchAnything(what, ...options);

  const shown = (selector) => document.querySelector(selector);

  function typing(target) {
    return target instanceof Element && target.closest("input:not([type=range]), textarea, select, [contenteditable=true]");
  }

  // What a key means: its label, but digits by their place, as French keyboards have them with Shift, and
  // letters by their place where the label is of another script.
  function labelled({ key, code }) {
    const [, digit, letter] = /^(?:Digit(\d)|Key([A-Z]))$/.exec(code) ?? [];
    if (digit) return digit;
    const foreign = key === "Process" || (/\p{L}/u.test(key) && !/\p{Script=Latin}/u.test(key));
    return letter && foreign ? letter.toLowerCase() : key;
  }

  // A key that Viser listens to, such as "alt+2".
  function viserKey(combination) {
    const key = combination.at(-1);
    const code = /^[0-9]$/.test(key) ? `Digit${key}` : `Key${key.toUpperCase()}`;
    document.documentElement.dispatchEvent(
      new KeyboardEvent("keydown", { key, code, altKey: true, bubbles: true, cancelable: true }),
    );
  }

  // Shows which answer is on its way, and for a moment that the server has taken it.
  async function flash(key, sent) {
    const button = shown(`.od-answers [data-key="${CSS.escape(key)}"]`);
    button?.classList.add("od-sent");
    const counted = await sent;
    button?.classList.remove("od-sent");
    if (!counted) return;
    button?.classList.add("od-pressed");
    setTimeout(() => button?.classList.remove("od-pressed"), 250);
  }

  class Refused extends Error {}
  class PageGone extends Refused {}

  // What the server asks of whatever changes something: no other site can read it.
  const named = () => ({ "X-Onedemo-Page": shown(".od-header")?.dataset.page ?? "" });

  async function post(where, what, options = {}) {
    const answer = await line.request(where, {
      method: "POST",
      headers: { "Content-Type": "application/json", ...named() },
      body: JSON.stringify(what),
      ...options,
    });
    if (answer.status === 401) {
      await line.ended();
      throw new line.Closed("This was not saved: this page is closed.");
    }
    if (answer.status === 410) throw new PageGone(await answer.text());
    if (!answer.ok) throw new Refused(await answer.text());
    return answer;
  }

  // What a researcher's button does; without a time limit, since a change of runs may wait for an iteration.
  const act = (action, fields) => post("do", { do: action, ...fields }, { signal: null });

  // Why the last answer did not count, or not yet; it stays until the next one.
  function say(text, late = false) {
    shown("body > .od-problem")?.remove();
    if (!text) return;
    const note = document.createElement("p");
    note.className = late ? "od-problem od-late" : "od-problem";
    note.setAttribute("role", late ? "status" : "alert");
    note.textContent = text;
    document.body.append(note);
  }

  const NOT_YET = "Not saved yet: the server does not answer. Your answer is kept here and sent again.";
  const NOT_TAKEN = "Not taken: there is no connection. Please answer once it is back.";

  // Presses without an answer, oldest first. They outlive a reload of the page.
  const PRESSES = `onedemo-presses-${new URL(".", location.href).pathname}`; // of the person, whatever the tab
  const kept = {
    read: () => JSON.parse(sessionStorage.getItem(PRESSES) ?? "[]"),
    write: (bodies) => sessionStorage.setItem(PRESSES, JSON.stringify(bodies)),
    add: (body) => kept.write([...kept.read(), body]),
    remove: (body) => kept.write(kept.read().filter(({ id }) => id !== body.id)),
  };

  // Answers go one after another.
  let queue = Promise.resolve();
  function send(press) {
    const id = [...crypto.getRandomValues(new Uint32Array(4))].join("-");
    const body = { page: pageName(), id, ...press };
    if (press.press !== "practise") kept.add(body);
    return enqueue(body);
  }

  function enqueue(body) {
    queue = queue.then(() => deliver(body)).then(
      (counted) => (kept.remove(body), say(""), counted),
      (error) => (kept.remove(body), say(error.message), false),
    );
    return queue;
  }

  // Sends a press until it is answered, always under the same number, by which the server knows it.
  async function deliver(body) {
    const late = setTimeout(() => say(NOT_YET, true), settings.lateMs);
    try {
      for (;;) {
        try {
          return (await (await post("press", body)).json()).counted;
        } catch (error) {
          if (error instanceof PageGone && (await movesOn(body))) continue;
          if (!line.unanswered(error)) throw error;
          await answers();
        }
      }
    } finally {
      clearTimeout(late);
    }
  }

  // The page at which it was pressed has gone, with its connection, before the press came: it counts at the
  // new page if the same clip is on screen there.
  async function movesOn(body) {
    const about = body.clip ? "clip" : "pair";
    if (!["rate", "skip", "compare"].includes(body.press) || body.answer === "undo") return false;
    const there = await seen(() => pageName() !== body.page && main()?.ready && main());
    if (!there || there.element.dataset[about] !== String(body[about])) return false;
    body.page = pageName();
    there.answered = true;
    await new Promise((go) => setTimeout(go, 500)); // a press that comes at once was made for another clip
    return true;
  }

  function pageName() {
    return shown(".od-header")?.dataset.page;
  }

  // What a function gives, once it gives something; null if it does not in time.
  async function seen(find, ms = 10000) {
    for (const end = performance.now() + ms; performance.now() < end; ) {
      const found = find();
      if (found) return found;
      await new Promise((go) => setTimeout(go, 100));
    }
    return null;
  }

  const KNOWS_MARKS = "onedemo-knows-marks";
  const PAIR = { 1: "left", 2: "equal", 3: "right", s: "skip" };
  const DOUBLE_MS = 600;
  const PRACTICE = { g: "next", s: "leave" };

  // What "1" to "5", "s" or "g" say of what is on screen, if they say anything.
  function meant(key, { clip, pair, exercise }, mark) {
    if (exercise) return { press: "practise", exercise: Number(exercise), do: PRACTICE[key] ?? Number(key) };
    if (pair) return PAIR[key] && { press: "compare", pair: Number(pair), answer: PAIR[key] };
    if (key === "s") return { press: "skip", clip: Number(clip) };
    return key !== "g" && { press: "rate", clip: Number(clip), value: Number(key), mark };
  }

  function answer(key) {
    if (shown("[data-introduction]")) return send({ press: "practise", exercise: 0, do: PRACTICE[key] ?? Number(key) });
    const player = main();
    // Nobody has seen it yet, or it was answered a moment ago and is about to go.
    if (!player?.ready || player.answered) return;
    if (line.lost()) return say(NOT_TAKEN);
    const { dataset } = player.element;
    const press = meant(key, dataset, player.mark);
    if (!press) return;
    player.answered = !dataset.exercise;
    const sent = send(press);
    flash(key, sent);
    sent.then((counted) => {
      if (!counted) return (player.answered = false);
      forget(player.clip);
      localStorage.setItem(KNOWS_MARKS, "yes"); // what the bar is for was said once, beside this clip
    });
  }

  // Takes back what was answered a moment ago, or what the button says.
  let undoneAt = -Infinity;
  function undo(event) {
    // The second half of a double click: the button says another clip by now.
    if (event.type === "click" && event.timeStamp - undoneAt < DOUBLE_MS) return;
    undoneAt = event.timeStamp;
    const player = main();
    const button = shown("[data-undo-clip], [data-undo-pair]");
    const { clip, pair } = player?.answered && !player.undone ? player.element.dataset : {};
    const { undoClip = clip, undoPair = pair } = clip || pair ? {} : (button?.dataset ?? {});
    if (!undoPair && !undoClip) return;
    if (line.lost()) return say(NOT_TAKEN);
    const press = undoPair
      ? { press: "compare", pair: Number(undoPair), answer: "undo" }
      : { press: "undo", clip: Number(undoClip) };
    // Not answered anew before it is taken back: that press would come too early to count.
    if (player) player.undone = player.answered;
    send(press).then(() => player?.undone && (player.answered = player.undone = false));
  }

  function sayWhy(box, reason) {
    const { clip, pair } = box.dataset;
    send(pair ? { press: "pair reason", pair: Number(pair), reason } : { press: "reason", clip: Number(clip), reason });
  }

  // Keys that concern this browser alone. True if the key was one of them.
  function local(key) {
    const player = main();
    if (key === "?") shown(".od-help")?.showModal();
    else if (!player) return false;
    else if (key === " ") player.replay();
    else if (key === "play") player.playing ? player.seek(player.frame) : player.replay();
    else if (key === "f" || key === "F") toggleSlow();
    else if (key === "t" || key === "T") toggleTrail();
    else if (key === "ArrowLeft") player.seek(player.frame - 1);
    else if (key === "ArrowRight") player.seek(player.frame + 1);
    else if ((key === "m" || key === "M") && player.clip) player.markByKey();
    else return false;
    return true;
  }

  window.addEventListener(
    "keydown",
    (event) => {
      if (typing(event.target) || event.getModifierState("AltGraph")) return;
      const name = labelled(event);
      if (event.ctrlKey || event.metaKey) {
        const undoes = name.toLowerCase() === "z" && !event.shiftKey && !event.altKey && !shown(".od-help[open]");
        if (!undoes || !main() && !shown("[data-undo-clip], [data-undo-pair]")) return;
        event.preventDefault();
        return event.repeat ? undefined : undo(event);
      }
      const stop = () => {
        event.stopImmediatePropagation();
        event.preventDefault();
      };
      if (event.altKey) {
        // Another tab begins at its top.
        if (/^[0-9]$/.test(name)) shown(".mantine-Paper-root:has(.od-header)")?.scrollTo(0, 0);
        if (!event.isTrusted || name.toLowerCase() === event.key.toLowerCase()) return;
        stop();
        return viserKey(`alt+${name}`);
      }
      // A browser clicks a button anew with each repeat of a held Enter.
      if (name === "Enter" && event.repeat) return event.preventDefault();
      if (shown(".od-help[open]")) {
        // Nobody sees the clip now. Escape, Enter and Tab belong to the dialog.
        if (event.key === "?") shown(".od-help").close();
        if (!["Escape", "Enter", "Tab"].includes(name)) stop();
        return;
      }
      const arrows = name.startsWith("Arrow");
      if (arrows && event.target.closest?.("input, [role=tablist]")) return;
      const key = name === "Backspace" ? "u" : name.toLowerCase();
      if (/^[1-5su]$/.test(key) && event.key !== "?") {
        event.preventDefault();
        if (!event.repeat) key === "u" ? undo(event) : answer(key);
        return;
      }
      if (name === "Enter" && shown("[data-go]") && !event.target.closest?.("button, a")) {
        stop();
        if (!event.repeat) answer("g");
        return;
      }
      // On a button too: the space bar always replays. Enter presses a button.
      if (arrows || !event.repeat ? local(event.key === "?" ? "?" : name) : name === " ") stop();
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
    if (data.key?.startsWith("alt+")) viserKey(data.key);
    else if (data.key === "u") undo(event);
    else if (data.key) answer(data.key);
    else if ("replay" in data) local(" ");
    else if ("play" in data) local("play");
    else if ("slow" in data) local("f");
    else if ("trail" in data) local("t");
    else if ("step" in data) local(data.step === "1" ? "ArrowRight" : "ArrowLeft");
    else if ("mark" in data) local("m");
    else if ("help" in data) local("?");
    else if ("signOut" in data)
      queue.then(() => post("signout", {})).then(
        (answer) => location.assign(answer.url),
        (error) => say(error.message),
      );
    else if ("unmark" in data) main()?.setMark(null);
    else if ("reason" in data) sayWhy(button.closest(".od-notice"), data.reason);
    else if ("submit" in data) answer(shown(".od-slide input").value);
  });

  // The slider says nothing until it is moved, or pressed where it stands.
  let beside = null; // the clip that is on screen, or the slider alone
  function setSlider(moved) {
    const slide = shown(".od-slide");
    if (!slide) return;
    const input = slide.querySelector("input");
    slide.toggleAttribute("data-moved", moved);
    if (!moved) input.value = (Number(input.min) + Number(input.max)) / 2;
    input.setAttribute("aria-valuetext", moved ? input.value : "not set");
    shown("[data-submit]").disabled = !moved;
  }
  for (const event of ["input", "pointerup"])
    document.addEventListener(event, ({ target }) => {
      if (target instanceof Element && target.matches(".od-slide input")) setSlider(true);
    });

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
    localStorage.setItem(KNOWS_MARKS, "yes");
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
    };
    player.seek(Math.floor(start));
    addEventListener("pointermove", move);
    addEventListener("pointerup", up);
    addEventListener("pointercancel", up);
  });

  // Another clip: the slider says nothing again, nor does the time bar what it is for.
  new MutationObserver(() => {
    const slide = shown(".od-slide");
    const now = slide && (shown(".od-clip > [data-src]") ?? slide);
    if (now === beside) return;
    beside = now;
    setSlider(false);
    document.documentElement.toggleAttribute("data-knows-marks", KNOWS_MARKS in localStorage);
  }).observe(document.documentElement, { childList: true, subtree: true });

  watchPlayers();

  // After a reload: what was on its way.
  seen(pageName, 60000).then(() => {
    for (const body of kept.read()) enqueue(body);
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
  // Asked only where the page does not come: a context of WebGL takes a tenth of a second without a GPU.
  seen(pageName, 3000).then((name) => {
    if (name || webgl()) return;
    const note = document.createElement("p");
    note.className = "od-nowebgl";
    note.setAttribute("role", "alert");
    note.textContent =
      "This page needs WebGL, which is switched off in this browser. Please switch on hardware " +
      "acceleration in its settings, or open the link in another browser.";
    document.body.append(note);
  });

  return { act, named, viserKey };
})();
