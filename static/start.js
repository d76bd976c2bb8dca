// The Start tab: inviting people, the links that were made, and ending them; and what else leads to a place on
// the page. Who may do what is decided by the server (app/http/commands.py).
(() => {
  "use strict";
  const { act } = page; // static/page.js
  const within = (event, selector) => (event.target instanceof Element ? event.target.closest(selector) : null);

  function toTab(title) {
    const tabs = [...document.querySelectorAll(".od-tabs > *")];
    tabs.find((tab) => tab.textContent.trim() === title)?.click();
  }

  function goTo(place) {
    const section = document.querySelector(`[data-place="${place}"]`);
    section?.scrollIntoView({ block: "start" });
    section?.querySelector("textarea, input")?.focus();
  }

  // The page's own address without the person: what links begin with if nobody says otherwise.
  const address = () => location.origin + location.pathname.replace(/\/r\/\d+\/.*$/, "");

  // Viser draws everything anew when a phone is turned: the links must not go with that.
  let made = [];

  async function invite(fields, place) {
    const note = place.querySelector(".od-form-note");
    note.textContent = "";
    try {
      const answer = await act("invite", fields);
      made = [...new DOMParser().parseFromString(await answer.text(), "text/html").body.childNodes];
      const links = place.querySelector(".od-invited");
      links.replaceChildren(...made);
      links.scrollIntoView({ block: "nearest" });
      return true;
    } catch (error) {
      note.textContent = error.message;
      return false;
    }
  }

  document.addEventListener("submit", (event) => {
    const form = within(event, "[data-invite]");
    if (!form) return;
    event.preventDefault();
    const { names, role, expires, after, address: where, once } = form.elements;
    const button = form.querySelector(".od-primary");
    button.disabled = true;
    const ends = expires.value === "other" ? after.value : expires.value;
    const fields = { names: names.value, role: role.value, expires: ends, once: once.checked, address: where.value };
    invite(fields, form.parentElement)
      .then((made) => made && (names.value = ""))
      .finally(() => (button.disabled = false));
  });

  document.addEventListener("change", (event) => {
    const form = within(event, "[data-invite]");
    if (!form) return;
    const { expires, after } = form.elements;
    after.closest("label").hidden = expires.value !== "other";
    after.required = expires.value === "other";
  });

  const linksIn = (list) =>
    [...list.querySelectorAll("li")].map((item) => `${item.dataset.name}\t${item.querySelector("input").value}`).join("\n");

  // Over plain HTTP a page gets no clipboard, and over any it may be refused.
  async function copy(text) {
    if (await navigator.clipboard?.writeText(text).then(() => true, () => false)) return;
    const field = document.createElement("textarea");
    field.value = text;
    field.style.cssText = "position: fixed; top: 0; opacity: 0";
    (document.querySelector("dialog[open]") ?? document.body).append(field);
    field.select();
    const done = document.execCommand("copy");
    field.remove();
    if (!done) throw new Error("not copied");
  }

  function say(button, text) {
    button.dataset.was ??= button.textContent;
    button.textContent = text;
    setTimeout(() => (button.textContent = button.dataset.was), 2000);
  }

  function save(text) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([`${text}\n`], { type: "text/plain" }));
    link.download = "onedemo-links.txt";
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  }

  // Asks before something is ended that cannot be taken back.
  let ending = null;
  function ask(button) {
    const { revoke, revokeLink, name, me } = button.dataset;
    ending = revoke ? ["revoke", { rater: Number(revoke) }] : ["revoke link", { link: Number(revokeLink) }];
    if (me !== undefined) ending[1].sure = true;
    const dialog = document.querySelector(".od-sure");
    const [title, text] = dialog.querySelectorAll("h2, p");
    title.textContent = revoke ? `Revoke ${name}?` : `Revoke link ${revokeLink} of ${name}?`;
    text.textContent =
      me === undefined
        ? "The open pages close within seconds, and the link opens no more. The ratings stay. You can make a new link afterwards."
        : "This is you: this page closes within seconds, too. If you are the only researcher, only the command line " +
          "of the server (onedemo rater add) can let you in again.";
    dialog.querySelector(".od-form-note").textContent = "";
    dialog.showModal();
  }

  function end(button) {
    const dialog = button.closest("dialog");
    button.disabled = true;
    act(...ending)
      .then(
        () => dialog.close(),
        (error) => (dialog.querySelector(".od-form-note").textContent = error.message),
      )
      .finally(() => (button.disabled = false));
  }

  document.addEventListener("click", (event) => {
    const button = within(event, "button");
    if (!button || button.disabled) return;
    const data = button.dataset;
    if (data.to) toTab(data.to);
    else if (data.goto) goTo(data.goto);
    else if (data.revoke || data.revokeLink) ask(button);
    else if (button.matches(".od-sure [data-sure]")) end(button);
    else if ("copy" in data) {
      const text = data.copy === "all" ? linksIn(button.closest(".od-links")) : button.closest("li").querySelector("input").value;
      copy(text).then(
        () => say(button, "Copied"),
        () => say(button, "Select it and copy it"),
      );
    } else if ("save" in data) save(linksIn(button.closest(".od-links")));
    else if ("qr" in data) {
      const code = button.nextElementSibling;
      code.hidden = !code.hidden;
      button.setAttribute("aria-expanded", !code.hidden);
    } else if ("linksClose" in data) {
      made = [];
      button.closest(".od-links").remove();
    } else if (data.relink) {
      const place = document.querySelector('[data-place="invite"]');
      const { value } = place.querySelector("[name=address]");
      invite({ names: data.relink, role: data.role, expires: "", once: false, address: value }, place);
    }
  });
  document.addEventListener("focusin", (event) => within(event, ".od-links input")?.select());

  // Figures are drawn anew while somebody reads them: what had the focus gets it back.
  const NAMED = ["do", "rater", "revoke", "revokeLink", "relink", "to", "goto"];
  let focused = null;
  document.addEventListener("focusin", (event) => (focused = within(event, ".od-data button")));
  new MutationObserver(() => {
    const place = document.querySelector("[data-invite] [name=address]:not([placeholder])");
    if (place) {
      place.placeholder = address();
      place.closest(".od-invite").querySelector(".od-invited").replaceChildren(...made);
    }
    if (!focused || focused.isConnected) return;
    const { dataset } = focused;
    focused = null;
    if (document.activeElement !== document.body) return;
    const known = NAMED.filter((name) => name in dataset);
    const same = [...document.querySelectorAll(".od-data button")].filter((button) =>
      known.every((name) => button.dataset[name] === dataset[name]),
    );
    if (known.length && same.length === 1) same[0].focus({ preventScroll: true });
  }).observe(document.documentElement, { childList: true, subtree: true });
})();
