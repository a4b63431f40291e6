// Model of the robot: its profile, measured joint angles, support polygon, trail, and planned path and footholds.

import * as THREE from "../vendor/three/three.module.js";
import { trunk } from "./body.js";
import { Skeleton } from "./skeleton.js";

const LEG_COLORS = [0x7fb7f0, 0xe8b64c, 0x7fb7f0, 0xe8b64c, 0x7fb7f0, 0xe8b64c]; // by tripod
const CARRIES = 0x6cc5a8;
const BAND = 0.006; // [m] half width of the path
const BAND_STEP = 0.02; // [m] between two heights of the path
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
    this.path = new THREE.Mesh(new THREE.BufferGeometry(), new THREE.MeshBasicMaterial({ color: 0xf08426, transparent: true, opacity: 0.75, side: THREE.DoubleSide }));
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
    this.skeleton = new Skeleton(profile);
    this.trunk.add(trunk(profile), this.skeleton.mesh);
    this.built = true;
  }

  /** Draw the legs at joint angles [rad], and return the knees and foot centres {body} of each. */
  pose(q, contact) {
    const [coxa, femur, tibia] = this.profile.links;
    const legs = this.profile.legs.map((leg, i) => {
      const [a, b, c] = q.slice(3 * i, 3 * i + 3);
      const yaw = leg.yaw + a;
      const out = (r, z) => new THREE.Vector3(leg.mount[0] + r * Math.cos(yaw), leg.mount[1] + r * Math.sin(yaw), leg.mount[2] + z);
      const joints = [
        out(0, 0),
        out(coxa, 0),
        out(coxa + femur * Math.cos(b), femur * Math.sin(b)),
        out(coxa + femur * Math.cos(b) + tibia * Math.cos(b + c), femur * Math.sin(b) + tibia * Math.sin(b + c)),
      ];
      this.skeleton.leg(i, joints, contact[i]);
      return joints.slice(1);
    });
    this.skeleton.done();
    return legs;
  }

  /** Show the state of the robot on the ground of a map. */
  show(state, terrain) {
    if (!this.built || !state.legs || !state.pose) return;
    this.T.copy(matrix(state.pose.T));
    this.trunk.matrix.copy(this.T);
    const legs = this.pose(state.legs.q, state.legs.contact).map((joints) => joints.map((point) => point.applyMatrix4(this.T)));
    const feet = legs.map((joints) => joints[2]);
    terrain.shade(this.T, this.profile.body, legs);
    const radius = this.profile.foot_radius;
    const ground = feet.filter((_, i) => state.legs.contact[i]).map((foot) => new THREE.Vector3(foot.x, foot.y, foot.z - radius + LIFT));
    this.support(hull(ground));
    const place = new THREE.Vector3().setFromMatrixPosition(this.T);
    const low = ground.length ? ground.reduce((sum, p) => sum + p.z, 0) / ground.length : place.z;
    this.centre.position.set(place.x, place.y, low + LIFT);
    this.ground = low; // [m] {world} of the standing feet
    this.walk(place, low);
    this.plan(state);
    this.route(pairs(state.planner ? state.planner.path : [], 2), (x, y) => terrain.heightAt(x, y) ?? low);
    this.goal.visible = Boolean(state.goal);
    if (state.goal) {
      const [x, y] = state.goal[state.goal.length - 1];
      this.goal.position.set(x, y, low);
    }
  }

  /** Draw the path to the goal as a band on the ground. */
  route(corners, heightAt) {
    const words = corners.join();
    if (words === this.drawnRoute) return;
    this.drawnRoute = words;
    this.path.visible = corners.length > 1;
    const places = [];
    for (let k = 0; k + 1 < corners.length; k++) {
      const [[x, y], [u, v]] = [corners[k], corners[k + 1]];
      const length = Math.hypot(u - x, v - y);
      if (length < 1e-6) continue;
      const [aside, along] = [(BAND / length) * (y - v), (BAND / length) * (u - x)];
      const steps = Math.max(1, Math.ceil(length / BAND_STEP));
      for (let n = 0; n < steps; n++) {
        const [from, to] = [n / steps, (n + 1) / steps].map((s) => {
          const [px, py] = [x + s * (u - x), y + s * (v - y)];
          const z = heightAt(px, py) + 2 * LIFT;
          return [new THREE.Vector3(px + aside, py + along, z), new THREE.Vector3(px - aside, py - along, z)];
        });
        places.push(from[0], from[1], to[0], from[1], to[1], to[0]);
      }
    }
    line(this.path, places);
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
