// All legs as one mesh with few vertices, recomputed for each state: software rendering pays for each draw call and vertex.

import * as THREE from "../vendor/three/three.module.js";
import { matte } from "./matte.js";

const SIDES = 6;
const RADII = [0.012, 0.011, 0.008]; // [m] coxa, femur, tibia
const COLORS = [0x3a4750, 0x6d808c, null]; // the tibia has the colour of its tripod
const TRIPODS = [0x7fb7f0, 0xe8b64c];
const LIMBS = 3;
const FOOT = new THREE.OctahedronGeometry(1, 1);

export class Skeleton {
  constructor(legs, foot) {
    this.foot = foot;
    this.perLimb = 2 * SIDES;
    this.perFoot = FOOT.attributes.position.count;
    this.perLeg = LIMBS * this.perLimb + this.perFoot;
    const corners = legs * this.perLeg;
    const geometry = new THREE.BufferGeometry();
    for (const name of ["position", "normal", "color"]) {
      geometry.setAttribute(name, new THREE.BufferAttribute(new Float32Array(3 * corners), 3).setUsage(THREE.DynamicDrawUsage));
    }
    const index = [];
    for (let leg = 0; leg < legs; leg++) {
      for (let limb = 0; limb < LIMBS; limb++) {
        const first = leg * this.perLeg + limb * this.perLimb;
        for (let k = 0; k < SIDES; k++) {
          const [a, b] = [first + 2 * k, first + 2 * ((k + 1) % SIDES)];
          index.push(a, b, a + 1, b, b + 1, a + 1);
        }
      }
      const first = leg * this.perLeg + LIMBS * this.perLimb;
      for (let k = 0; k < this.perFoot; k++) index.push(first + k);
    }
    geometry.setIndex(index);
    this.mesh = new THREE.Mesh(geometry, matte(0xffffff, true));
    this.mesh.material.side = THREE.DoubleSide;
    this.mesh.frustumCulled = false;
  }

  /** Place the limbs of leg `i` between its four joints {body}, and colour its foot. */
  leg(i, joints, footColor) {
    const first = i * this.perLeg;
    for (let limb = 0; limb < LIMBS; limb++) {
      this.limb(first + limb * this.perLimb, joints[limb], joints[limb + 1], RADII[limb], COLORS[limb] ?? TRIPODS[i % 2]);
    }
    const { position, normal, color } = this.mesh.geometry.attributes;
    const paint = new THREE.Color(footColor);
    const centre = joints[LIMBS];
    for (let k = 0, at = first + LIMBS * this.perLimb; k < this.perFoot; k++, at++) {
      const [x, y, z] = [FOOT.attributes.position.getX(k), FOOT.attributes.position.getY(k), FOOT.attributes.position.getZ(k)];
      position.setXYZ(at, centre.x + this.foot * x, centre.y + this.foot * y, centre.z + this.foot * z);
      normal.setXYZ(at, x, y, z);
      color.setXYZ(at, paint.r, paint.g, paint.b);
    }
  }

  limb(first, from, to, radius, hex) {
    const { position, normal, color } = this.mesh.geometry.attributes;
    const paint = new THREE.Color(hex);
    const along = to.clone().sub(from).normalize();
    const aside = new THREE.Vector3(-along.y, along.x, 0);
    if (aside.lengthSq() < 1e-6) aside.set(1, 0, 0);
    aside.normalize();
    const up = along.clone().cross(aside);
    for (let k = 0; k < SIDES; k++) {
      const angle = (2 * Math.PI * k) / SIDES;
      const out = aside.clone().multiplyScalar(Math.cos(angle)).addScaledVector(up, Math.sin(angle));
      [[from, radius], [to, 0.8 * radius]].forEach(([end, wide], side) => {
        const at = first + 2 * k + side;
        position.setXYZ(at, end.x + wide * out.x, end.y + wide * out.y, end.z + wide * out.z);
        normal.setXYZ(at, out.x, out.y, out.z);
        color.setXYZ(at, paint.r, paint.g, paint.b);
      });
    }
  }

  /** Upload the vertices after all legs are placed. */
  done() {
    for (const attribute of Object.values(this.mesh.geometry.attributes)) attribute.needsUpdate = true;
  }
}
