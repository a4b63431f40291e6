// Model of the robot: its profile, measured joint angles, support polygon, trail, and planned path and footholds.

import * as THREE from "../vendor/three/three.module.js";
import { matte } from "./matte.js";
import { Skeleton } from "./skeleton.js";

const LEG_COLORS = [0x7fb7f0, 0xe8b64c, 0x7fb7f0, 0xe8b64c, 0x7fb7f0, 0xe8b64c]; // by tripod
const CARRIES = 0x6cc5a8;
const IN_AIR = 0xf4f1e8;
const TRAIL = 200; // points
const TRAIL_STEP = 0.02; // [m]
const MOST_FOOTHOLDS = 512;
const LIFT = 0.004; // [m] offset of ground markers above the ground

export class Robot {
  constructor() {
    this.group = new THREE.Group(); // {world}
    this.trunk = new THREE.Group(); // {body}
    this.trunk.matrixAutoUpdate = false;
    const flat = () => new THREE.MeshBasicMaterial({ side: THREE.DoubleSide });
    this.rings = new THREE.InstancedMesh(new THREE.RingGeometry(0.012, 0.018, 16), flat(), 6); // planned touchdown points
    this.footholds = new THREE.InstancedMesh(new THREE.CircleGeometry(0.008, 8), flat(), MOST_FOOTHOLDS); // footholds of a gap crossing
    this.rings.material.color.setHex(0xffffff);
    for (const mesh of [this.rings, this.footholds]) {
      mesh.count = 0;
      mesh.frustumCulled = false;
    }
    this.group.add(this.trunk, this.rings, this.footholds);
    this.polygon = new THREE.Mesh(new THREE.BufferGeometry(), new THREE.MeshBasicMaterial({ color: CARRIES, transparent: true, opacity: 0.22, side: THREE.DoubleSide, depthWrite: false }));
    this.outline = new THREE.LineLoop(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: CARRIES }));
    this.path = new THREE.Line(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: 0xffffff }));
    this.trail = new THREE.Line(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: 0x7fb7f0, transparent: true, opacity: 0.7 }));
    this.centre = new THREE.Mesh(new THREE.CircleGeometry(0.008, 16), new THREE.MeshBasicMaterial({ color: 0xffffff, side: THREE.DoubleSide }));
    for (const thing of [this.polygon, this.outline, this.path, this.trail]) thing.frustumCulled = false;
    this.group.add(this.polygon, this.outline, this.path, this.trail, this.centre);
    this.goal = flag();
    this.goal.visible = false;
    this.group.add(this.goal);
    this.walked = [];
    this.T = new THREE.Matrix4();
    this.built = false;
  }

  /** Build the model of a robot profile. */
  build(profile) {
    this.trunk.clear();
    this.profile = profile;
    const skin = matte(0x44525c);
    const [length, width, height] = profile.body;
    const box = new THREE.Mesh(new THREE.BoxGeometry(length, width, height), skin);
    const nose = new THREE.Mesh(new THREE.ConeGeometry(height * 0.35, height * 0.8, 4), matte(0xf4f1e8));
    nose.rotation.z = -Math.PI / 2;
    nose.position.set(length / 2, 0, height * 0.35);
    this.trunk.add(box, nose);
    const eye = new THREE.Mesh(new THREE.BoxGeometry(0.02, 0.06, 0.02), matte(0x14212b));
    eye.applyMatrix4(matrix(profile.camera).multiply(new THREE.Matrix4().makeRotationY(Math.PI / 2)));
    this.trunk.add(eye);
    this.skeleton = new Skeleton(profile.legs.length, Math.max(profile.foot_radius, 0.008));
    this.trunk.add(this.skeleton.mesh);
    this.built = true;
  }

  /** Draw the legs at joint angles [rad], and return the foot centres {body}. */
  pose(q, contact) {
    const [coxa, femur, tibia] = this.profile.links;
    const feet = this.profile.legs.map((leg, i) => {
      const [a, b, c] = q.slice(3 * i, 3 * i + 3);
      const yaw = leg.yaw + a;
      const out = (r, z) => new THREE.Vector3(leg.mount[0] + r * Math.cos(yaw), leg.mount[1] + r * Math.sin(yaw), leg.mount[2] + z);
      const joints = [
        out(0, 0),
        out(coxa, 0),
        out(coxa + femur * Math.cos(b), femur * Math.sin(b)),
        out(coxa + femur * Math.cos(b) + tibia * Math.cos(b + c), femur * Math.sin(b) + tibia * Math.sin(b + c)),
      ];
      this.skeleton.leg(i, joints, contact[i] ? CARRIES : IN_AIR);
      return joints[3];
    });
    this.skeleton.done();
    return feet;
  }

  /** Show the state of the robot. */
  show(state) {
    if (!this.built || !state.legs || !state.pose) return;
    this.T.copy(matrix(state.pose.T));
    this.trunk.matrix.copy(this.T);
    const feet = this.pose(state.legs.q, state.legs.contact).map((foot) => foot.applyMatrix4(this.T));
    const radius = this.profile.foot_radius;
    const ground = feet.filter((_, i) => state.legs.contact[i]).map((foot) => new THREE.Vector3(foot.x, foot.y, foot.z - radius + LIFT));
    this.support(hull(ground));
    const place = new THREE.Vector3().setFromMatrixPosition(this.T);
    const low = ground.length ? ground.reduce((sum, p) => sum + p.z, 0) / ground.length : place.z;
    this.centre.position.set(place.x, place.y, low + LIFT);
    this.walk(place, low);
    this.plan(state);
    line(this.path, pairs(state.planner ? state.planner.path : [], 2).map(([x, y]) => new THREE.Vector3(x, y, low + 0.02)));
    this.goal.visible = Boolean(state.goal);
    if (state.goal) {
      const [x, y] = state.goal[state.goal.length - 1];
      this.goal.position.set(x, y, low);
    }
  }

  support(corners) {
    this.polygon.visible = this.outline.visible = corners.length > 2;
    if (corners.length < 3) return;
    line(this.outline, corners);
    const fan = [];
    for (let i = 1; i + 1 < corners.length; i++) fan.push(corners[0], corners[i], corners[i + 1]);
    line(this.polygon, fan);
  }

  walk(place, low) {
    const last = this.walked[this.walked.length - 1];
    if (last && last.distanceTo(place) < TRAIL_STEP) return;
    this.walked.push(place.clone());
    if (this.walked.length > TRAIL) this.walked.shift();
    line(this.trail, this.walked.map((p) => new THREE.Vector3(p.x, p.y, low + LIFT)));
  }

  plan(state) {
    const radius = this.profile.foot_radius;
    const places = state.plan ? pairs(state.plan.touchdown, 3) : [];
    places.forEach(([x, y, z], k) => this.rings.setMatrixAt(k, new THREE.Matrix4().setPosition(x, y, z - radius + LIFT)));
    this.rings.count = places.length;
    this.rings.instanceMatrix.needsUpdate = true;
  }

  /** Show a planned section of a gap crossing. */
  passage(plan) {
    const places = pairs(plan.footholds, 3).slice(0, MOST_FOOTHOLDS);
    places.forEach(([x, y, z], k) => {
      this.footholds.setMatrixAt(k, new THREE.Matrix4().setPosition(x, y, z - this.profile.foot_radius + LIFT));
      this.footholds.setColorAt(k, paint.setHex(plan.state === "no way" ? 0x9fb0b8 : LEG_COLORS[plan.legs[k]]));
    });
    this.footholds.count = places.length;
    this.footholds.instanceMatrix.needsUpdate = true;
    if (this.footholds.instanceColor) this.footholds.instanceColor.needsUpdate = true;
  }
}

