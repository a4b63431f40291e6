// Main module of the page: shows the console's messages and sends the operator's requests.

import { Link } from "./link.js";
import { Pad } from "./pad.js";
import { Panels } from "./panels.js";
import { View } from "./view.js";

const $ = (id) => document.getElementById(id);
const HERE_MS = 1000;

const panels = new Panels();
const view = new View($("scene"), clicked);
let layer = "score";
let looking = false;
let aiming = false;
let fastest = 0.11;

const link = new Link({
  up() {
    watch();
  },
  down(why) {
    pad.cut();
    panels.down(why);
  },
  text(message) {
    switch (message.type) {
      case "hello":
        panels.hello(message);
        view.robot.build(message.robot);
        fit(message.walk);
        pad.deadManMs = message.dead_man_ms;
        break;
      case "state":
        panels.state(message);
        view.show(message);
        break;
      case "passage":
        view.robot.passage(message);
        view.touch();
        break;
      case "calibration":
        panels.calibration(message);
        break;
      case "health":
        panels.health(message);
        break;
      case "log":
        panels.log(message);
        break;
      case "refused":
        pad.cut(); // a held pad no longer moves the robot
        panels.notice(message.words);
        break;
    }
  },
  frame(header, data, offset) {
    if (header.type === "map") {
      view.terrain.show(header, data, offset);
      panels.map(header);
      view.touch();
    } else if (looking) {
      panels.picture(header, data, offset);
    }
    link.ask("seen", { what: header.type });
  },
});

const pad = new Pad(
  (fields) => link.ask("drive", fields),
  () => link.ask("release"),
  () => ({ speed: Number($("speed").value), fastest, ...walk(), blind_walking: $("by-touch").checked }),
  (words) => panels.notice(words),
);

function walk() {
  return { height: Number($("height").value), lift: Number($("lift").value), gait: $("gait").value };
}

function fit(said) {
  fastest = said.speed;
  for (const [id, low, high, value, unit] of [
    ["speed", 0.02, said.speed, said.speed, "cm/s"], ["height", ...said.heights, said.height, "cm"], ["lift", ...said.lifts, said.lift, "cm"],
  ]) {
    const input = $(id);
    input.min = low;
    input.max = high;
    if (!input.dataset.fitted) input.value = value;
    input.dataset.fitted = "yes";
    const tell = () => ($(`${id}-out`).textContent = `${(100 * input.value).toFixed(1)} ${unit}`);
    input.oninput = tell;
    tell();
  }
}

function watch() {
  link.ask("watch", { layer, picture: looking });
}

function aim(on) {
  aiming = on;
  $("goal").setAttribute("aria-pressed", String(on));
  $("scene").classList.toggle("goal", on);
}

function clicked(point) {
  if (!aiming) return;
  aim(false);
  if (!point) {
    panels.notice("the ground is unknown there; click on the map");
    return;
  }
  link.ask("go to", { waypoints: [[point.x, point.y]], speed: Number($("speed").value), ...walk(), passage: $("passage").checked });
}

for (const order of ["off", "stop"]) {
  // Send on pointerdown, and again on click, which keyboards and assistive tools produce; a repeat is harmless.
  for (const name of ["pointerdown", "click"]) $(order).addEventListener(name, () => link.ask("order", { order }));
}
for (const button of document.querySelectorAll("[data-order]")) button.onclick = () => link.ask("order", { order: button.dataset.order });
$("take-over").onclick = () => link.ask("take over");
$("goal").onclick = () => aim(!aiming);
$("give-up").onclick = () => link.ask("give up");
$("follow").onclick = () => {
  view.follow = !view.follow;
  $("follow").setAttribute("aria-pressed", String(view.follow));
};
$("above").onclick = () => view.look("above");
$("behind").onclick = () => view.look("behind");
$("look").onclick = () => {
  looking = !looking;
  $("look").setAttribute("aria-pressed", String(looking));
  $("look").textContent = looking ? "hide" : "show";
  if (!looking) panels.hidePictures();
  watch();
};
$("record").onclick = () => link.ask("record", { on: $("record").getAttribute("aria-pressed") !== "true" });
for (const choice of document.querySelectorAll("input[name=layer]")) {
  choice.onchange = () => {
    layer = choice.value;
    watch();
  };
}
window.addEventListener("keydown", (event) => {
  if (event.code === "Space" && !event.target.matches("button, input, select")) {
    event.preventDefault();
    link.ask("order", { order: "stop" });
  } else if (event.code === "Escape") {
    if (event.shiftKey) link.ask("order", { order: "off" });
    aim(false);
  }
});
setInterval(() => document.hidden || link.ask("here"), HERE_MS);

window.sextant = { view, link, pad }; // for the browser's developer tools and for tests

// Behind a fleet proxy, each robot's page is below its name. A console without a proxy returns an empty list of robots.
const { robots, here } = await (await fetch("robots.json")).json();
if (robots.length > 0) {
  $("fleet").hidden = false;
  $("all-robots").href = `../${location.hash}`; // keeps the token
  $("robots").replaceChildren(...robots.map((name) => new Option(name, name, name === here, name === here)));
  $("robots").onchange = () => location.assign(`../${$("robots").value}/${location.hash}`);
}
