// Orbit and walk cameras by pointer, touch and keyboard.

import * as THREE from "../vendor/three/three.module.min.js";
import { OrbitControls } from "../vendor/three/OrbitControls.js";

const TURN = 0.05; // radians a key press
const DRAG = 0.004; // radians a pixel
const STEP = 0.02; // of the scene's size a key press
const MOVES = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0] };
const TURNS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

// A camera in the file's coordinates, about the origin that the meshes are drawn about.
export function localCamera(camera, origin) {
  const less = (point) => point.map((value, axis) => value - origin[axis]);
  return { ...camera, position: less(camera.position), target: less(camera.target) };
}

// From `#camera=px,py,pz:tx,ty,tz:fov`, as `lightkiln shade` takes it; null where there is none.
export function readCamera(hash) {
  const number = "(-?[0-9.]+)";
  const point = `${number},${number},${number}`;
  const found = new RegExp(`^#camera=${point}:${point}:${number}$`).exec(decodeURIComponent(hash));
  if (found === null) return null;
  const [px, py, pz, tx, ty, tz, fov] = found.slice(1).map(Number);
  return { position: [px, py, pz], target: [tx, ty, tz], fov_deg: fov };
}

export class Navigation {
  constructor(picture, canvas, redraw) {
    this.camera = picture.camera;
    this.redraw = redraw;
    this.step = STEP * picture.bounds.getSize(new THREE.Vector3()).length();
    this.walking = false;
    this.orbit = new OrbitControls(this.camera, canvas);
    this.target = () => picture.target;
    this.follow();
    this.orbit.addEventListener("change", redraw);
    canvas.addEventListener("keydown", (event) => this.#key(event));
    canvas.addEventListener("pointermove", (event) => {
      if (this.walking && event.buttons) this.#turn(DRAG * event.movementX, DRAG * event.movementY);
    });
  }

  // Take the place where the picture's camera has been put.
  follow() {
    this.orbit.target.copy(this.target());
    this.orbit.update();
  }

  setWalking(walking) {
    this.walking = walking;
    this.orbit.enabled = !walking;
  }

  #key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const move = MOVES[event.key.toLowerCase()];
    const turn = TURNS[event.key];
    if (move) {
      const [right, up, forward] = move;
      const by = new THREE.Vector3(right, up, -forward).multiplyScalar(this.step).applyQuaternion(this.camera.quaternion);
      this.camera.position.add(by);
      this.orbit.target.add(by);
    } else if (turn) {
      this.#turn(TURN * turn[0], TURN * turn[1]);
    } else {
      return;
    }
    event.preventDefault();
    this.redraw();
  }

  // Turn about the eye; the point that is orbited stays ahead of it.
  #turn(yaw, pitch) {
    const ahead = this.orbit.target.clone().sub(this.camera.position);
    const around = new THREE.Spherical().setFromVector3(ahead);
    around.theta += yaw;
    around.phi = Math.min(Math.max(around.phi - pitch, 0.05), Math.PI - 0.05);
    this.orbit.target.copy(this.camera.position).add(ahead.setFromSpherical(around));
    this.camera.lookAt(this.orbit.target);
    this.redraw();
  }
}
