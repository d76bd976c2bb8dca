// The part of a video that is wanted: two handles on its time, a rectangle on its picture. For static/demos.js.
//
// Times are seconds, the crop is shares of the turned picture's width and height: x, y, w, h; it is turned by
// degrees, clockwise.
//
// part(name) gives an element of the dialog. hooks: upright() gives the width and height of the upright video,
// pixels, before it is turned; moved(which) is called when "start" or "end" has been moved.
function demoPart(part, hooks) {
  "use strict";
  const { upright, moved } = hooks;
  const FRAME = 1 / 30; // of what is stored, and a step of the arrow keys
  const LEAST = 0.3; // seconds of a demo
  const LEAST_SIDE = 16; // pixels
  const WHOLE = { x: 0, y: 0, w: 1, h: 1 };
  const clamp = (value, low, high) => Math.min(high, Math.max(low, value));
  let start, end, length, crop, turned;

  function begin() {
    [start, end, length, crop, turned] = [0, 0, 0, { ...WHOLE }, 0];
  }

  function size() {
    const [width, height] = upright();
    return turned % 180 ? [height, width] : [width, height];
  }

  function measure(seconds) {
    length = seconds;
    [start, end] = [0, Math.min(seconds, 60)];
    draw();
  }

  function trim(which, value) {
    const least = Math.min(LEAST, length);
    if (which === "start") start = clamp(value, 0, end - least);
    else end = clamp(value, start + least, length);
    draw();
    moved(which);
  }

  function setCrop(box) {
    const [width, height] = size();
    const w = clamp(box.w, Math.min(1, LEAST_SIDE / width), 1);
    const h = clamp(box.h, Math.min(1, LEAST_SIDE / height), 1);
    crop = { w, h, x: clamp(box.x, 0, 1 - w), y: clamp(box.y, 0, 1 - h) };
    draw();
  }

  // By a quarter, with the rectangle.
  function turn() {
    turned = (turned + 90) % 360;
    setCrop({ x: 1 - crop.y - crop.h, y: crop.x, w: crop.h, h: crop.w });
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
    const [width, height] = size();
    const frame = part("frame").style;
    for (const [name, value] of Object.entries({ width, height, turn: `${turned}deg` })) frame.setProperty(`--od-${name}`, value);
    part("frame").classList.toggle("od-across", turned % 180 !== 0);
    part("turned").textContent = turned ? `Turned by ${turned} degrees, clockwise` : "";
    const box = part("crop");
    for (const [name, value] of Object.entries({ left: crop.x, top: crop.y, width: crop.w, height: crop.h }))
      box.style[name] = `${100 * value}%`;
    const values = pixels();
    const sides = ["x", "y", "w", "h"];
    sides.forEach((side, k) => fill(part(`crop-${side}`), values[k]));
    box.setAttribute("aria-label", `Part of the picture: ${values[2]} x ${values[3]} pixels, from ${values[0]}, ${values[1]}`);
    box.classList.toggle("od-whole", whole());
    part("whole").disabled = whole();
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
  }

  begin();
  listen();
  return {
    begin, draw, measure, turn,
    setWhole: () => setCrop(WHOLE),
    // As the server takes it.
    chosen: () => ({
      start: start || null,
      end: length && end >= length - FRAME / 2 ? null : end || null,
      rotate: turned,
      crop: whole() ? null : pixels(),
    }),
    get start() { return start; },
    get end() { return end; },
    get length() { return length; },
  };
}
