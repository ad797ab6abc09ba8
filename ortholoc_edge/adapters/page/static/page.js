"use strict";
/* The live page: what the daemon tells, and above all how old it is. All times are ms of the daemon's clock. */

const REASONS = {
  bad_frame: "broken frame", dark: "too dark", repeated: "the picture before once more", frozen: "the camera is frozen",
  motion_blur: "smeared by motion", no_prior: "nothing says where to look", bad_attitude: "no attitude from the autopilot",
  gimbal_unknown: "gimbal's direction unknown", prior_too_wide: "too uncertain where to look",
  outside_map: "looks beyond the map", map_nodata: "the map has a hole here", few_matches: "too few matches",
  few_inliers: "too few inliers", low_inlier_ratio: "most matches disagree", low_contrast: "the map fits here hardly better",
  poor_spread: "matches huddle in one place", high_reprojection: "matches fit badly",
  degenerate_geometry: "matches do not settle the pose", gravity_disagrees: "horizon disagrees with the autopilot",
  ambiguous: "another place fits as well", prior_disagrees: "too far from the prediction", uncertain: "fix too uncertain",
  late: "too late", internal: "a defect, see the log",
};
const SILENT_MS = 3000, OLD_FIX_MS = 3000, NO_FRAMES_MS = 3000, STILL_MS = 3500;
const KEPT_MARKS = 200, KEPT_PLACES = 6000, SHOWN_REJECTIONS = 8;

const byId = (id) => document.getElementById(id);
const known = {
  session: null, scene: null, marks: [], track: [], every: 1, health: null, picture: null,
  /* The daemon's clock less ours, as the least delayed event had it; and when the last came, on ours. */
  offset: null, heard: null, since: performance.now(), awake: true,
};
let map = null, zoomed = false;

/* -- time: an event that a slow link held back must not make old things look fresh -- */

const ours = () => performance.now();

function keepTime(now) {
  const here = ours(), offset = now - here;
  // Clocks drift apart by less than a ms in a second.
  const before = known.offset === null ? -Infinity : known.offset - (here - known.heard) * 0.001;
  known.offset = Math.max(offset, before);
  known.heard = here;
}

const daemonNow = () => known.offset + ours();
const age = (stamp) => Math.max(0, daemonNow() - stamp);

function words(ms) {
  const s = ms / 1000;
  if (s < 9.95) return `${s.toFixed(1)} s`;
  if (s < 120) return `${Math.round(s)} s`;
  return s < 7200 ? `${Math.round(s / 60)} min` : `${Math.round(s / 3600)} h`;
}

/* -- what comes in -- */

function hear(event) {
  if (event.session !== known.session) {
    if (!event.scene) return;
    Object.assign(known, { session: event.session, marks: [], track: [], health: null, picture: null, offset: null });
  }
  keepTime(event.now);
  known.awake = true;
  if (event.scene) {
    known.marks = [];
    known.track = event.track;
    known.every = 1;
    setScene(event.scene);
  }
  for (const mark of event.marks) {
    known.marks.push(mark);
    const pose = mark.fix || mark.prior;
    // Of the last ones all are drawn, of those before as many as a long flight leaves room for.
    if (pose && mark.n % known.every === 0) known.track.push([pose.at[0], pose.at[1], mark.fix ? 1 : 0, mark.t]);
  }
  known.marks.splice(0, known.marks.length - KEPT_MARKS);
  if (known.track.length > KEPT_PLACES) {
    known.every *= 2;
    known.track = known.track.filter((_, k) => k % 2 === 0);
  }
  if (event.health) known.health = event.health;
  if (event.picture) setPicture(event.picture);
  render();
}

