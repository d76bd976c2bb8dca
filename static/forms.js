// Buttons and forms of a researcher: actions on a run, the filter of the Data tab, uploads.
(() => {
  "use strict";
  const { act, named } = page; // static/page.js

  document.addEventListener("click", (event) => {
    const button = event.target instanceof Element ? event.target.closest("button") : null;
    if (!button || button.disabled) return;
    const data = button.dataset;
    if (data.do) {
      button.disabled = true; // until the page is drawn anew
      const { do: action, ...fields } = data;
      if (fields.rater) fields.rater = Number(fields.rater);
      act(action, fields).catch((error) => {
        button.disabled = false;
        button.textContent = error.message;
      });
    } else if (data.compare) compare(data.compare);
  });

  // A run on or off the charts: what is written in the field says which are there.
  function compare(run) {
    const field = document.querySelector("div:has(> .od-runs) ~ div input");
    const on = [...document.querySelectorAll('[data-compare][aria-pressed="true"]')].map((b) => b.dataset.compare);
    const runs = on.includes(run) ? on.filter((name) => name !== run) : [...on, run];
    // React sees a change only through the element's own setter.
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(field, runs.join(", "));
    field.dispatchEvent(new Event("input", { bubbles: true }));
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
  // A form that is an action.
  document.addEventListener("submit", (event) => {
    const form = event.target.closest?.("[data-act]");
    if (!form) return;
    event.preventDefault();
    const place = form.parentElement.querySelector(".od-form-note");
    const fields = Object.fromEntries(new FormData(form));
    for (const input of form.querySelectorAll("[type=number]")) fields[input.name] = Number(input.value);
    place.textContent = "One moment: the current run finishes its iteration first.";
    act(form.dataset.act, fields).catch((error) => (place.textContent = error.message));
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
      place.textContent = share < 100 ? `Uploading: ${share} %` : "Upload complete; the video is being checked.";
    };
    request.onload = () => {
      if (request.status !== 200) return done(request.responseText);
      const choice = document.querySelector(".od-new-run select[name=demo]");
      const name = request.getResponseHeader("X-Demo");
      if (choice && ![...choice.options].some((option) => option.value === name)) choice.add(new Option(name));
      if (choice) choice.value = name;
      form.reset();
      done(request.responseText);
    };
    request.onerror = () => done("The connection was lost during the upload. Please try again.");
    request.open("POST", form.dataset.upload);
    for (const [name, value] of Object.entries(named())) request.setRequestHeader(name, value);
    button.disabled = true;
    place.textContent = "Uploading";
    request.send(new FormData(form));
    line.during(new Promise((over) => (request.onloadend = over)));
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
})();
