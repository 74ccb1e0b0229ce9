// A path-traced picture over the part of the drawn one right of a slider; packages whose jobs stated FLIP gates hold some.

import { localCamera } from "./navigation.js";

const WHITE = 2; // where lightkiln's tone map puts a picture's white, in Reinhard's units

export class Reference {
  constructor(picture, form) {
    this.picture = picture;
    this.controls = form.elements;
    this.views = picture.opened.manifest.views ?? {};
    this.panel = document.getElementById("reference");
    document.getElementById("compare").hidden = Object.keys(this.views).length === 0;
    for (const name of Object.keys(this.views)) this.controls.view.add(new Option(name, name));
  }

  get view() {
    return this.views[this.controls.view.value];
  }

  // That shows the drawn picture with the reference's white; 1 where there is none.
  get exposure() {
    return this.view ? WHITE / this.view.white : 1;
  }

  // Show what is chosen and look from its camera; whether there is something.
  choose() {
    this.panel.hidden = !this.view;
    if (!this.view) return false;
    const name = encodeURIComponent(this.controls.view.value);
    this.panel.firstElementChild.src = `${document.body.dataset.package}gates/${name}_reference.png`;
    this.picture.setCamera(localCamera(this.view.camera, this.picture.opened.origin));
    this.controls.tone.value = "reinhard";
    return true;
  }

  split() {
    this.panel.style.setProperty("--split", `${this.controls.split.value}%`);
  }
}
