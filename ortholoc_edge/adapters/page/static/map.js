"use strict";
/* The map: orthophoto, track, poses with what they are worth. Knows nothing of where they come from.
   World: metres east and north from the scene's origin. Screen: CSS pixels, y down. */

const INK = {
  fix: "#00692b", rejected: "#c00020", predicted: "#6a1fc2", believed: "#0b3fb5", gnss: "#a04800", truth: "#00838f",
  sees: "#111111", old: "#5a5a5a", point: "#ffd400", paper: "#ffffff",
};
const SIGMAS = 2;

/* Half axes in metres and the angle of the longer one from east, counterclockwise, of a covariance [ee, en, nn]. */
function ellipseOf(cov, sigmas) {
  const [ee, en, nn] = cov;
  const middle = (ee + nn) / 2, apart = Math.hypot((ee - nn) / 2, en);
  return {
    long: sigmas * Math.sqrt(Math.max(0, middle + apart)),
    short: sigmas * Math.sqrt(Math.max(0, middle - apart)),
    angle: 0.5 * Math.atan2(2 * en, ee - nn),
  };
}

class FlightMap {
  /* scene: bounds [west, south, east, north], convergence_rad; tiles {side, gsd_m, levels, v} with a tileUrl, or
     picture {image, bounds}. */
  constructor(canvas, scene, tileUrl) {
    this.canvas = canvas;
    this.scene = scene;
    this.tileUrl = tileUrl;
    this.tiles = new Map();
    this.loading = 0;
    this.layers = { track: [], truth: [], points: [], pose: null, prior: null, believed: null, gnss: null, old: null, area: [] };
    this.follows = true;
    this.wasFitted = false;
    this.centre = [(scene.bounds[0] + scene.bounds[2]) / 2, (scene.bounds[1] + scene.bounds[3]) / 2];
    this.scale = 1;
    this.onView = () => {};
    /* Told of a tap, [east, north], while it is set. */
    this.onTap = null;
    this.tap = null;
    this.asked = false;
    this.pointers = new Map();
    this.resize();
    this.listen();
    new ResizeObserver(() => { this.resize(); this.draw(); }).observe(canvas);
  }

  resize() {
    const box = this.canvas.getBoundingClientRect();
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    this.width = Math.max(1, box.width);
    this.height = Math.max(1, box.height);
    this.ratio = ratio;
    this.canvas.width = Math.round(this.width * ratio);
    this.canvas.height = Math.round(this.height * ratio);
    if (!this.wasFitted && box.width > 1) {
      this.fit(this.scene.bounds);
      this.wasFitted = true;
    }
  }

  fit(bounds) {
    const [west, south, east, north] = bounds;
    this.centre = [(west + east) / 2, (south + north) / 2];
    const room = 0.94;
    this.scale = room * Math.min(this.width / Math.max(1, east - west), this.height / Math.max(1, north - south));
    this.clampScale();
    this.draw();
  }

  clampScale() {
    const [west, south, east, north] = this.scene.bounds;
    const least = 0.4 * Math.min(this.width / (east - west), this.height / (north - south));
    this.scale = Math.min(Math.max(this.scale, least), 80);
  }

  toScreen(east, north) {
    return [this.width / 2 + (east - this.centre[0]) * this.scale, this.height / 2 - (north - this.centre[1]) * this.scale];
  }

  toWorld(x, y) {
    return [this.centre[0] + (x - this.width / 2) / this.scale, this.centre[1] - (y - this.height / 2) / this.scale];
  }

  zoom(factor, x = this.width / 2, y = this.height / 2) {
    const before = this.toWorld(x, y);
    this.scale *= factor;
    this.clampScale();
    if (!this.follows) {
      const after = this.toWorld(x, y);
      this.centre = [this.centre[0] + before[0] - after[0], this.centre[1] + before[1] - after[1]];
    }
    this.draw();
  }

  move(dx, dy) {
    this.setFollows(false);
    this.centre = [this.centre[0] - dx / this.scale, this.centre[1] + dy / this.scale];
    this.draw();
  }

  setFollows(on) {
    this.follows = on;
    this.onView();
    this.draw();
  }

