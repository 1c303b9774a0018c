// One static scene while it is looked at: its tables, what each cell needs, the requests under way, and what comes of
// them.
import { Arrivals } from "./static-arrivals.ts";
import { Cells, everything, readRow } from "./static-cells.ts";
import type { CellRow } from "./static-cells.ts";
import { FirstView, PieceFile } from "./static-first.ts";
import { hasLittle, sectorsOf } from "./static-glances.ts";
import { Index } from "./static-index.ts";
import type { Link } from "./static-link.ts";
import { PartError } from "./static-parts.ts";
import type { Parts } from "./static-parts.ts";
import { readPiece } from "./static-pieces.ts";
import type { Piece } from "./static-pieces.ts";
import { PlainArrivals } from "./static-plain.ts";
import { ASKED, choose, HELD, LOST, NONE, worthOf } from "./static-plan.ts";
import type { Choice, Holdings } from "./static-plan.ts";
import type { StaticScene } from "./static-scene.ts";
import { readSets } from "./static-sets.ts";
import type { Pose, SourceEvents, View } from "./types.ts";

const TURN = 0.087; // radians by which the head turns before all is ranked again
const MOVE = 0.1; // share of the side of a cell by which it moves
const CONNECTIONS = 6, MOST_REQUESTS = 16; // at once: of HTTP/1.1, and of links with a long delay
const PART = 16 << 10; // bytes, about
const KEPT_ROWS = 64; // cells
const REST = -1; // in place of a cell: all that there is
const LEAST_LEFT = 0.05; // share of a part that may still be of use after a first view

interface SessionEvents extends SourceEvents {
  gone(): void; // a file of this scene is missing: there may be a new one
}

export class StaticSession {
  readonly arrivals: Arrivals;
  readonly #plain: PlainArrivals | null; // in place of `arrivals`
  readonly #held: Holdings;
  readonly #rows = new Map<number, CellRow | Promise<CellRow>>();
  readonly #first: FirstView[];
  #index: Index | null = null;
  #cells: Cells | null = null;
  #pose: Pose | null = null;
  #view: View | null = null;
  #planned: { cell: number; pose: Pose; view: View } | null = null;
  #worth: Float32Array = new Float32Array(0);
  #ofTerms: Float32Array | null = null;
  #glances: number[] = []; // that the planned view needs before parts
  #left: number[] | null = null; // cells of which what they see is sent when the planned one has all
  #busy = 0;
  #isClosed = false;
  #isComplete = false;
  readonly #losses = new Map<string, number>();

