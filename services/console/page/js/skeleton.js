// All legs as one mesh with few vertices, recomputed for each state: software rendering pays for each draw call and vertex.

import * as THREE from "../vendor/three/three.module.js";
import { matte } from "./matte.js";

const SIDES = 6;
const JOINT = new THREE.Color(0x22252b);
const LINK = new THREE.Color(0xc4c9cf);
const CARRIES = new THREE.Color(0x129e6e);
const SWINGS = new THREE.Color(0xfac434);
const SOCK = 0.42; // share of the tibia, from the foot up, whose colour shows load
const PHANTOMX = 0.199; // [m] femur and tibia of the robot for which the radii below are
const LIMBS = 8; // three joints, coxa, two plates of the femur, two parts of the tibia
const FOOT = new THREE.OctahedronGeometry(1, 1);

export class Skeleton {
  constructor(profile) {
    const [, femur, tibia] = profile.links;
    this.scale = Math.min(3, Math.max(0.5, (femur + tibia) / PHANTOMX));
    this.foot = Math.max(profile.foot_radius, 0.008);
    this.perLimb = 2 * SIDES;
    this.perFoot = FOOT.attributes.position.count;
    this.perLeg = LIMBS * this.perLimb + this.perFoot;
    const legs = profile.legs.length;
    const geometry = new THREE.BufferGeometry();
    for (const name of ["position", "normal", "color"]) {
      geometry.setAttribute(name, new THREE.BufferAttribute(new Float32Array(3 * legs * this.perLeg), 3).setUsage(THREE.DynamicDrawUsage));
    }
    const index = [];
    for (let leg = 0; leg < legs; leg++) {
      for (let limb = 0; limb < LIMBS; limb++) {
        const first = leg * this.perLeg + limb * this.perLimb;
        for (let k = 0; k < SIDES; k++) {
          const [a, b] = [first + 2 * k, first + 2 * ((k + 1) % SIDES)];
          index.push(a, b, a + 1, b, b + 1, a + 1);
          if (k > 1) index.push(first, a - 2, a, first + 1, a + 1, a - 1); // both ends
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

  /** Place leg `i` between the axes of coxa and femur, the knee and the foot {body}; `carries` colours the foot. */
  leg(i, [coxa, femur, knee, foot], carries) {
    const r = this.scale;
    const out = femur.clone().sub(coxa);
    const hinge = out.clone().cross(knee.clone().sub(femur));
    if (hinge.lengthSq() < 1e-12) hinge.set(-out.y, out.x, 0);
    hinge.normalize();
    const up = hinge.clone().cross(out).normalize();
    const beside = (point, axis, by) => point.clone().addScaledVector(axis, by * r);
    const cuff = foot.clone().lerp(knee, SOCK);
    const state = carries ? CARRIES : SWINGS;
    const tip = 0.82 * this.foot;
    const wide = tip + SOCK * (0.013 * r - tip);
    const limbs = [
      [beside(coxa, up, -0.014), beside(coxa, up, 0.014), 0.0175 * r, 0.0175 * r, JOINT],
      [coxa, femur, 0.0135 * r, 0.0125 * r, LINK],
      [beside(femur, hinge, -0.017), beside(femur, hinge, 0.017), 0.0155 * r, 0.0155 * r, JOINT],
      [beside(femur, hinge, -0.0115), beside(knee, hinge, -0.0115), 0.009 * r, 0.008 * r, LINK],
      [beside(femur, hinge, 0.0115), beside(knee, hinge, 0.0115), 0.009 * r, 0.008 * r, LINK],
      [beside(knee, hinge, -0.016), beside(knee, hinge, 0.016), 0.0145 * r, 0.0145 * r, JOINT],
      [knee, cuff, 0.013 * r, wide, LINK],
      [cuff, foot, 1.04 * wide, tip, state],
    ];
    const first = i * this.perLeg;
    limbs.forEach((limb, k) => this.limb(first + k * this.perLimb, ...limb));
    this.ball(first + LIMBS * this.perLimb, foot, state);
  }

  ball(first, centre, paint) {
    const { position, normal, color } = this.mesh.geometry.attributes;
    for (let k = 0, at = first; k < this.perFoot; k++, at++) {
      const [x, y, z] = [FOOT.attributes.position.getX(k), FOOT.attributes.position.getY(k), FOOT.attributes.position.getZ(k)];
      position.setXYZ(at, centre.x + this.foot * x, centre.y + this.foot * y, centre.z + this.foot * z);
      normal.setXYZ(at, x, y, z);
      color.setXYZ(at, paint.r, paint.g, paint.b);
    }
  }

  limb(first, from, to, radius, radiusTo, paint) {
    const { position, normal, color } = this.mesh.geometry.attributes;
    const along = to.clone().sub(from).normalize();
    const aside = new THREE.Vector3(-along.y, along.x, 0);
    if (aside.lengthSq() < 1e-6) aside.set(1, 0, 0);
    aside.normalize();
    const up = along.clone().cross(aside);
    for (let k = 0; k < SIDES; k++) {
      const angle = (2 * Math.PI * k) / SIDES;
      const out = aside.clone().multiplyScalar(Math.cos(angle)).addScaledVector(up, Math.sin(angle));
      [[from, radius], [to, radiusTo]].forEach(([end, wide], side) => {
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
