// Several maps beside each other, each in a frame of its own. The cameras move together if they are linked.

import { byId } from "panels";

export async function start() {
  const maps = await (await fetch("./maps")).json();
  document.body.classList.add("side-by-side");
  const board = document.createElement("main");
  board.className = "frames";
  const bar = document.createElement("label");
  bar.className = "link-cameras";
  const linked = document.createElement("input");
  linked.type = "checkbox";
  linked.checked = maps.every(({ capture }) => capture === maps[0].capture);
  bar.append(linked, " Link cameras and questions");
  const frames = maps.map(({ name }, number) => {
    const frame = document.createElement("iframe");
    frame.src = `./?map=${number}`;
    frame.title = name;
    board.append(frame);
    return frame;
  });
  addEventListener("message", (event) => {
    if (event.origin !== location.origin || !linked.checked) return;
    for (const frame of frames) {
      if (frame.contentWindow !== event.source) frame.contentWindow?.postMessage(event.data, location.origin);
    }
  });
  byId("viewer").replaceWith(board, bar);
}
