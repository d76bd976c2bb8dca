// What a video would be as a demonstration: how it is played, and a preview that follows each change. For
// static/demos.js.
//
// part(name) gives an element of the dialog. hooks: bring(options) has the server make the result and resolves to
// its facts, rejected with a sentence; place() is where the server keeps it.
//
// Whoever else wants to look at the result listens for "demo-result", an event that bubbles from the dialog, with
// place, facts and options as its detail; its place is data-part="more".
function demoResult(part, hooks) {
  "use strict";
  const WAIT = 350; // milliseconds after a change, in which another may follow
  const SWITCHES = ["reverse", "mirror", "track", "stabilise"];
  const USUAL = { speed: 1, loop: "1", reverse: false, mirror: false, track: false, stabilise: false };
  const calm = matchMedia("(prefers-reduced-motion: reduce)");
  let shown = null; // the options of the preview, once there is one
  let work = null; // while a result is made: a promise
  let again = false; // whether another is wanted by now
  let [due, videos] = [0, 0];

  function wait(then) {
    clearTimeout(due);
    due = then ? setTimeout(() => ((due = 0), then()), WAIT) : 0;
  }

  function begin() {
    wait();
    videos += 1;
    [shown, work, again] = [null, null, false];
    fill(USUAL);
    clear();
    say("");
  }

  function clear() {
    part("result").removeAttribute("src");
    for (const name of ["first", "last"]) part(name).removeAttribute("src");
    part("facts").replaceChildren();
    part("warnings").replaceChildren();
  }

  // ---- what is chosen

  function fill(options) {
    part("speed").value = options.speed;
    part("loop").value = options.loop;
    for (const name of SWITCHES) part(name).checked = options[name];
    speedWrong();
  }

  function read() {
    const options = { speed: part("speed").valueAsNumber, loop: part("loop").value };
    for (const name of SWITCHES) options[name] = part(name).checked;
    return options;
  }

  const sent = ({ loop, ...options }) => ({ ...options, loop: loop === "fill" ? true : Number(loop) });
  const same = (one, other) => one && Object.keys(USUAL).every((name) => one[name] === other[name]);

  function speedWrong() {
    const right = part("speed").checkValidity() && part("speed").value !== "";
    part("speed-wrong").textContent = right ? "" : "The speed is a number from 0.1 to 20.";
    part("speed").setAttribute("aria-invalid", String(!right));
    return !right;
  }

  function say(text) {
    part("edits-wrong").textContent = text;
    if (text) part("edits-wrong").scrollIntoView({ block: "nearest" });
  }

  // ---- what it would be

  function changed() {
    wait();
    if (speedWrong()) return making(Boolean(work));
    if (same(shown, read()) && !work) return making(false);
    making(true);
    wait(() => update().catch(() => {}));
  }

  function making(is) {
    part("preview").classList.toggle("od-making", is);
    part("preview").setAttribute("aria-busy", String(is));
    part("making").textContent = is ? "Showing the change…" : "";
    part("keep-it").disabled = is || !shown || part("speed").getAttribute("aria-invalid") === "true";
  }

  // Asks for one result at a time, and for the newest choice once it is there. What cannot be done is undone;
  // rejected with the sentence if there is no result at all.
  function update() {
    wait();
    again = Boolean(work);
    return (work ??= make(videos));
  }

  async function make(video) {
    making(true);
    let wrong = null;
    do {
      again = false;
      const options = read();
      try {
        const facts = await hooks.bring(sent(options));
        if (video !== videos) return;
        wrong = null;
        draw(facts, options);
      } catch (error) {
        if (video !== videos) return;
        wrong = error;
        if (!again && shown) fill(shown);
      }
    } while (again && !speedWrong());
    work = null;
    making(Boolean(due));
    say(wrong ? wrong.message : "");
    if (!shown) throw wrong;
  }

  // The first result of a part. What the options ask of another part may be more than this one can give.
  async function show() {
    await work?.catch(() => {}); // of the part before
    if (speedWrong()) fill({ ...read(), speed: shown ? shown.speed : USUAL.speed });
    const before = shown;
    shown = null;
    try {
      await update();
    } catch (error) {
      const { track, stabilise } = read();
      if (!track && !stabilise) {
        shown = before;
        throw error;
      }
      part("track").checked = part("stabilise").checked = false;
      await update();
      say(`${error.message} It is shown without.`);
    }
  }

  function draw(facts, options) {
    shown = options;
    const place = hooks.place();
    const video = part("result");
    video.src = `${place}/result-${facts.result}.webm`;
    for (const name of ["first", "last"]) part(name).src = `${place}/result-${facts.result}-${name}.jpg`;
    if (!calm.matches) video.play().catch(() => {});
    const rows = [["Length", `${facts.seconds.toFixed(2)} s`], ["Frames", `${facts.frames}`], ["Rate", `${facts.fps} a second`],
      ["Size", `${facts.width} x ${facts.height}`]];
    part("facts").replaceChildren(
      ...rows.map(([term, value]) => {
        const pair = document.createElement("div");
        pair.append(element("dt", term), element("dd", value));
        return pair;
      }),
    );
    const told = [...facts.warnings];
    if (facts.known) told.unshift(`This video is a demo already, called ${facts.known}. Keeping it adds nothing.`);
    part("warnings").replaceChildren(...told.map((text) => element("li", text)));
    const detail = { place, facts, options: sent(options) };
    part("result").dispatchEvent(new CustomEvent("demo-result", { bubbles: true, detail }));
  }

  const element = (tag, textContent) => Object.assign(document.createElement(tag), { textContent });

  for (const name of ["loop", ...SWITCHES]) part(name).addEventListener("change", changed);
  part("speed").addEventListener("input", changed);
  part("speed").addEventListener("keydown", (event) => event.key === "Enter" && event.preventDefault());
  begin();
  return { begin, show };
}
