// Draws a side of a clip: a frame out of its picture, and what is known of it (trainer/render/framing.py):
// heights, the way along the floor, the first pose, the paths of its ends. Metres, where not pixels.
const drawing = (() => {
  "use strict";
  const INK = "24 32 43";
  const HEAD = "200 52 24";
  const FOOT = "158 96 0";

  // place: where to draw, pen included; unit: a pixel of the page.
  function drawSide(place, image, about, side, frame, { trail, labels }) {
    const { pen, width, height } = place;
    const [cellWidth, cellHeight] = about.cell;
    const [wide, tall] = side.seen ?? side.size;
    const by = Math.min(width / wide, height / tall);
    pen.imageSmoothingQuality = by > 1 ? "high" : "low"; // made smaller, better ones look at the whole file
    const paint = (number) => {
      const [dx, dy] = side.offsets?.[number] ?? [0, 0];
      const x = (number % about.columns) * cellWidth + side.at + dx;
      const y = Math.floor(number / about.columns) * cellHeight + dy;
      pen.drawImage(image, x, y, wide, tall, (width - wide * by) / 2, (height - tall * by) / 2, wide * by, tall * by);
    };
    paint(frame);
    if (!side.left) {
      if (!trail || !frame) return;
      pen.globalAlpha = 0.3;
      paint(0);
      pen.globalAlpha = 1;
      return;
    }
    const metre = width / side.width;
    const bottom = side.bottom[frame] ?? side.bottom; // seen from above it goes along, too
    const at = ([x, z]) => [(x - side.left[frame]) * metre, height - (z - bottom) * metre];
    if (side.camera) drawScale(place, side, frame, metre, at);
    if (trail) drawTrail(place, side, frame, at);
    if (labels) {
      pen.globalAlpha = labels;
      marksOf(side).forEach(([word, path, colour]) => word && drawWord(place, word, at(path[frame]), colour));
      pen.globalAlpha = 1;
    }
  }

  // Each path with its word, if it is named, and its colour.
  const marksOf = (side) => (side.marks ?? []).map(([word, path], k) => [word, path, k ? FOOT : HEAD]);

  // Lines every half metre above the floor, and marks on the floor, which stay where they are in the world.
  function drawScale({ pen, width, height, unit }, side, frame, metre, at) {
    const [cameraHeight, distance] = side.camera;
    if (!(metre > 0)) return;
    pen.font = `${11 * unit}px system-ui, sans-serif`;
    pen.lineWidth = unit;
    pen.textAlign = "right";
    // Of a small robot these are decimetres, or whatever the floor's squares are.
    const { unit: step } = side;
    const said = (metres) => `${Number(metres.toPrecision(3))} m`;
    for (let k = 1; k / 2 < (side.bottom + height / metre) / step; k += 1) {
      const z = (k / 2) * step;
      const y = Math.round(at([0, z])[1]) + unit / 2;
      if (y > height) continue;
      pen.strokeStyle = `rgb(${INK} / 13%)`;
      pen.beginPath();
      pen.moveTo(0, y);
      pen.lineTo(width, y);
      pen.stroke();
      pen.fillStyle = `rgb(${INK} / 55%)`;
      if (y > 46 * unit) pen.fillText(said(z), width - 8 * unit, y - 4 * unit);
    }
    // On the near side of the robot's lane, where it hides none.
    const near = (distance / (distance - 0.3 * step)) * metre;
    const eye = side.eye[frame];
    const middle = at([eye, 0])[0];
    const y = at([0, cameraHeight])[1] + cameraHeight * near;
    if (y > height - 2 * unit) return;
    pen.strokeStyle = pen.fillStyle = `rgb(${INK} / 55%)`;
    pen.textAlign = "center";
    const first = Math.ceil(((eye - side.eye[0] - middle / near) * 4) / step);
    const last = Math.floor(((eye - side.eye[0] + (width - middle) / near) * 4) / step);
    for (let k = first; k <= last; k += 1) {
      const x = Math.round(middle + (side.eye[0] + (k / 4) * step - eye) * near);
      const long = k % 2 === 0;
      pen.beginPath();
      pen.moveTo(x, y);
      pen.lineTo(x, y + (long ? 7 : 4) * unit);
      pen.stroke();
      if (long) pen.fillText(k ? `${k > 0 ? "+" : "−"}${said(Math.abs(k / 4) * step)}` : "0", x, y + 17 * unit);
    }
  }

  function drawTrail({ pen, unit }, side, frame, at) {
    pen.lineJoin = pen.lineCap = "round";
    if (side.ghost) {
      pen.beginPath();
      for (const point of side.ghost) pen.lineTo(...at(point));
      pen.closePath();
      pen.fillStyle = `rgb(${INK} / 9%)`;
      pen.fill();
      pen.setLineDash([4 * unit, 3 * unit]);
      pen.lineWidth = 1.5 * unit;
      pen.strokeStyle = `rgb(${INK} / 60%)`;
      pen.stroke();
      pen.setLineDash([]);
    }
    for (const [, path, colour] of marksOf(side)) {
      for (const [line, stroke] of [[5, "rgb(255 255 255 / 75%)"], [2.5, `rgb(${colour})`]]) {
        pen.beginPath();
        for (const point of path) pen.lineTo(...at(point));
        pen.lineWidth = line * unit;
        pen.strokeStyle = stroke;
        pen.stroke();
      }
      pen.fillStyle = "#fff";
      pen.lineWidth = 2 * unit;
      pen.strokeStyle = `rgb(${colour})`;
      pen.beginPath();
      pen.arc(...at(path[frame]), 4.5 * unit, 0, 2 * Math.PI);
      pen.fill();
      pen.stroke();
    }
  }

  // A word beside a place, with a line to it.
  function drawWord({ pen, width, unit }, word, [x, y], colour) {
    const right = x < width * 0.6 ? 1 : -1;
    pen.font = `600 ${13 * unit}px system-ui, sans-serif`;
    const [wide, tall] = [pen.measureText(word).width + 14 * unit, 22 * unit];
    const left = right > 0 ? x + 34 * unit : x - 34 * unit - wide;
    pen.lineWidth = 2 * unit;
    pen.strokeStyle = pen.fillStyle = `rgb(${colour})`;
    pen.beginPath();
    pen.moveTo(x, y);
    pen.lineTo(right > 0 ? left : left + wide, y);
    pen.stroke();
    pen.beginPath();
    pen.roundRect(left, y - tall / 2, wide, tall, 6 * unit);
    pen.fill();
    pen.fillStyle = "#fff";
    pen.textAlign = "left";
    pen.fillText(word, left + 7 * unit, y + 4.5 * unit);
  }

  // At the top right, where there is neither a caption nor the floor.
  function drawPace({ pen, width, unit }, pace) {
    if (width < 165 * unit) return; // the caption has all the room
    const word = { 1: "1×", 0.5: "½×", 0.25: "¼×" }[pace];
    pen.font = `600 ${12 * unit}px system-ui, sans-serif`;
    pen.fillStyle = "rgb(255 255 255 / 72%)";
    pen.beginPath();
    pen.roundRect(width - 42 * unit, 12 * unit, 30 * unit, 22 * unit, 6 * unit);
    pen.fill();
    pen.fillStyle = `rgb(${INK} / 85%)`;
    pen.textAlign = "center";
    pen.fillText(word, width - 27 * unit, 27.5 * unit);
  }

  return { drawPace, drawSide };
})();
