// A new demonstration: a video is chosen, sent, trimmed and cropped, looked at as it would be learned from, and
// kept. The dialog stands outside what Viser draws, so it outlives a lost connection; closing it keeps its state.
//
// Times are seconds, the crop is shares of the picture's width and height: x, y, w, h.
const demos = (() => {
  "use strict";
  const { named } = page; // static/page.js
  const FRAME = 1 / 30; // of what is stored, and a step of the arrow keys
  const LEAST = 0.3; // seconds of a demo
  const LEAST_SIDE = 16; // pixels
  const WHOLE = { x: 0, y: 0, w: 1, h: 1 };
  const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

  let dialog = null;
  const part = (name) => dialog.querySelector(`[data-part="${name}"]`);
  let file, upload, sending, playable, start, end, length, crop;

  function open() {
    if (!dialog) {
      const template = document.querySelector("#od-new-demo");
      dialog = template.content.firstElementChild.cloneNode(true);
      document.body.append(dialog);
      listen();
      begin();
    }
    dialog.showModal();
  }

  function begin() {
    sending?.abort();
    if (file) URL.revokeObjectURL(part("video").src);
    [file, upload, sending, playable, start, end, length, crop] = [null, null, null, null, 0, 0, 0, { ...WHOLE }];
    part("file").value = "";
    part("video").removeAttribute("src");
    part("result").removeAttribute("src");
    part("mirror").checked = false;
    show("choose");
  }

  function show(step) {
    for (const section of dialog.querySelectorAll("[data-step]")) section.hidden = section.dataset.step !== step;
    part("steps").dataset.at = step;
    if (step !== "part") part("video").pause();
    if (step !== "result") part("result").pause();
  }

  const say = (text, bad = false) => {
    for (const note of dialog.querySelectorAll(".od-form-note")) {
      note.textContent = text;
      note.classList.toggle("od-bad", bad);
    }
  };

  // ---- 1: the file is played here at once, and sent meanwhile

  function choose(chosen) {
    begin();
    file = chosen;
    part("name").value = file.name.replace(/\.[^.]*$/, "").replace(/[^A-Za-z0-9_-]+/g, "-").replace(/^-+|-+$/g, "").slice(0, 64);
    part("video").src = URL.createObjectURL(file);
    say("");
    part("poster").hidden = part("video").hidden = true;
    part("frame").classList.add("od-empty");
    measure(0);
    show("part");
    send();
  }

  // What the browser makes of it: nothing is known of a video that it cannot play.
  function played(works) {
    if (playable !== null || !file) return;
    playable = works;
    part("video").hidden = !works;
    part("play").disabled = !works;
    if (!works) return still();
    part("frame").classList.remove("od-empty");
    const { duration } = part("video");
    measure(Number.isFinite(duration) ? duration : 0);
    part("video").play().catch(() => {});
  }

  function send() {
    const request = (sending = new XMLHttpRequest());
    const mine = () => sending === request;
    request.responseType = "text";
    request.upload.onprogress = ({ loaded, total }) => {
      const share = Math.floor((100 * loaded) / total);
      if (mine()) progress(share < 100 ? `Uploading: ${share} %` : "Uploaded. The server looks at it.", share);
    };
    request.onload = () => {
      if (!mine()) return;
      if (request.status !== 200) return failed(request.responseText);
      upload = JSON.parse(request.responseText);
      progress("");
      if (!length) measure(upload.seconds);
      if (playable === false) still();
      draw();
    };
    request.onerror = () => mine() && failed("The connection was lost during the upload. Please choose the video again.");
    request.open("POST", "demos");
    for (const [name, value] of Object.entries(named())) request.setRequestHeader(name, value);
    const form = new FormData();
    form.append("video", file);
    progress("Uploading");
    request.send(form);
    line.during(new Promise((over) => (request.onloadend = over)));
  }

  function failed(text) {
    begin();
    say(text || "The video could not be sent. Please try again.", true);
  }

  function progress(text, share = 0) {
    part("progress").textContent = text;
    part("progress").style.setProperty("--od-share", `${share}%`);
    part("show").disabled = !upload;
  }

  // A frame made by the server, for what this browser cannot play.
  let asked = 0;
  function still() {
    say("This browser cannot play the video. It can be used all the same: the picture is its frame where the part begins.");
    if (!upload) return;
    clearTimeout(asked);
    asked = setTimeout(() => {
      const poster = part("poster");
      poster.src = `demos/${upload.upload}/poster.jpg?at=${start.toFixed(3)}`;
      poster.hidden = false;
      part("frame").classList.remove("od-empty");
    }, 200);
  }

  // ---- 2: which part

  function measure(seconds) {
    length = seconds;
    [start, end] = [0, Math.min(seconds, 60)];
    draw();
  }

  function size() {
    const video = part("video");
    return upload ? [upload.width, upload.height] : [video.videoWidth || 1, video.videoHeight || 1];
  }

  function trim(which, value) {
    const least = Math.min(LEAST, length);
    if (which === "start") start = clamp(value, 0, end - least);
    else end = clamp(value, start + least, length);
    draw();
    if (playable) {
      part("video").pause();
      part("video").currentTime = which === "start" ? start : Math.max(start, end - FRAME);
    } else if (which === "start") still();
  }

  function setCrop(box) {
    const [width, height] = size();
    const w = clamp(box.w, Math.min(1, LEAST_SIDE / width), 1);
    const h = clamp(box.h, Math.min(1, LEAST_SIDE / height), 1);
    crop = { w, h, x: clamp(box.x, 0, 1 - w), y: clamp(box.y, 0, 1 - h) };
    draw();
  }

  const whole = () => crop.w > 0.999 && crop.h > 0.999;

  // The crop in pixels of the source.
  function pixels() {
    const [width, height] = size();
    const [x, y] = [Math.round(crop.x * width), Math.round(crop.y * height)];
    return [x, y, Math.min(width - x, Math.round(crop.w * width)), Math.min(height - y, Math.round(crop.h * height))];
  }

  function draw() {
    const trimmed = part("trim");
    const share = (seconds) => `${length ? (100 * seconds) / length : 0}%`;
    trimmed.style.setProperty("--od-from", share(start));
    trimmed.style.setProperty("--od-to", share(end));
    trimmed.hidden = !length;
    for (const [name, value] of [["start", start], ["end", end]]) {
      const handle = part(name);
      handle.setAttribute("aria-valuemin", "0");
      handle.setAttribute("aria-valuemax", length.toFixed(2));
      handle.setAttribute("aria-valuenow", value.toFixed(2));
      handle.setAttribute("aria-valuetext", `${value.toFixed(2)} s`);
      fill(part(`${name}-s`), value.toFixed(2));
    }
    part("lasts").textContent = length ? `${(end - start).toFixed(2)} s of ${length.toFixed(2)} s` : "";
    part("lasts").classList.toggle("od-bad", end - start > 60);
    const box = part("crop");
    for (const [name, value] of Object.entries({ left: crop.x, top: crop.y, width: crop.w, height: crop.h }))
      box.style[name] = `${100 * value}%`;
    const values = pixels();
    const sides = ["x", "y", "w", "h"];
    sides.forEach((side, k) => fill(part(`crop-${side}`), values[k]));
    box.setAttribute("aria-label", `Part of the picture: ${values[2]} x ${values[3]} pixels, from ${values[0]}, ${values[1]}`);
    box.classList.toggle("od-whole", whole());
    part("whole").disabled = whole();
    part("show").disabled = !upload;
  }

  // Not what somebody is typing.
  function fill(input, value) {
    if (document.activeElement !== input) input.value = value;
  }

  function cropped(event) {
    const box = part("frame").getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  }

  // Follows the pointer until it is let go.
  function drag(event, move) {
    event.preventDefault();
    const target = event.currentTarget;
    target.setPointerCapture(event.pointerId);
    target.addEventListener("pointermove", move);
    const up = () => {
      target.removeEventListener("pointermove", move);
      for (const name of ["pointerup", "pointercancel"]) target.removeEventListener(name, up);
    };
    for (const name of ["pointerup", "pointercancel"]) target.addEventListener(name, up);
  }

  // A corner, such as "nw", moved to a place.
  function corner(name, x, y) {
    const [right, bottom] = [crop.x + crop.w, crop.y + crop.h];
    const [width, height] = size();
    const [leastW, leastH] = [LEAST_SIDE / width, LEAST_SIDE / height];
    const left = name.includes("w") ? clamp(x, 0, right - leastW) : crop.x;
    const top = name.includes("n") ? clamp(y, 0, bottom - leastH) : crop.y;
    const w = name.includes("w") ? right - left : clamp(x, crop.x + leastW, 1) - crop.x;
    const h = name.includes("n") ? bottom - top : clamp(y, crop.y + leastH, 1) - crop.y;
    setCrop({ x: left, y: top, w, h });
  }

  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

  function listen() {
    const video = part("video");
    video.addEventListener("loadeddata", () => played(video.videoWidth > 0));
    video.addEventListener("error", () => video.getAttribute("src") && played(false));
    video.addEventListener("timeupdate", () => {
      part("trim").style.setProperty("--od-at", `${length ? (100 * video.currentTime) / length : 0}%`);
      if (!video.paused && (video.currentTime >= end || video.currentTime < start - FRAME)) video.currentTime = start;
    });
    video.addEventListener("ended", () => {
      video.currentTime = start;
      video.play().catch(() => {});
    });
    for (const name of ["play", "pause"])
      video.addEventListener(name, () => (part("play").textContent = video.paused ? "Play the part" : "Pause"));

    for (const which of ["start", "end"]) {
      const at = (event) => {
        const box = part("trim").getBoundingClientRect();
        trim(which, clamp((event.clientX - box.left) / box.width, 0, 1) * length);
      };
      const handle = part(which);
      handle.addEventListener("pointerdown", (event) => (handle.focus(), drag(event, at)));
      handle.addEventListener("keydown", (event) => {
        const now = which === "start" ? start : end;
        const steps = { ArrowLeft: -FRAME, ArrowDown: -FRAME, ArrowRight: FRAME, ArrowUp: FRAME, PageDown: -1, PageUp: 1 };
        const step = (steps[event.key] ?? 0) * (event.shiftKey ? 10 : 1);
        const to = event.key === "Home" ? 0 : event.key === "End" ? length : now + step;
        if (!step && to === now) return;
        event.preventDefault();
        trim(which, to);
      });
      part(`${which}-s`).addEventListener("change", (event) => {
        const typed = Number(event.target.value);
        if (length) trim(which, Number.isFinite(typed) ? typed : 0);
        else if (which === "start") start = Math.max(0, typed);
        else end = Math.max(0, typed);
        event.target.blur();
        draw();
      });
    }

    const box = part("crop");
    box.addEventListener("pointerdown", (event) => {
      if (event.target !== box) return;
      box.focus();
      const [x, y] = cropped(event);
      const from = { ...crop };
      drag(event, (moved) => {
        const [toX, toY] = cropped(moved);
        setCrop({ ...from, x: from.x + toX - x, y: from.y + toY - y });
      });
    });
    box.addEventListener("keydown", (event) => {
      const way = ARROWS[event.key];
      if (!way) return;
      event.preventDefault();
      const [width, height] = size();
      const step = event.shiftKey ? 10 : 1;
      const [dx, dy] = [(way[0] * step) / width, (way[1] * step) / height];
      const name = event.target.dataset.corner;
      if (!name) return setCrop({ ...crop, x: crop.x + dx, y: crop.y + dy });
      corner(name, crop.x + (name.includes("e") ? crop.w : 0) + dx, crop.y + (name.includes("s") ? crop.h : 0) + dy);
    });
    for (const handle of box.querySelectorAll("[data-corner]"))
      handle.addEventListener("pointerdown", (event) => {
        event.stopPropagation();
        handle.focus();
        drag(event, (moved) => corner(handle.dataset.corner, ...cropped(moved)));
      });
    for (const [side, across] of [["x", 0], ["y", 1], ["w", 0], ["h", 1]])
      part(`crop-${side}`).addEventListener("change", (event) => {
        event.target.blur();
        setCrop({ ...crop, [side]: Number(event.target.value) / size()[across] });
      });

    part("file").addEventListener("change", (event) => event.target.files[0] && choose(event.target.files[0]));
    const drop = part("drop");
    for (const name of ["dragover", "dragleave", "drop"])
      drop.addEventListener(name, (event) => {
        event.preventDefault();
        drop.classList.toggle("od-over", name === "dragover");
        if (name === "drop" && event.dataTransfer.files[0]) choose(event.dataTransfer.files[0]);
      });
    const press = { close: () => dialog.close(), again: () => (discard(), begin()), whole: () => setCrop(WHOLE), back: () => show("part"),
      play: () => (video.paused ? (video.currentTime = start, video.play()) : video.pause()), show: result, run: () => startRun(part("run").dataset.name) };
    for (const [name, act] of Object.entries(press))
      for (const button of dialog.querySelectorAll(`[data-press="${name}"]`)) button.addEventListener("click", act);
    part("keep").addEventListener("submit", keep);
  }

  // ---- 3: what it would be

  async function post(where, body) {
    const answer = await line.request(`demos/${upload.upload}/${where}`, {
      method: "POST", signal: null, headers: { "Content-Type": "application/json", ...named() },
      body: JSON.stringify(body ?? {}),
    });
    if (!answer.ok) throw new Error(await answer.text());
    return answer;
  }

  async function result() {
    const of = upload;
    part("show").disabled = true;
    say("The part is being brought in: some seconds.");
    const body = {
      start: start || null,
      end: end && (!length || end < length - FRAME / 2) ? end : null,
      crop: whole() ? null : pixels(),
      mirror: part("mirror").checked,
    };
    try {
      const facts = await (await line.during(post("result", body))).json();
      if (of !== upload) return;
      say("");
      part("result").src = `demos/${of.upload}/result-${facts.result}.webm`;
      part("facts").replaceChildren(
        ...[["Length", `${facts.seconds.toFixed(2)} s`], ["Frames", `${facts.frames}`], ["Rate", `${facts.fps} a second`],
          ["Size", `${facts.width} x ${facts.height} pixels`]].map(([term, value]) => {
          const pair = document.createElement("div");
          const [dt, dd] = [document.createElement("dt"), document.createElement("dd")];
          [dt.textContent, dd.textContent] = [term, value];
          pair.append(dt, dd);
          return pair;
        }),
      );
      const told = [...facts.warnings];
      if (facts.known) told.unshift(`This video is a demo already, called ${facts.known}. Keeping it adds nothing.`);
      part("warnings").replaceChildren(
        ...told.map((text) => Object.assign(document.createElement("li"), { textContent: text })),
      );
      show("result");
      part("result").play().catch(() => {});
      part("name").focus();
    } catch (error) {
      say(error.message, true);
    } finally {
      part("show").disabled = !upload;
    }
  }

  async function keep(event) {
    event.preventDefault();
    const name = part("name").value.trim();
    const note = part("name-wrong");
    note.textContent = /^[A-Za-z0-9_-]{1,64}$/.test(name) ? "" : "A name is 1 to 64 letters, digits, - or _.";
    if (note.textContent) return part("name").focus();
    try {
      const kept = await (await post(`keep?name=${encodeURIComponent(name)}`)).json();
      part("kept").textContent = kept.known ? `It was a demo already: ${kept.name}.` : `${kept.name} is a demo now.`;
      part("run").dataset.name = kept.name;
      offer(kept.name);
      upload = null;
      show("kept");
      part("run").focus();
    } catch (error) {
      note.textContent = error.message;
    }
  }

  function discard() {
    if (upload) post("discard").catch(() => {}); // else it goes by itself after an hour
  }

  // ---- 4: and then

  function offer(name) {
    const choice = document.querySelector(".od-new-run select[name=demo]");
    if (choice && ![...choice.options].some((option) => option.value === name)) choice.add(new Option(name));
    if (!choice) return;
    choice.value = name;
    choice.dispatchEvent(new Event("change", { bubbles: true })); // its robot is chosen with it
  }

  function startRun(name) {
    if (dialog?.open) {
      dialog.close();
      begin();
    }
    offer(name);
    const form = document.querySelector(".od-new-run");
    form.scrollIntoView({ block: "start", behavior: matchMedia("(prefers-reduced-motion: reduce)").matches ? "auto" : "smooth" });
    form.querySelector("select[name=demo]").focus({ preventScroll: true });
  }

  document.addEventListener("click", (event) => {
    const button = event.target instanceof Element ? event.target.closest("button") : null;
    if (button?.dataset.newDemo !== undefined) open();
    else if (button?.dataset.runWith) startRun(button.dataset.runWith);
  });

  return { startRun };
})();