function setScene(scene) {
  known.scene = scene;
  if (!map) {
    map = new FlightMap(byId("map"), scene, (key) => `/tiles/${key}.jpg?v=${encodeURIComponent(scene.tiles.v)}`);
    map.onView = () => byId("follow").setAttribute("aria-pressed", String(map.follows));
    byId("zoom-in").onclick = () => map.zoom(1.6);
    byId("zoom-out").onclick = () => map.zoom(1 / 1.6);
    byId("follow").onclick = () => map.setFollows(!map.follows);
    byId("whole").onclick = () => { map.setFollows(false); map.fit(known.scene.bounds); };
    fillLegend(byId("legend"));
    offerSearch();
  } else if (JSON.stringify(map.scene) !== JSON.stringify(scene)) {
    map.scene = scene;
    map.tiles.clear();
    map.fit(scene.bounds);
    zoomed = false;
  }
  byId("draw").hidden = byId("everywhere").hidden = !scene.commands;
  const { pack } = scene;
  byId("about").textContent =
    `OrthoLoC Edge ${scene.version} · ${scene.vehicle} · map ${pack.name}, ${pack.date || "undated"}, ${scene.crs}` +
    ` · ${pack.attribution || ""} · matcher ${scene.matcher}`;
}

/* -- the search, by whoever knows where the vehicle is -- */

function searchNote(text) {
  byId("search-note").hidden = !text;
  setText("search-note", text);
}

function offerSearch() {
  const draw = byId("draw"), send = byId("send");
  const end = () => {
    map.onTap = null;
    map.show({ area: [] });
    draw.textContent = "search here";
    send.hidden = true;
  };
  draw.onclick = () => {
    if (map.onTap) { end(); searchNote(""); return; }
    map.setFollows(false);
    draw.textContent = "cancel";
    searchNote("tap the corners of the area where the vehicle is, in order");
    map.onTap = (place) => {
      if (map.layers.area.length >= 100) return;
      map.show({ area: [...map.layers.area, place] });
      send.hidden = map.layers.area.length < 3;
    };
  };
  send.onclick = () => { const corners = map.layers.area; end(); sendSearch({ corners }); };
  byId("everywhere").onclick = () => { end(); sendSearch({}); };
}

async function sendSearch(what) {
  searchNote("sent, no answer yet");
  try {
    const answer = await fetch("/command/search", {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(what),
      signal: AbortSignal.timeout(15000),
    });
    const text = await answer.text();
    if (!answer.ok) { searchNote(`refused: ${text.slice(0, 200)}`); return; }
    const reply = JSON.parse(text);
    searchNote(reply.accepted ? (what.corners ? "accepted: searching in the area" : "accepted: searching everywhere")
      : `refused: ${reply.reason}; ${reply.remedy}`);
  } catch {
    searchNote("no answer: it may or may not have been taken");
  }
}

function setPicture(picture) {
  const image = new Image();
  // Shown together, or not at all: the matches belong to this frame.
  image.onload = () => {
    if (known.picture && known.picture.n > picture.n && known.picture.session === known.session) return;
    known.picture = { ...picture, image, session: known.session };
    drawFrame();
  };
  image.src = `/frame/${picture.n}.jpg`;
}

/* -- what it comes to -- */

/* dead: nothing that is shown is of now. old: the fix is not. */
function verdict() {
  const dead = (word, why, kind = "bad") => ({ kind, word, why, old: true, dead: true });
  if (known.heard === null) {
    const waited = ours() - known.since;
    return waited < SILENT_MS ? dead("CONNECTING", "", "") : dead("NO CONTACT", `nothing heard from the drone for ${words(waited)}`);
  }
  const silent = known.awake ? ours() - known.heard : SILENT_MS + 1;
  if (silent > SILENT_MS) {
    return dead("NO CONTACT", `nothing heard from the drone for ${words(ours() - known.heard)}; what stands below is old`);
  }
  const { health, marks } = known;
  if (!health) return dead("STARTING", "the daemon is up, no frame was taken yet", "warn");
  const still = age(health.now_ns / 1e6);
  if (still > STILL_MS) return dead("STANDS STILL", `the daemon's frame path does nothing for ${words(still)}`);
  if (health.paused) return dead("PAUSED", "by a command: no frame is looked at", "warn");
  const last = marks[marks.length - 1];
  if (!last) return dead("NO FRAMES", "the camera gave no frame yet");
  if (age(last.t) > NO_FRAMES_MS + (last.late_ms || 0)) {
    return dead("NO FRAMES", `the camera is silent for ${words(age(last.t))}`);
  }
  const fix = lastFix(), old = !fix || age(fix.t) > OLD_FIX_MS;
  const refused = last.reason ? REASONS[last.reason] || last.reason : "";
  const state = !fix ? { kind: "warn", word: "NO FIX YET", why: refused }
    : old ? { kind: "warn", word: `NO FIX ${words(age(fix.t))}`, why: refused || "frames take too long" }
      : { kind: "good", word: "FIX", why: `${words(age(fix.t))} old, \u03c3 ${metres(sigmaOf(fix.fix))}` };
  if (health.autopilot.connected) return { ...state, old, dead: false };
  // Whatever the camera finds, nobody steers by it.
  return { kind: "bad", word: "LINK LOST", why: `autopilot not heard; ${state.word.toLowerCase()}, ${state.why}`, old, dead: false };
}

