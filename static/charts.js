// Charts of Watch and Runs: the figures that a template names, drawn by uPlot (static/vendor/uplot) from what
// the server tells of a run as JSON.
//
// <section class="od-charts" data-runs='["a"]' data-x="number"> holds <figure class="od-chart"
// data-series='[["kl", "KL"]]'>. Viser draws and removes them as it likes: whatever appears is drawn, from what
// is known already; whatever is gone is let go.
const charts = (() => {
  "use strict";
  const settings = { askMs: 1000, restMs: 30000, most: 3000 };

  // ---- What is known of a run, asked for while anybody wants it

  const feeds = new Map();

  class Feed {
    columns = {};
    marks = [];
    levels = {};
    last = 0;
    readers = new Set();
    #askedAt = -Infinity;
    #asking = false;
    #gone = false;

    constructor(run) {
      this.run = run;
    }

    // Whether the server has said all that it knows by now.
    get answered() {
      return this.#gone || this.live !== undefined;
    }

    get due() {
      const pause = this.live === false ? settings.restMs : settings.askMs;
      return this.readers.size && !this.#asking && !this.#gone && performance.now() - this.#askedAt >= pause - 50;
    }

    async ask() {
      this.#asking = true;
      this.#askedAt = performance.now();
      try {
        const answer = await line.request(`curves.json?run=${encodeURIComponent(this.run)}&after=${this.last}`);
        if (answer.status === 401) await line.ended();
        if ([400, 401, 403, 404].includes(answer.status)) {
          this.#gone = true;
          for (const read of [...this.readers]) read(this);
        }
        if (answer.ok) this.#take(await answer.json());
      } catch (error) {
        if (!line.unanswered(error)) throw error;
      } finally {
        this.#asking = false;
      }
    }

    #take({ last, columns, marks, levels, colour, title, live }) {
      const first = this.last === 0;
      const told = ([marks, levels, title]) => JSON.stringify([marks, levels, title]);
      const changed = first || columns.number.length || told([marks, levels, title]) !== told([this.marks, this.levels, this.title]);
      for (const [name, values] of Object.entries(columns))
        this.columns[name] = first ? values : this.columns[name].concat(values);
      Object.assign(this, { last, marks, levels, colour, title, live });
      if (this.columns.number.length > settings.most) this.last = 0; // asked for anew, thinned
      if (changed) for (const read of [...this.readers]) read(this);
    }
  }

  function feedOf(run) {
    if (!feeds.has(run)) feeds.set(run, new Feed(run));
    return feeds.get(run);
  }

  // Calls a function with what is known of a run, now and whenever there is more; returns what ends that.
  function follow(run, read) {
    const feed = feedOf(run);
    feed.readers.add(read);
    if (feed.answered) read(feed);
    ask();
    return () => feed.readers.delete(read);
  }

  function ask() {
    if (document.hidden) return;
    for (const feed of feeds.values()) if (feed.due) feed.ask();
  }

  // ---- Numbers

  function short(value) {
    const size = Math.abs(value);
    if (size >= 1e6) return `${+(value / 1e6).toPrecision(4)} M`;
    if (size >= 1e4) return `${+(value / 1e3).toPrecision(4)} k`;
    return `${+value.toPrecision(size < 1 ? 2 : 3)}`;
  }

  const told = (value) => (value == null ? "–" : Math.abs(value) >= 1000 ? Math.round(value).toLocaleString("en") : short(value));

  // A running mean that forgets; as if there had been nothing before the first value.
  function smoothed(values, keep) {
    if (!keep) return values;
    let sum = 0;
    let weight = 0;
    return values.map((value) => {
      if (value == null) return value;
      sum = keep * sum + (1 - keep) * value;
      weight = keep * weight + (1 - keep);
      return sum / weight;
    });
  }

  function nearest(values, index, reach) {
    for (let d = 0; d <= reach; d += 1) {
      if (values[index - d] != null) return index - d;
      if (values[index + d] != null) return index + d;
    }
    return null;
  }

  // ---- Looks

  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const COLOURS = 8;
  const DASHES = [[], [7, 4], [2, 3]];
  // By the run's number, so that a run has one colour wherever it is drawn.
  const look = (number) => ({
    stroke: style(`--od-series-${((number - 1) % COLOURS) + 1}`),
    dash: DASHES[Math.floor((number - 1) / COLOURS) % DASHES.length],
  });
  const SIGNS = { paused: "‖", resumed: "▶", stopped: "■", failed: "×", excluded: "−", included: "+" };
  const FONT = "11px system-ui, sans-serif";
  const WHOLE = [1, 2, 5].map((d) => [0, 1, 2, 3, 4, 5, 6, 7].map((p) => d * 10 ** p)).flat().sort((a, b) => a - b);

  // ---- Charts that share their axis, their cursor and what is zoomed to

  let groups = [];

  class Group {
    zoom = null;
    #ends = [];

    constructor(element) {
      this.element = element;
      this.runs = JSON.parse(element.dataset.runs);
      this.x = element.dataset.x;
      this.sync = uPlot.sync(`od-${Math.random()}`);
      this.input = element.querySelector("[data-smooth]");
      this.input.value = localStorage.getItem("onedemo-smoothing") ?? 0;
      this.input.addEventListener("input", () => {
        localStorage.setItem("onedemo-smoothing", this.input.value);
        for (const group of groups) {
          group.input.value = this.input.value;
          group.draw();
        }
      });
      this.back = element.querySelector("[data-zoom-out]");
      this.back.addEventListener("click", () => this.show(null));
      this.charts = [...element.querySelectorAll(".od-chart")].map((figure) => new Chart(figure, this));
      this.feeds = [];
      this.#ends = this.runs.map((run) => follow(run, () => this.draw()));
      element.addEventListener("toggle", () => this.draw(), true); // a fold opens
    }

    get smoothing() {
      return Number(this.input.value);
    }

    // All of the axis, or the part that was chosen.
    get extent() {
      if (this.zoom) return this.zoom;
      const all = this.feeds.flatMap((feed) => [feed.columns[this.x][0], feed.columns[this.x].at(-1)]);
      const low = Math.min(...all);
      return [low === 1 ? 0 : low, Math.max(...all, low + 1)];
    }

    show(zoom) {
      this.zoom = zoom;
      this.back.hidden = !zoom;
      this.draw();
    }

    draw() {
      this.feeds = this.runs.map((run) => feeds.get(run)).filter((feed) => feed?.columns.number?.length);
      for (const chart of this.charts) chart.draw();
    }

    // What a run is called here: by its title, if no other one has that.
    nameOf(run) {
      const { title } = feedOf(run);
      const alone = this.runs.filter((other) => feedOf(other).title === title).length === 1;
      return !title ? run : alone ? title : `${title} (${run})`;
    }

    end() {
      for (const end of this.#ends) end();
      for (const chart of this.charts) chart.end();
    }
  }

  class Chart {
    #plot = null;
    #lines = [];
    #drawn = "";

    constructor(figure, group) {
      this.figure = figure;
      this.group = group;
      this.place = figure.querySelector(".od-plot");
      this.value = figure.querySelector(".od-value");
      this.legend = figure.querySelector(".od-legend-of-chart");
      this.nothing = figure.querySelector(".od-nothing");
      this.series = JSON.parse(figure.dataset.series);
      this.limits = JSON.parse(figure.dataset.limits ?? "[null, null]");
      this.span = Number(figure.dataset.span ?? 0);
      this.title = figure.querySelector("figcaption b").textContent;
      this.watch = new ResizeObserver(() => this.#fit());
      this.watch.observe(this.place);
    }

    // Each run's lines: what is measured, faint, and the same smoothed; then what the demo itself would get.
    #table() {
      const { feeds: known, x, smoothing } = this.group;
      const several = known.length > 1 || this.group.element.dataset.several !== undefined;
      const lines = [];
      const tables = known.map((feed) => {
        const columns = [];
        this.series.forEach(([column, label], k) => {
          const values = feed.columns[column];
          if (!values?.some((value) => value != null)) return;
          const looks = look(this.series.length > 1 ? k + 1 : feed.colour);
          const named = { run: feed.run, label: several ? this.group.nameOf(feed.run) : label, ...looks };
          lines.push({ ...named, faint: true }, named);
          columns.push(values, smoothed(values, smoothing));
        });
        const level = this.figure.dataset.level;
        if (columns.length && level) {
          const constant = feed.levels[level];
          const values = constant != null ? feed.columns[x].map(() => constant) : feed.columns[level];
          if (values?.some((value) => value != null)) {
            const own = several && (constant == null || known.filter(({ levels }) => levels[level] === constant).length === 1);
            const stroke = own ? look(feed.colour).stroke : style("--od-muted");
            lines.push({ run: feed.run, label: "the demo itself", stroke, dash: [5, 4], level: true, own });
            columns.push(values);
          }
        }
        return columns.length ? [feed.columns[x], ...columns] : null;
      }).filter(Boolean);
      return { lines, data: tables.length ? uPlot.join(tables) : null };
    }

    draw() {
      if (!this.place.checkVisibility()) return; // in a fold: once that is opened
      const { lines, data } = this.#table();
      this.figure.toggleAttribute("data-drawn", Boolean(data));
      const known = this.group.runs.every((run) => feedOf(run).answered);
      this.nothing.textContent = known ? this.figure.dataset.nothing : "Loading…";
      if (!data) return this.#drop();
      const key = JSON.stringify(lines);
      if (key !== this.#drawn) this.#drop();
      this.#lines = lines;
      if (this.#plot) this.#plot.setData(data);
      else if (this.place.clientWidth) {
        this.#drawn = key;
        this.#plot = new uPlot(this.#options(), data, this.place);
      }
      this.#tell(this.#plot?.cursor.idx ?? null);
    }

    #drop() {
      this.#plot?.destroy();
      this.#plot = null;
      this.#drawn = "";
    }

    #fit() {
      const { clientWidth: width, clientHeight: height } = this.place;
      if (!width || !height) return;
      if (!this.#plot) this.group.draw();
      else if (width !== this.#plot.width || height !== this.#plot.height) this.#plot.setSize({ width, height });
    }

    #options() {
      const { group } = this;
      const ink = style("--od-muted");
      const axis = {
        stroke: ink, font: FONT, ticks: { show: false }, grid: { stroke: style("--od-line"), width: 1 },
        values: (u, splits) => splits.map(short),
      };
      return {
        width: this.place.clientWidth,
        height: this.place.clientHeight,
        padding: [14, 18, 0, 0],
        legend: { show: false },
        scales: { x: { time: false, range: () => group.extent }, y: { range: (u, low, high) => this.#range(low, high) } },
        axes: [{ ...axis, size: 26, space: 48, incrs: WHOLE }, { ...axis, size: 46, space: 34 }],
        series: [
          {},
          ...this.#lines.map(({ stroke, dash, faint, level }) => ({
            stroke, dash, width: faint || level ? 1.25 : 2, alpha: faint ? 0.28 : 1, spanGaps: true,
            points: { show: (u, s, from, to) => !faint && !level && to - from < 2 },
          })),
        ],
        cursor: {
          y: false,
          sync: { key: group.sync.key },
          drag: { x: true, y: false, setScale: false },
          points: { show: (u, s) => !this.#lines[s - 1]?.faint && !this.#lines[s - 1]?.level, size: 7 },
          bind: { dblclick: () => () => group.show(null) },
        },
        hooks: {
          setCursor: [(u) => this.#tell(u.cursor.idx)],
          setSelect: [(u) => this.#choose(u)],
          draw: [(u) => this.#mark(u)],
        },
      };
    }

    // The values, never so close that noise looks like a rise, and within what is possible.
    #range(low, high) {
      if (low == null) [low, high] = [0, 1];
      const span = Math.max(high - low, this.span, 1e-9 + 0.02 * Math.max(Math.abs(low), Math.abs(high)));
      const middle = (low + high) / 2;
      const [least, most] = this.limits;
      let [from, to] = [middle - 0.56 * span, middle + 0.56 * span];
      if (least != null && from < least) [from, to] = [least, Math.max(to, Math.min(least + span, most ?? Infinity))];
      if (most != null && to > most) [from, to] = [Math.min(from, Math.max(most - span, least ?? -Infinity)), most];
      return [from, to];
    }

    #choose(u) {
      const { left, width } = u.select;
      if (width < 6) return;
      u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
      this.group.show([u.posToVal(left, "x"), u.posToVal(left + width, "x")]);
    }

    // Beside the title the newest values, or those under the pointer, there with more about them.
    #tell(index) {
      const u = this.#plot;
      if (!u) return;
      const [x, ...columns] = u.data;
      const hovered = index != null && u.over.matches(":hover");
      const reach = Math.max(2, Math.ceil(x.length / 20));
      const rows = this.#lines.map((line, k) => {
        const at = nearest(columns[k], index ?? x.length - 1, index == null ? x.length : reach);
        return { ...line, value: at == null ? null : columns[k][at], raw: at == null ? null : columns[Math.max(0, k - 1)][at] };
      });
      const main = rows.filter(({ faint, level }) => !faint && !level);
      const compared = this.group.element.dataset.several !== undefined;
      this.value.textContent = compared || main.length > 1 ? "" : told(main[0]?.value); // else in the legend
      // Of several runs those without a value, too, so that nobody looks for their line; one may be new here.
      const empty = (run) => ({ label: this.group.nameOf(run), ...look(feedOf(run).colour ?? 1), value: null });
      const listed = compared
        ? this.group.runs.map((run) => main.find((line) => line.run === run) ?? empty(run))
        : main;
      this.legend.replaceChildren(...(compared || main.length > 1 ? listed.map((line) => this.#item(line)) : []));
      this.place.setAttribute("aria-label", `${this.title}: ${main.map(({ label, value }) => (main.length > 1 ? `${label} ${told(value)}` : told(value))).join(", ")}`);
      let tip = this.place.querySelector(".od-tip");
      if (!hovered) return tip?.remove();
      if (!tip) {
        tip = document.createElement("div");
        tip.className = "od-tip";
        this.place.append(tip);
      }
      const smooth = this.group.smoothing > 0;
      const title = document.createElement("b");
      title.textContent = this.group.x === "number" ? `Iteration ${told(x[index])}` : `${short(x[index])} control steps`;
      // A level of several runs is told once; those that each run has for itself, unless they are too many.
      const levels = new Set();
      const said = ({ level, own, value }) => !level || (own ? main.length < 4 : levels.size < levels.add(value).size);
      const items = rows.filter((line) => !line.faint && line.value != null && said(line)).map((line) => {
        const item = this.#item(line);
        if (smooth && !line.level) item.append(` (measured ${told(line.raw)})`);
        return item;
      });
      const near = this.#marks().filter(({ x: at }) => Math.abs(u.valToPos(at, "x") - u.cursor.left) < 7);
      tip.replaceChildren(title, ...items, ...near.map(({ text }) => Object.assign(document.createElement("span"), { textContent: text })));
      const left = u.over.offsetLeft + u.cursor.left;
      // Within the charts: beside them the robot's canvas would cover it.
      const [around, place] = [this.group.element.getBoundingClientRect(), this.place.getBoundingClientRect()];
      const [least, most] = [around.left - place.left, around.right - place.left - tip.offsetWidth];
      const before = left - 14 - tip.offsetWidth;
      const at = left > this.place.clientWidth / 2 && before >= least ? before : left + 14;
      tip.style.left = `${Math.max(least, Math.min(at, most))}px`;
    }

    #item({ label, stroke, dash, value }) {
      const item = document.createElement("span");
      const swatch = document.createElement("i");
      if (dash.length) swatch.style.borderTopStyle = dash[0] > 3 ? "dashed" : "dotted";
      swatch.style.color = stroke;
      item.append(swatch, `${label} `, Object.assign(document.createElement("em"), { textContent: told(value) }));
      return item;
    }

    #marks() {
      if (this.group.x !== "number" || this.group.feeds.length !== 1) return [];
      return this.group.feeds[0].marks.map(([after, kind, rater]) => ({
        x: after + 0.5, sign: SIGNS[kind] ?? "", text: rater ? `${rater} ${kind}` : kind[0].toUpperCase() + kind.slice(1),
      }));
    }

    // What happened in between: a line with a sign at its top; where the predictor was fitted anew, a stroke
    // at the axis.
    #mark(u) {
      const { ctx, bbox } = u;
      const ratio = uPlot.pxRatio;
      const inside = (at) => at >= bbox.left - 1 && at <= bbox.left + bbox.width + 1;
      ctx.save();
      ctx.strokeStyle = ctx.fillStyle = style("--od-muted");
      ctx.lineWidth = ratio;
      ctx.font = `${11 * ratio}px system-ui, sans-serif`;
      ctx.textAlign = "center";
      let [before, beside] = [null, 0];
      for (const { x, sign } of this.#marks()) {
        beside = x === before ? beside + 1 : 0; // what came at once stands in a row
        before = x;
        const at = Math.round(u.valToPos(x, "x", true)) + 0.5;
        if (!inside(at)) continue;
        ctx.setLineDash([2 * ratio, 3 * ratio]);
        ctx.beginPath();
        ctx.moveTo(at, bbox.top);
        ctx.lineTo(at, bbox.top + bbox.height);
        ctx.stroke();
        ctx.fillText(sign, at + 11 * beside * ratio, bbox.top - 3 * ratio);
      }
      if (this.group.x === "number" && this.group.feeds.length === 1) {
        const { number, snapshot } = this.group.feeds[0].columns;
        ctx.setLineDash([]);
        ctx.globalAlpha = 0.55;
        ctx.beginPath();
        number.forEach((n, k) => {
          const at = Math.round(u.valToPos(n, "x", true)) + 0.5;
          if (k && snapshot[k] === snapshot[k - 1] || !inside(at)) return;
          ctx.moveTo(at, bbox.top + bbox.height);
          ctx.lineTo(at, bbox.top + bbox.height - 5 * ratio);
        });
        ctx.stroke();
      }
      ctx.restore();
    }

    end() {
      this.watch.disconnect();
      this.#drop();
    }
  }

  function sweep() {
    for (const group of groups) if (!group.element.isConnected) group.end();
    groups = groups.filter(({ element }) => element.isConnected);
    for (const element of document.querySelectorAll(".od-charts"))
      if (!groups.some((group) => group.element === element)) groups.push(new Group(element));
  }

  new MutationObserver(sweep).observe(document.documentElement, { childList: true, subtree: true });
  document.addEventListener("visibilitychange", ask);
  setInterval(ask, settings.askMs);

  return { follow };
})();
