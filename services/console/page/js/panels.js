// Panels next to the view: mode, lease holder, planner, servos, services and log. All text is set as text, never as HTML.

import { LEGENDS, SHOWN, TABLES } from "./colors.js";

const $ = (id) => document.getElementById(id);
const MOST_LINES = 200;
const NUMBERS_MS = 200; // period of numeric values; their layout takes longer than drawing the robot

function set(id, words, kind = "") {
  write($(id), words);
  mark($(id), kind);
}

// Skip unchanged text, because the browser repeats the layout even if the new text is the same.
function write(element, words) {
  if (element.textContent !== words) element.textContent = words;
}

function mark(element, kind) {
  if (element.className !== kind) element.className = kind;
}

const FIRST = { // what to do before the first walk, by mode
  off: 'Press "stand": the robot gets up.',
  ready: 'Press "stand": the robot gets up.',
  stand: "The robot is getting up.",
  hold: 'Hold the pad to walk, or press "goal" and click the map.',
};

export class Panels {
  constructor() {
    this.walked = this.calibrating = false;
    this.seat = 0;
    this.robot = null;
    this.cells = [];
    this.newest = null; // newest state whose numbers are not shown yet
  }

  hello(message) {
    this.seat = message.seat;
    this.robot = message.robot;
    set("robot", `Sextant: ${message.robot.name}`);
    document.title = `${message.robot.name} - Sextant`;
    $("entries").replaceChildren(); // the console sends the whole log next
    const body = $("loads");
    body.replaceChildren();
    this.cells = message.robot.legs.map((leg, i) => {
      const row = body.insertRow();
      const name = row.insertCell();
      const foot = document.createElement("span");
      foot.className = "foot";
      name.append(foot, leg.name);
      const bars = message.robot.servo_ids[i].map((id) => {
        const cell = row.insertCell();
        const bar = document.createElement("span");
        const fill = document.createElement("i");
        const text = document.createElement("b");
        bar.className = "bar";
        bar.title = `servo ${id}`;
        bar.append(fill, text);
        cell.append(bar);
        return { fill, text };
      });
      return { foot, bars };
    });
  }

  down(why) {
    set("mode-word", "no link", "lost");
    set("mode-reason", why);
    set("leader-words", "");
  }

  state(state) {
    const { legs } = state;
    set("mode-word", legs ? legs.mode : "lost", legs ? legs.mode : "lost");
    set("mode-reason", legs ? legs.reason : "no message from the actuator");
    const leading = state.seats.find((seat) => seat.leads);
    const mine = Boolean(leading) && leading.seat === this.seat;
    const lease = legs ? legs.lease : "";
    set("leader-words", mine ? "you are in control" : lease ? `${leading ? leading.name : lease} is in control` : "no client is in control");
    mark($("leader"), mine ? "me" : "");
    $("take-over").hidden = mine || !lease || this.seat === 0;
    $("give-up").disabled = !state.goal;
    this.first(legs ? legs.mode : "", this.seat > 0 && (mine || !lease));
    if (this.newest === null) setTimeout(() => this.numbers(), NUMBERS_MS);
    this.newest = state;
  }

  /** Show what to do first, until the robot walks. */
  first(mode, free) {
    this.walked ||= mode === "walk";
    const words = (!this.walked && free && FIRST[mode]) || "";
    write($("first"), words);
    $("first").hidden = !words;
  }

  numbers() {
    const { legs, planner, pose, camera, recorder } = this.newest;
    this.newest = null;
    set("planner-words", planner ? `${planner.state}: ${planner.reason}` : "no message from the planner", planner && planner.state === "blocked" ? "bad" : "");
    const at = pose ? `x ${pose.T[3].toFixed(2)} m, y ${pose.T[7].toFixed(2)} m, ${((pose.yaw * 180) / Math.PI).toFixed(0)} deg` : "no pose";
    const overlap = pose && pose.overlap !== null ? `, overlap ${(100 * pose.overlap).toFixed(0)} %` : "";
    set("pose-words", `${at}${overlap}${pose && pose.reason ? `: ${pose.reason}` : ""}`, pose && !pose.ok ? "warn" : "");
    set("camera-words", camera ? (camera.ok ? camera.device : camera.reason) : "", camera && !camera.ok ? "bad" : "");
    this.recorder(recorder);
    if (legs && this.robot) this.servos(legs);
  }

  /** Show the progress of a calibration, or its result; open the panel when a calibration begins. */
  calibration({ running, status, posture, postures, result, refusal }) {
    const words = running ? status : refusal ? `not written: ${refusal}` : "measured; restart the services with the file that the command has written";
    set("calibration-words", words, running ? "" : refusal ? "bad" : "good");
    const bar = $("calibration-progress");
    bar.max = postures;
    bar.value = posture;
    bar.hidden = !running;
    $("calibration-command").hidden = true;
    $("calibration-result").replaceChildren(...result.map((line) => item(line.replaceAll(/ +/g, " ").replaceAll("+-", "±"))));
    if (running && !this.calibrating) $("calibration").open = true;
    this.calibrating = running;
  }

