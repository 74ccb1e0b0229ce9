// Draws a package: linear radiance into a float target, then exposed and tone-mapped onto the canvas; or read back as
// it is, for tests and for comparison with `lightkiln shade`.

import * as THREE from "../vendor/three/three.module.min.js";
import { INCLUDES, PRECISION, makeMaterial, makeShared, nameAttributes } from "./material.js";

export const TERMS = ["emission", "diffuse", "interreflection", "environment", "unoccluded", "background"];
export const TONE_MAPS = ["reinhard", "neutral", "none"];

const FULL_SCREEN = `${PRECISION}
in vec3 position;
out vec2 vClip;
void main() {
  vClip = position.xy;
  gl_Position = vec4(position.xy, 1.0, 1.0);
}
`;

// What `lightkiln shade` draws behind the scene: the environment itself; its texture's first row is the lowest.
const BACKGROUND = `${PRECISION}
const float PI = 3.141592653589793;
uniform sampler2D uEnvironment;
uniform mat4 uToWorld;
uniform vec3 uEye;
in vec2 vClip;
out vec4 radiance;
void main() {
  vec4 far = uToWorld * vec4(vClip, 1.0, 1.0);
  vec3 towards = normalize(far.xyz / far.w - uEye);
  vec2 at = vec2(0.5 + 0.5 * atan(towards.z, towards.x) / PI, 0.5 + asin(clamp(towards.y, -1.0, 1.0)) / PI);
  radiance = vec4(textureLod(uEnvironment, at, 0.0).rgb, 1.0);
}
`;

// 0: Reinhard et al. 2002, eq. 4, on luminance, as lightkiln's own pictures; 1: Khronos PBR Neutral; 2: clipped.
const TONE = `
uniform float uExposure;
uniform int uToneMap;
vec3 neutral(vec3 c) {
  const float start = 0.8 - 0.04, desaturation = 0.15;
  float x = min(c.r, min(c.g, c.b));
  c -= x < 0.08 ? x - 6.25 * x * x : 0.04;
  float peak = max(c.r, max(c.g, c.b));
  if (peak < start) return c;
  float d = 1.0 - start, top = 1.0 - d * d / (peak + d - start);
  return mix(c * top / peak, vec3(top), 1.0 - 1.0 / (desaturation * (peak - top) + 1.0));
}
vec3 displayed(vec3 radiance) {
  vec3 c = max(radiance, 0.0) * uExposure;
  if (uToneMap == 0) {
    float light = dot(c, vec3(0.2126, 0.7152, 0.0722));
    c *= (1.0 + light / 4.0) / (1.0 + light);
  } else if (uToneMap == 1) {
    c = neutral(c);
  }
  c = clamp(c, 0.0, 1.0);
  return mix(12.92 * c, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c));
}
`;

const DISPLAY = `${PRECISION}${TONE}
uniform sampler2D uRadiance;
in vec2 vClip;
out vec4 colour;
void main() {
  colour = vec4(displayed(texture(uRadiance, 0.5 + 0.5 * vClip).rgb), 1.0);
}
`;

// The light field of a point of the light map, as a sphere that shows at each place the light from its direction.
const SPHERE = `${TONE}
uniform sampler2DArray uLightField;
uniform int uLightFieldLobes;
uniform vec2 uAt;
uniform mat3 uFromCamera;
in vec2 vClip;
out vec4 colour;
void main() {
  float square = dot(vClip, vClip);
  if (square > 1.0) discard;
  vec3 direction = uFromCamera * vec3(vClip, sqrt(1.0 - square));
  colour = vec4(displayed(lkLobeSum(uLightField, uLightFieldLobes, uAt, direction)), 1.0);
}
`;
const SPHERE_SHARE = 0.3; // of the picture's shorter side

