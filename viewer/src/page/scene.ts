// Asks the server what a scene is, and reads what static scenes say beside their Gaussians.

import type { Header, Pose, Source, SourceEvents } from "../core/types.ts";
import { resolve } from "./address.ts";
import type { Permit, SceneAddress } from "./address.ts";
import { Facts } from "./facts.ts";
import { fields, list } from "./json.ts";

/**
 * Where a scene is read from, its number of Gaussians where that is known, and whether its server prepares it for
 * streaming, or reads the whole of it, meanwhile; `answered`: the server has said so.
 */
interface Located {
  scene: SceneAddress;
  preparing: boolean;
  answered: boolean;
  gaussians: number | null;
}

// between two questions whether there is more of a scene: at first, and after half a minute
const FIRST_LOOK_MS = 250, LOOK_MS = 1000, SLOWER = 1.03;
const LONGEST_LOOK_MS = 60_000; // the same, of a server that does not answer

/**
 * Return the address to read a scene from: a server has some scenes as streams and some as files. What it says counts
 * only where the page may open it.
 */
export async function locate(scene: SceneAddress, permits: Permit): Promise<Located> {
  if (!scene.root) return { scene, preparing: false, answered: false, gaussians: null };
  const listed = await ask(scene.root);
  const rows = fields(listed)?.scenes;
  const row = list(rows).map(fields).find((each) => each?.name === scene.name);
  const gaussians = typeof row?.gaussians === "number" ? row.gaussians : null;
  const said = { preparing: false, answered: Array.isArray(rows), gaussians };
  const kind = typeof row?.stream === "string" ? "stream" : "static", path = row?.[kind];
  const url = typeof path === "string" ? resolve(path, scene.root, permits) : null;
  if (url === null) return { ...said, scene };
  if (kind === "stream") return { ...said, scene: { ...scene, kind, url: url.replace(/^http/, "ws") } };
  return { ...said, scene: { ...scene, kind, url }, preparing: row?.preparing === true };
}

/**
 * Ask until the server has more of a scene than what is shown: its stream, or files of another number of Gaussians.
 * Return null where neither will come.
 */
export async function awaitMore(
  scene: SceneAddress, permits: Permit, shown: number | null = null,
  sleep: (milliseconds: number) => Promise<void> = rest,
): Promise<SceneAddress | null> {
  for (let wait = FIRST_LOOK_MS, pace = wait; ; ) {
    await sleep(wait);
    const now = await locate(scene, permits);
    pace = Math.min(SLOWER * pace, LOOK_MS);
    wait = now.answered ? pace : Math.min(2 * wait, LONGEST_LOOK_MS); // a question without an answer settles nothing
    if (!now.answered) continue;
    const isWhole = shown !== null && now.gaussians !== null && now.gaussians !== shown;
    if (now.scene.kind === "stream" || isWhole) return now.scene;
    if (!now.preparing) return null;
  }
}

export const rest = (milliseconds: number): Promise<void> => new Promise((done) => { setTimeout(done, milliseconds); });

/** Return what is known of a scene: a server is asked, a static scene has views, and where it has cells those, in files. */
export function factsOf(scene: SceneAddress): Facts {
  if (scene.kind === "static") {
    const at = placesOf(scene.url), said = ask(at("scene.json"));
    return new Facts(null, readFiles(at, said), said);
  }
  return new Facts(scene.root && new URL(`scenes/${encodeURIComponent(scene.name)}/`, scene.root).href);
}

/** Return what gives the address of each file of a static scene. */
function placesOf(url: string): (name: string) => string {
  return (name) => url === "inline:"
    ? `data:;base64,${document.querySelector(`script[data-name="${name}"]`)?.textContent}`
    : new URL(name, url.replace(/(\/[^/]*\.json)?\/?$/, "/")).href;
}

/** Return what a server would answer, of a static scene: `cells`, with its views, `floor`, and the address of `walk`. */
async function readFiles(at: (name: string) => string, scene: Promise<unknown>): Promise<unknown> {
  const said = fields(await scene), files = fields(said?.files);
  const file = fields(files?.facts), walk = fields(files?.walk);
  const facts = file && fields(await fetch(at(String(file.name))).then(
    ({ body }) => new Response(body!.pipeThrough(new DecompressionStream("deflate"))).json(),
  ).catch(() => null));
  return {
    ...facts, cells: { ...fields(facts?.cells), views: said?.poses }, walk: walk && at(String(walk.name)),
  };
}

/**
 * Start a source at once, so that it connects while the page prepares to draw, and hold poses back until the page has
 * chosen its first view: no byte is spent on a view that nobody sees. `header` is the first header that it says.
 */
export function holdPoses(source: Source): { source: Source; header: Promise<Header>; release(): void } {
  let [held, open]: [Pose | null, boolean] = [null, false];
  let know = (_: Header): void => undefined;
  const known = new Promise<Header>((resolve) => { know = resolve; });
  let begin = (_: SourceEvents): void => undefined;
  const started = new Promise<SourceEvents>((resolve) => { begin = resolve; });
  let events: SourceEvents | null = null;
  const pass = (work: (to: SourceEvents) => void): void => {
    if (events) work(events);
    else void started.then(work);
  };
  source.start({
    header: (header, fresh) => {
      know(header);
      pass((to) => to.header(header, fresh));
    },
    batch: (batch) => pass((to) => to.batch(batch)),
    sets: (first, sets) => pass((to) => to.sets?.(first, sets)),
    state: (state) => pass((to) => to.state(state)), traffic: (traffic) => pass((to) => to.traffic(traffic)),
  });
  return {
    header: known,
    source: {
      start: (to) => {
        begin(to);
        void started.then(() => { events = to; }); // behind what has waited
      },
      view: (view) => source.view(view),
      close: () => source.close(),
      pose: (pose) => {
        held = pose;
        if (open) source.pose(pose);
      },
    },
    release: () => {
      if (!open && held) source.pose(held);
      open = true;
    },
  };
}

async function ask(address: string): Promise<unknown> {
  try {
    const response = await fetch(address, { headers: { accept: "application/json" } });
    return response.ok ? await response.json() : null;
  } catch {
    return null; // the source says what is wrong
  }
}
