// Reference floor at the height of the standing feet, beyond the known cells of the map: a grid that fades with the distance.

import * as THREE from "../vendor/three/three.module.js";

const HALF = 6; // [m]
const BELOW = 0.006; // [m] offset below the feet, so that the map covers it

const VERTEX = `
uniform vec3 centre;
out vec2 vPlace;
void main() {
  vPlace = centre.xy + position.xy;
  gl_Position = projectionMatrix * viewMatrix * vec4(vPlace, centre.z, 1.0);
}`;

const FRAGMENT = `
precision highp float;
in vec2 vPlace;
uniform vec3 centre;
uniform vec2 origin;
uniform float resolution;
uniform vec2 cells;
uniform bool colored;
uniform sampler2D values;
out vec4 color;
float lines(float every) {
  vec2 at = vPlace / every;
  vec2 width = max(fwidth(at), 1e-5);
  vec2 line = abs(fract(at + 0.5) - 0.5) / width;
  return (1.0 - min(min(line.x, line.y), 1.0)) * (1.0 - smoothstep(0.15, 0.5, max(width.x, width.y)));
}
void main() {
  ivec2 cell = ivec2(floor((vPlace - origin) / resolution + 0.5));
  bool inMap = all(greaterThanEqual(cell, ivec2(0))) && all(lessThan(cell, ivec2(cells)));
  if (inMap) {
    vec4 value = texelFetch(values, cell.yx, 0);
    if (colored ? value.a > 0.5 : value.r < 0.999) discard;
  }
  float near = 1.0 - smoothstep(1.0, ${HALF.toFixed(1)}, length(vPlace - centre.xy));
  vec3 ground = mix(vec3(0.043, 0.067, 0.082), vec3(0.075, 0.110, 0.132), near);
  vec3 line = mix(ground, vec3(0.22, 0.29, 0.33), near);
  color = vec4(mix(ground, line, max(0.35 * lines(0.1), 0.8 * lines(1.0))), 1.0);
}`;

export class Floor {
  /** @param {Record<string, { value: unknown }>} map uniforms of the elevation map, which it shares */
  constructor(map) {
    const material = new THREE.ShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      side: THREE.DoubleSide,
      uniforms: { ...map, centre: { value: new THREE.Vector3() } },
    });
    this.mesh = new THREE.Mesh(new THREE.PlaneGeometry(2 * HALF, 2 * HALF), material);
    this.mesh.frustumCulled = false;
    this.mesh.visible = false;
  }

  /** Centre it below the robot; `height` [m] {world} is that of the standing feet. */
  show(place, height) {
    const { centre } = this.mesh.material.uniforms;
    const z = this.mesh.visible ? centre.value.z + 0.2 * (height - BELOW - centre.value.z) : height - BELOW;
    centre.value.set(place.x, place.y, z);
    this.mesh.visible = true;
  }
}
