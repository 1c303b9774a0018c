// One static scene while it is looked at: its tables, what each cell needs, the requests under way, and what comes of
// them.
import { Arrivals } from "./static-arrivals.ts";
import { Blocks } from "./static-blocks.ts";
import { Cells, everything, readRow } from "./static-cells.ts";
import type { CellRow } from "./static-cells.ts";
import { PartError } from "./static-parts.ts";
import type { Parts } from "./static-parts.ts";
import { HELD, LOST, levelBytes, NONE, rank, regimeOf, slice, widen } from "./static-plan.ts";
import type { Holdings, Order, Regime, Run } from "./static-plan.ts";
import type { StaticScene } from "./static-scene.ts";
import type { Link } from "./static-link.ts";
import type { Pose, SourceEvents, View } from "./types.ts";

const TURN = 0.087; // radians by which the head turns before all is ranked again
const MOVE = 0.1; // share of the side of a cell by which it moves
const CONNECTIONS = 6;
const SLICE_SECONDS = 0.2;
const [LEAST_SLICE, MOST_SLICE] = [32 << 10, 512 << 10];
const [LEAST_GAP, MOST_GAP] = [1 << 10, 2 << 10]; // more would cost a slow link more than requests do
const [ALL_SLICE, ALL_GAP] = [128 << 10, 64 << 10]; // where every block is needed in the end, as without cells
const KEPT_ROWS = 64; // cells
const REST = -1; // in place of a cell: all that there is

const NOTHING: Order = { blocks: new Uint32Array(0), terms: new Uint8Array(0) };

interface SessionEvents extends SourceEvents {
  gone(): void; // a file of this scene is missing: there may be a new one
}

export class StaticSession {
  readonly arrivals: Arrivals;
  readonly #held: Holdings;
  readonly #rows = new Map<number, CellRow | Promise<CellRow>>();
  #pose: Pose | null = null;
  #view: View | null = null;
  #planned: { cell: number; pose: Pose; view: View; regime: Regime; terms: boolean } | null = null;
  #order = NOTHING;
  #place = 0;
  #queue: Run[] = [];
  #left: number[] | null = null; // cells of which what they see is sent when the planned one has all
  #busy = 0;
  #deferred: { run: Run; data: Uint8Array }[] = []; // terms that came before their records
  #regime: Regime | null = null;
  #seen: Uint8Array | null = null; // which blocks the planned row has
  #termsAsked = false;
  #isClosed = false;
  #isComplete = false;
  readonly #losses = new Map<string, number>();

