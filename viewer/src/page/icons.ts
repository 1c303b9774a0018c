// Icons, drawn in lines on 24 x 24.

import { draw } from "./dom.ts";

const LINES = {
  back: "M15 5l-7 7 7 7",
  next: "M9 5l7 7-7 7",
  up: "M6 14l6-6 6 6",
  author: "M4 20l1-4L16 5l3 3L8 19zM14 7l3 3",
  close: "M6 6l12 12M18 6L6 18",
  inspect: "M12 3v4M12 17v4M3 12h4M17 12h4M12 7a5 5 0 1 0 0 10a5 5 0 0 0 0-10M12 12h.01",
  options: "M4 7h9M19 7h1M4 17h1M11 17h9" +
    "M16 4.5a2.5 2.5 0 1 0 0 5a2.5 2.5 0 0 0 0-5M8 14.5a2.5 2.5 0 1 0 0 5a2.5 2.5 0 0 0 0-5",
  statistics: "M5 20v-7M12 20V4M19 20v-10",
  share: "M10 14a4 4 0 0 0 5.7 0l3.1-3.1a4 4 0 0 0-5.7-5.7l-1 1M14 10a4 4 0 0 0-5.7 0l-3.1 3.1a4 4 0 0 0 5.7 5.7l1-1",
  picture: "M4 8h3.5l1.6-2.5h5.8L16.5 8H20v11H4zM12 10.2a3.2 3.2 0 1 0 0 6.4a3.2 3.2 0 0 0 0-6.4",
  play: "M8 5.5l10.5 6.5L8 18.5z",
  pause: "M8.5 5.5v13M15.5 5.5v13",
  repeat: "M4 11a8 8 0 0 1 14.5-3.5L20 9M20 4v5h-5M20 13a8 8 0 0 1-14.5 3.5L4 15M4 20v-5h5",
  pingpong: "M4 9h15l-3.5-3.5M20 15H5l3.5 3.5",
  full: "M4 9V4h5M15 4h5v5M20 15v5h-5M9 20H4v-5",
  help: "M9 9a3 3 0 1 1 4.4 2.6c-.9.5-1.4 1.1-1.4 2.2v.4M12 17.5h.01",
  headset: "M4 8h16a1 1 0 0 1 1 1v7a1 1 0 0 1-1 1h-4l-2.5-3h-3L8 17H4a1 1 0 0 1-1-1V9a1 1 0 0 1 1-1",
  home: "M4 11.5L12 5l8 6.5M6.5 10v9h11v-9",
  orbit: "M12 9.5a2.5 2.5 0 1 0 0 5a2.5 2.5 0 0 0 0-5M20.5 9.5c.9 2.8-2.2 6.2-6.9 7.6" +
    "S4.4 17.3 3.5 14.5s2.2-6.2 6.9-7.6s9.2-.2 10.1 2.6",
  fly: "M3 11.5L21 4l-6.5 17-3-7.5z",
  walk: "M13 3.5a1.5 1.5 0 1 0 0 3a1.5 1.5 0 0 0 0-3M12.5 9l-1.5 5.5 3 2.5 1 4" +
    "M11 14.5L9.5 18 7 21M12.5 9L9 10.5 8 13.5M12.5 9l2.5 2.5 3 .5",
} as const;

export type IconName = keyof typeof LINES;

export function icon(name: IconName): SVGSVGElement {
  return draw(
    "svg", { viewBox: "0 0 24 24", class: "icon", "aria-hidden": "true", focusable: "false" },
    draw("path", { d: LINES[name] }),
  );
}
