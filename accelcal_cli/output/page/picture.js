// Pictures on a canvas: the sphere of poses, and a box that is held as a pose is. Directions are those of the specific
// force in the axes of the sensor: at rest it points up.
"use strict";

const AXES = ["x", "y", "z"];
const COVER = Math.cos((20 * Math.PI) / 180); // what counts as the planned pose
const TRAIL = 40;

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, k) => a.map((v) => v * k);
const sum = (a, b) => a.map((v, i) => v + b[i]);
const unit = (a) => scaled(a, 1 / (Math.hypot(...a) || 1));

/** The colours of the page as they are now, light or dark. */
function colours() {
  const style = getComputedStyle(document.documentElement);
  const names = ["page", "panel", "ink", "quiet", "line", "faint", "accent", "good"];
  return Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

/** A canvas as large as it is shown, in the pixels of the screen; null while it is not shown. */
function prepared(canvas) {
  const width = canvas.clientWidth;
  const height = canvas.clientHeight;
  if (!width || !height) return null;
  const ratio = window.devicePixelRatio || 1;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.lineJoin = "round";
  pen.font = "600 14px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  return { pen, width, height };
}

/** Rows right, up and towards the eye, for an eye at an azimuth and an elevation, radians. */
function camera(azimuth, elevation) {
  const eye = [
    Math.cos(elevation) * Math.cos(azimuth),
    Math.cos(elevation) * Math.sin(azimuth),
    Math.sin(elevation),
  ];
  const right = [-Math.sin(azimuth), Math.cos(azimuth), 0];
  return [right, cross(eye, right), eye];
}

const BOX_CAMERA = camera((-65 * Math.PI) / 180, (24 * Math.PI) / 180);

/** The sensor's axes in the world when a direction is up, by the shortest way from z up. */
function attitude([x, y, z]) {
  if (z < -0.999999) return [[1, 0, 0], [0, -1, 0], [0, 0, -1]];
  const k = 1 / (1 + z);
  return [
    [1 - x * x * k, -x * y * k, -x],
    [-x * y * k, 1 - y * y * k, -y],
    [x, y, z],
  ];
}

/** Draw a box that is held with a direction up, the faces named. */
function drawBox(canvas, direction, colour) {
  const place = prepared(canvas);
  if (!place || !direction) return;
  const { pen, width, height } = place;
  const size = 0.25 * Math.min(width, height);
  const middle = width / 2 - 8; // an arrow is beside it
  const world = attitude(direction);
  const seen = (body) => {
    const turned = world.map((row) => dot(row, body));
    return BOX_CAMERA.map((row) => dot(row, turned));
  };
  const at = (body) => {
    const [right, up] = seen(body);
    return [middle + size * right, height / 2 - size * up];
  };
  const tones = colours();
  for (let axis = 0; axis < 3; axis += 1) {
    for (const sign of [1, -1]) {
      const normal = [0, 0, 0];
      normal[axis] = sign;
      if (seen(normal)[2] <= 0.02) continue;
      const [first, second] = [(axis + 1) % 3, (axis + 2) % 3];
      pen.beginPath();
      for (const [a, b] of [[1, 1], [1, -1], [-1, -1], [-1, 1]]) {
        const corner = [...normal];
        corner[first] = a;
        corner[second] = b;
        pen.lineTo(...at(corner));
      }
      pen.closePath();
      pen.fillStyle = tones.page;
      pen.fill();
      pen.strokeStyle = colour;
      pen.lineWidth = 2;
      pen.stroke();
      pen.fillStyle = tones.ink;
      pen.fillText(`${sign > 0 ? "+" : "\u2212"}${AXES[axis]}`, ...at(normal));
    }
  }
  const [column, top] = [width - 8, height / 2]; // up is up
  pen.strokeStyle = tones.quiet;
  pen.beginPath();
  pen.moveTo(column, top + 18);
  pen.lineTo(column, top - 18);
  pen.moveTo(column - 5, top - 11);
  pen.lineTo(column, top - 18);
  pen.lineTo(column + 5, top - 11);
  pen.stroke();
}

/** The sphere of poses: drawn when asked, turned by pointer and keys, and by itself towards the pose to take next. */
class Globe {
  constructor(canvas, holder) {
    this.canvas = canvas;
    this.azimuth = -1.0;
    this.elevation = 0.4;
    this.goal = null;
    this.byHand = false;
    this.trail = [];
    this.scene = { planned: [], numbers: [], taken: [], next: null, now: null };
    this.still = window.matchMedia("(prefers-reduced-motion: reduce)");
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons) this.turn(-event.movementX * 0.01, event.movementY * 0.01);
    });
    const keys = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, 0.15], ArrowDown: [0, -0.15] };
    holder.addEventListener("keydown", (event) => {
      if (!keys[event.key]) return;
      event.preventDefault();
      this.turn(...keys[event.key]);
    });
  }

  turn(sideways, upwards) {
    this.byHand = true;
    this.goal = null;
    this.azimuth += sideways;
    this.elevation = Math.max(-1.5, Math.min(1.5, this.elevation + upwards));
    this.draw();
  }

  /** Bring a direction to the front, unless somebody has turned the sphere. */
  face([x, y, z]) {
    if (this.byHand) return;
    const azimuth = Math.atan2(y, x) - 0.35;
    const turns = Math.round((this.azimuth - azimuth) / (2 * Math.PI));
    this.goal = [azimuth + 2 * Math.PI * turns, Math.max(-1.2, Math.min(1.2, Math.asin(z) * 0.7 + 0.15))];
    if (this.still.matches) [this.azimuth, this.elevation] = this.goal;
  }

  follow(direction) {
    this.scene.now = direction;
    this.trail.push(direction);
    if (this.trail.length > TRAIL) this.trail.shift();
  }

  draw() {
    const place = prepared(this.canvas);
    if (!place) return;
    if (this.goal) {
      this.azimuth += 0.15 * (this.goal[0] - this.azimuth);
      this.elevation += 0.15 * (this.goal[1] - this.elevation);
    }
    const { pen, width, height } = place;
    const tones = colours();
    const radius = 0.43 * Math.min(width, height);
    const view = camera(this.azimuth, this.elevation);
    const at = (direction) => {
      const [right, up, near] = view.map((row) => dot(row, direction));
      return [width / 2 + radius * right, height / 2 - radius * up, near];
    };
    pen.beginPath();
    pen.arc(width / 2, height / 2, radius, 0, 2 * Math.PI);
    pen.fillStyle = tones.page;
    pen.fill();
    pen.strokeStyle = tones.quiet;
    pen.lineWidth = 1.5;
    pen.stroke();
    const ring = (normal, cosine) => {
      const one = unit(cross(normal, Math.abs(normal[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0]));
      const two = cross(normal, one);
      const size = Math.sqrt(1 - cosine * cosine);
      return Array.from({ length: 49 }, (_, k) => {
        const angle = (k / 48) * 2 * Math.PI;
        const around = sum(scaled(one, Math.cos(angle) * size), scaled(two, Math.sin(angle) * size));
        return at(sum(scaled(normal, cosine), around));
      });
    };
    for (const axis of [[1, 0, 0], [0, 1, 0], [0, 0, 1]]) {
      const points = ring(axis, 0);
      for (let k = 1; k < points.length; k += 1) {
        pen.globalAlpha = points[k][2] > 0 ? 1 : 0.35;
        pen.strokeStyle = tones.line;
        pen.lineWidth = 1;
        pen.beginPath();
        pen.moveTo(points[k - 1][0], points[k - 1][1]);
        pen.lineTo(points[k][0], points[k][1]);
        pen.stroke();
      }
    }
    const { planned, numbers, taken, next, now } = this.scene;
    pen.fillStyle = tones.good;
    for (const direction of taken) {
      const points = ring(direction, COVER);
      const front = points.filter((point) => point[2] > 0).length > 40;
      pen.globalAlpha = front ? 0.22 : 0.06;
      pen.beginPath();
      for (const point of points) pen.lineTo(point[0], point[1]);
      pen.fill();
    }
    const mark = (direction, size, fill, stroke, thick) => {
      const [x, y, near] = at(direction);
      pen.globalAlpha = near > 0 ? 1 : 0.3;
      pen.beginPath();
      pen.arc(x, y, near > 0 ? size : 0.75 * size, 0, 2 * Math.PI);
      if (fill) {
        pen.fillStyle = fill;
        pen.fill();
      }
      pen.strokeStyle = stroke;
      pen.lineWidth = thick;
      pen.stroke();
    };
    planned.forEach((direction, index) => {
      if (numbers[index] === null && index !== next) mark(direction, 6, null, tones.quiet, 2);
    });
    for (const direction of taken) mark(direction, 6, tones.good, tones.good, 1);
    if (next !== null && planned[next]) {
      mark(planned[next], 9, null, tones.accent, 3);
      mark(planned[next], 3, tones.accent, tones.accent, 1);
    }
    AXES.forEach((name, axis) => {
      for (const sign of [1, -1]) {
        const direction = [0, 0, 0];
        direction[axis] = 1.1 * sign;
        const [x, y, near] = at(direction);
        pen.globalAlpha = near > 0 ? 1 : 0.4;
        pen.fillStyle = tones.quiet;
        pen.fillText(`${sign > 0 ? "+" : "\u2212"}${name}`, x, y);
      }
    });
    pen.strokeStyle = tones.ink;
    pen.lineWidth = 1.5;
    for (let k = 1; k < this.trail.length; k += 1) {
      const [one, other] = [at(this.trail[k - 1]), at(this.trail[k])];
      pen.globalAlpha = (other[2] > 0 ? 0.6 : 0.15) * (k / this.trail.length);
      pen.beginPath();
      pen.moveTo(one[0], one[1]);
      pen.lineTo(other[0], other[1]);
      pen.stroke();
    }
    if (now) {
      const [x, y, near] = at(now);
      pen.globalAlpha = near > 0 ? 1 : 0.4;
      pen.fillStyle = tones.ink;
      pen.beginPath();
      for (const [a, b] of [[0, -8], [8, 0], [0, 8], [-8, 0]]) pen.lineTo(x + a, y + b);
      pen.fill();
    }
    pen.globalAlpha = 1;
  }
}
