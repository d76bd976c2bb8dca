// A new demonstration: a video is chosen, sent, trimmed and cropped, looked at as it would be learned from, and
// kept. The dialog stands outside what Viser draws, so it outlives a lost connection; closing it keeps its state.
// Which part of the video is wanted, and its handles: static/demo-part.js. How it is played, and what comes of it:
// static/demo-result.js.
const demos = (() => {
  "use strict";
  const { named } = page; // static/page.js
  const FRAME = 1 / 30; // of what is stored

  let dialog = null;
  const part = (name) => dialog.querySelector(`[data-part="${name}"]`);
  let file, upload, sending, playable, wanted, preview;

  function open() {
    if (!dialog) {
      const template = document.querySelector("#od-new-demo");
      dialog = template.content.firstElementChild.cloneNode(true);
      document.body.append(dialog);
      wanted = demoPart(part, { upright, moved });
      preview = demoResult(part, { bring, place });
      listen();
      dialog.addEventListener("demo-result", ({ detail }) => {
        moves.begin(dialog, upload.upload, detail.facts, part("result").src);
      });
      begin();
    }
    dialog.showModal();
  }

  function begin() {
    sending?.abort();
    if (file) URL.revokeObjectURL(part("video").src);
    [file, upload, sending, playable] = [null, null, null, null];
    wanted.begin();
    preview.begin();
    part("file").value = "";
    part("video").removeAttribute("src");
    show("choose");
  }

  function show(step) {
    for (const section of dialog.querySelectorAll("[data-step]")) section.hidden = section.dataset.step !== step;
    part("steps").dataset.at = step;
    if (step !== "part") part("video").pause();
    if (step !== "result") part("result").pause();
    if (step !== "result") moves.end(); // static/mask.js
  }

  const say = (text, bad = false) => {
    for (const note of dialog.querySelectorAll(":is([data-step=choose], [data-step=part]) > .od-form-note")) {
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
    wanted.measure(0);
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
    wanted.measure(Number.isFinite(duration) ? duration : 0);
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
      if (!wanted.length) wanted.measure(upload.seconds);
      if (playable === false) still();
      wanted.draw();
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
      poster.src = `demos/${upload.upload}/poster.jpg?at=${wanted.start.toFixed(3)}`;
      poster.hidden = false;
      part("frame").classList.remove("od-empty");
    }, 200);
  }

  // ---- 2: which part

  function upright() {
    const video = part("video");
    return upload ? [upload.width, upload.height] : [video.videoWidth || 1, video.videoHeight || 1];
  }

  function moved(which) {
    if (playable) {
      part("video").pause();
      part("video").currentTime = which === "start" ? wanted.start : Math.max(wanted.start, wanted.end - FRAME);
    } else if (which === "start") still();
  }

  function listen() {
    const video = part("video");
    video.addEventListener("loadeddata", () => played(video.videoWidth > 0));
    video.addEventListener("error", () => video.getAttribute("src") && played(false));
    video.addEventListener("timeupdate", () => {
      const { start, end, length } = wanted;
      part("trim").style.setProperty("--od-at", `${length ? (100 * video.currentTime) / length : 0}%`);
      if (!video.paused && (video.currentTime >= end || video.currentTime < start - FRAME)) video.currentTime = start;
    });
    video.addEventListener("ended", () => {
      video.currentTime = wanted.start;
      video.play().catch(() => {});
    });
    for (const name of ["play", "pause"])
      video.addEventListener(name, () => (part("play").textContent = video.paused ? "Play the part" : "Pause"));

    part("file").addEventListener("change", (event) => event.target.files[0] && choose(event.target.files[0]));
    const drop = part("drop");
    for (const name of ["dragover", "dragleave", "drop"])
      drop.addEventListener(name, (event) => {
        event.preventDefault();
        drop.classList.toggle("od-over", name === "dragover");
        if (name === "drop" && event.dataTransfer.files[0]) choose(event.dataTransfer.files[0]);
      });
    const press = { close: () => dialog.close(), again: () => (discard(), begin()), whole: wanted.setWhole, turn: wanted.turn, back: () => show("part"),
      play: () => (video.paused ? (video.currentTime = wanted.start, video.play()) : video.pause()), show: result, run: () => startRun(part("run").dataset.name) };
    for (const [name, act] of Object.entries(press))
      for (const button of dialog.querySelectorAll(`[data-press="${name}"]`)) button.addEventListener("click", act);
    part("keep").addEventListener("submit", keep);
  }

  // ---- 3: what it would be

  async function post(where, body) {
    const answer = await line.request(`demos/${upload.upload}/${where}`, {
      method: "POST", signal: null, headers: { "Content-Type": "application/json", ...named() },
      body: JSON.stringify(body ?? {}),
    }).catch((error) => {
      throw line.unanswered(error) ? new Error("The server does not answer. Nothing is lost: please try again.") : error;
    });
    if (!answer.ok) throw new Error(await answer.text());
    return answer;
  }

  const place = () => `demos/${upload.upload}`;

  // What the server makes of the part with these options.
  async function bring(options) {
    const of = upload;
    const facts = await (await line.during(post("result", { ...wanted.chosen(), ...options }))).json();
    if (of !== upload) throw new Error("Another video was chosen.");
    return facts;
  }

  async function result() {
    const of = upload;
    part("show").disabled = true;
    say("The part is being brought in: some seconds.");
    try {
      await preview.show();
      if (of !== upload) return;
      say("");
      show("result");
      part("result").focus();
    } catch (error) {
      if (of === upload) say(error.message, true);
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
