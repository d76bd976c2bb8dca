// The Watch tab beyond its charts: the best rollouts, their films, and the robot's canvas, which Viser fixes to
// the window, where the page scrolls under it.
(() => {
  "use strict";
  const SHOWN = 12; // cards to begin with
  const film = () => document.querySelector(".od-film");

  // ---- Best rollouts: cards are added at the end, and stay where they are

  class Gallery {
    #known = new Set();
    #stride = 0;
    #best = null;
    #end;

    constructor(element) {
      this.element = element;
      this.list = element.querySelector("ol");
      this.template = element.querySelector("template");
      this.#end = charts.follow(element.dataset.run, ({ columns }) => this.#take(columns));
    }

    #take({ number, best }) {
      const there = number.map((n, k) => [n, best[k]]).filter(([, rating]) => rating != null);
      if (!there.length) return;
      this.element.hidden = false;
      const most = there.reduce((a, b) => (b[1] > a[1] ? b : a));
      // Never under the pointer: what somebody is about to press stays.
      if (!this.#best || (this.#best.dataset.number !== String(most[0]) && !this.#best.matches(":hover, :focus-within"))) {
        const card = this.#card(...most, `Best so far: iteration ${most[0].toLocaleString("en")}`);
        card.className = "od-best";
        if (this.#best) this.#best.replaceWith(card);
        else this.list.prepend(card);
        this.#best = card;
      }
      // Spread evenly over what there was when the page came; after that as far apart as before.
      this.#stride ||= 2 ** Math.max(0, Math.ceil(Math.log2(there.length / SHOWN)));
      for (const [n, rating] of there) {
        if (this.#known.has(n) || (n - there[0][0]) % this.#stride) continue;
        this.#known.add(n);
        this.list.append(this.#card(n, rating, `Iteration ${n.toLocaleString("en")}`));
      }
    }

    #card(number, rating, title) {
      const card = this.template.content.firstElementChild.cloneNode(true);
      const address = (suffix) => `rollouts/${number}.${suffix}?v=${this.element.dataset.version}`;
      const about = `predicted rating ${rating.toFixed(1)}`;
      card.dataset.number = number;
      const button = card.querySelector("button");
      button.setAttribute("aria-label", `Play the best rollout of iteration ${number}`);
      Object.assign(button.dataset, { film: address("webm"), title: `Best rollout of iteration ${number.toLocaleString("en")}: ${about}` });
      card.querySelector("img").src = address("jpg");
      card.querySelector("b").textContent = title;
      card.querySelector("span").textContent = about;
      Object.assign(card.querySelector("a"), { href: address("webm"), download: `onedemo-iteration-${number}.webm` });
      return card;
    }

    end() {
      this.#end();
    }
  }

  let galleries = [];
  new MutationObserver(() => {
    for (const gallery of galleries) if (!gallery.element.isConnected) gallery.end();
    galleries = galleries.filter(({ element }) => element.isConnected);
    for (const element of document.querySelectorAll(".od-gallery"))
      if (!galleries.some((gallery) => gallery.element === element)) galleries.push(new Gallery(element));
  }).observe(document.documentElement, { childList: true, subtree: true });

  document.addEventListener("click", (event) => {
    const button = event.target instanceof Element ? event.target.closest("[data-film]") : null;
    if (!button) return;
    const dialog = film();
    const video = dialog.querySelector("video");
    const link = dialog.querySelector("a");
    dialog.querySelector("h2").textContent = button.dataset.title;
    Object.assign(link, { href: button.dataset.film, download: button.closest("li").querySelector("a").download });
    dialog.toggleAttribute("data-ready", false);
    video.addEventListener("loadeddata", () => dialog.toggleAttribute("data-ready", true), { once: true });
    video.src = button.dataset.film;
    dialog.showModal();
    video.play().catch(() => {});
    dialog.addEventListener("close", () => video.pause(), { once: true });
  });

  // ---- The canvas goes with the page where that scrolls

  // Looked at in each frame, while Watch is shown: a resize may move the page without saying so.
  const narrow = window.matchMedia("(max-width: 900px)");
  let page = null;
  let scrolled = "";
  let going = false;
  function goWith() {
    going = narrow.matches && document.querySelector('.od-header[data-tab="watch"]') !== null;
    if (!going) return;
    if (!page?.isConnected) page = document.querySelector(".mantine-Paper-root:has(.od-header)");
    const now = `${page?.scrollTop ?? 0}px`;
    if (now !== scrolled) document.documentElement.style.setProperty("--od-scrolled", (scrolled = now));
    requestAnimationFrame(goWith);
  }
  const begin = () => going || goWith();
  new MutationObserver(begin).observe(document.documentElement, { childList: true, subtree: true });
  narrow.addEventListener("change", begin);
})();
