// Trunk of the robot with its plates and camera, as one mesh, in the proportions of the film.

import * as THREE from "../vendor/three/three.module.js";
import { matte } from "./matte.js";

const SHELL = 0x343a44;
const PLATE = 0x4e5663;
const JOINT = 0x22252b;
const ACCENT = 0xf08426;
const LENS = 0x0e121e;
const HEAD_FROM_CAMERA = new THREE.Matrix4().set(0, -1, 0, 0, 0, 0, -1, 0, 1, 0, 0, 0, 0, 0, 0, 1); // x forward, y left, z up

/** Return the trunk {body} of a robot's profile. */
export function trunk(profile) {
  const [length, width, height] = profile.body;
  const plate = Math.max(0.16 * height, 0.004);
  const parts = [
    box([0.94 * length, 0.8 * width, 0.72 * height], at(0, 0, 0), SHELL),
    box([length, width, plate], at(0, 0, (height - plate) / 2), PLATE),
    box([length, width, plate], at(0, 0, (plate - height) / 2), PLATE),
    box([0.5 * length, 0.6 * width, 0.6 * height], at(-0.1 * length, 0, 0.78 * height), SHELL),
    box([0.4 * length, 0.1 * width, 0.06 * height], at(-0.1 * length, 0, 1.09 * height), ACCENT),
    ...camera(new THREE.Matrix4().set(...profile.camera), height),
  ];
  return new THREE.Mesh(merged(parts), matte(0xffffff, true));
}

function camera(T, height) {
  const [x, y, z] = T.elements.slice(12, 15);
  const head = (forward, left, up) => T.clone().multiply(HEAD_FROM_CAMERA).multiply(at(forward, left, up));
  const parts = [
    box([0.034, 0.125, 0.03], head(-0.014, 0, 0), SHELL),
    box([0.006, 0.1, 0.006], head(0.002, 0, 0.0125), ACCENT),
    ...[-0.034, 0, 0.034].map((left) => box([0.003, 0.015, 0.015], head(0.004, left, -0.001), LENS)),
  ];
  const mast = z - height / 2;
  if (mast > 0) parts.push(box([0.013, 0.013, mast], at(x - 0.02, y, z - mast / 2), JOINT));
  return parts;
}

function at(x, y, z) {
  return new THREE.Matrix4().setPosition(x, y, z);
}

function box(size, T, hex) {
  const geometry = new THREE.BoxGeometry(...size).applyMatrix4(T);
  const paint = new THREE.Color(hex);
  const count = geometry.attributes.position.count;
  const colors = new Float32Array(3 * count);
  for (let k = 0; k < count; k++) colors.set([paint.r, paint.g, paint.b], 3 * k);
  geometry.setAttribute("color", new THREE.BufferAttribute(colors, 3));
  return geometry;
}

function merged(parts) {
  const geometry = new THREE.BufferGeometry();
  for (const name of ["position", "normal", "color"]) {
    const arrays = parts.map((part) => part.attributes[name].array);
    const all = new Float32Array(arrays.reduce((sum, one) => sum + one.length, 0));
    arrays.reduce((offset, one) => (all.set(one, offset), offset + one.length), 0);
    geometry.setAttribute(name, new THREE.BufferAttribute(all, 3));
  }
  const index = [];
  parts.reduce((first, part) => {
    index.push(...Array.from(part.index.array, (k) => k + first));
    return first + part.attributes.position.count;
  }, 0);
  geometry.setIndex(index);
  return geometry;
}
