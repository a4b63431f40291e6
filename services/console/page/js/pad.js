// Hold-to-move pad: mouse, touch, keys and gamepad together make one press. The press ends when all inputs are released, when
// the page loses focus or visibility, or when the page freezes.

const SAY_MS = 66; // period of the drive message while the pad is held; the console publishes only the newest
const DEAD_ZONE = 0.25; // of a gamepad axis, as a share of its range
const TURN = 0.3; // [rad/s] at full speed
const KEYS = {
  KeyW: [1, 0, 0], ArrowUp: [1, 0, 0], KeyS: [-1, 0, 0], ArrowDown: [-1, 0, 0],
  KeyA: [0, 1, 0], KeyD: [0, -1, 0], KeyQ: [0, 0, 1], ArrowLeft: [0, 0, 1], KeyE: [0, 0, -1], ArrowRight: [0, 0, -1],
};

export class Pad {
  /**
   * @param {(fields: object) => boolean} drive sends the velocity of the press; returns false without a connection
   * @param {() => void} release sends the end of the press
   * @param {() => {speed: number}} walk returns the speed and the walking parameters
   * @param {(words: string) => void} sayCut shows why a press was ended
   */
  constructor(drive, release, walk, sayCut) {
    this.drive = drive;
    this.release = release;
    this.walk = walk;
    this.sayCut = sayCut;
    this.deadManMs = 0; // gap between two updates after which the page counts as frozen; the console sends its dead-man time
    this.press = 0; // number of the newest press
    this.held = false;
    this.stale = false; // the press was ended while inputs were held; they are ignored until all are released
    this.stick = [0, 0];
    this.turns = new Map(); // pointer -> direction
    this.keys = new Set();
    this.gamepad = [0, 0, 0];
    this.pad = document.getElementById("pad");
    this.knob = document.getElementById("knob");
    this.seen = performance.now();
    this.listenToPointers();
    this.listenToKeys();
    for (const [target, name] of [[window, "blur"], [window, "pagehide"], [document, "freeze"]]) target.addEventListener(name, () => this.cut());
    document.addEventListener("visibilitychange", () => document.hidden && this.cut());
    setInterval(() => this.look(), SAY_MS);
  }

  /** Return the wanted motion [forward, left, turn], each from -1 to 1; null without input. */
  wish() {
    let [forward, left, turn] = [this.stick[0], this.stick[1], 0];
    for (const direction of this.turns.values()) turn += direction;
    for (const key of this.keys) {
      const [f, l, t] = KEYS[key];
      forward += f; left += l; turn += t;
    }
    forward += this.gamepad[0]; left += this.gamepad[1]; turn += this.gamepad[2];
    const length = Math.max(1, Math.hypot(forward, left));
    const touched = this.pointer !== undefined || this.turns.size || this.keys.size || this.gamepad.some(Boolean);
    return touched ? [forward / length, left / length, Math.max(-1, Math.min(1, turn))] : null;
  }

  look() {
    const now = performance.now();
    const frozen = now - this.seen > this.deadManMs;
    this.seen = now;
    this.readGamepad();
    if (frozen && this.held) {
      this.cut();
      this.sayCut("this page was paused, and the robot was stopped; release the pad and press it again");
    }
    const wish = this.wish();
    if (wish === null) {
      this.stale = false;
      this.end();
    } else if (!this.stale) {
      this.say(wish);
    }
    this.draw(wish);
  }

  say([forward, left, turn]) {
    if (!this.held) {
      this.held = true;
      this.press++;
    }
    const { speed, ...walk } = this.walk();
    const share = speed / walk.fastest;
    delete walk.fastest;
    const sent = this.drive({ press: this.press, forward: forward * speed, left: left * speed, turn: turn * TURN * share, ...walk });
    if (!sent) this.cut();
  }

  end() {
    if (!this.held) return;
    this.held = false;
    this.release();
  }

  /** End the press; held inputs are ignored until they are released. */
  cut() {
    this.end();
    this.stick = [0, 0];
    this.pointer = undefined;
    this.turns.clear();
    this.keys.clear();
    this.stale = this.gamepad.some(Boolean); // pointers and keys are cleared, but a stick must return to its centre
    this.draw(null);
  }

  listenToPointers() {
    const { pad } = this;
    const place = (event) => {
      const box = pad.getBoundingClientRect();
      const x = ((event.clientX - box.left) / box.width) * 2 - 1;
      const y = ((event.clientY - box.top) / box.height) * 2 - 1;
      const length = Math.max(1, Math.hypot(x, y));
      this.stick = [-y / length, -x / length];
    };
    pad.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      pad.setPointerCapture(event.pointerId);
      this.pointer = event.pointerId;
      place(event);
      this.look();
    });
    pad.addEventListener("pointermove", (event) => event.pointerId === this.pointer && place(event));
    const up = (event) => {
      if (event.pointerId !== this.pointer) return;
      this.pointer = undefined;
      this.stick = [0, 0];
      this.look();
    };
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) pad.addEventListener(name, up);
    pad.addEventListener("contextmenu", (event) => event.preventDefault());
    for (const button of document.querySelectorAll(".turn")) {
      const direction = Number(button.dataset.turn);
      button.addEventListener("pointerdown", (event) => {
        event.preventDefault();
        button.setPointerCapture(event.pointerId);
        this.turns.set(event.pointerId, direction);
        this.look();
      });
      const off = (event) => {
        if (this.turns.delete(event.pointerId)) this.look();
      };
      for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) button.addEventListener(name, off);
      button.addEventListener("contextmenu", (event) => event.preventDefault());
    }
  }

  listenToKeys() {
    const typing = (event) => event.target.matches("input[type=text], textarea, select") || event.ctrlKey || event.metaKey || event.altKey;
    window.addEventListener("keydown", (event) => {
      if (!(event.code in KEYS) || typing(event)) return;
      if (event.target.matches("input[type=range]") && event.code.startsWith("Arrow")) return;
      event.preventDefault();
      if (event.repeat) return;
      this.keys.add(event.code);
      this.look();
    });
    window.addEventListener("keyup", (event) => {
      if (this.keys.delete(event.code)) this.look();
    });
  }

  readGamepad() {
    const found = [...(navigator.getGamepads?.() ?? [])].find((pad) => pad && pad.connected);
    const axis = (value) => (Math.abs(value) > DEAD_ZONE ? value : 0);
    this.gamepad = found ? [-axis(found.axes[1] ?? 0), -axis(found.axes[0] ?? 0), -axis(found.axes[2] ?? 0)].map((v) => v || 0) : [0, 0, 0];
  }

  draw(wish) {
    const [forward, left] = wish ?? [0, 0];
    const looks = [this.held, ...(wish ?? [])].join();
    if (looks === this.drawn) return; // layout takes longer than the rest of an update
    this.drawn = looks;
    this.pad.classList.toggle("held", this.held);
    const reach = this.pad.clientWidth / 2 - 20;
    this.knob.style.transform = `translate(${-left * reach}px, ${-forward * reach}px)`;
    for (const button of document.querySelectorAll(".turn")) {
      button.classList.toggle("held", this.held && wish !== null && Math.sign(wish[2]) === Number(button.dataset.turn));
    }
  }
}