  recorder(recorder) {
    const button = $("record");
    button.disabled = !recorder;
    button.setAttribute("aria-pressed", String(Boolean(recorder && recorder.recording)));
    write(button, recorder && recorder.recording ? "end" : "record");
    if (!recorder) return set("recorder-words", "no recorder is running", "");
    const free = recorder.disk_free_gb === null ? "" : `, ${recorder.disk_free_gb} GB free`;
    const lost = recorder.dropped ? `, ${recorder.dropped} messages lost` : "";
    const how = `${recorder.duration_s} s, ${recorder.size_mb} MB${free}${lost}`;
    const words = recorder.recording ? `${how}: ${recorder.file}` : recorder.file ? `recorded ${recorder.file}` : `no recording yet${free}`;
    return set("recorder-words", recorder.reason || words, recorder.reason ? "bad" : lost ? "warn" : "");
  }

  servos(legs) {
    const { stall_torques: stall, warm_temperature: hot, warn_voltage: low } = this.robot;
    const volts = legs.voltage === null ? "voltage unknown" : `${legs.voltage.toFixed(1)} V`;
    const warm = legs.temperature === null ? "temperature unknown" : `hottest ${legs.temperature.toFixed(0)} °C`;
    const tired = legs.speed_scale < 1 ? `, walking at ${(100 * legs.speed_scale).toFixed(0)} %` : "";
    const bad = (legs.voltage !== null && legs.voltage < low) || (legs.temperature !== null && legs.temperature > hot);
    set("power", `${volts}, ${warm}${tired}`, bad ? "warn" : "");
    this.cells.forEach(({ foot, bars }, i) => {
      mark(foot, `foot ${legs.contact[i] ? "carries" : ""} ${legs.swing[i] ? "swings" : ""}`);
      bars.forEach(({ fill, text }, j) => {
        const share = Math.abs(legs.load[3 * i + j]) / stall[3 * i + j];
        const width = `${Math.min(100, 100 * share).toFixed(0)}%`;
        if (fill.style.width !== width) fill.style.width = width;
        mark(fill, share > 0.8 ? "bad" : share > 0.45 ? "warn" : "");
        write(text, legs.load[3 * i + j].toFixed(2));
      });
    });
    const list = $("warnings");
    if (list.dataset.said !== legs.warnings.join("\n")) {
      list.dataset.said = legs.warnings.join("\n");
      list.replaceChildren(...legs.warnings.map((words) => item(words)));
    }
  }

  health(message) {
    const slow = message.too_slow ? [item(message.too_slow)] : [];
    const p99 = message.services.map((service) => service.stages["capture to plan"]).find((ms) => ms !== undefined);
    const latency = p99 === undefined ? [] : [item(`depth image to legs: 99 % within ${p99.toFixed(0)} ms`)];
    slow.forEach((line) => line.classList.add("silent", "slow"));
    $("service-list").replaceChildren(...slow, ...latency, ...message.services.map((service) => {
      const line = document.createElement("li");
      const name = document.createElement("b");
      name.textContent = `${service.name} `;
      const words = document.createElement("span");
      words.textContent = service.silent ? `silent for ${service.age_s.toFixed(0)} s` : service.status;
      line.className = service.silent ? "silent" : "";
      const clock = service.robot_clock_offset_s ? [`another machine; the robot's clock is ${service.robot_clock_offset_s} s ahead of its clock`] : [];
      line.title = [...clock, ...Object.entries(service.stages).map(([stage, p99]) => `${stage}: p99 ${p99} ms`)].join("\n");
      line.append(name, words);
      return line;
    }));
  }

  log(message) {
    const list = $("entries");
    for (const entry of message.entries) {
      const line = document.createElement("li");
      const time = document.createElement("time");
      time.textContent = new Date(Date.now() - 1000 * entry.ago_s).toTimeString().slice(0, 8);
      const who = document.createElement("b");
      who.textContent = entry.who;
      const words = document.createElement("span");
      words.textContent = entry.words;
      line.className = entry.bad ? "bad" : "";
      line.append(time, who, words);
      list.prepend(line);
    }
    while (list.children.length > MOST_LINES) list.lastChild.remove();
  }

  map(header) {
    const [low, high] = LEGENDS[header.layer];
    set("legend-low", low);
    set("legend-high", high);
    document.querySelector("input[name=layer][value=color]").disabled = !header.layers.includes("color");
    const bar = $("legend-bar");
    bar.hidden = header.layer === "color";
    if (bar.hidden || bar.dataset.layer === header.layer) return;
    bar.dataset.layer = header.layer;
    const context = bar.getContext("2d");
    const image = context.createImageData(256, 1);
    for (let i = 0; i < 256; i++) {
      const k = Math.round((i / 255) * SHOWN[header.layer]);
      image.data.set(TABLES[header.layer].subarray(4 * k, 4 * k + 4), 4 * i);
    }
    context.putImageData(image, 0, 0);
  }

  picture(header, data, offset) {
    const depth = data.slice(offset, offset + header.depth);
    const color = data.slice(offset + header.depth, offset + header.depth + header.color);
    for (const [id, bytes] of [["depth", depth], ["color", color]]) {
      const image = $(id);
      if (bytes.byteLength === 0) {
        image.hidden = true;
        continue;
      }
      if (image.src) URL.revokeObjectURL(image.src);
      image.src = URL.createObjectURL(new Blob([bytes], { type: "image/jpeg" }));
      image.hidden = false;
    }
  }

  hidePictures() {
    $("depth").hidden = $("color").hidden = true;
  }

  notice(words) {
    set("notice", words);
    $("notice").hidden = false;
    clearTimeout(this.fading);
    this.fading = setTimeout(() => ($("notice").hidden = true), 5000);
  }
}

function item(words) {
  const line = document.createElement("li");
  line.textContent = words;
  return line;
}
