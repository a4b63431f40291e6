// 3-D view. It is drawn only after a change.

import * as THREE from "../vendor/three/three.module.js";
import { Paper } from "./paper.js";
import { Terrain } from "./terrain.js";
import { Floor } from "./floor.js";
import { Robot } from "./robot.js";

const CLICK_PX = 5; // a pointer that moved less counts as a click

export class View {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {(point: THREE.Vector3 | null) => void} clicked receives the point on the ground {world} of a click
   */
  constructor(canvas, clicked) {
    this.canvas = canvas;
    this.clicked = clicked;
    THREE.ColorManagement.enabled = false; // colours are sRGB values of the page, without conversion
    this.renderedBy = rendererName();
    const software = /swiftshader|llvmpipe|software|basic render/i.test(this.renderedBy);
    const drawnOn = software ? document.createElement("canvas") : canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas: drawnOn, antialias: !software, powerPreference: "low-power" });
    this.paper = software ? new Paper(canvas, this.renderer.getContext()) : null;
    this.sharpness = software ? 1 : 2; // maximum device pixels per CSS pixel
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.renderer.setClearColor(0x0b1115);
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(45, 1, 0.02, 30);
    this.camera.up.set(0, 0, 1);
    this.terrain = new Terrain(software ? 3 : 1);
    this.robot = new Robot();
    this.floor = new Floor(this.terrain.material.uniforms);
    this.scene.add(this.terrain.mesh, this.floor.mesh, this.robot.group);
    this.target = new THREE.Vector3();
    this.eye = { azimuth: Math.PI, elevation: 0.75, distance: 1.7 };
    this.follow = true;
    this.frames = 0; // number of frames drawn
    this.dirty = this.drawing = false; // whether the scene has changed; whether a frame is being drawn
    this.pointers = new Map();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
    this.listen();
    this.touch();
  }

  /** Request a new frame after a change of the scene. */
  touch() {
    this.dirty = true;
    if (this.drawing) return;
    this.drawing = true;
    requestAnimationFrame(() => this.draw());
  }

  async draw() {
    this.dirty = false;
    this.render();
    await this.paper?.lay();
    this.drawing = false;
    if (this.dirty) this.touch();
  }

  render() {
    const { azimuth, elevation, distance } = this.eye;
    this.camera.position.set(
      this.target.x + distance * Math.cos(elevation) * Math.cos(azimuth),
      this.target.y + distance * Math.cos(elevation) * Math.sin(azimuth),
      this.target.z + distance * Math.sin(elevation),
    );
    this.camera.lookAt(this.target);
    this.renderer.render(this.scene, this.camera);
    this.frames++;
  }

  /** Measure and return the maximum frame rate [1/s] while the camera circles for some seconds. */
  async benchmark(seconds = 3) {
    const gl = this.renderer.getContext();
    const pixel = new Uint8Array(4);
    const before = this.frames;
    const began = performance.now();
    while (performance.now() - began < seconds * 1000) {
      this.eye.azimuth += 0.02;
      this.render();
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); // waits for the frame; `finish` does not wait in all browsers
      this.paper?.fetch(gl.canvas.width, gl.canvas.height);
      await new Promise((done) => setTimeout(done, 0));
    }
    return (this.frames - before) / ((performance.now() - began) / 1000);
  }

  show(state) {
    this.robot.show(state, this.terrain);
    const place = new THREE.Vector3().setFromMatrixPosition(this.robot.T);
    if (this.robot.ground !== undefined) this.floor.show(place, this.robot.ground);
    if (this.follow && state.pose) {
      const turned = wrapped(state.pose.yaw - (this.yaw ?? state.pose.yaw));
      this.yaw = state.pose.yaw;
      this.eye.azimuth += turned;
      this.target.lerp(place, this.target.distanceTo(place) > 1 ? 1 : 0.3);
    }
    this.touch();
  }

  /** Move the camera to the view "above" or "behind" of the robot. */
  look(from) {
    this.follow = true;
    this.eye = { azimuth: (this.yaw ?? 0) + Math.PI, elevation: from === "above" ? 1.5 : 0.6, distance: from === "above" ? 2.6 : 1.5 };
    this.touch();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, this.sharpness));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.touch();
  }

  listen() {
    const { canvas, pointers } = this;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, moved: 0 });
    });
    canvas.addEventListener("pointermove", (event) => {
      const pointer = pointers.get(event.pointerId);
      if (!pointer) return;
      const [dx, dy] = [event.clientX - pointer.x, event.clientY - pointer.y];
      const others = [...pointers.entries()].filter(([id]) => id !== event.pointerId);
      if (others.length === 1) {
        const other = others[0][1];
        const before = Math.hypot(pointer.x - other.x, pointer.y - other.y);
        this.zoom(before / Math.max(1, Math.hypot(event.clientX - other.x, event.clientY - other.y)));
      } else if (event.shiftKey || event.buttons & 2) {
        this.pan(dx, dy);
      } else {
        this.eye.azimuth -= dx * 0.008;
        this.eye.elevation = Math.min(1.55, Math.max(0.05, this.eye.elevation + dy * 0.008));
      }
      pointer.moved += Math.abs(dx) + Math.abs(dy);
      pointer.x = event.clientX;
      pointer.y = event.clientY;
      this.touch();
    });
    const up = (event) => {
      const pointer = pointers.get(event.pointerId);
      pointers.delete(event.pointerId);
      if (event.type === "pointerup" && pointer && pointer.moved < CLICK_PX && event.button === 0) this.click(event);
    };
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", up);
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(event.deltaY * 0.001));
    }, { passive: false });
  }

  zoom(by) {
    this.eye.distance = Math.min(8, Math.max(0.3, this.eye.distance * by));
    this.touch();
  }

  pan(dx, dy) {
    this.follow = false;
    const scale = this.eye.distance / this.canvas.clientHeight;
    const { azimuth } = this.eye;
    this.target.x += scale * (dx * Math.sin(azimuth) - dy * Math.cos(azimuth));
    this.target.y += scale * (-dx * Math.cos(azimuth) - dy * Math.sin(azimuth));
  }

  click(event) {
    const box = this.canvas.getBoundingClientRect();
    const caster = new THREE.Raycaster();
    const at = new THREE.Vector2(((event.clientX - box.left) / box.width) * 2 - 1, 1 - ((event.clientY - box.top) / box.height) * 2);
    caster.setFromCamera(at, this.camera);
    this.clicked(this.terrain.meet(caster.ray));
  }

  /** Return the position in the window [px] of a point {world}, for tests that click there. */
  pixel(x, y, z) {
    const at = new THREE.Vector3(x, y, z).project(this.camera);
    const box = this.canvas.getBoundingClientRect();
    return [box.left + ((at.x + 1) / 2) * box.width, box.top + ((1 - at.y) / 2) * box.height];
  }
}

/** Return the name of the browser's renderer: a GPU or a software renderer; "" if unknown. */
function rendererName() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return name;
}

function wrapped(angle) {
  return Math.atan2(Math.sin(angle), Math.cos(angle));
}