  constructor(
    readonly scene: StaticScene, private readonly parts: Parts, private readonly link: Link,
    private readonly events: SessionEvents,
  ) {
    const { parts: count, sets, cells } = scene;
    this.#held = {
      part: new Uint8Array(count), terms: new Uint8Array(count), sets: new Uint8Array(sets.bytes.length),
      glance: new Uint8Array(cells.count * (cells.glances?.sectors ?? 0)),
      left: new Float32Array(count).fill(1),
    };
    this.arrivals = new Arrivals(scene.header);
    this.#plain = scene.header.plain ? new PlainArrivals(scene.header) : null;
    this.#first = scene.first.map((_, k) => new FirstView(scene, k));
  }

  /** What has come so far. */
  get arrived(): { readonly gaussians: number; readonly terms: number } {
    return this.#plain ?? this.arrivals;
  }

  /** Read the tables of the scene. Without an index nothing can be drawn; without a grid there is one cell. */
  async start(): Promise<void> {
    const grid = this.#read("grid").then((data) => Cells.open(this.scene, data)).catch((error: unknown) => {
      if (!(error instanceof PartError)) throw error;
      this.#lose(error);
      return null;
    });
    grid.catch(() => undefined); // an index that is lost is reported first
    const index = await Index.open(this.scene, await this.#read("index"));
    this.#cells = await grid;
    this.#index = index;
    this.#pump();
  }

  setPose(pose: Pose): void {
    this.#pose = pose;
    this.#pump();
  }

  setView(view: View): void {
    this.#view = view;
    this.#pump();
  }

  close(): void {
    this.#isClosed = true;
  }

  /** Say again how things stand, as after a wait. */
  report(): void {
    const message = this.#message();
    this.events.state({ kind: this.#isComplete ? "complete" : "streaming", ...(message === null ? {} : { message }) });
  }

  /** Rank where that is due, and keep requests under way. */
  #pump(): void {
    if (this.#isClosed || this.#pose === null || this.#view === null) return;
    const first = this.#first.find((each) => each.isFor(this.#pose!) && !each.isOver);
    for (const { number } of this.#first) {
      if (number !== first?.number) this.parts.drop?.(`${this.scene.files.get("first")!.name}-${number}.bin`);
    }
    if (first !== undefined && !first.isAsked) void this.#fetchFirst(first);
    if (this.#index === null) return;
    const cell = this.#cells?.at(this.#pose.position) ?? 0, row = this.#row(cell);
    if (first !== undefined || row instanceof Promise) return; // they pump when they come
    if (this.#isStale(cell)) this.#plan(cell, row, this.#index, this.#pose, this.#view);
    while (this.#busy < this.#mostRequests()) {
      const delay = (this.link.throughput * this.link.roundTrip) / CONNECTIONS;
      const glance = this.#glances.shift();
      const choice = glance === undefined ? this.#choose(this.#index, delay) : { kind: "glance" as const, number: glance };
      if (choice === null) break;
      this.#held[choice.kind][choice.number] = ASKED;
      this.#busy++;
      void this.#fetch(choice, this.#index).finally(() => {
        this.#busy--;
        this.#pump();
      });
    }
    if (this.#busy === 0) this.#finish(cell);
  }

  /** Return how many requests fill the link: six, which is what HTTP/1.1 has, and more where the delay is long. */
  #mostRequests(): number {
    const filling = Math.ceil((1.5 * this.link.throughput * this.link.roundTrip) / PART);
    return Math.min(Math.max(filling, CONNECTIONS), MOST_REQUESTS);
  }

  #isStale(cell: number): boolean {
    const was = this.#planned, pose = this.#pose!, view = this.#view!;
    if (was === null || was.cell !== cell) return true;
    if ((["left", "right", "up", "down"] as const).some((side) => was.view[side] !== view[side])) return true;
    const moved = Math.hypot(...pose.position.map((v, k) => v - was.pose.position[k]));
    const size = this.scene.cells.size > 0 ? this.scene.cells.size : 4 * this.#index!.meanRadius;
    const cosine = Math.abs(pose.rotation.reduce((sum, v, k) => sum + v * was.pose.rotation[k], 0));
    const norms = Math.hypot(...pose.rotation) * Math.hypot(...was.pose.rotation);
    return moved > MOVE * size || 2 * Math.acos(Math.min(cosine / norms, 1)) > TURN;
  }

  #plan(cell: number, row: CellRow, index: Index, pose: Pose, view: View): void {
    this.#worth = worthOf(index, row, this.scene.cells.size, pose, view);
    this.#ofTerms = row.terms;
    this.#glances = this.#glancesOf(cell, row, pose, view);
    this.#planned = { cell, pose, view };
    this.#left = null;
    if (this.#isComplete && this.#choose(index, 0) !== null) {
      this.#isComplete = false;
      this.report();
    }
  }

  /** Return the glances of a view that are worth their bytes. */
  #glancesOf(cell: number, row: CellRow, pose: Pose, view: View): number[] {
    const { glances } = this.scene.cells, { length } = row.glances;
    if (glances === null || length === 0 || !hasLittle(this.#worth, this.#held)) return [];
    const some = sectorsOf(glances, pose, view).filter((sector) => row.glances[sector] > 0);
    return some.map((sector) => cell * length + sector).filter((number) => this.#held.glance[number] === NONE);
  }

  /** All that the cell needs is here: say so, and go on with what the cells beside it see, and then with the rest. */
  #finish(cell: number): void {
    if (!this.#isComplete) {
      this.#isComplete = true;
      this.report();
    }
    this.#left ??= [...this.#cells?.beside(cell) ?? [], REST];
    const other = this.#left[0];
    if (other === undefined) return;
    const row = other === REST ? everything(this.scene) : this.#row(other);
    if (row instanceof Promise) return;
    this.#left.shift();
    this.#worth = row.gains.slice();
    this.#ofTerms = row.terms;
    this.#pump();
  }

  #row(cell: number): CellRow | Promise<CellRow> {
    const found = this.#rows.get(cell);
    if (found !== undefined) return found;
    const cells = this.#cells;
    const asked = cells === null
      ? Promise.resolve(everything(this.scene))
      : this.#read("row", cell, cells.bytes[cell]).then((data) => readRow(this.scene, data, cells.middle(cell)));
    const made = asked.catch((error: unknown) => {
      this.#lose(error);
      return everything(this.scene);
    }).then((row) => {
      for (const key of this.#rows.keys()) {
        if (this.#rows.size >= KEPT_ROWS && key !== this.#planned?.cell) this.#rows.delete(key);
      }
      this.#rows.set(cell, row);
      this.#pump();
      return row;
    });
    this.#rows.set(cell, made);
    return made;
  }

  /** Read the file of a first view while it comes. */
  async #fetchFirst(first: FirstView): Promise<void> {
    const { number, bytes, where } = first;
    first.isAsked = true;
    let made = Promise.resolve();
    try {
      await this.#read("first", number, bytes, (data) => {
        for (const part of first.take(data)) {
          made = made.then(async () => {
            const piece = await readPiece(part, this.scene.header, this.arrivals.rows, where);
            if (!this.#isClosed) this.events.batch(this.arrivals.add(piece));
          });
          made.catch(() => undefined); // awaited below
        }
      });
      await made;
      this.#takeLeft(await first.left());
    } catch (error) {
      if (!this.#isClosed) this.#lose(error);
    }
    first.isOver = true;
    this.#pump();
  }

  #choose(index: Index, delay: number): Choice | null {
    return choose(index, this.#worth, this.#ofTerms, this.#held, delay, this.scene.sets);
  }

  async #fetch({ kind, number }: Choice, index: Index): Promise<void> {
    const states = this.#held[kind];
    try {
      const data = await this.#read(kind, number, this.#bytesOf({ kind, number }, index));
      const where = `${kind} ${number}`;
      const tell = kind === "sets" ? await this.#readSets(data, number)
        : kind === "glance" ? await this.#readGlance(data, where) : await this.#readPart(data, where);
      if (this.#isClosed) return;
      states[number] = HELD;
      tell();
    } catch (error) {
      if (this.#isClosed) return;
      states[number] = LOST;
      this.#lose(error);
    }
  }

  #bytesOf({ kind, number }: Choice, index: Index): number {
    const sectors = this.scene.cells.glances?.sectors ?? 1, row = this.#rows.get(Math.floor(number / sectors));
    if (kind === "glance") return row === undefined || row instanceof Promise ? 0 : row.glances[number % sectors];
    return { part: index.bytes, terms: index.termBytes, sets: this.scene.sets.bytes }[kind][number];
  }

  /** Decode a glance; return what tells of it. */
  async #readGlance(data: Uint8Array, where: string): Promise<() => void> {
    const file = new PieceFile(this.scene, where), pieces: Piece[] = [];
    for (const piece of file.take(data)) {
      pieces.push(await readPiece(piece, this.scene.header, this.arrivals.rows, where));
    }
    const left = await file.left();
    return () => {
      for (const piece of pieces) this.events.batch(this.arrivals.add(piece));
      this.#takeLeft(left);
    };
  }

  /** Count what is left of parts. */
  #takeLeft(left: Float32Array): void {
    left.forEach((share, p) => (this.#held.left[p] *= Math.max(share, LEAST_LEFT)));
  }

  /** Decode a part, or terms; return what tells of it. */
  async #readPart(data: Uint8Array, where: string): Promise<() => void> {
    const plain = this.#plain;
    if (plain !== null) {
      return () => {
        const { batch, harmonics } = plain.add(data, where);
        if (harmonics !== null) this.events.sets?.(harmonics.first, harmonics.sets);
        this.events.batch(batch);
      };
    }
    const piece = await readPiece(data, this.scene.header, this.arrivals.rows, where);
    return () => this.events.batch(this.arrivals.add(piece));
  }

  /** Decode a block of sets of harmonics; return what tells of it. */
  async #readSets(data: Uint8Array, block: number): Promise<() => void> {
    const { first, sets } = await readSets(data, block, this.scene.header.harmonics!);
    return () => this.events.sets?.(first, sets);
  }

  /** Return a file, or one of a kind by its number. */
  async #read(kind: string, number?: number, bytes?: number, take?: (data: Uint8Array) => void): Promise<Uint8Array> {
    const family = kind === "part" && this.#plain !== null ? "plain" : kind;
    const { name, bytes: all } = this.scene.files.get(family)!, file = number === undefined ? name : `${name}-${number}.bin`;
    return this.link.measure(() => this.parts.read(file, bytes ?? all, take), this.parts.isAhead?.(file));
  }

  #lose(reason: unknown): void {
    const message = reason instanceof Error ? reason.message : String(reason);
    this.#losses.set(message, (this.#losses.get(message) ?? 0) + 1);
    this.report();
    this.events.gone();
  }

  #message(): string | null {
    const [first] = this.#losses.keys();
    if (first === undefined) return null;
    return this.#losses.size === 1
      ? `A part of the scene is missing: ${first}`
      : `${this.#losses.size} parts of the scene are missing, such as ${first}`;
  }
}