function lastFix() {
  for (let k = known.marks.length - 1; k >= 0; k--) if (known.marks[k].fix) return known.marks[k];
  return null;
}

const sigmaOf = (pose) => ellipseOf(pose.cov, 1).long;

function metres(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "\u2013";
  return value < 9.995 ? `${value.toFixed(2)} m` : value < 999.5 ? `${value.toFixed(1)} m` : `${(value / 1000).toFixed(2)} km`;
}

function badges(state) {
  const list = [], { health } = known;
  if (!health) return list;
  const { autopilot } = health;
  list.push(autopilot.connected ? ["good", "link up"] : ["bad", "LINK LOST"]);
  const fusion = { fused: ["good", "fixes fused"], rejected: ["bad", "FIXES REJECTED"],
    ignored: ["warn", "fixes ignored"] }[autopilot.fusion];
  if (autopilot.connected) list.push(fusion || ["calm", "fixes: use unknown"]);
  const gnss = { ok: ["good", "GNSS agrees"], suspect: ["warn", "GNSS suspect"], bad: ["bad", "GNSS CONTRADICTS"] }[autopilot.gnss];
  if (gnss && autopilot.connected) list.push(gnss);
  const { computer } = health;
  if (computer.is_under_voltage) list.push(["bad", "UNDER-VOLTAGE"]);
  if (computer.is_throttled) list.push(["warn", "throttled"]);
  if (computer.is_hot) list.push(["warn", "hot"]);
  if (health.rung > 0) list.push(["warn", `less detail${health.rate_hz ? `, ${health.rate_hz} Hz` : ""}: rung ${health.rung} of ${health.rungs - 1}`]);
  if (health.statistics.map_files_damaged) list.push(["warn", `${health.statistics.map_files_damaged} map files damaged`]);
  return state.word === "NO CONTACT" ? list.map(([, text]) => ["calm", `${text} (old)`]) : list;
}

/* -- showing it; text only ever as text -- */

function element(tag, className, text) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

function render() {
  const state = verdict();
  document.body.className = state.dead ? "dead" : "";
  const box = byId("state");
  box.className = state.kind;
  setText("state-word", state.word);
  setText("state-why", state.why);
  byId("badges").replaceChildren(...badges(state).map(([kind, text]) => element("li", kind, text)));
  renderMap(state);
  renderFigures(state);
  renderStages();
  renderRejections();
  setText("frame-note", known.picture ? frameNote() : "none yet");
}

function setText(id, text) {
  const node = byId(id);
  if (node.textContent !== text) node.textContent = text;
}

function frameNote() {
  const { picture } = known;
  const what = picture.reason ? REASONS[picture.reason] || picture.reason : `${picture.inliers.length} of its matches`;
  return `${words(age(picture.t))} ago, ${what}`;
}

function way() {
  const first = known.marks.length ? known.marks[0].t : Infinity;
  const recent = known.marks.map((mark) => [mark.fix || mark.prior, mark.fix ? 1 : 0]).filter(([pose]) => pose);
  return [...known.track.filter((place) => place[3] < first), ...recent.map(([pose, isFix]) => [...pose.at.slice(0, 2), isFix])];
}