export function matrix(rows) {
  return new THREE.Matrix4().set(...rows);
}

function pairs(numbers, size) {
  const out = [];
  for (let i = 0; i + size <= numbers.length; i += size) out.push(numbers.slice(i, i + size));
  return out;
}

const paint = new THREE.Color();

function line(thing, points) {
  thing.geometry.dispose();
  thing.geometry = new THREE.BufferGeometry().setFromPoints(points);
}

function flag() {
  const group = new THREE.Group();
  const pole = new THREE.Mesh(new THREE.CylinderGeometry(0.004, 0.004, 0.25, 6), new THREE.MeshBasicMaterial({ color: 0xffffff }));
  pole.rotation.x = Math.PI / 2;
  pole.position.z = 0.125;
  const cloth = new THREE.Mesh(new THREE.PlaneGeometry(0.1, 0.06), new THREE.MeshBasicMaterial({ color: 0xf0685a, side: THREE.DoubleSide }));
  cloth.rotation.x = Math.PI / 2;
  cloth.position.set(0.05, 0, 0.22);
  group.add(pole, cloth);
  return group;
}

/** Return the corners of the convex hull in x and y, counterclockwise. */
function hull(points) {
  const sorted = [...points].sort((a, b) => a.x - b.x || a.y - b.y);
  const turn = (o, a, b) => (a.x - o.x) * (b.y - o.y) - (a.y - o.y) * (b.x - o.x);
  const half = (list) => {
    const out = [];
    for (const p of list) {
      while (out.length > 1 && turn(out[out.length - 2], out[out.length - 1], p) <= 0) out.pop();
      out.push(p);
    }
    out.pop();
    return out;
  };
  return [...half(sorted), ...half(sorted.reverse())];
}
