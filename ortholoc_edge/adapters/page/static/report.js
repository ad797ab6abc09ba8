"use strict";
/* A flight that is over, frame by frame, on the live page's map. All data is in this file. */

const report = JSON.parse(document.getElementById("data").textContent);
const node = (id) => document.getElementById(id);
let map = null, chosen = 0;

function pictureOf(source, then) {
  const image = new Image();
  image.onload = then;
  image.src = source;
  return image;
}

function start() {
  const backdrop = pictureOf(report.map.src, () => map && map.draw());
  const scene = { bounds: report.map.bounds, convergence_rad: report.convergence_rad,
    picture: { image: backdrop, bounds: report.map.bounds } };
  map = new FlightMap(node("map"), scene);
  map.onView = () => node("follow").setAttribute("aria-pressed", String(map.follows));
  map.setFollows(false);
  node("zoom-in").onclick = () => map.zoom(1.6);
  node("zoom-out").onclick = () => map.zoom(1 / 1.6);
  node("follow").onclick = () => map.setFollows(!map.follows);
  node("whole").onclick = () => { map.setFollows(false); map.fit(scene.bounds); };
  const hasTruth = report.frames.some((frame) => frame.truth);
  const truth = [(ghost, pen) => ghost.paintLine(pen, [[-12, 0], [12, 0]], INK.truth), "truth"];
  fillLegend(node("legend"), [...(hasTruth ? [truth] : []),
    ...LEGEND.filter(([, what]) => report.frames.some(({ mark }) => what === "GNSS" ? mark.gnss
      : what === "autopilot believes" ? mark.believed : true))]);
  const slider = node("slider");
  slider.max = report.frames.length - 1;
  slider.oninput = () => choose(Number(slider.value));
  node("before").onclick = () => choose(chosen - 1);
  node("after").onclick = () => choose(chosen + 1);
  node("chart").onclick = (event) => {
    const box = node("chart").getBoundingClientRect();
    choose(Math.round((event.clientX - box.left - 44) / (box.width - 54) * (report.frames.length - 1)));
  };
  new ResizeObserver(chart).observe(node("chart"));
  map.show({
    truth: report.frames.map((frame) => frame.truth).filter(Boolean),
    track: report.frames.map(({ mark, truth: at }) => {
      const place = mark.fix ? mark.fix.at : at || (mark.prior && mark.prior.at);
      return place && [place[0], place[1], mark.fix ? 1 : 0];
    }).filter(Boolean),
  });
  const first = report.frames.findIndex((frame) => frame.picture);
  choose(Math.max(first, 0));
}

function choose(number) {
  chosen = Math.min(Math.max(number, 0), report.frames.length - 1);
  const frame = report.frames[chosen], { mark } = frame;
  node("slider").value = chosen;
  map.show({ pose: mark.fix || null, prior: mark.prior || null, believed: mark.believed || null, gnss: mark.gnss || null,
    points: frame.picture ? frame.picture.inliers.map((row) => [row[4], row[5]]) : [] });
  node("name").textContent = `${chosen + 1} of ${report.frames.length}: ${frame.name}`;
  const lines = mark.fix
    ? [`fix, 1 \u03c3 ${ellipseOf(mark.fix.cov, 1).long.toFixed(2)} m across, ${mark.fix.sigma_h.toFixed(2)} m in height`,
      `${mark.inliers} of ${mark.matches} matches are inliers, rms ${mark.rms_px} px`]
    : [`no fix: ${mark.reason}`, mark.detail, mark.measured === undefined || mark.measured === null ? ""
      : `measured ${Number(mark.measured.toPrecision(3))}, limit ${mark.limit === null || mark.limit === undefined ? "-"
        : Number(mark.limit.toPrecision(3))}`];
  if (frame.error) lines.push(`off the truth by ${frame.error[0].toFixed(2)} m and ${frame.error[1].toFixed(2)}\u00b0`);
  if (mark.took_ms && mark.took_ms.total) lines.push(`took ${Math.round(mark.took_ms.total)} ms`);
  node("what").replaceChildren(...lines.filter(Boolean).map((line) => {
    const item = document.createElement("p");
    item.textContent = line;
    return item;
  }));
  showPicture(frame.picture);
  chart();
}

function showPicture(picture) {
  const canvas = node("frame");
  canvas.hidden = !picture;
  node("no-picture").hidden = Boolean(picture);
  if (!picture) return;
  const [width, height] = picture.size;
  const image = pictureOf(picture.src, () => {
    if (report.frames[chosen].picture !== picture) return;
    canvas.width = width * 2;
    canvas.height = height * 2;
    const pen = canvas.getContext("2d");
    pen.setTransform(2, 0, 0, 2, 0, 0);
    pen.drawImage(image, 0, 0, width, height);
    drawInliers(pen, picture.inliers);
  });
}

/* Error and sigma over the frames; ticks for frames without a fix. */
function chart() {
  const canvas = node("chart"), box = canvas.getBoundingClientRect();
  const ratio = Math.min(window.devicePixelRatio || 1, 2), width = box.width, height = box.height;
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  const { frames } = report;
  const sigma = frames.map(({ mark }) => mark.fix ? ellipseOf(mark.fix.cov, 1).long : null);
  const error = frames.map((frame) => frame.error ? frame.error[0] : null);
  const top = 1.1 * Math.max(0.1, ...[...sigma, ...error].filter((value) => value !== null));
  const x = (k) => 44 + (width - 54) * (frames.length > 1 ? k / (frames.length - 1) : 0.5);
  const y = (value) => height - 18 - (height - 28) * value / top;
  pen.font = "13px system-ui, sans-serif";
  pen.fillStyle = "#333";
  for (const part of [0, 0.5, 1]) {
    pen.strokeStyle = "#ccc";
    pen.strokeRect(44, y(part * top / 1.1), width - 54, 0);
    pen.fillText(`${(part * top / 1.1).toFixed(2)}`, 2, y(part * top / 1.1) + 4);
  }
  frames.forEach(({ mark }, k) => {
    if (mark.fix) return;
    pen.fillStyle = INK.rejected;
    pen.fillRect(x(k) - 1, height - 15, 2, 12);
  });
  const dots = (values, ink, radius) => values.forEach((value, k) => {
    if (value === null) return;
    pen.beginPath();
    pen.arc(x(k), y(value), radius, 0, 7);
    pen.fillStyle = ink;
    pen.fill();
  });
  dots(sigma, INK.predicted, 2);
  dots(error, INK.fix, 3);
  pen.strokeStyle = "#000";
  pen.strokeRect(x(chosen), 4, 0, height - 8);
}

start();
