// The Data tab's list of single ratings: each can be looked at with its clip, and withdrawn with a reason.
// Everything that people wrote comes as JSON and is set as text.
(() => {
  "use strict";

  function element(tag, text = "", attributes = {}) {
    const made = document.createElement(tag);
    made.textContent = text;
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    return made;
  }

  const time = (at) => at.slice(0, 16).replace("T", " ");

  function row(rating) {
    const { event, value, rater, repeat, created_at, withdrawn, by } = rating;
    const made = element("tr", "", withdrawn === null ? {} : { class: "od-left-out" });
    const head = element("th", String(event), { scope: "row" });
    const stars = element("td");
    stars.append(element("b", String(value)), repeat ? " (asked again)" : "");
    const look = element("td");
    look.append(element("button", "Look", { type: "button", class: "od-button od-small", "data-look": event }));
    look.firstChild.addEventListener("click", (click) => open(click.target.closest(".od-given"), rating));
    const said = withdrawn === null ? "" : `Withdrawn${by ? ` by ${by}` : ""}: ${withdrawn}`;
    made.append(head, element("td", rater), stars, element("td", time(created_at)), element("td", said), look);
    return made;
  }

  // Fills the list anew, or adds what is older than its last row.
  async function load(place, older = false) {
    const [form, body, more] = ["form[data-ratings]", "tbody", "[data-more]"].map((part) => place.querySelector(part));
    const note = place.querySelector(".od-form-note");
    const query = new URLSearchParams({ run: form.dataset.ratings, rater: form.elements.of.value });
    const last = body.lastElementChild?.querySelector("th").textContent;
    if (older && last) query.set("before", last);
    try {
      const answer = await line.request(`ratings?${query}`, { cache: "no-store" });
      if (!answer.ok) throw new Error(await answer.text());
      const { ratings, more: left, raters } = await answer.json();
      const rows = ratings.map(row);
      older ? body.append(...rows) : body.replaceChildren(...rows);
      more.hidden = !left;
      body.closest(".od-scroll").hidden = !body.children.length;
      note.textContent = body.children.length ? "" : "There are no such ratings yet.";
      offer(form.elements.of, raters);
      offerBoxes(raters);
    } catch (error) {
      note.textContent = line.unanswered(error) ? "There is no answer from the server. Try again." : error.message;
    }
  }

  function offer(select, raters) {
    const { value } = select;
    const names = new Set(value ? [...raters, value] : raters);
    select.replaceChildren(new Option("anybody", ""), ...[...names].map((name) => new Option(name)));
    select.value = value;
  }

  // The raters of the filter below, each with a box to tick.
  function offerBoxes(raters) {
    const boxes = document.querySelector("[data-filter] .od-choose fieldset");
    const there = new Set([...boxes.querySelectorAll("input")].map(({ value }) => value));
    for (const name of raters.filter((one) => !there.has(one))) {
      const label = element("label");
      label.append(element("input", "", { type: "checkbox", name: "rater", value: name }), name);
      boxes.append(label);
    }
  }
  function sayChosen(boxes) {
    const names = [...boxes.querySelectorAll("input:checked")].map(({ value }) => value);
    const summary = boxes.closest("details").querySelector("summary");
    summary.textContent = names.length > 1 ? `${names.length} raters` : (names[0] ?? "anybody");
  }

  function open(place, { event, clip, value, rater, repeat, created_at, withdrawn, by }) {
    const dialog = place.querySelector("dialog");
    const [title, about, note] = ["h2", ".od-about", ".od-form-note"].map((part) => dialog.querySelector(part));
    const { answers, clips } = dialog.dataset;
    title.textContent = `${rater}: ${value}, ${answers.split("|")[value - 1]}`;
    about.textContent = `Rating ${event} of clip ${clip}, ${time(created_at)} UTC${repeat ? ", asked again" : ""}.`;
    note.textContent = withdrawn === null ? "" : `Withdrawn${by ? ` by ${by}` : ""}: ${withdrawn}`;
    const form = dialog.querySelector("[data-withdraw]");
    form.hidden = withdrawn !== null;
    form.reset();
    form.elements.rating.value = event;
    play(dialog, clip, clips);
  }

  // A clip in a dialog that opens with it.
  async function play(dialog, clip, clips) {
    const [seen, about] = [dialog.querySelector(".od-look"), dialog.querySelector(".od-about")];
    seen.replaceChildren();
    dialog.showModal();
    const source = clips.replace("CLIP", clip);
    const there = await fetch(source).then(({ ok }) => ok, () => false);
    if (!there) return (about.textContent += " Its picture cannot be shown now.");
    const template = dialog.closest(".od-given").querySelector("template");
    const player = template.content.firstElementChild.cloneNode(true);
    player.dataset.src = source;
    seen.replaceChildren(player);
  }

  // A clip that people disagree on, with what each of them said.
  function compare(button) {
    const dialog = document.querySelector(".od-dispute");
    const { clipLook: clip } = button.dataset;
    dialog.querySelector("h2").textContent = `Clip ${clip}`;
    dialog.querySelector(".od-about").textContent = "";
    dialog.querySelector(".od-said").replaceChildren(button.closest("li").querySelector(".od-opinions").cloneNode(true));
    play(dialog, clip, document.querySelector(".od-given [data-clips]").dataset.clips);
  }

  document.addEventListener("submit", (event) => {
    const form = event.target;
    if (!(form instanceof HTMLFormElement) || !form.matches("[data-ratings], [data-withdraw]")) return;
    event.preventDefault();
    const place = form.closest(".od-given");
    if (form.matches("[data-ratings]")) return load(place);
    const [button, note] = [form.querySelector("button"), form.closest("dialog").querySelector(".od-form-note")];
    button.disabled = true;
    page
      .act("withdraw", { rating: Number(form.elements.rating.value), reason: form.elements.reason.value })
      .then(
        () => (form.closest("dialog").close(), load(place)),
        (error) => (note.textContent = error.message),
      )
      .finally(() => (button.disabled = false));
  });
  document.addEventListener("change", (event) => {
    const boxes = event.target.closest?.(".od-choose fieldset");
    if (boxes) sayChosen(boxes);
    if (event.target.matches?.("[data-ratings] select")) load(event.target.closest(".od-given"));
  });
  document.addEventListener("click", (event) => {
    const look = event.target.closest?.("[data-clip-look]");
    if (look) compare(look);
    for (const list of document.querySelectorAll(".od-choose details[open]"))
      if (!list.contains(event.target)) list.open = false;
    if (event.target.matches?.(".od-given [data-more]")) load(event.target.closest(".od-given"), true);
  });

  // The tab has come into view.
  new MutationObserver(() => {
    const form = document.querySelector("[data-ratings]:not([data-loaded])");
    if (!form) return;
    form.dataset.loaded = "";
    load(form.closest(".od-given"));
  }).observe(document.documentElement, { childList: true, subtree: true });
})();
