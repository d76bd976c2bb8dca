// Buttons and forms of a researcher: runs and demos, the filter of the Data tab. New videos are in
// static/demos.js; films in static/watch.js.
(() => {
  "use strict";
  const { act } = page; // static/page.js

  document.addEventListener("click", (event) => {
    const button = event.target instanceof Element ? event.target.closest("button") : null;
    if (!button || button.disabled) return;
    const data = button.dataset;
    if (data.do) {
      button.disabled = true; // until the page is drawn anew
      const { do: action, said, ...fields } = data;
      if (fields.rater) fields.rater = Number(fields.rater);
      if (action === "open run") tell("One moment: the run at hand finishes its iteration first.");
      line.during(act(action, fields)).then(
        () => said && tell(said),
        (error) => {
          button.disabled = false;
          if (action === "open run") tell(plain(error.message));
          else button.textContent = error.message;
        },
      );
    } else if (data.compare) compare(data.compare);
    else if ("compareNone" in data) compareOnly([""]);
    else if ("compareUsual" in data) compareOnly([]);
    else if (data.editRun) editRun(data);
    else if (data.editDemo) editDemo(data);
    else if (data.jump) document.getElementById(data.jump)?.scrollIntoView({ block: "start" });
    else if ("close" in data) button.closest("dialog").close();
  });

  // A word on what was done, at the bottom edge; it outlives what Viser draws.
  let gone = 0;
  function tell(text) {
    let note = document.querySelector("body > .od-told");
    if (!note) {
      note = document.createElement("p");
      note.className = "od-told";
      note.setAttribute("role", "status");
      document.body.append(note);
    }
    note.textContent = text;
    clearTimeout(gone);
    gone = setTimeout(() => note.remove(), 12000);
  }

  const plain = (text) => {
    const said = text.replace(/^This could not be done: /, "");
    return said.charAt(0).toUpperCase() + said.slice(1);
  };

  // Which runs are compared: their names, in a field that Viser sends on and nobody sees; "," is none. The
  // address says the same (static/address.js).
  const compareField = () => document.querySelector("div:has(> .od-runs) + div input");
  function compareOnly(runs) {
    const none = runs.length === 1 && !runs[0];
    address.compared = runs.length ? runs.join(",") : null;
    const field = compareField();
    // React sees a change only through the element's own setter.
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(field, none ? "," : runs.join(", "));
    field.dispatchEvent(new Event("input", { bubbles: true }));
  }
  // When the tab comes: what the address says, or else what was compared before is said in it.
  let fieldBefore = null;
  function compareAsAddressed() {
    const field = compareField();
    if (field === fieldBefore) return;
    fieldBefore = field;
    if (!field) return;
    if (address.compared !== null) compareOnly(address.compared.split(","));
    else if (field.value) address.compared = field.value.split(",").map((name) => name.trim()).filter(Boolean).join(",");
  }
  new MutationObserver(compareAsAddressed).observe(document.documentElement, { childList: true, subtree: true });
  window.addEventListener("popstate", () => {
    if (compareField() && address.compared !== null) compareOnly(address.compared.split(","));
  });
  function compare(run) {
    const on = [...document.querySelectorAll('[data-compare][aria-pressed="true"]')].map((b) => b.dataset.compare);
    const runs = on.includes(run) ? on.filter((name) => name !== run) : [...on, run];
    compareOnly(runs.length ? runs : [""]);
  }

  // Dialogs of their own, outside what Viser draws anew.
  function dialogOf(template, name) {
    const dialog = document.getElementById(template).content.firstElementChild.cloneNode(true);
    dialog.querySelector("[data-name]").textContent = name;
    dialog.addEventListener("close", () => dialog.remove());
    document.body.append(dialog);
    dialog.showModal();
    return dialog;
  }

  // What a dialog's button does: the dialog closes, or says why it cannot be.
  function doing(dialog, action, fields, said) {
    const note = dialog.querySelector(".od-form-note");
    act(action, fields).then(
      () => (dialog.close(), tell(said)),
      (error) => (note.textContent = plain(error.message)),
    );
  }

  // A button that asks once more before it deletes something.
  function asking(button, text, again, done) {
    button.textContent = text;
    button.addEventListener("click", () => {
      if ("asked" in button.dataset) return done();
      button.dataset.asked = "";
      button.textContent = again;
    });
    button.addEventListener("blur", () => {
      delete button.dataset.asked;
      button.textContent = text;
    });
  }

  const count = (number, one) => `${Number(number).toLocaleString("en")} ${one}${Number(number) === 1 ? "" : "s"}`;

  function editRun({ editRun: run, title, note, rated: ratings, comparisons, here }) {
    const dialog = dialogOf("od-edit-run", run);
    const form = dialog.querySelector("form");
    [form.elements.title.value, form.elements.note.value] = [title, note];
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      const fields = { run, title: form.elements.title.value, note: form.elements.note.value };
      doing(dialog, "describe run", fields, "Saved.");
    });
    dialog.querySelector("[data-free]").hidden = Boolean(here);
    dialog.querySelector("[data-kept]").hidden = !here;
    const people = [Number(ratings) && count(ratings, "rating"), Number(comparisons) && count(comparisons, "comparison")].filter(Boolean);
    const what = people.length ? ` with ${people.join(" and ")} that people gave` : "";
    dialog.querySelector("[data-what]").textContent =
      `The run ${run} goes${what}, with its clips, reward models, films and policy.`;
    const save = dialog.querySelector("[data-export]");
    save.href = `export.zip?run=${encodeURIComponent(run)}`;
    save.hidden = !people.length;
    const button = dialog.querySelector("[data-delete]");
    const gone = people.length ? `Delete the run and its ${people.join(" and ")}` : "Delete the run";
    asking(button, gone, "Press again to delete it for good", () =>
      doing(dialog, "delete run", { run }, `The run ${run} is deleted.`));
  }

  function editDemo({ editDemo: demo, runs }) {
    const dialog = dialogOf("od-edit-demo", demo);
    const form = dialog.querySelector("form");
    form.elements.name.value = demo;
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      const name = form.elements.name.value.trim();
      doing(dialog, "rename demo", { demo, name }, `${demo} is called ${name} now.`);
    });
    const used = Number(runs) > 0;
    dialog.querySelector("[data-free]").hidden = used;
    dialog.querySelector("[data-kept]").hidden = !used;
    asking(dialog.querySelector("[data-delete]"), "Remove it", "Press again to remove it for good", () =>
      doing(dialog, "remove demo", { demo }, `${demo} is removed.`));
  }

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
    fetch(`preview${query(form)}`).then(async (answer) => {
      const text = await answer.text();
      if (!answer.ok) return (place.textContent = text);
      place.replaceChildren(...new DOMParser().parseFromString(text, "text/html").body.childNodes);
    });
  });
  // A form that is an action. What is wrong is said in one sentence at the field that it is about.
  document.addEventListener("submit", (event) => {
    const form = event.target.closest?.("[data-act]");
    if (!form) return;
    event.preventDefault();
    const inputs = [...form.elements].filter((input) => input.name);
    for (const input of inputs) wrong(input, "");
    const bad = inputs.filter((input) => !input.checkValidity());
    for (const input of bad) wrong(input, input.dataset.wrong ?? input.validationMessage);
    if (bad.length) return bad[0].focus();
    const place = (form.closest("section") ?? form.parentElement).querySelector(".od-form-note");
    const fields = Object.fromEntries(new FormData(form));
    for (const { name, value } of form.querySelectorAll("[type=number]")) fields[name] = value === "" ? null : Number(value);
    const button = form.querySelector("button:not([type=button])");
    button.disabled = true;
    place.textContent = "One moment: the current run finishes its iteration first.";
    line.during(act(form.dataset.act, fields)).then(
      () => {
        place.textContent = "";
        if (form.dataset.done) tell(form.dataset.done);
      },
      (error) => {
        const said = error.message;
        const about = inputs.find(({ name, dataset }) =>
          name.includes(".") ? said.includes(name) : dataset.says && new RegExp(`: (a )?${dataset.says}|\\b${dataset.says}\\b`).test(said));
        place.textContent = about ? "" : plain(said);
        if (!about) return;
        wrong(about, plain(said.replace(about.name, about.dataset.label ?? about.name)));
        about.focus();
      },
    ).finally(() => (button.disabled = false));
  });

  // A demo that shows a robot is learned by that robot alone: the one is chosen with the other.
  document.addEventListener("change", (event) => {
    const form = event.target.closest?.(".od-new-run form");
    if (!form || !["demo", "env"].includes(event.target.name)) return;
    const [robot, demos] = [form.elements.env, form.elements.demo];
    const shown = demos.selectedOptions[0]?.dataset.of;
    if (event.target === demos && shown && [...robot.options].some((o) => o.value === shown)) robot.value = shown;
    for (const option of demos.options) option.disabled = Boolean(option.dataset.of) && option.dataset.of !== robot.value;
    if (demos.selectedOptions[0]?.disabled) demos.value = [...demos.options].find((o) => !o.disabled)?.value ?? "";
  });

  // The sentence at a field; none if it is empty.
  function wrong(input, text) {
    const field = input.closest(".od-field");
    if (!field) return;
    let note = field.querySelector(".od-field-wrong");
    if (!text) {
      note?.remove();
      input.removeAttribute("aria-invalid");
      return;
    }
    if (!note) {
      note = document.createElement("small");
      note.className = "od-field-wrong";
      note.setAttribute("role", "alert");
      input.after(note);
    }
    note.textContent = text;
    input.setAttribute("aria-invalid", "true");
  }
  document.addEventListener("input", (event) => {
    const form = event.target.closest?.("[data-filter]");
    if (!form) return;
    for (const link of form.parentElement.querySelectorAll("[data-filtered]"))
      link.href = link.dataset.filtered + query(form);
    const run = new URLSearchParams(query(form)).get("run");
    for (const link of form.parentElement.querySelectorAll("[data-of-run]"))
      link.href = link.dataset.ofRun + (run ? `?run=${encodeURIComponent(run)}` : "");
  });
})();
