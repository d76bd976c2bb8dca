// Plays clips. One picture holds all frames of both sides (trainer/render/clip_image.py); they are drawn onto
// canvases here, so that a clip can be slowed down, stepped through and marked. Whatever element has
// data-src is a player; elements come and go as the server redraws the page.
const clips = (() => {
  "use strict";
  const { drawPace, drawSide } = drawing; // static/drawing.js
  const SIDES = { left: [0], right: [1], third: [2], both: [0, 1] };
  const PACES = [1, 0.5]; // real time, then half of it, in turn
  const SLOW = 0.25;
  const BEAT_S = 0.12; // the last frame stays so long, so that the jump back can be told from the movement
  const LABELS_S = [5, 6.5]; // what head and foot are is said so long, and then fades
  const KEPT = 6; // pictures kept in memory, decoded: up to 31 MB each

  const still = window.matchMedia("(prefers-reduced-motion: reduce)");
  const pictures = new Map();
  const players = new Map();
  const marks = new Map(); // of clips that are not answered yet: another tab takes them off the page
  const chosen = (name) => localStorage.getItem(`onedemo-${name}`) === "on";
  let slow = chosen("slow");
  let trail = chosen("trail"); // first pose, and the paths of head and feet

  // A bitmap stays decoded; an element's picture may have to be decoded again when it is drawn.
  async function decoded(source) {
    const answer = await fetch(source);
    if (!answer.ok) throw new Error(`${source}: ${answer.status}`);
    const blob = await answer.blob();
    const about = noted(new DataView(await blob.slice(0, 1 << 19).arrayBuffer()));
    return { image: await createImageBitmap(blob), about };
  }

  // What is written in the comments of a clip's file, in the order in which they stand.
  function noted(bytes) {
    const words = new TextDecoder();
    let text = "";
    for (let at = 2; bytes.getUint16(at) !== 0xffda; at += 2 + bytes.getUint16(at + 2)) {
      if (bytes.getUint16(at) !== 0xfffe) continue;
      const note = words.decode(new Uint8Array(bytes.buffer, at + 4, bytes.getUint16(at + 2) - 2));
      if (note.startsWith("onedemo clip ")) text += note.slice(13);
    }
    return JSON.parse(text);
  }

  function picture(source) {
    let entry = pictures.get(source);
    if (entry) return entry;
    entry = { image: null, about: null, ready: false };
    pictures.set(source, entry);
    if (pictures.size > KEPT) pictures.delete(pictures.keys().next().value);
    decoded(source).then(
      (found) => {
        Object.assign(entry, found, { ready: true });
        for (const player of players.values()) if (player.source === source) player.draw();
        wake();
      },
      () => {
        pictures.delete(source); // the line may be back in a second
        setTimeout(() => players.forEach((p) => p.source === source && picture(source)), 1000);
      },
    );
    return entry;
  }

  class Player {
    constructor(element) {
      this.element = element;
      this.source = element.dataset.src;
      this.fps = Number(element.dataset.fps);
      this.clip = Number(element.dataset.clip) || null;
      this.canvases = [...element.querySelectorAll("canvas")];
      this.box = element.parentElement;
      this.hint = element.querySelector(".od-hint");
      this.time = 0;
      this.pass = 0;
      this.playing = !still.matches;
      this.once = false;
      this.mark = null; // [first frame, frame after the last]
      this.marking = null; // frame at which a mark by key began
      this.answered = false;
      this.drawn = "";
      this.seen = 0; // seconds since it was on screen
      picture(this.source);
      this.canvases.forEach(fit);
      const before = element.dataset.mark?.split(",").map(Number); // as it was when it was taken back
      const mark = marks.has(this.clip) ? marks.get(this.clip) : before;
      if (mark) this.setMark(mark);
      this.draw();
    }

    get entry() {
      return picture(this.source);
    }
    get ready() {
      return this.entry.ready;
    }
    get frames() {
      return this.ready ? this.entry.about.frames : 1;
    }
    get frame() {
      return Math.max(0, Math.min(this.frames - 1, Math.floor(this.time * this.fps + 1e-6)));
    }

    draw() {
      this.element.toggleAttribute("data-still", !this.playing);
      if (!this.ready) return;
      const { frame, labels } = this;
      const pace = `${this.pace}`;
      const what = [frame, pace, labels, trail, this.playing, ...this.canvases.map((c) => c.width * c.height)].join();
      if (what === this.drawn) return;
      this.drawn = what;
      if (this.box && this.clip) this.drawBar();
      if (this.hint) this.hint.hidden = this.playing || !this.isMain;
      const { image, about } = this.entry;
      for (const canvas of this.canvases) {
        const pen = canvas.getContext("2d");
        const sides = SIDES[canvas.dataset.side];
        const gap = sides.length > 1 ? Math.round(canvas.width * 0.012) : 0;
        const width = (canvas.width - gap * (sides.length - 1)) / sides.length;
        pen.clearRect(0, 0, canvas.width, canvas.height);
        sides.forEach((side, index) => {
          pen.save();
          pen.translate(index * (width + gap), 0);
          pen.beginPath();
          pen.rect(0, 0, width, canvas.height);
          pen.clip();
          const { height } = canvas;
          const place = { pen, width, height, unit: height / (canvas.clientHeight || 360) };
          drawSide(place, image, about, about.sides[side], frame, { trail, labels });
          if (side === 0 && this.playing && this.isMain) drawPace(place, pace);
          pen.restore();
        });
      }
      this.element.dataset.frame = frame;
      this.element.dataset.pace = pace;
    }

    // How plainly head and foot are named: in the first practice clip, for some seconds.
    get labels() {
      if (this.element.dataset.exercise !== "1") return 0;
      const [from, to] = LABELS_S;
      return still.matches ? 1 : Math.max(0, Math.min(1, (to - this.seen) / (to - from)));
    }

    get pace() {
      return slow && this.isMain ? SLOW : this.once ? 1 : PACES[this.pass % PACES.length];
    }

    advance(seconds) {
      if (!this.ready) return;
      this.seen += seconds;
      if (this.playing) {
        const length = this.frames / this.fps;
        this.time += seconds * this.pace;
        if (this.once && this.time >= length) {
          this.playing = this.once = false;
          this.time = length;
        } else if (this.time >= length + BEAT_S * this.pace) {
          this.time = 0;
          this.pass += 1;
        }
      }
      this.draw();
    }

    get isMain() {
      return this.box?.classList.contains("od-clip");
    }

    replay() {
      this.time = this.pass = 0;
      this.playing = true;
      this.once = still.matches;
      this.draw();
      wake();
    }

    seek(frame) {
      this.playing = false;
      this.time = Math.max(0, Math.min(this.frames - 1, frame)) / this.fps;
      this.draw();
    }

    // Marks

    drawBar() {
      const bar = this.box.querySelector(".od-bar");
      if (!bar) return;
      const share = (frame) => `${((100 * frame) / this.frames).toFixed(2)}%`;
      const head = bar.querySelector(".od-head");
      head.style.left = share(this.frame);
      head.style.width = share(1);
      const wrong = bar.querySelector(".od-wrong");
      const [from, to] = this.mark ?? (this.marking === null ? [0, 0] : [this.marking, this.frame + 1]);
      wrong.style.left = share(Math.min(from, to));
      wrong.style.width = share(Math.abs(to - from));
      if (this.frames !== Number(bar.dataset.frames)) {
        bar.dataset.frames = this.frames;
        bar.style.setProperty("--od-frames", this.frames);
      }
    }

    say(text) {
      const bar = this.box.querySelector(".od-bar");
      if (!bar) return;
      bar.querySelector(".od-bar-note").textContent = text;
      bar.querySelector("[data-unmark]").hidden = !this.mark;
    }

    setMark(mark) {
      this.mark = mark;
      this.marking = null;
      marks.set(this.clip, mark);
      this.drawBar();
      if (!mark) return this.say("Drag to mark where it goes wrong");
      const [from, to] = mark.map((frame) => (frame / this.fps).toFixed(2));
      this.say(`Goes wrong from ${from} to ${to} s`);
    }

    markByKey() {
      if (this.mark) return this.setMark(null);
      if (this.marking === null) {
        this.seek(this.frame);
        this.marking = this.frame;
        this.drawBar();
        return this.say("Step forward to where it ends, then press Mark again");
      }
      const ends = [this.marking, this.frame].sort((a, b) => a - b);
      this.setMark([ends[0], ends[1] + 1]);
    }
  }

  // Gives a canvas the pixels of the screen that it covers.
  function fit(canvas) {
    const by = window.devicePixelRatio;
    const width = Math.round((canvas.clientWidth || 480) * by);
    const height = Math.round((canvas.clientHeight || 360) * by);
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  }
  const sizes = new ResizeObserver((changes) => {
    for (const { target } of changes) fit(target);
    for (const player of players.values()) player.draw();
  });

  let last = 0;
  let running = false;
  function tick(now) {
    const seconds = Math.max(0, Math.min(0.1, (now - last) / 1000)); // a frame may have begun before it was asked for
    last = now;
    let any = false;
    for (const player of players.values()) {
      player.advance(seconds);
      any ||= player.playing || (player.labels > 0 && !still.matches);
    }
    running = any;
    if (any) requestAnimationFrame(tick);
  }
  function wake() {
    if (running) return;
    running = true;
    last = performance.now();
    requestAnimationFrame(tick);
  }

  function look() {
    for (const element of players.keys()) if (!element.isConnected) players.delete(element);
    for (const element of document.querySelectorAll("[data-src]")) {
      const known = players.get(element);
      if (known && known.source === element.dataset.src) continue;
      players.set(element, new Player(element));
      for (const canvas of element.querySelectorAll("canvas")) sizes.observe(canvas);
      wake();
    }
    for (const element of document.querySelectorAll("[data-ahead]")) picture(element.dataset.ahead);
    for (const [name, on] of [["slow", slow], ["trail", trail]]) {
      const button = document.querySelector(`[data-${name}]`);
      if (button && button.getAttribute("aria-pressed") !== String(on)) button.setAttribute("aria-pressed", on);
    }
  }

  function watchPlayers() {
    new MutationObserver(look).observe(document.documentElement, { childList: true, subtree: true });
    look();
  }

  // The clip that is being rated, if there is one.
  function main() {
    const element = document.querySelector(".od-clip > [data-src]");
    return element ? (players.get(element) ?? null) : null;
  }

  // What stays as it was chosen, after a reload too.
  function choose(name, on) {
    localStorage.setItem(`onedemo-${name}`, on ? "on" : "off");
    look();
    for (const player of players.values()) player.draw();
  }
  const toggleSlow = () => choose("slow", (slow = !slow));
  const toggleTrail = () => choose("trail", (trail = !trail));

  // A clip was answered, with its mark.
  function forget(clip) {
    marks.delete(Number(clip));
  }

  return { forget, main, toggleSlow, toggleTrail, watchPlayers };
})();
