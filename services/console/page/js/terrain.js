// Elevation map: a mesh of the known cells. Heights are a vertex attribute and colours are a texture, so a new map takes only
// three GPU uploads: heights, index and colours.

import * as THREE from "../vendor/three/three.module.js";
import { TABLES } from "./colors.js";

const NO_HEIGHT = -32768;
const BLOCK = 16; // [cells] edge of the largest square

const VERTEX = `
in float mm;
uniform vec2 origin;
uniform float resolution;
uniform int ny;
out vec3 vPlace;
out vec2 vCell;
void main() {
  vCell = vec2(gl_VertexID / ny, gl_VertexID % ny);
  vPlace = vec3(origin + resolution * vCell, mm * 0.001);
  gl_Position = projectionMatrix * viewMatrix * vec4(vPlace, 1.0);
}`;

const FRAGMENT = `
precision highp float;
in vec3 vPlace;
in vec2 vCell;
uniform sampler2D values, table;
uniform bool colored;
uniform vec4 trunk, legs[12];
uniform vec2 trunkHalf;
out vec4 color;
float shadow() { // of the robot, below it
  vec2 p = vPlace.xy - trunk.xy;
  if (dot(p, p) > 0.25) return 0.0;
  vec2 outside = abs(vec2(trunk.z * p.x + trunk.w * p.y, trunk.z * p.y - trunk.w * p.x)) - trunkHalf;
  float dark = 0.5 * (1.0 - smoothstep(-0.02, 0.03, length(max(outside, 0.0)) + min(max(outside.x, outside.y), 0.0)));
  for (int k = 0; k < 12; k++) {
    vec2 a = vPlace.xy - legs[k].xy, b = legs[k].zw - legs[k].xy;
    float apart = length(a - b * clamp(dot(a, b) / max(dot(b, b), 1e-6), 0.0, 1.0));
    dark = max(dark, 0.4 * (1.0 - smoothstep(0.005, 0.022, apart)));
  }
  return dark;
}
void main() {
  vec3 normal = normalize(cross(dFdx(vPlace), dFdy(vPlace)));
  if (normal.z < 0.0) normal = -normal;
  float light = 0.45 + 0.55 * max(0.0, dot(normal, normalize(vec3(-0.4, 0.5, 0.9))));
  ivec2 at = ivec2(floor(vCell.yx + 0.5));
  vec4 value = texelFetch(values, at, 0);
  vec3 base = colored ? value.rgb : texelFetch(table, ivec2(int(value.r * 255.0 + 0.5), 0), 0).rgb;
  vec2 line = abs(fract(vPlace.xy * 10.0 + 0.5) - 0.5) / max(fwidth(vPlace.xy * 10.0), 1e-4);
  float grid = (1.0 - min(min(line.x, line.y), 1.0)) * (1.0 - smoothstep(0.2, 0.6, max(fwidth(vPlace.x), fwidth(vPlace.y)) * 10.0));
  light *= 1.0 - shadow();
  color = vec4(mix(base * light, vec3(0.0), 0.12 * grid), 1.0); // the tables are sRGB already
}`;

