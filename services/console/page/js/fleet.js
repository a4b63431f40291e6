// Overview of all robots of a base station: a summary of each robot, and stop buttons for each and for all.

import { Link } from "./link.js";

const $ = (id) => document.getElementById(id);

function made(kind, className = "", words = "") {
  const element = document.createElement(kind);
  element.className = className;
  element.textContent = words;
  return element;
}

class Card {
  constructor(name) {
    this.name = name;
    this.item = made("li", "robot");
    this.title = made("a", "name", name);
    this.title.href = `${name}/${location.hash}`; // keeps the token
    this.mode = made("b", "mode lost", "no link");
    this.reason = made("p", "reason", "connecting");
    this.planner = made("p", "dim");
    this.power = made("p", "dim");
    this.wrong = made("p", "bad");
    const stop = made("button", "stop", "stop");
    const off = made("button", "off", "torque off");
    for (const [button, order] of [[stop, "stop"], [off, "off"]]) {
      // Send on pointerdown, and again on click, which keyboards and assistive tools produce; a repeat is harmless.
      for (const event of ["pointerdown", "click"]) button.addEventListener(event, () => this.order(order));
    }
    const heading = made("h2");
    const orders = made("div", "orders");
    heading.append(this.title, this.mode);
    orders.append(stop, off);
    this.item.append(heading, this.reason, this.planner, this.power, this.wrong, orders);
    this.link = new Link({ up() {}, down: (why) => this.show(null, why), text: (message) => this.take(message), frame() {} }, `${name}/socket?glance`);
  }

  order(order) {
    if (!this.link.ask("order", { order })) this.wrong.textContent = `${order === "off" ? "torque off" : "stop"} was not sent: no link`;
  }

  take(message) {
    if (message.type === "glance") this.show(message, "");
    else if (message.type === "refused") this.wrong.textContent = message.words;
  }

  show(glance, why) {
    const mode = glance && glance.mode ? glance.mode : "lost";
    this.mode.textContent = glance ? mode : "no link";
    this.mode.className = `mode ${mode}`;
    this.reason.textContent = glance ? glance.reason : why;
    this.planner.textContent = glance ? glance.planner : "";
    const known = glance ? [glance.voltage === null ? "" : `${glance.voltage.toFixed(1)} V`, glance.temperature === null ? "" : `hottest ${glance.temperature.toFixed(0)} °C`, glance.leader ? `${glance.leader} is in control` : "no client is in control"] : [];
    this.power.textContent = known.filter(Boolean).join(", ");
    this.wrong.textContent = glance && glance.silent.length ? `silent: ${glance.silent.join(", ")}` : "";
    this.fine = Boolean(glance && glance.mode);
    count();
  }
}

let cards = [];

function count() {
  const here = cards.filter((card) => card.fine).length;
  $("count").textContent = `${here} of ${cards.length} robots are connected`;
}

function orderAll(order) {
  for (const card of cards) card.order(order);
}

for (const [id, order] of [["stop-all", "stop"], ["off", "off"]]) {
  for (const event of ["pointerdown", "click"]) $(id).addEventListener(event, () => orderAll(order));
}
window.addEventListener("keydown", (event) => {
  if (event.code === "Space" && !event.target.matches("button, a")) {
    event.preventDefault();
    orderAll("stop");
  } else if (event.code === "Escape" && event.shiftKey) orderAll("off");
});

const { robots } = await (await fetch("robots.json")).json();
cards = robots.map((name) => new Card(name));
$("robots").replaceChildren(...cards.map((card) => card.item));
count();
window.sextant = { cards };
