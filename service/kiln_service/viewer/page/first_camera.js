// The first look at a scene that neither the URL nor the package has a camera for.
//
// 1. Where walls stand around a place inside the scene's box, one looks from inside: across the middle of the free space,
//    half-way between the floor and what is above, from near to what is behind. Of sixteen ways to look that one is
//    taken whose picture shows most and farthest: what stands close before the eye counts little, an opening nothing.
// 2. Else from outside: from above the horizon, so never from below a floor, with all of the scene in the picture, from the
//    side that shows most fronts of surfaces and fewest backs, which are black. Of sides that are nearly alike the front
//    is taken (+Z, as glTF has it), a little from the right.
//
// Scenes of many triangles, for which this would take seconds, are seen from the front without a look at them.
//
// A place is inside where of eight horizontal rays six hit the front of a surface, none hits the back of one (that would be
// the inside of something solid), and the ray down finds a floor.

import * as THREE from "../vendor/three/three.module.min.js";

const UP = new THREE.Vector3(0, 1, 0);
const DOWN = new THREE.Vector3(0, -1, 0);
const MOST_TRIANGLES = 500_000;
const AROUND = 8;
const WALLS = 6;
const WAYS = 16;
const PLAN = [0.5, 0.25, 0.75]; // of the box's width and depth
const HEIGHTS = [0.35, 0.65]; // of its height
const INSIDE_FOV = 60;
const STAND = 0.85; // of the way to what is behind
const LOWER = 0.15; // of the room's height is what one looks at below the eye,
const STEEPEST = 0.5; // but no more than of the way to it
const OUTSIDE_FOV = 45;
const MARGIN = 1.05;
const ELEVATION = 0.35; // radians
const ALIKE = 0.8; // of what the best side shows
const SIDES = [0.4, -0.4, 1.2, -1.2, 2.0, -2.0, 2.8, -2.8]; // radians from +Z towards +X
const RASTER = [8, 5]; // rays of a picture

// The triangles of meshes in world space.
class Surfaces {
  constructor(meshes) {
    this.parts = meshes.map(({ geometry, material }) => ({
      corners: corners(geometry),
      box: new THREE.Box3().setFromBufferAttribute(geometry.attributes.position),
      doubleSided: material.uniforms.uDoubleSided.value,
    }));
  }

  // What a ray meets first, { distance, front }; infinitely far where it meets nothing.
  meet(from, towards) {
    const ray = new THREE.Ray(from, towards);
    let nearest = { distance: Infinity, front: false };
    for (const part of this.parts) {
      if (ray.intersectsBox(part.box)) nearest = meetPart(part, from, towards, nearest);
    }
    return nearest;
  }
}

// Of each triangle a corner, and from there to the other two.
function corners({ attributes: { position }, index }) {
  const count = index?.count ?? position.count;
  const out = new Float32Array(3 * count);
  const [a, b, c] = [0, 1, 2].map(() => new THREE.Vector3());
  for (let at = 0; at < count; at += 3) {
    [a, b, c].forEach((corner, k) => corner.fromBufferAttribute(position, index ? index.getX(at + k) : at + k));
    out.set([...a, ...b.sub(a), ...c.sub(a)], 3 * at);
  }
  return out;
}

// Möller and Trumbore 1997, for all triangles of a part.
function meetPart({ corners, doubleSided }, { x: ox, y: oy, z: oz }, { x: dx, y: dy, z: dz }, nearest) {
  let { distance, front } = nearest;
  for (let at = 0; at < corners.length; at += 9) {
    const e1x = corners[at + 3], e1y = corners[at + 4], e1z = corners[at + 5];
    const e2x = corners[at + 6], e2y = corners[at + 7], e2z = corners[at + 8];
    const px = dy * e2z - dz * e2y, py = dz * e2x - dx * e2z, pz = dx * e2y - dy * e2x;
    const facing = e1x * px + e1y * py + e1z * pz; // over 0: towards the front
    if (facing === 0) continue;
    const tx = ox - corners[at], ty = oy - corners[at + 1], tz = oz - corners[at + 2];
    const u = (tx * px + ty * py + tz * pz) / facing;
    if (u < 0 || u > 1) continue;
    const qx = ty * e1z - tz * e1y, qy = tz * e1x - tx * e1z, qz = tx * e1y - ty * e1x;
    const v = (dx * qx + dy * qy + dz * qz) / facing;
    if (v < 0 || u + v > 1) continue;
    const t = (e2x * qx + e2y * qy + e2z * qz) / facing;
    if (t > 0 && t < distance) [distance, front] = [t, facing > 0 || doubleSided];
  }
  return { distance, front };
}

export function firstCamera(meshes, bounds, aspect) {
  const triangles = meshes.reduce((sum, { geometry }) => sum + (geometry.index ?? geometry.attributes.position).count / 3, 0);
  if (triangles > MOST_TRIANGLES) return framing(bounds, SIDES[0], aspect);
  const surfaces = new Surfaces(meshes);
  return inside(surfaces, bounds, aspect) ?? outside(surfaces, bounds, aspect);
}

