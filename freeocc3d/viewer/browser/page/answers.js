// The question, the list of answers, and what is shown of the chosen one.

const MOST_LISTED = 60;

function element(kind, className, text) {
  const made = document.createElement(kind);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

/** Splits "sofa, coffee table" into words. */
export function splitWords(text) {
  return text.split(",").map((word) => word.trim()).filter(Boolean);
}

export class Answers extends EventTarget {
  /** @param root the panel.  Fires "asked" with {question} and "chosen" with {result, region, number}. */
  constructor(root) {
    super();
    this.root = root;
    this.form = root.querySelector("#question");
    this.list = root.querySelector("#answers");
    this.box = undefined;
    this.classes = new Set();
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.ask();
    });
    root.querySelector("#clear").addEventListener("click", () => this.clear());
  }

  ask() {
    this.dispatchEvent(new CustomEvent("asked", { detail: this.question() }));
  }

  clear() {
    for (const input of this.form.querySelectorAll("input[type=text], input[type=search]")) input.value = "";
    this.classes.clear();
    this.root.querySelectorAll("#classes [aria-pressed=true]").forEach((each) => each.setAttribute("aria-pressed", "false"));
    this.ask();
  }

  question() {
    const value = (name) => this.form.elements[name].value.trim();
    const question = { words: splitWords(value("words")).slice(0, 20), classes: [...this.classes].slice(0, 20) };
    if (value("not")) question.negative = splitWords(value("not")).slice(0, 20);
    if (value("on")) question.on = value("on");
    if (value("near")) question.near = value("near");
    const meters = Number.parseFloat(value("near_m"));
    if (value("near") && meters >= 0) question.near_m = meters;
    if (this.box) question.within = this.box;
    return question;
  }

  /** @param classes [{name, color, voxels}] */
  showClasses(classes) {
    const list = this.root.querySelector("#classes");
    list.replaceChildren();
    for (const { name, number, color, voxels } of classes) {
      if (!number) continue;
      const chip = element("button", "chip", name);
      chip.type = "button";
      chip.title = `${voxels.toLocaleString("en")} voxels`;
      chip.style.setProperty("--word", `rgb(${color.join(", ")})`);
      chip.setAttribute("aria-pressed", String(this.classes.has(name)));
      chip.addEventListener("click", () => {
        if (!this.classes.delete(name)) this.classes.add(name);
        chip.setAttribute("aria-pressed", String(this.classes.has(name)));
        this.ask();
      });
      list.append(chip);
    }
  }

  showBusy() {
    this.list.setAttribute("aria-busy", "true");
  }

  showRefusal(text) {
    this.list.removeAttribute("aria-busy");
    this.list.replaceChildren(element("p", "note", text));
  }

  /** @param lengths {format(length), volume(m3)}.  @param away gives the distance of a region to the viewer. */
  show(results, lengths, away) {
    this.list.removeAttribute("aria-busy");
    this.list.replaceChildren();
    this.rows = [];
    let number = 0;
    for (const result of results) {
      const count = result.regions.length;
      const title = element("h3", "word");
      title.style.setProperty("--word", `rgb(${(result.color ?? [128, 128, 128]).join(", ")})`);
      title.append(element("span", "", result.word), element("small", "", count ? `${count} found` : "no match"));
      this.list.append(title);
      if (result.note) this.list.append(element("p", "note", result.note));
      const regions = element("ol", "regions");
      result.regions.forEach((region, k) => {
        const own = number + k;
        if (k >= MOST_LISTED) return;
        const row = element("li"), button = element("button", "region");
        const size = region.extent ?? region.box_max.map((high, axis) => high - region.box_min[axis]);
        button.append(
          element("b", "", region.score.toFixed(2)),
          element("span", "", region.name && region.name !== result.word ? region.name : `${lengths.volume(region.volume_m3)}`),
          element("span", "size", size.map((side) => lengths.number(side)).join(" × ") + ` ${lengths.unit}`),
          element("span", "away", ""),
        );
        button.addEventListener("click", () => this.choose(own));
        row.append(button);
        regions.append(row);
        this.rows[own] = { button, result, region, number: own };
      });
      if (count > MOST_LISTED) regions.append(element("li", "note", `and ${count - MOST_LISTED} more`));
      this.list.append(regions);
      number += count;
    }
    this.away = away;
    this.updateDistances();
  }

  /** Writes how far each region is from where the viewer stands. */
  updateDistances() {
    for (const row of this.rows ?? []) if (row) row.button.querySelector(".away").textContent = this.away(row.region);
  }

  choose(number) {
    for (const row of this.rows ?? []) row?.button.setAttribute("aria-current", String(row.number === number));
    const row = this.rows?.[number];
    if (row) this.dispatchEvent(new CustomEvent("chosen", { detail: row }));
  }
}
