// Plays clips. One picture holds all frames of both sides (trainer/render/clip_image.py); they are drawn onto
// canvases here, so that a clip can be slowed down, stepped through and marked. Whatever element has
// data-src is a player; elements come and go as the server redraws the page.
const clips = (() => {
  "use strict";
  const HEIGHT = 360;
  const LEFT = { both: 0, left: 0, right: 492, third: 984 };
  const WIDTH = { false: 972, true: 1464 }; // of a moment: video and one robot, or two
  const HOLD_S = 0.5; // the last frame stays so long before the clip starts over
  const SLOW = 0.25;
  const KEPT = 8; // pictures kept in memory, decoded: up to 17 MB each

  const still = window.matchMedia("(prefers-reduced-motion: reduce)");
  const pictures = new Map();
  const players = new Map();
  const marks = new Map(); // of clips that are not answered yet: another tab takes them off the page
  let slow = false;

  // A bitmap stays decoded; an element's picture may have to be decoded again when it is drawn.
  async function decoded(source) {
    const answer = await fetch(source);
    if (!answer.ok) throw new Error(`${source}: ${answer.status}`);
    return createImageBitmap(await answer.blob());
  }

  function picture(source) {
    let entry = pictures.get(source);
    if (entry) return entry;
    entry = { image: null, ready: false };
    pictures.set(source, entry);
    if (pictures.size > KEPT) pictures.delete(pictures.keys().next().value);
    decoded(source).then(
      (image) => {
        entry.image = image;
        entry.ready = true;
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
      this.width = WIDTH["pair" in element.dataset];
      this.time = 0;
      this.playing = !still.matches;
      this.once = false;
      this.mark = null; // [first frame, frame after the last]
      this.marking = null; // frame at which a mark by key began
      this.answered = false;
      this.drawn = -1;
      picture(this.source);
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
    get columns() {
      return Math.round(this.entry.image.width / this.width);
    }
    get frames() {
      return this.ready ? this.columns * Math.round(this.entry.image.height / HEIGHT) : 1;
    }
    get frame() {
      return Math.min(this.frames - 1, Math.floor(this.time * this.fps + 1e-6));
    }

    draw() {
      this.element.toggleAttribute("data-still", !this.playing);
      if (!this.ready) return;
      const frame = this.frame;
      if (this.box && this.clip) this.drawBar();
      if (frame === this.drawn) return;
      this.drawn = frame;
      const y = Math.floor(frame / this.columns) * HEIGHT;
      const x = (frame % this.columns) * this.width;
      for (const canvas of this.canvases) {
        const { width, height } = canvas;
        canvas
          .getContext("2d")
          .drawImage(this.entry.image, x + LEFT[canvas.dataset.side], y, width, height, 0, 0, width, height);
      }
      this.element.dataset.frame = frame;
    }

    advance(seconds) {
      if (!this.playing || !this.ready) return;
      const length = this.frames / this.fps;
      this.time += seconds * (slow && this.isMain ? SLOW : 1);
      if (this.time >= length + HOLD_S || (this.once && this.time >= length)) {
        if (this.once) this.playing = this.once = false;
        this.time = this.playing ? 0 : length;
      }
      this.draw();
    }

    get isMain() {
      return this.box?.classList.contains("od-clip");
    }

    replay() {
      this.time = 0;
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

  let last = 0;
  let running = false;
  function tick(now) {
    const seconds = Math.min(0.1, (now - last) / 1000);
    last = now;
    let any = false;
    for (const player of players.values()) {
      player.advance(seconds);
      any ||= player.playing;
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
      wake();
    }
    for (const element of document.querySelectorAll("[data-ahead]")) picture(element.dataset.ahead);
    const slowButton = document.querySelector("[data-slow]");
    if (slowButton && slowButton.getAttribute("aria-pressed") !== String(slow))
      slowButton.setAttribute("aria-pressed", slow);
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

  function toggleSlow() {
    slow = !slow;
    look();
  }

  // A clip was answered, with its mark.
  function forget(clip) {
    marks.delete(Number(clip));
  }

  return { forget, main, toggleSlow, watchPlayers };
})();