export class Terrain {
  /** @param {number} flat [mm] maximum height error of one square that replaces many cells */
  constructor(flat = 1) {
    this.flat = flat;
    this.material = new THREE.ShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      side: THREE.DoubleSide,
      uniforms: {
        values: { value: null }, table: { value: null }, colored: { value: false },
        origin: { value: new THREE.Vector2() }, resolution: { value: 0.01 }, ny: { value: 0 }, cells: { value: new THREE.Vector2() },
        trunk: { value: new THREE.Vector4(1e3, 1e3, 1, 0) }, trunkHalf: { value: new THREE.Vector2() },
        legs: { value: Array.from({ length: 12 }, () => new THREE.Vector4()) },
      },
    });
    this.mesh = new THREE.Mesh(new THREE.BufferGeometry(), this.material);
    this.mesh.frustumCulled = false;
    this.mesh.visible = false;
    this.tables = {};
    this.heights = null;
    this.header = null;
  }

  /** Show a map frame: header, buffer, and offset [bytes] of the heights in it. */
  show(header, data, offset) {
    const { nx, ny } = header;
    const cells = nx * ny;
    const bytes = new Uint8Array(data, offset + 2 * cells);
    const colored = header.layer === "color";
    this.fit(nx, ny, colored);
    this.heights.set(new Int16Array(data, offset, cells)); // also the source of the GPU upload
    const { geometry } = this.mesh;
    geometry.attributes.mm.needsUpdate = true;
    const corners = this.weave(nx, ny, geometry.index.array);
    geometry.index.clearUpdateRanges();
    geometry.index.addUpdateRange(0, corners); // the rest of the buffer is reserve for less flat ground
    geometry.index.needsUpdate = true;
    geometry.setDrawRange(0, corners);
    const uniforms = this.material.uniforms;
    const values = uniforms.values.value;
    if (colored) {
      const out = values.image.data;
      for (let i = 0; i < cells; i++) {
        out[4 * i] = bytes[3 * i]; out[4 * i + 1] = bytes[3 * i + 1]; out[4 * i + 2] = bytes[3 * i + 2];
        out[4 * i + 3] = this.heights[i] === NO_HEIGHT ? 0 : 255;
      }
    } else {
      values.image.data.set(bytes.subarray(0, cells));
      uniforms.table.value = this.tableOf(header.layer);
    }
    values.needsUpdate = true;
    uniforms.colored.value = colored;
    uniforms.origin.value.set(header.origin[0], header.origin[1]);
    uniforms.resolution.value = header.resolution;
    uniforms.ny.value = ny;
    uniforms.cells.value.set(nx, ny);
    this.header = header;
    this.mesh.visible = true;
  }

  /** Place the shadow of a robot: body pose, size of the body, and femur axis, knee and foot {world} of each leg. */
  shade(T, [length, width], legs) {
    const { trunk, trunkHalf, legs: limbs } = this.material.uniforms;
    const [x, y] = T.elements.slice(12, 14);
    const turn = Math.atan2(T.elements[1], T.elements[0]);
    trunk.value.set(x, y, Math.cos(turn), Math.sin(turn));
    trunkHalf.value.set(length / 2, width / 2);
    legs.forEach(([femur, knee, foot], i) => {
      limbs.value[2 * i].set(femur.x, femur.y, knee.x, knee.y);
      limbs.value[2 * i + 1].set(knee.x, knee.y, foot.x, foot.y);
    });
  }

  /**
   * Write the triangles between known cells to the index, and return the number of entries. One square replaces many cells on
   * flat ground, because software rendering takes a microsecond or more per triangle.
   */
  weave(nx, ny, index) {
    const { heights, flat } = this;
    let k = 0;
    const isFlat = (i, j, size) => {
      const row = i * ny + j;
      const [a, b, c, d] = [heights[row], heights[row + size * ny], heights[row + size], heights[row + size * ny + size]];
      if (a === NO_HEIGHT || b === NO_HEIGHT || c === NO_HEIGHT || d === NO_HEIGHT) return false;
      const [along, across, twist] = [(b - a) / size, (c - a) / size, (d - b - c + a) / (size * size)];
      for (let u = 0; u <= size; u++) {
        for (let v = 0; v <= size; v++) {
          const height = heights[row + u * ny + v];
          if (height === NO_HEIGHT || Math.abs(height - (a + along * u + across * v + twist * u * v)) > flat) return false;
        }
      }
      return true;
    };
    const square = (i, j, size) => {
      const a = i * ny + j;
      const [b, c] = [a + size * ny, a + size];
      const d = b + size;
      if (heights[b] === NO_HEIGHT || heights[c] === NO_HEIGHT) return;
      if (heights[a] !== NO_HEIGHT) { index[k] = a; index[k + 1] = b; index[k + 2] = c; k += 3; }
      if (heights[d] !== NO_HEIGHT) { index[k] = c; index[k + 1] = b; index[k + 2] = d; k += 3; }
    };
    const cover = (i, j, size) => {
      if (i + 1 >= nx || j + 1 >= ny) return;
      if (size === 1) {
        square(i, j, 1);
      } else if (i + size < nx && j + size < ny && isFlat(i, j, size)) {
        square(i, j, size);
      } else {
        const half = size / 2;
        cover(i, j, half); cover(i + half, j, half); cover(i, j + half, half); cover(i + half, j + half, half);
      }
    };
    for (let i = 0; i < nx; i += BLOCK) for (let j = 0; j < ny; j += BLOCK) cover(i, j, BLOCK);
    return k;
  }

  /** Create the geometry and the texture for the size of the map, if the size has changed. */
  fit(nx, ny, colored) {
    const uniforms = this.material.uniforms;
    const known = this.header;
    const same = known && known.nx === nx && known.ny === ny;
    if (!same) {
      this.mesh.geometry.dispose();
      const geometry = new THREE.BufferGeometry();
      this.heights = new Int16Array(nx * ny);
      const mm = new THREE.BufferAttribute(this.heights, 1);
      const index = new THREE.BufferAttribute(new Uint32Array(6 * nx * ny), 1);
      for (const attribute of [mm, index]) attribute.setUsage(THREE.DynamicDrawUsage);
      geometry.setAttribute("mm", mm);
      geometry.setIndex(index);
      this.mesh.geometry = geometry;
    }
    if (same && uniforms.colored.value === colored && uniforms.values.value) return;
    uniforms.values.value?.dispose();
    const format = colored ? THREE.RGBAFormat : THREE.RedFormat;
    const values = new THREE.DataTexture(new Uint8Array(nx * ny * (colored ? 4 : 1)), ny, nx, format, THREE.UnsignedByteType);
    values.minFilter = values.magFilter = THREE.NearestFilter;
    values.unpackAlignment = 1;
    uniforms.values.value = values;
  }

  tableOf(layer) {
    if (!this.tables[layer]) {
      const table = new THREE.DataTexture(TABLES[layer].slice(), 256, 1, THREE.RGBAFormat, THREE.UnsignedByteType);
      table.minFilter = table.magFilter = THREE.NearestFilter;
      table.needsUpdate = true;
      this.tables[layer] = table;
    }
    return this.tables[layer];
  }

  /** Return the height [m] of the ground at a point {world}, null if it is unknown. */
  heightAt(x, y) {
    if (!this.header) return null;
    const { origin, resolution, nx, ny } = this.header;
    const i = Math.round((x - origin[0]) / resolution);
    const j = Math.round((y - origin[1]) / resolution);
    if (i < 0 || j < 0 || i >= nx || j >= ny) return null;
    const mm = this.heights[i * ny + j];
    return mm === NO_HEIGHT ? null : mm * 0.001;
  }

  /** Return the first intersection of a ray with the ground, null without one. */
  meet(ray) {
    const step = 0.01;
    const point = new THREE.Vector3();
    for (let t = 0; t < 12; t += step) {
      ray.at(t, point);
      const height = this.heightAt(point.x, point.y);
      if (height !== null && point.z <= height && point.z > height - 0.3) return point.setZ(height);
    }
    return null;
  }
}
