// Material with one directional light, computed per vertex: per-pixel lighting is too slow for software rendering.

import * as THREE from "../vendor/three/three.module.js";

const VERTEX = `
uniform vec3 base;
out vec3 vColor;
void main() {
  vec4 place = vec4(position, 1.0);
  vec3 up = normal;
  up = normalize(mat3(modelMatrix) * up);
  vColor = base * (0.55 + 0.45 * dot(up, normalize(vec3(-0.4, 0.5, 0.9))));
#ifdef USE_COLOR
  vColor *= color;
#endif
  gl_Position = projectionMatrix * viewMatrix * modelMatrix * place;
}`;

const FRAGMENT = `
precision mediump float;
in vec3 vColor;
out vec4 shown;
void main() {
  shown = vec4(vColor, 1.0);
}`;

/**
 * Create the material.
 * @param {number} color base colour
 * @param {boolean} colored whether the geometry has vertex colours
 */
export function matte(color = 0xffffff, colored = false) {
  return new THREE.ShaderMaterial({
    glslVersion: THREE.GLSL3,
    vertexColors: colored,
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    uniforms: { base: { value: new THREE.Color(color) } },
  });
}