function renderMap(state) {
  if (!map) return;
  const { marks } = known;
  const last = marks[marks.length - 1] || null, fix = lastFix();
  const isOld = state.old && fix !== null;
  const note = byId("map-old");
  note.hidden = !isOld;
  if (isOld) note.textContent = `last fix ${words(age(fix.t))} old`;
  const isNow = last !== null && !state.dead;
  map.show({
    track: way(),
    pose: fix ? fix.fix : null,
    prior: isNow ? last.prior || null : null,
    believed: isNow ? last.believed || null : null,
    gnss: isNow ? last.gnss || null : null,
    points: isNow && known.picture && !state.old ? known.picture.inliers.map((row) => [row[4], row[5]]) : [],
    old: isOld ? `${words(age(fix.t))} old` : null,
  });
  if (!zoomed && (fix || (last && last.prior))) {
    // The pack may be kilometres wide: begin where the flight is.
    zoomed = true;
    const pose = fix ? fix.fix : last.prior;
    const reach = Math.max(90, ...(pose.rim || []).map(([e, n]) => 1.6 * Math.hypot(e - pose.at[0], n - pose.at[1])));
    map.fit([pose.at[0] - reach, pose.at[1] - reach, pose.at[0] + reach, pose.at[1] + reach]);
  }
}

function renderFigures(state) {
  const { health, marks } = known;
  const fix = lastFix(), last = marks[marks.length - 1];
  const figures = [];
  const add = (name, value, note = "", kind = "", ofFix = false) => figures.push([name, value, note, kind, ofFix]);
  if (fix) {
    add("1 \u03c3 across", metres(sigmaOf(fix.fix)), `height \u00b1 ${metres(fix.fix.sigma_h)}`, "", true);
    add("Last fix", `${words(age(fix.t))} ago`, `quality ${Math.round(100 * (fix.quality || 0))} %`, "", true);
    add("Inliers", `${fix.inliers}`, `of ${fix.matches} matches, rms ${fix.rms_px} px`, "", true);
  } else {
    add("1 \u03c3 across", "\u2013", "no fix yet");
    add("Last fix", "none");
    add("Inliers", "\u2013");
  }
  const recent = marks.slice(-60);
  if (recent.length > 1) {
    const span = (recent[recent.length - 1].t - recent[0].t) / 1000;
    const fixes = recent.filter((mark) => mark.fix).length;
    add("Fixes", `${fixes} of ${recent.length}`, span > 0 ? `${((recent.length - 1) / span).toFixed(1)} frames/s` : "");
  }
  if (last && last.late_ms !== undefined) {
    const late = recent.map((mark) => mark.late_ms).filter((ms) => ms !== undefined).sort((a, b) => a - b);
    add("Exposure to outcome", `${Math.round(late[Math.floor(late.length / 2)])} ms`,
      `median; most ${Math.round(late[late.length - 1])} ms`);
  }
  if (health) {
    const { autopilot, computer, statistics } = health;
    add("Sent to autopilot", `${statistics.sent}`, autopilot.latency_median_ms === null ? "nothing yet"
      : `exposure to sent ${Math.round(autopilot.latency_median_ms)} ms, p99 ${Math.round(autopilot.latency_p99_ms)} ms`);
    const fusion = { fused: "good", rejected: "bad", ignored: "warn" }[autopilot.fusion] || "";
    add("Autopilot", autopilot.connected ? autopilot.fusion : "LINK LOST",
      autopilot.connected ? [health.vehicle, autopilot.fusion_reason].filter(Boolean).join(": ")
        : health.trouble || "nothing heard", autopilot.connected ? fusion : "bad");
    const apart = autopilot.gnss_apart_m === null ? "" : `${metres(autopilot.gnss_apart_m)} from the last fix`;
    add("GNSS", autopilot.gnss, apart, { ok: "good", suspect: "warn", bad: "bad" }[autopilot.gnss] || "");
    const hottest = computer.temperatures_c.length ? Math.max(...computer.temperatures_c) : null;
    const flags = [computer.is_under_voltage && "under-voltage", computer.is_throttled && "throttled", computer.is_hot && "hot"]
      .filter(Boolean).join(", ");
    add("Temperature", hottest === null ? "no sensor" : `${Math.round(hottest)} \u00b0C`, flags || "not throttled",
      flags ? "warn" : "");
    const busy = computer.cpu_percent;
    add("Processor", busy.length ? `${Math.round(busy.reduce((a, b) => a + b, 0) / busy.length)} %` : "\u2013",
      `of ${busy.length} cores; memory ${computer.memory_used_mib} of ${computer.memory_total_mib} MiB`);
    add("Detail", health.rung === 0 ? "full" : `rung ${health.rung} of ${health.rungs - 1}`,
      health.rung === 0 ? "" : [health.rate_hz && `${health.rate_hz} frames a second`, health.rung_why].filter(Boolean).join("; "),
      health.rung === 0 ? "" : "warn");
    add("Tracker", health.tracker, `${statistics.fixes || 0} fixes, ${statistics.rejected || 0} frames without`);
  }
  if (fix && known.scene) {
    const [east, north] = known.scene.origin;
    add("Camera at", `${(east + fix.fix.at[0]).toFixed(1)} E`, `${(north + fix.fix.at[1]).toFixed(1)} N, height ` +
      `${fix.fix.at[2].toFixed(1)} m (map's)`, "long", true);
  }
  byId("figures").replaceChildren(...figures.map(([name, value, note, kind, ofFix]) => {
    const box = element("div", ofFix && state.old ? "figure old" : "figure");
    box.append(element("h3", "", name), element("b", kind, value), element("p", "", note));
    return box;
  }));
}