// The camera inside an enclosure, or null where none is found.
function inside(surfaces, bounds, aspect) {
  let best = { room: 0 };
  for (const y of HEIGHTS) {
    for (const x of PLAN) {
      for (const z of PLAN) {
        const place = new THREE.Vector3(x, y, z).multiply(bounds.getSize(new THREE.Vector3())).add(bounds.min);
        const room = roomAt(surfaces, bounds, place);
        if (room > best.room) best = { place, room };
      }
    }
  }
  if (!best.room) return null;
  const cameras = around(WAYS).map((towards) => across(surfaces, bounds, best.place, towards));
  const far = (met) => met.reduce((sum, { distance, front }) => sum + (front ? Math.sqrt(distance) : 0), 0);
  return most(cameras, (camera) => far(seen(surfaces, camera, aspect)));
}

// How much room there is around a place: the mean way to what stands around; 0 where it is not inside.
function roomAt(surfaces, bounds, place) {
  if (!surfaces.meet(place, DOWN).front) return 0;
  const met = around(AROUND).map((towards) => ({ towards, ...surfaces.meet(place, towards) }));
  const walls = met.filter(({ front }) => front).length;
  const backs = met.filter(({ front, distance }) => !front && distance < Infinity).length;
  if (walls < WALLS || backs > 0) return 0;
  return met.reduce((sum, { towards, distance }) => sum + Math.min(distance, wayOut(bounds, place, towards)), 0) / AROUND;
}

// The camera that looks across a place, from near to what is behind it.
function across(surfaces, bounds, place, towards) {
  const backwards = towards.clone().negate();
  const back = Math.min(surfaces.meet(place, backwards).distance, wayOut(bounds, place, backwards));
  const eye = place.clone().addScaledVector(backwards, STAND * back);
  const floor = Math.max(eye.y - surfaces.meet(eye, DOWN).distance, bounds.min.y);
  const above = Math.min(eye.y + surfaces.meet(eye, UP).distance, bounds.max.y);
  eye.y = (floor + above) / 2;
  const target = place.clone().setY(eye.y - Math.min(LOWER * (above - floor), STEEPEST * STAND * back));
  return { position: eye.toArray(), target: target.toArray(), fov_deg: INSIDE_FOV };
}

function outside(surfaces, bounds, aspect) {
  const cameras = SIDES.map((side) => framing(bounds, side, aspect));
  const fronts = (met) => met.reduce((sum, { distance, front }) => sum + (distance < Infinity ? 2 * front - 1 : 0), 0);
  return most(cameras, (camera) => fronts(seen(surfaces, camera, aspect)), ALIKE);
}

// The camera on a side of a box that has it all in its picture.
function framing(bounds, side, aspect) {
  const centre = bounds.getCenter(new THREE.Vector3());
  const back = new THREE.Vector3().setFromSphericalCoords(1, Math.PI / 2 - ELEVATION, side);
  const right = new THREE.Vector3().crossVectors(UP, back).normalize();
  const up = new THREE.Vector3().crossVectors(back, right);
  const slope = Math.tan((OUTSIDE_FOV * Math.PI) / 360);
  let distance = 0;
  for (let corner = 0; corner < 8; corner += 1) {
    const part = ["x", "y", "z"].map((axis, k) => bounds[(corner >> k) & 1 ? "max" : "min"][axis] - centre[axis]);
    const at = new THREE.Vector3(...part);
    const beside = Math.max(Math.abs(at.dot(up)), Math.abs(at.dot(right)) / aspect) / slope;
    distance = Math.max(distance, at.dot(back) + MARGIN * beside);
  }
  return { position: centre.clone().addScaledVector(back, distance).toArray(), target: centre.toArray(), fov_deg: OUTSIDE_FOV };
}

// What the rays of a camera's picture meet.
function seen(surfaces, { position, target, fov_deg }, aspect) {
  const camera = new THREE.PerspectiveCamera(fov_deg, aspect, 0.1, 1);
  camera.position.set(...position);
  camera.lookAt(...target);
  camera.updateMatrixWorld();
  return Array.from({ length: RASTER[0] * RASTER[1] }, (_, ray) => {
    const [i, j] = [ray % RASTER[0], Math.floor(ray / RASTER[0])];
    const at = new THREE.Vector3((2 * (i + 0.5)) / RASTER[0] - 1, 1 - (2 * (j + 0.5)) / RASTER[1], 0.5);
    return surfaces.meet(camera.position, at.unproject(camera).sub(camera.position).normalize());
  });
}

// The first of those that are worth most, or nearly so.
function most(cameras, worth, alike = 1) {
  const worths = cameras.map(worth);
  const best = Math.max(...worths);
  return cameras[worths.findIndex((one) => one >= Math.min(best, alike * best))];
}

// Horizontal directions, the first towards -Z, as somebody looks who stands in front.
function around(count) {
  return Array.from({ length: count }, (_, k) => new THREE.Vector3(0, 0, -1).applyAxisAngle(UP, (2 * Math.PI * k) / count));
}

// How far it is from inside a box to its faces.
function wayOut(bounds, place, towards) {
  const far = ["x", "y", "z"].map((axis) => {
    const face = towards[axis] > 0 ? bounds.max[axis] : bounds.min[axis];
    return Math.abs(towards[axis]) < 1e-9 ? Infinity : (face - place[axis]) / towards[axis];
  });
  return Math.min(...far);
}