  listen() {
    const canvas = this.canvas;
    const at = (event) => {
      const box = canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    canvas.addEventListener("pointerdown", (event) => {
      try { canvas.setPointerCapture(event.pointerId); } catch { /* it is gone already */ }
      this.tap = this.pointers.size ? null : at(event);
      this.pointers.set(event.pointerId, at(event));
    });
    canvas.addEventListener("pointerup", (event) => {
      // A finger rolls by some pixels; more is a drag.
      const [x, y] = at(event), tap = this.tap;
      this.tap = null;
      if (this.onTap && tap && Math.hypot(x - tap[0], y - tap[1]) < 10) this.onTap(this.toWorld(...tap));
    });
    canvas.addEventListener("pointermove", (event) => {
      const was = this.pointers.get(event.pointerId);
      if (!was) return;
      const now = at(event);
      if (this.onTap && this.tap && Math.hypot(now[0] - this.tap[0], now[1] - this.tap[1]) < 10) return;
      const others = [...this.pointers].filter(([id]) => id !== event.pointerId);
      if (others.length === 0) {
        this.move(now[0] - was[0], now[1] - was[1]);
      } else {
        const still = others[0][1];
        const before = Math.hypot(was[0] - still[0], was[1] - still[1]);
        const after = Math.hypot(now[0] - still[0], now[1] - still[1]);
        if (before > 5) this.zoom(after / before, (now[0] + still[0]) / 2, (now[1] + still[1]) / 2);
      }
      this.pointers.set(event.pointerId, now);
    });
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...at(event));
    }, { passive: false });
    canvas.addEventListener("dblclick", (event) => { if (!this.onTap) this.zoom(2, ...at(event)); });
    canvas.addEventListener("keydown", (event) => {
      const steps = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
      if (event.key in steps) this.move(...steps[event.key]);
      else if (event.key === "+" || event.key === "=") this.zoom(1.4);
      else if (event.key === "-") this.zoom(1 / 1.4);
      else return;
      event.preventDefault();
    });
  }

  show(layers) {
    Object.assign(this.layers, layers);
    this.draw();
  }

  draw() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => { this.asked = false; this.paint(); });
  }

  paint() {
    const pen = this.canvas.getContext("2d");
    const { track, truth, points, pose, prior, believed, gnss, old } = this.layers;
    // An old place is not where the vehicle is.
    const middle = old && prior ? prior : pose || prior;
    if (this.follows && middle) this.centre = [middle.at[0], middle.at[1]];
    pen.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    pen.fillStyle = "#e2e2e2";
    pen.fillRect(0, 0, this.width, this.height);
    this.paintPhoto(pen);
    this.paintLine(pen, truth, INK.truth);
    this.paintTrack(pen, track);
    for (const [east, north] of points) this.disc(pen, east, north, 2.2, INK.point);
    if (prior) {
      this.polygon(pen, prior.rim, INK.predicted, [7, 5]);
      this.ellipse(pen, prior, INK.predicted, [4, 4]);
      if (!pose) this.arrow(pen, prior, INK.predicted, true);
    }
    if (pose) {
      const ink = old ? INK.old : INK.fix;
      if (!old) this.polygon(pen, pose.rim, INK.sees, []);
      this.ellipse(pen, pose, ink, [], old ? 0 : 0.28);
    }
    const { area } = this.layers;
    this.polygon(pen, area, INK.predicted, []);
    if (area.length === 2) this.paintLine(pen, area, INK.predicted);
    for (const [east, north] of area) this.disc(pen, east, north, 6, INK.point);
    if (gnss) this.ring(pen, gnss, INK.gnss);
    if (believed) this.diamond(pen, believed, INK.believed);
    if (pose) {
      this.arrow(pen, pose, old ? INK.old : INK.fix, Boolean(old));
      if (old) this.label(pen, pose.at[0], pose.at[1], old);
    }
    this.paintFurniture(pen);
  }

  /* -- the orthophoto -- */

  paintPhoto(pen) {
    const { picture, tiles } = this.scene;
    if (picture) {
      if (!picture.image.complete) return;
      const [left, top] = this.toScreen(picture.bounds[0], picture.bounds[3]);
      const [right, bottom] = this.toScreen(picture.bounds[2], picture.bounds[1]);
      pen.drawImage(picture.image, left, top, right - left, bottom - top);
      return;
    }
    if (!tiles) return;
    const wanted = Math.round(Math.log2(1 / (this.scale * this.ratio) / tiles.gsd_m) - 0.1);
    const level = Math.min(Math.max(wanted, 0), tiles.levels - 1);
    const side = tiles.side * tiles.gsd_m * 2 ** level;
    const [west, south, east, north] = this.scene.bounds;
    const [seenWest, seenNorth] = this.toWorld(0, 0);
    const [seenEast, seenSouth] = this.toWorld(this.width, this.height);
    const first = Math.max(0, Math.floor((seenWest - west) / side));
    const last = Math.min(Math.ceil((east - west) / side), Math.ceil((seenEast - west) / side));
    const top = Math.max(0, Math.floor((north - seenNorth) / side));
    const bottom = Math.min(Math.ceil((north - south) / side), Math.ceil((north - seenSouth) / side));
    for (let row = top; row < bottom; row++) {
      for (let column = first; column < last; column++) this.paintTile(pen, level, column, row);
    }
  }

  paintTile(pen, level, column, row) {
    const { tiles, bounds } = this.scene;
    const side = tiles.side * tiles.gsd_m * 2 ** level;
    const [x, y] = this.toScreen(bounds[0] + column * side, bounds[3] - row * side);
    const size = side * this.scale;
    const image = this.tile(level, column, row, true);
    if (image) {
      // Half a pixel more, or seams show.
      pen.drawImage(image, x, y, size + 0.5, size + 0.5);
      return;
    }
    for (let up = 1; level + up < tiles.levels; up++) {
      const coarse = this.tile(level + up, column >> up, row >> up, false);
      if (!coarse) continue;
      const part = tiles.side / 2 ** up;
      const within = (value) => (value & ((1 << up) - 1)) * part;
      pen.drawImage(coarse, within(column), within(row), part, part, x, y, size + 0.5, size + 0.5);
      return;
    }
  }

  tile(level, column, row, wanted) {
    const key = `${level}/${column}/${row}`;
    const found = this.tiles.get(key);
    if (found) {
      this.tiles.delete(key);
      this.tiles.set(key, found);
      if (found.image) return found.image;
      if (!found.again || found.again > Date.now()) return null;
      this.tiles.delete(key);
    }
    if (!wanted || this.loading >= 3) return null;
    const entry = { image: null, again: 0 };
    const image = new Image();
    this.loading++;
    const done = () => { this.loading--; this.draw(); };
    image.onload = () => { entry.image = image; done(); };
    image.onerror = () => { entry.again = Date.now() + 4000; done(); };
    image.src = this.tileUrl(key);
    this.tiles.set(key, entry);
    for (const [oldest, one] of this.tiles) {
      if (this.tiles.size <= 96) break;
      if (one.image) this.tiles.delete(oldest); else break;
    }
    return null;
  }

  /* -- what lies on it -- */

  paintLine(pen, places, ink) {
    if (places.length < 2) return;
    const path = new Path2D();
    places.forEach(([east, north], k) => path[k ? "lineTo" : "moveTo"](...this.toScreen(east, north)));
    pen.lineJoin = "round";
    this.cased(pen, path, ink, 2.5);
  }

  paintTrack(pen, track) {
    const line = new Path2D(), crosses = new Path2D();
    const dots = [];
    let last = null;
    for (const [east, north, isFix] of track) {
      const [x, y] = this.toScreen(east, north);
      if (!isFix) {
        if (x > -9 && y > -9 && x < this.width + 9 && y < this.height + 9) {
          crosses.moveTo(x - 4, y - 4); crosses.lineTo(x + 4, y + 4);
          crosses.moveTo(x - 4, y + 4); crosses.lineTo(x + 4, y - 4);
        }
        continue;
      }
      if (last && Math.hypot(x - last[0], y - last[1]) < 1.5) continue;
      line[last ? "lineTo" : "moveTo"](x, y);
      if (!last || Math.hypot(x - last[2], y - last[3]) >= 9) {
        dots.push([x, y]);
        last = [x, y, x, y];
      } else {
        last = [x, y, last[2], last[3]];
      }
    }
    pen.lineJoin = "round";
    this.cased(pen, line, INK.fix, 2.5);
    this.cased(pen, crosses, INK.rejected, 2.5);
    for (const [x, y] of dots) {
      if (x < -9 || y < -9 || x > this.width + 9 || y > this.height + 9) continue;
      pen.beginPath();
      pen.arc(x, y, 3.2, 0, 7);
      pen.fillStyle = INK.fix;
      pen.fill();
      pen.lineWidth = 1.2;
      pen.strokeStyle = INK.paper;
      pen.stroke();
    }
  }

  cased(pen, path, ink, width, dashes = []) {
    pen.setLineDash([]);
    pen.lineWidth = width + 3;
    pen.strokeStyle = "rgba(255,255,255,.85)";
    pen.stroke(path);
    pen.setLineDash(dashes);
    pen.lineWidth = width;
    pen.strokeStyle = ink;
    pen.stroke(path);
    pen.setLineDash([]);
  }

  disc(pen, east, north, radius, ink) {
    const [x, y] = this.toScreen(east, north);
    pen.beginPath();
    pen.arc(x, y, radius, 0, 7);
    pen.fillStyle = ink;
    pen.fill();
    pen.lineWidth = 0.8;
    pen.strokeStyle = "#000";
    pen.stroke();
  }

  polygon(pen, rim, ink, dashes) {
    if (!rim || rim.length < 3) return;
    const path = new Path2D();
    rim.forEach(([east, north], k) => path[k ? "lineTo" : "moveTo"](...this.toScreen(east, north)));
    path.closePath();
    this.cased(pen, path, ink, 2, dashes);
  }

  ellipse(pen, pose, ink, dashes, fill = 0) {
    const [x, y] = this.toScreen(pose.at[0], pose.at[1]);
    const { long, short, angle } = ellipseOf(pose.cov, SIGMAS);
    if (!(long > 0) || long * this.scale > 20000) return;
    const path = new Path2D();
    // The screen's y points down, so angles turn the other way.
    path.ellipse(x, y, long * this.scale, short * this.scale, -angle, 0, 2 * Math.PI);
    if (fill) {
      pen.globalAlpha = fill;
      pen.fillStyle = ink;
      pen.fill(path);
      pen.globalAlpha = 1;
    }
    this.cased(pen, path, ink, 2, dashes);
  }

  arrow(pen, pose, ink, hollow) {
    const [x, y] = this.toScreen(pose.at[0], pose.at[1]);
    const path = new Path2D();
    if (pose.heading_deg === undefined || pose.heading_deg === null) {
      path.arc(x, y, 8, 0, 7);
    } else {
      const turn = pose.heading_deg * Math.PI / 180;
      const corner = (forward, right) => [
        x + forward * Math.sin(turn) + right * Math.cos(turn), y - forward * Math.cos(turn) + right * Math.sin(turn),
      ];
      path.moveTo(...corner(15, 0));
      path.lineTo(...corner(-10, 9));
      path.lineTo(...corner(-5, 0));
      path.lineTo(...corner(-10, -9));
      path.closePath();
    }
    pen.lineJoin = "round";
    pen.lineWidth = 5;
    pen.strokeStyle = INK.paper;
    pen.stroke(path);
    pen.fillStyle = hollow ? INK.paper : ink;
    pen.fill(path);
    pen.lineWidth = 2;
    pen.strokeStyle = hollow ? ink : "#000";
    pen.stroke(path);
  }

  ring(pen, [east, north], ink) {
    const [x, y] = this.toScreen(east, north);
    const path = new Path2D();
    path.arc(x, y, 10, 0, 7);
    this.cased(pen, path, ink, 2.5);
  }

  diamond(pen, [east, north], ink) {
    const [x, y] = this.toScreen(east, north);
    const path = new Path2D();
    path.moveTo(x, y - 9); path.lineTo(x + 9, y); path.lineTo(x, y + 9); path.lineTo(x - 9, y);
    path.closePath();
    this.cased(pen, path, ink, 2.5);
  }

  label(pen, east, north, text) {
    const [x, y] = this.toScreen(east, north);
    this.text(pen, text, x + 16, y - 12, 17);
  }

  text(pen, text, x, y, size, align = "left") {
    pen.font = `700 ${size}px system-ui, sans-serif`;
    pen.textAlign = align;
    pen.lineJoin = "round";
    pen.lineWidth = 5;
    pen.strokeStyle = "#fff";
    pen.strokeText(text, x, y);
    pen.fillStyle = "#000";
    pen.fillText(text, x, y);
  }

  paintFurniture(pen) {
    const widest = Math.min(0.35 * this.width, 200) / this.scale;
    const power = 10 ** Math.floor(Math.log10(widest));
    const length = [5, 2, 1].map((step) => step * power).find((one) => one <= widest) || power;
    const x = 12, y = this.height - 14, bar = length * this.scale;
    const path = new Path2D();
    path.moveTo(x, y - 7); path.lineTo(x, y); path.lineTo(x + bar, y); path.lineTo(x + bar, y - 7);
    this.cased(pen, path, "#000", 2.5);
    this.text(pen, length >= 1000 ? `${length / 1000} km` : `${Number(length.toPrecision(2))} m`, x + 6, y - 8, 15);
    // True north: the grid's is up.
    const turn = -(this.scene.convergence_rad || 0), footX = this.width - 26, footY = this.height - 16;
    const tip = [footX + 34 * Math.sin(turn), footY - 34 * Math.cos(turn)];
    const shaft = new Path2D();
    const back = (angle) => [tip[0] - 11 * Math.sin(turn + angle), tip[1] + 11 * Math.cos(turn + angle)];
    shaft.moveTo(footX, footY); shaft.lineTo(...tip);
    shaft.moveTo(...back(0.45)); shaft.lineTo(...tip); shaft.lineTo(...back(-0.45));
    this.cased(pen, shaft, "#000", 2.5);
    this.text(pen, "N", tip[0], tip[1] - 5, 15, "center");
  }
}