  private constructor(
    readonly scene: StaticScene, private readonly parts: Parts, private readonly blocks: Blocks,
    private readonly cells: Cells | null,
    private readonly link: Link, private readonly events: SessionEvents,
  ) {
    this.#held = { records: new Uint8Array(blocks.count), terms: new Uint8Array(scene.layers * blocks.count) };
    this.arrivals = new Arrivals(blocks, this.#held);
  }

  /** Read the tables of a scene. Without chunks nothing can be drawn; without a grid there is one cell. */
  static async open(scene: StaticScene, parts: Parts, link: Link, events: SessionEvents): Promise<StaticSession> {
    const whole = (kind: string): Promise<Uint8Array> => {
      const file = scene.files.get(kind)!;
      return parts.read(file, 0, file.bytes);
    };
    let lost = "";
    const grid = whole("grid").then((data) => Cells.open(scene, data)).catch((error: unknown) => {
      if (!(error instanceof PartError)) throw error;
      lost = error.message;
      return null;
    });
    const blocks = await Blocks.open(scene, await whole("index"));
    const session = new StaticSession(scene, parts, blocks, await grid, link, events);
    if (lost !== "") session.#lose(lost);
    return session;
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
    this.#queue = [];
  }

  /** Say again how things stand, as after a wait. */
  report(): void {
    const message = this.#message();
    this.events.state({ kind: this.#isComplete ? "complete" : "streaming", ...(message === null ? {} : { message }) });
  }

  /** Rank where that is due, and keep requests under way. */
  #pump(): void {
    if (this.#isClosed || this.#pose === null || this.#view === null) return;
    const cell = this.cells?.at(this.#pose.position) ?? 0, row = this.#row(cell);
    if (row instanceof Promise) return; // it pumps when it comes
    if (this.#isStale(cell)) this.#plan(cell, row, this.#pose, this.#view);
    while (this.#busy < CONNECTIONS) {
      if (this.#queue.length === 0) this.#refill();
      const run = this.#queue.shift();
      if (run === undefined) break;
      this.#busy++;
      void this.#fetch(run).finally(() => {
        this.#busy--;
        this.#pump();
      });
    }
    if (this.#busy === 0 && this.#queue.length === 0) this.#finish(cell);
  }

  #isStale(cell: number): boolean {
    const was = this.#planned, pose = this.#pose!, view = this.#view!;
    if (was === null || was.cell !== cell || was.terms !== (this.blocks.termStart !== null)) return true;
    if ((["left", "right", "up", "down"] as const).some((side) => was.view[side] !== view[side])) return true;
    const moved = Math.hypot(...pose.position.map((v, k) => v - was.pose.position[k]));
    const size = this.scene.cells.size > 0 ? this.scene.cells.size : 4 * this.blocks.meanRadius;
    const cosine = Math.abs(pose.rotation.reduce((sum, v, k) => sum + v * was.pose.rotation[k], 0));
    const norms = Math.hypot(...pose.rotation) * Math.hypot(...was.pose.rotation);
    return moved > MOVE * size || 2 * Math.acos(Math.min(cosine / norms, 1)) > TURN ||
      this.#currentRegime(cell) !== was.regime;
  }

  #currentRegime(cell: number): Regime {
    const row = this.#rows.get(cell);
    if (this.blocks.top === 0 || row === undefined || row instanceof Promise) return "high";
    return (this.#regime = regimeOf(this.link.throughput, levelBytes(this.blocks, row), this.#regime));
  }

  #plan(cell: number, row: CellRow, pose: Pose, view: View): void {
    for (const run of this.#queue) for (let b = run.first; b < run.end; b++) this.#states(run)[b] = NONE;
    this.#queue = [];
    const regime = this.#currentRegime(cell), wide = widen(this.blocks, row, this.scene.cells.size, pose.position);
    this.#order = rank(this.blocks, wide, this.#held, pose, view, regime);
    this.#place = 0;
    this.#planned = { cell, pose, view, regime, terms: this.blocks.termStart !== null };
    this.#seen = new Uint8Array(this.blocks.count);
    for (const b of wide.blocks) this.#seen[b] = 1;
    this.#left = null;
    if (this.#order.blocks.length > 0 && this.#isComplete) {
      this.#isComplete = false;
      this.report();
    }
  }

  #refill(): void {
    const least = this.scene.cells.size === 0 ? ALL_SLICE : LEAST_SLICE;
    const budget = Math.min(Math.max(SLICE_SECONDS * this.link.throughput, least), MOST_SLICE);
    const { runs, next } = slice(this.blocks, this.#order, this.#place, this.#held, budget, this.#gap());
    this.#place = next;
    this.#queue.push(...runs);
  }

  /** Return the bytes between two runs for which they are still one request. */
  #gap(): number {
    if (!this.parts.ranges) return 0;
    if (this.scene.cells.size === 0) return ALL_GAP;
    return Math.min(Math.max((this.link.throughput * this.link.roundTrip) / CONNECTIONS, LEAST_GAP), MOST_GAP);
  }

  /** All that the cell needs is here: say so, and go on with what the cells beside it see, and then with the rest. */
  #finish(cell: number): void {
    if (!this.#termsAsked && this.scene.header.terms > 0) {
      void this.#loadTerms();
      return;
    }
    if (this.#termsAsked && this.blocks.termStart === null && !this.#termsLost) return;
    if (!this.#isComplete) {
      this.#sweep(true);
      this.#isComplete = true;
      this.report();
    }
    this.#left ??= [...this.cells?.beside(cell) ?? [], REST];
    const other = this.#left[0];
    if (other === undefined) {
      this.#seen!.fill(1);
      this.#sweep(true);
      return;
    }
    const isRest = other === REST, row = isRest ? everything(this.scene) : this.#row(other);
    if (row instanceof Promise) return;
    this.#left.shift();
    const regime = isRest ? "high" : this.#planned!.regime;
    this.#order = rank(this.blocks, row, this.#held, this.#pose!, this.#view!, regime, !isRest);
    this.#place = 0;
    this.#pump();
  }

  #termsLost = false;

  async #loadTerms(): Promise<void> {
    this.#termsAsked = true;
    const file = this.scene.files.get("blocks")!;
    try {
      await this.blocks.setTerms(await this.parts.read(file, 0, file.bytes));
    } catch (error) {
      this.#termsLost = true;
      this.#lose(error);
    }
    this.#pump();
  }

  #row(cell: number): CellRow | Promise<CellRow> {
    const found = this.#rows.get(cell);
    if (found !== undefined) return found;
    const file = this.scene.files.get("cells")!, [start, end] = this.cells?.range(cell) ?? [0, 0];
    const asked = this.cells === null
      ? Promise.resolve(everything(this.scene))
      : this.parts.read(file, start, end).then((data) => readRow(this.scene, data, this.cells!.middle(cell)));
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

  async #fetch(run: Run): Promise<void> {
    try {
      if (run.terms) await this.#fetchTerms(run);
      else await this.#fetchRecords(run);
    } catch (error) {
      if (this.#isClosed) return;
      const middle = (run.first + run.end) >> 1;
      if (error instanceof PartError && error.kind === "cut" && middle > run.first) {
        this.#queue.push({ ...run, end: middle }, { ...run, first: middle }); // a part of it may be there
        return;
      }
      for (let b = run.first; b < run.end; b++) this.#states(run)[b] = LOST;
      this.#lose(error);
    }
  }

  async #fetchRecords(run: Run): Promise<void> {
    const { start, recordStart, harmonicBytes: width } = this.blocks;
    const harmonics = width === 0
      ? null
      : this.#read("harmonics", width * start[run.first], width * start[run.end]).catch((error: unknown) => {
      if (!this.#isClosed) this.#lose(error);
      return null;
    });
    const data = await this.#read("records", recordStart[run.first], recordStart[run.end]), more = await harmonics;
    if (this.#isClosed) return;
    this.events.batch(this.arrivals.addRecords(run, data, more, (error) => this.#lose(error)));
    if (!this.#termsAsked && this.scene.header.terms > 0) void this.#loadTerms();
    this.#deferred = this.#deferred.filter((each) => !this.#takeTerms(each.run, each.data));
    this.#sweep();
  }

  #sweep(whole = false): void {
    const gone = this.#seen === null ? null : this.arrivals.sweep(this.#seen, whole);
    if (gone !== null && !this.#isClosed) this.events.batch(gone);
  }

  async #fetchTerms(run: Run): Promise<void> {
    const starts = this.blocks.termStart!, data = await this.#read("terms", starts[run.first], starts[run.end]);
    if (!this.#isClosed && !this.#takeTerms(run, data)) this.#deferred.push({ run, data });
  }

  /** Return whether these terms are settled: given on, or of no use because their records are lost. */
  #takeTerms(run: Run, data: Uint8Array): boolean {
    const { records } = this.#held, { count } = this.blocks;
    for (let item = run.first; item < run.end; item++) {
      if (records[item % count] !== HELD && records[item % count] !== LOST) return false;
    }
    this.events.batch(this.arrivals.addTerms(run, data, (error) => this.#lose(error)));
    return true;
  }

  async #read(kind: string, start: number, end: number): Promise<Uint8Array> {
    const file = this.scene.files.get(kind);
    if (file === undefined) throw new PartError("missing", `${kind}: scene.json names no such file`);
    return this.link.measure(() => this.parts.read(file, start, end));
  }

  #states(run: Run): Uint8Array {
    return run.terms ? this.#held.terms : this.#held.records;
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