function renderStages() {
  const taken = known.marks.slice(-30).map((mark) => mark.took_ms).filter((took) => took && took.total !== undefined);
  const rows = [];
  const box = byId("stages");
  setText("stages-note", taken.length ? `median of the last ${taken.length}, ms` : "none yet");
  if (!taken.length) return box.replaceChildren();
  // Structural matching is one stage with the others inside.
  const sums = ["structural", "total"];
  const names = [...new Set(taken.flatMap(Object.keys))].filter((name) => !sums.includes(name));
  const median = (name) => {
    const values = taken.map((took) => took[name] || 0).sort((a, b) => a - b);
    return values[Math.floor(values.length / 2)];
  };
  const total = median("total"), budget = (known.health && known.health.budget_ms) || total;
  const top = Math.max(total, budget);
  const shown = names.filter((name) => median(name) >= 0.05).sort((a, b) => median(b) - median(a));
  for (const name of [...shown, ...(median("structural") ? sums : ["total"])]) {
    const isSum = sums.includes(name);
    const label = element("span", isSum ? "all" : "", { structural: "structural, in all", total: "frame, in all" }[name]
      || name.replaceAll("_", " "));
    const bar = element("div", "bar"), fill = element("i", name === "total" && total > budget ? "over" : "");
    fill.style.width = `${Math.min(100, 100 * median(name) / top).toFixed(1)}%`;
    bar.append(fill);
    rows.push(label, bar, element("span", isSum ? "all" : "", median(name).toFixed(median(name) < 10 ? 1 : 0)));
  }
  return box.replaceChildren(...rows);
}

function renderRejections() {
  const refused = known.marks.filter((mark) => mark.reason).slice(-SHOWN_REJECTIONS).reverse();
  setText("rejections-note", refused.length ? "" : "none lately");
  byId("rejections").replaceChildren(...refused.map((mark) => {
    const item = element("li");
    const measured = mark.measured === undefined || mark.measured === null ? ""
      : ` (${Number(mark.measured.toPrecision(3))}${mark.limit === undefined || mark.limit === null ? ""
        : `, limit ${Number(mark.limit.toPrecision(3))}`})`;
    item.append(element("span", "", `${words(age(mark.t))} ago`), element("b", "", REASONS[mark.reason] || mark.reason),
      element("p", "", `${mark.detail || mark.reason}${measured}`));
    return item;
  }));
}

function drawFrame() {
  const { picture } = known;
  if (!picture) return;
  const canvas = byId("frame");
  const [width, height] = picture.size;
  if (canvas.width !== width * 2) {
    canvas.width = width * 2;
    canvas.height = height * 2;
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(2, 0, 0, 2, 0, 0);
  pen.drawImage(picture.image, 0, 0, width, height);
  drawInliers(pen, picture.inliers);
}

/* -- the line to the daemon -- */

let source = null;

function connect() {
  if (source) source.close();
  source = new EventSource("/events");
  source.onmessage = (message) => hear(JSON.parse(message.data));
  source.onerror = () => {
    // The browser tries again by itself, unless it was refused.
    if (source.readyState === EventSource.CLOSED) setTimeout(connect, 3000);
  };
}

// A phone that slept: its clock may have stood still, so nothing counts as fresh until it hears again.
document.addEventListener("visibilitychange", () => {
  if (document.visibilityState === "visible") {
    known.awake = false;
    connect();
    render();
  } else if (source) {
    source.close();
  }
});

setInterval(render, 500);
connect();
render();
