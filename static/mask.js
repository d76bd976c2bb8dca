// What moves in a result that is looked at before it is kept (static/demos.js): drawn over the video, and marked by
// a box or by places where it is wrong; the server then finds it again.
//
// Places are pixels of the result. Marks belong to a frame: what is drawn there is meant there.
const moves = (() => {
  "use strict";
  const { named } = page; // static/page.js
  const UNSURE = 50; // percent of doubt from which on a frame is unsure
  const LEAST_SIDE = 8; // pixels of a box
  const LONGEST = 300_000; // milliseconds that the server may take
  const HELP = {
    "": "",
    box: "Drag a box close around all of it, in a frame where it is seen whole. By keyboard: arrow keys and Enter for two corners.",
    it: "Press on a part of it that is not tinted. By keyboard: arrow keys move the cross, Enter marks.",
    not: "Press on a part that is tinted but does not belong to it. By keyboard: arrow keys move the cross, Enter marks.",
  };
  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

  let root = null; // of the dialog's part
  let upload = ""; // what the result belongs to; "" while nothing is looked at
  let facts = null; // of the result: frames, fps, width, height
  let found = null; // the server's last answer
  let marks = []; // {kind: "box", frame, x, y, w, h} at most once, or {kind: "it" | "not", frame, x, y}
  let mode = "";
  let busy = false;
  let stale = false; // whether marks have changed since the server was asked
  let cross = null; // of the keyboard: x, y
  let corner = null; // the first of a box: x, y, and of whom
  const part = (name) => root.querySelector(`[data-moves-part="${name}"]`);
  const video = () => root.querySelector("video");

  function begin(dialog, name, about, source) {
    if (!root) {
      root = dialog.querySelector("[data-moves]");
      listen();
    }
    [upload, facts, found, marks, stale, cross, corner] = [name, about, null, [], false, null, null];
    video().src = source;
    video().play().catch(() => {});
    part("at").max = about.frames - 1;
    [part("drawn").width, part("drawn").height] = [about.width, about.height];
    choose("");
    find();
    requestAnimationFrame(follow);
  }

  function end() {
    upload = "";
  }

  // ---- the server

  async function find() {
    if (busy) return void (stale = true);
    const of = upload;
    [busy, stale] = [true, false];
    root.dataset.busy = "";
    say("Looking for it: some seconds.");
    const box = marks.find((mark) => mark.kind === "box");
    const clicks = marks.filter((mark) => mark.kind !== "box");
    try {
      const answer = await line.during(
        line.request(`demos/${of}/mask`, {
          method: "POST", signal: AbortSignal.timeout(LONGEST), headers: { "Content-Type": "application/json", ...named() },
          body: JSON.stringify({
            box: box ? [box.x, box.y, box.w, box.h, box.frame] : null,
            clicks: clicks.map(({ x, y, frame, kind }) => [x, y, frame, kind === "it" ? 1 : 0]),
          }),
        }),
      );
      if (!answer.ok) throw new Error(await answer.text());
      const about = await answer.json();
      if (of === upload && !stale) {
        found = about;
        tell();
      }
    } catch (error) {
      if (of === upload) say(error.message || "This did not work. Please try again.", true);
    } finally {
      busy = false;
      delete root.dataset.busy;
      if (upload && (stale || of !== upload)) find();
    }
  }

  function say(text, bad = false) {
    part("said").textContent = text;
    part("said").classList.toggle("od-bad", bad);
  }

  function tell() {
    const { said, sure, frames } = found;
    if (!said) say("Nothing was found that moves. Draw a box around it.", true);
    else say(`Found ${said}. Sure in ${sure === frames ? `all ${frames}` : `${sure} of ${frames}`} frames${sure < 0.6 * frames ? ": please look, and mark it" : ""}.`);
    part("unsure").disabled = sure === frames;
    drawDoubt();
  }

  // ---- marks

  function choose(wanted) {
    mode = wanted;
    corner = null;
    for (const button of root.querySelectorAll("[data-moves-mode]")) button.setAttribute("aria-pressed", String(button.dataset.movesMode === mode));
    part("help").textContent = HELP[mode];
    part("pad").dataset.mode = mode;
    if (mode) video().pause();
    ready();
  }

  function ready() {
    part("undo").disabled = part("clear").disabled = !marks.length;
    part("unsure").disabled = !found || found.sure === found.frames;
  }

  function mark(one) {
    if (one.kind === "box") marks = marks.filter((other) => other.kind !== "box");
    marks.push(one);
    ready();
    find();
  }

  function boxed(from, to) {
    const [x, y] = [Math.min(from.x, to.x), Math.min(from.y, to.y)];
    return { kind: "box", frame: now(), x, y, w: Math.abs(to.x - from.x), h: Math.abs(to.y - from.y) };
  }

  function press(at) {
    if (!mode) return toggle();
    if (mode !== "box") return mark({ kind: mode, frame: now(), ...at });
    if (!corner) return void (corner = at);
    const box = boxed(corner, at);
    corner = null;
    if (Math.min(box.w, box.h) >= LEAST_SIDE) mark(box);
    else say("This box is too small: drag it around all of what moves.", true);
  }

  // ---- what is shown

  const now = () => clamp(Math.floor(video().currentTime * facts.fps + 0.01), 0, facts.frames - 1);

  function go(frame) {
    video().pause();
    video().currentTime = (clamp(frame, 0, facts.frames - 1) + 0.5) / facts.fps;
  }

  const toggle = () => (video().paused ? video().play().catch(() => {}) : video().pause());

  function follow() {
    if (!upload) return;
    if (root.checkVisibility()) draw();
    requestAnimationFrame(follow);
  }

  function draw() {
    const frame = now();
    const at = part("at");
    if (document.activeElement !== at || !video().paused) at.value = frame;
    const unsure = found && found.doubt[frame] >= UNSURE;
    const told = `Frame ${frame + 1} of ${facts.frames}${unsure ? ", unsure" : ""}`;
    if (part("frame-said").textContent !== told) {
      part("frame-said").textContent = told;
      at.setAttribute("aria-valuetext", told);
    }
    const canvas = part("drawn");
    const pen = canvas.getContext("2d");
    const pixel = canvas.width / Math.max(1, canvas.clientWidth); // of the result, one on screen
    pen.clearRect(0, 0, canvas.width, canvas.height);
    if (found && part("shown").checked) outline(pen, found.outlines[frame] ?? [], pixel, unsure);
    for (const one of marks) if (one.frame === frame) drawMark(pen, one, pixel);
    if (corner) drawMark(pen, boxed(corner, cross ?? corner), pixel);
    if (cross && document.activeElement === part("pad")) drawCross(pen, pixel);
  }

  function outline(pen, parts, pixel, unsure) {
    pen.beginPath();
    for (const places of parts) {
      for (let k = 0; k < places.length; k += 2) pen[k ? "lineTo" : "moveTo"](places[k], places[k + 1]);
      pen.closePath();
    }
    pen.fillStyle = "rgb(255 0 190 / 34%)";
    pen.fill("evenodd");
    stroke(pen, pixel, "#ff4fd0", unsure ? [6 * pixel, 4 * pixel] : []);
  }

  function stroke(pen, pixel, colour, dashes = []) {
    pen.setLineDash([]);
    [pen.lineWidth, pen.strokeStyle] = [4 * pixel, "rgb(0 0 0 / 55%)"];
    pen.stroke();
    pen.setLineDash(dashes);
    [pen.lineWidth, pen.strokeStyle] = [2 * pixel, colour];
    pen.stroke();
    pen.setLineDash([]);
  }

  function drawMark(pen, one, pixel) {
    pen.beginPath();
    if (one.kind === "box") {
      pen.rect(one.x, one.y, one.w, one.h);
      return stroke(pen, pixel, "#fff", [8 * pixel, 5 * pixel]);
    }
    const radius = 9 * pixel;
    pen.arc(one.x, one.y, radius, 0, 2 * Math.PI);
    pen.fillStyle = one.kind === "it" ? "#0d7a5f" : "#b3261e";
    pen.fill();
    stroke(pen, pixel / 2, "#fff");
    pen.beginPath();
    pen.moveTo(one.x - radius / 2, one.y);
    pen.lineTo(one.x + radius / 2, one.y);
    if (one.kind === "it") {
      pen.moveTo(one.x, one.y - radius / 2);
      pen.lineTo(one.x, one.y + radius / 2);
    }
    [pen.lineWidth, pen.strokeStyle] = [2 * pixel, "#fff"];
    pen.stroke();
  }

  function drawCross(pen, pixel) {
    pen.beginPath();
    pen.moveTo(cross.x - 12 * pixel, cross.y);
    pen.lineTo(cross.x + 12 * pixel, cross.y);
    pen.moveTo(cross.x, cross.y - 12 * pixel);
    pen.lineTo(cross.x, cross.y + 12 * pixel);
    stroke(pen, pixel, "#fff");
  }

  // Under the slider: how unsure each frame is.
  function drawDoubt() {
    const canvas = part("doubt");
    [canvas.width, canvas.height] = [facts.frames, 20];
    const pen = canvas.getContext("2d");
    pen.clearRect(0, 0, canvas.width, canvas.height);
    const style = getComputedStyle(root);
    found.doubt.forEach((doubt, frame) => {
      pen.fillStyle = style.getPropertyValue(doubt >= UNSURE ? "--od-warn" : "--od-line");
      const high = Math.max(2, Math.round(doubt / 5));
      pen.fillRect(frame, 20 - high, 1, high);
    });
  }

  // ---- hands

  function place(event) {
    const box = part("pad").getBoundingClientRect();
    return {
      x: clamp(((event.clientX - box.left) / box.width) * facts.width, 0, facts.width),
      y: clamp(((event.clientY - box.top) / box.height) * facts.height, 0, facts.height),
    };
  }

  function listen() {
    const pad = part("pad");
    pad.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      pad.focus();
      cross = null;
      if (mode !== "box") return press(place(event));
      event.preventDefault();
      video().pause();
      pad.setPointerCapture(event.pointerId);
      corner = cross = place(event);
      const follow = (moved) => (cross = place(moved));
      const up = (over) => {
        pad.removeEventListener("pointermove", follow);
        for (const name of ["pointerup", "pointercancel"]) pad.removeEventListener(name, up);
        if (over.type === "pointerup") press(place(over));
        corner = cross = null;
      };
      pad.addEventListener("pointermove", follow);
      for (const name of ["pointerup", "pointercancel"]) pad.addEventListener(name, up);
    });
    pad.addEventListener("keydown", (event) => {
      const way = ARROWS[event.key];
      if (way) {
        event.preventDefault();
        cross ??= { x: facts.width / 2, y: facts.height / 2 };
        const step = (facts.width / 100) * (event.shiftKey ? 10 : 1);
        cross = { x: clamp(cross.x + step * way[0], 0, facts.width), y: clamp(cross.y + step * way[1], 0, facts.height) };
      } else if (event.key === "Enter" || event.key === " ") {
        event.preventDefault();
        press(cross ?? { x: facts.width / 2, y: facts.height / 2 });
      } else if (event.key === "Escape" && (corner || mode)) {
        event.preventDefault();
        choose("");
      }
    });
    pad.addEventListener("blur", () => (cross = corner = null));
    part("at").addEventListener("input", (event) => go(Number(event.target.value)));
    part("play").addEventListener("click", toggle);
    for (const name of ["play", "pause"])
      video().addEventListener(name, () => (part("play").textContent = video().paused ? "Play" : "Pause"));
    for (const button of root.querySelectorAll("[data-moves-mode]"))
      button.addEventListener("click", () => choose(mode === button.dataset.movesMode ? "" : button.dataset.movesMode));
    part("undo").addEventListener("click", () => (marks.pop(), ready(), find()));
    part("clear").addEventListener("click", () => ((marks = []), choose(""), find()));
    part("unsure").addEventListener("click", () => {
      const { doubt } = found;
      const after = doubt.findIndex((value, frame) => frame > now() && value >= UNSURE);
      go(after >= 0 ? after : doubt.findIndex((value) => value >= UNSURE));
    });
  }

  return { begin, end };
})();
