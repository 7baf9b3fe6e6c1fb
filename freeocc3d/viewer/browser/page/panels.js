// The parts of the page around the canvas: photographs, facts about a voxel, messages, help, the theme.

const VIRIDIS = [[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]];

/** Returns the viridis color of 0…1. */
export function viridis(value) {
  const at = Math.min(Math.max(value, 0), 1) * (VIRIDIS.length - 1), low = Math.min(Math.floor(at), VIRIDIS.length - 2);
  return VIRIDIS[low].map((from, k) => Math.round(from + (at - low) * (VIRIDIS[low + 1][k] - from)));
}

export const byId = (id) => document.getElementById(id);

/** A photograph with an optional box of pixels on it. */
export class Photograph {
  constructor() {
    this.panel = byId("photograph");
    this.image = this.panel.querySelector("img");
    this.mark = this.panel.querySelector(".mark");
    byId("photograph-close").addEventListener("click", () => this.hide());
    this.image.addEventListener("error", () => {
      if (this.image.getAttribute("src")) byId("photograph-name").textContent += " (cannot be shown)";
    });
  }

  /** @param camera {width, height}.  @param mark {box: x0, y0, x1, y1 with the last pixels included, color}, or none. */
  show(source, name, camera, mark) {
    this.panel.hidden = false;
    byId("photograph-name").textContent = source ? name : `${name}: this file holds no photograph of it`;
    this.image.parentElement.hidden = !source;
    if (source) this.image.src = source;
    this.mark.hidden = !mark || !source;
    if (mark) {
      this.mark.style.borderColor = mark.color;
      const [x0, y0, x1, y1] = mark.box, percent = (value, whole) => `${(100 * value) / whole}%`;
      Object.assign(this.mark.style, {
        left: percent(x0, camera.width), top: percent(y0, camera.height),
        width: percent(x1 + 1 - x0, camera.width), height: percent(y1 + 1 - y0, camera.height),
      });
    }
  }

  hide() {
    this.panel.hidden = true;
    this.image.removeAttribute("src");
    this.panel.dispatchEvent(new Event("hidden"));
  }
}

/** Shows rows of a name and a value. */
export function showFacts(title, rows) {
  const panel = byId("facts");
  panel.hidden = false;
  byId("facts-title").textContent = title;
  const list = byId("facts-list");
  list.replaceChildren();
  for (const [name, value] of rows) {
    const term = document.createElement("dt"), told = document.createElement("dd");
    term.textContent = name;
    if (value instanceof Node) told.append(value);
    else told.textContent = value;
    list.append(term, told);
  }
}

/** One line above everything; empty hides it. */
export function say(text) {
  byId("message").textContent = text;
  byId("message").hidden = !text;
}

/** Dark or light: what was chosen here before, else what the system wants. */
export function theme(changed) {
  const wanted = matchMedia("(prefers-color-scheme: dark)");
  let chosen;
  try {
    chosen = localStorage.getItem("freeocc3d-theme") ?? undefined;
  } catch { /* a page from a file may have no storage */ }
  const apply = () => {
    const dark = chosen ? chosen === "dark" : wanted.matches;
    document.documentElement.dataset.theme = dark ? "dark" : "light";
    changed(dark);
  };
  wanted.addEventListener("change", apply);
  byId("theme").addEventListener("click", () => {
    chosen = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
    try {
      localStorage.setItem("freeocc3d-theme", chosen);
    } catch { /* as above */ }
    apply();
  });
  apply();
}