/* What the map's marks mean, as a list of [drawing, words]. */
const LEGEND = [
  [(map, pen) => map.arrow(pen, { at: [0, 0], heading_deg: 90 }, INK.fix, false), "fix, nose forward"],
  [(map, pen) => map.ellipse(pen, { at: [0, 0], cov: [12, 6, 8] }, INK.fix, [], 0.28), "2 \u03c3 of it"],
  [(map, pen) => map.polygon(pen, [[-11, -5], [11, -5], [9, 5], [-9, 5]], INK.sees, []), "camera sees"],
  [(map, pen) => map.ellipse(pen, { at: [0, 0], cov: [12, 6, 8] }, INK.predicted, [4, 4]), "prediction"],
  [(map, pen) => map.paintTrack(pen, [[0, 0, 0]]), "no fix"],
  [(map, pen) => map.diamond(pen, [0, 0], INK.believed), "autopilot believes"],
  [(map, pen) => map.ring(pen, [0, 0], INK.gnss), "GNSS"],
];

function fillLegend(list, entries = LEGEND) {
  for (const [drawing, words] of entries) {
    const item = document.createElement("li"), canvas = document.createElement("canvas");
    const ratio = 2;
    canvas.width = 26 * ratio;
    canvas.height = 16 * ratio;
    const pen = canvas.getContext("2d");
    pen.setTransform(0.72 * ratio, 0, 0, 0.72 * ratio, 0, 0);
    const ghost = Object.create(FlightMap.prototype);
    Object.assign(ghost, { width: 36, height: 22, centre: [0, 0], scale: 1, ratio });
    drawing(ghost, pen);
    item.append(canvas, words);
    list.append(item);
  }
}

/* Inliers on a frame, each [u, v, u where the pose puts it, v, ...], and ten times the way between the two. */
function drawInliers(pen, inliers) {
  for (const [u, v, putU, putV] of inliers) {
    pen.beginPath();
    pen.moveTo(u, v);
    pen.lineTo(u + 10 * (putU - u), v + 10 * (putV - v));
    pen.lineWidth = 1.6;
    pen.strokeStyle = "#d4006a";
    pen.stroke();
    pen.beginPath();
    pen.arc(u, v, 2.4, 0, 7);
    pen.fillStyle = INK.point;
    pen.fill();
    pen.lineWidth = 1;
    pen.strokeStyle = "#000";
    pen.stroke();
  }
}
