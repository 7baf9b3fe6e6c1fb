// Frames beside each other that look the same way and ask the same: each tells the page around it, which tells the others.

/** @param ask is called when another frame has asked for words. */
export function linkFrame(scene, answers, ask) {
  let quiet = true; // until someone uses this frame
  for (const name of ["pointerdown", "wheel", "keydown"]) addEventListener(name, () => { quiet = false; }, { capture: true });
  scene.controls.addEventListener("change", () => {
    if (quiet) return;
    const camera = { position: scene.camera.position.toArray(), target: scene.controls.target.toArray() };
    parent.postMessage({ camera }, location.origin);
  });
  addEventListener("message", ({ data, origin, source }) => {
    if (origin !== location.origin || source !== parent) return;
    quiet = true;
    if (data.camera) {
      scene.camera.position.fromArray(data.camera.position);
      scene.controls.target.fromArray(data.camera.target);
      scene.controls.update();
      scene.moved();
    }
    if (data.words !== undefined) {
      answers.form.elements.words.value = data.words;
      ask();
    }
  });
}

/** Tells the other frames what is asked for. */
export function tellWords(answers) {
  parent.postMessage({ words: answers.form.elements.words.value }, location.origin);
}