export class Picture {
  constructor(canvas, opened) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
    this.renderer.autoClear = false;
    this.floats = this.renderer.extensions.has("EXT_color_buffer_float");
    this.opened = opened;
    this.shared = makeShared(opened);
    this.hasEnvironment = "environment_u.ktx2" in opened.textures;
    this.camera = new THREE.PerspectiveCamera(45, 1, 0.01, 1000);
    this.scene = new THREE.Scene();
    this.bounds = new THREE.Box3();
    for (const mesh of opened.meshes) {
      nameAttributes(mesh.geometry);
      mesh.material = makeMaterial(mesh.material, mesh.geometry, opened.shaders, this.shared, this.hasEnvironment);
      this.scene.attach(mesh);
      this.bounds.expandByObject(mesh);
    }
    this.exposure = 1;
    this.toneMap = "reinhard";
    this.background = true;
    this.lobes = this.shared.uLightFieldLobes.value;
    this.target = new THREE.Vector3(); // what the camera looks at
    this.at = null; // [u, v] of the light map whose light field is shown
    this.film = null;
    this.sky = fullScreen(BACKGROUND, {
      uEnvironment: { value: opened.environment },
      uToWorld: { value: new THREE.Matrix4() },
      uEye: this.shared.uEye,
    });
    this.display = fullScreen(DISPLAY, {
      uRadiance: { value: null },
      uExposure: { value: 1 },
      uToneMap: { value: 0 },
    });
    this.sphere = fullScreen(PRECISION + INCLUDES.map((name) => opened.shaders[name]).join("\n") + SPHERE, {
      uLightField: this.shared.uLightField,
      uLightFieldLobes: this.shared.uLightFieldLobes,
      uExposure: this.display.material.uniforms.uExposure,
      uToneMap: this.display.material.uniforms.uToneMap,
      uAt: { value: new THREE.Vector2() },
      uFromCamera: { value: new THREE.Matrix3() },
    });
  }

  // Show a sum of some of TERMS; `unoccluded` stands in the place of `environment`.
  setTerms(terms) {
    const has = (name) => (terms.includes(name) ? 1 : 0);
    const reflected = Math.max(has("environment"), has("unoccluded"));
    this.shared.uTerms.value.set(has("emission"), has("diffuse"), has("interreflection"), reflected);
    this.shared.uOcclusion.value = has("environment") === 1;
    this.background = has("background") === 1;
  }

  setLobes(count) {
    this.shared.uLightFieldLobes.value = count;
    this.shared.uVisibilityLobes.value = Math.min(count, (this.shared.uVisibility.value?.image.depth ?? 0) / 2);
  }

  // A number for all surfaces, or null for their own.
  setRoughness(value) {
    for (const { material } of this.opened.meshes) {
      material.uniforms.uRoughness.value = value === null ? material.userData.roughness : 0;
      material.uniforms.uRoughnessBias.value = value ?? 0;
    }
  }

  setTexelGrid(shown) {
    this.shared.uTexelGrid.value = shown;
  }

  // Vertical field of view in degrees.
  setCamera({ position, target, fov_deg: fov, up = [0, 1, 0] }) {
    this.camera.up.set(...up);
    this.camera.position.set(...position);
    this.camera.fov = fov;
    this.target.set(...target);
    this.camera.lookAt(this.target);
  }

  // Draw onto the canvas at its size in device pixels.
  draw(width, height) {
    this.setMipmaps(true);
    this.renderer.setSize(width, height, false);
    this.#radiance(this.#targetOf(width, height, THREE.HalfFloatType, 4), width / height);
    const { uniforms } = this.display.material;
    uniforms.uRadiance.value = this.film.texture;
    uniforms.uExposure.value = this.exposure;
    uniforms.uToneMap.value = TONE_MAPS.indexOf(this.toneMap);
    this.renderer.setRenderTarget(null);
    this.renderer.render(this.display, this.camera);
    if (this.at !== null) this.#drawSphere(width, height);
  }

  // Wait until all is drawn: what WebGL was told to do is done only when somebody reads it.
  finish() {
    const gl = this.renderer.getContext();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  // Show the light field of what is at x, y in [-1, 1] of the picture; none where no surface is.
  pointAt(x, y) {
    const ray = new THREE.Raycaster();
    this.camera.updateMatrixWorld();
    ray.setFromCamera(new THREE.Vector2(x, y), this.camera);
    this.at = ray.intersectObjects(this.opened.meshes)[0]?.uv1.toArray() ?? null;
  }

  #drawSphere(width, height) {
    const side = Math.round(SPHERE_SHARE * Math.min(width, height));
    const { uniforms } = this.sphere.material;
    uniforms.uAt.value.set(...this.at);
    uniforms.uFromCamera.value.setFromMatrix4(this.camera.matrixWorld);
    this.renderer.setViewport(8, 8, side, side);
    this.renderer.render(this.sphere, this.camera);
    this.renderer.setViewport(0, 0, width, height);
  }

  // Whether the materials' textures are filtered with mips, as on the screen, or not, as `lightkiln shade` does.
  setMipmaps(used) {
    const minFilter = used ? THREE.LinearMipmapLinearFilter : THREE.LinearFilter;
    const maps = ["uBaseColorMap", "uMetallicRoughnessMap", "uEmissionMap"];
    for (const { material } of this.opened.meshes) {
      for (const texture of maps.map((name) => material.uniforms[name]?.value)) {
        if (texture && texture.minFilter !== minFilter) Object.assign(texture, { minFilter, needsUpdate: true });
      }
    }
  }

  // Linear radiance, Float32Array [height][width][RGBA], row 0 at the top; alpha is 0 where nothing was drawn. The picture
  // is drawn `finer` (odd) times larger and the middle pixels are kept: rasterisers snap vertices to a sixteenth of a
  // pixel or so, which would otherwise shift every attribute.
  capture(width, height, finer = 1) {
    if (!this.floats) throw new Error("This browser cannot draw to float targets (EXT_color_buffer_float).");
    this.setMipmaps(false);
    const [wide, high] = [width * finer, height * finer];
    const target = this.#targetOf(wide, high, THREE.FloatType, 0);
    this.#radiance(target, width / height);
    const all = new Float32Array(wide * high * 4);
    this.renderer.readRenderTargetPixels(target, 0, 0, wide, high, all);
    const out = new Float32Array(width * height * 4);
    const middle = (finer - 1) / 2;
    for (let row = 0; row < height; row += 1) {
      for (let column = 0; column < width; column += 1) {
        const from = 4 * ((high - 1 - (row * finer + middle)) * wide + column * finer + middle);
        out.set(all.subarray(from, from + 4), 4 * (row * width + column));
      }
    }
    return out;
  }

  #radiance(target, aspect) {
    const { camera, renderer, shared } = this;
    camera.aspect = aspect;
    const size = this.bounds.getSize(new THREE.Vector3()).length() || 1;
    camera.far = this.bounds.getCenter(new THREE.Vector3()).distanceTo(camera.position) + size;
    camera.near = camera.far * 1e-4;
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
    shared.uEye.value.copy(camera.position);
    shared.uViewProjection.value.multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
    renderer.setRenderTarget(target);
    renderer.setClearColor(0x000000, 0);
    renderer.clear();
    if (this.background && this.opened.environment) {
      this.sky.material.uniforms.uToWorld.value.copy(shared.uViewProjection.value).invert();
      renderer.render(this.sky, camera);
    }
    renderer.render(this.scene, camera);
  }

  #targetOf(width, height, type, samples) {
    const { film: target } = this;
    if (target && target.width === width && target.height === height && target.texture.type === type) return target;
    target?.dispose();
    const filter = THREE.NearestFilter;
    this.film = new THREE.WebGLRenderTarget(width, height, { type, samples, minFilter: filter, magFilter: filter });
    return this.film;
  }
}

function fullScreen(fragmentShader, uniforms) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute([-1, -1, 0, 3, -1, 0, -1, 3, 0], 3));
  const material = new THREE.RawShaderMaterial({
    glslVersion: THREE.GLSL3,
    vertexShader: FULL_SCREEN,
    fragmentShader,
    uniforms,
    depthTest: false,
    depthWrite: false,
  });
  const mesh = new THREE.Mesh(geometry, material);
  mesh.frustumCulled = false;
  // Rendered as a scene of its own.
  const scene = new THREE.Scene();
  scene.add(mesh);
  scene.material = material;
  return scene;
}
