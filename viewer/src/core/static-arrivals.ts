// What has come of a static scene, as the batches that a renderer takes: slots, rows of chunks, terms, and what is
// replaced.
import type { Blocks } from "./static-blocks.ts";
import { HELD, LOST } from "./static-plan.ts";
import type { Holdings, Run } from "./static-plan.ts";
import { decodeMean, recordLayout } from "./tables.ts";
import type { RecordLayout } from "./tables.ts";
import type { Batch } from "./types.ts";

interface Replaced {
  slot: number;
  block: number;
  needs: Uint32Array; // blocks with what replaces it
}

export class Arrivals {
  gaussians = 0;
  terms = 0;
  replaced = 0;
  readonly firstSlot: Uint32Array; // slot of the first Gaussian of each held block
  readonly #rowOf: Int32Array; // row of each chunk, -1 before it is sent
  #rows = 0;
  #waiting: Replaced[] = [];
  readonly #layout: RecordLayout;

  constructor(private readonly blocks: Blocks, private readonly held: Holdings) {
    const { header } = blocks.scene;
    this.firstSlot = new Uint32Array(blocks.count);
    this.#rowOf = new Int32Array(header.chunks).fill(-1);
    this.#layout = recordLayout(header.colors.variant);
  }

  /**
   * Return the batch of a run of records. Without harmonics of a scene that has them, they are 0. A block that makes no
   * sense is lost, and `lose` is called.
   */
  addRecords(run: Run, data: Uint8Array, harmonics: Uint8Array | null, lose: (error: unknown) => void): Batch {
    const { blocks } = this, layout = this.#layout, each = blocks.harmonicBytes, start = blocks.recordStart;
    const good: number[] = [], parts: { records: Uint32Array; needs: Uint32Array[] }[] = [];
    for (let b = run.first; b < run.end; b++) {
      this.held.records[b] = LOST;
      try {
        parts.push(blocks.records(b, data.subarray(start[b] - start[run.first], start[b + 1] - start[run.first])));
        good.push(b);
        this.held.records[b] = HELD;
      } catch (error) {
        lose(error);
      }
    }
    const count = good.reduce((sum, b) => sum + blocks.size(b), 0);
    const ids = new Uint32Array(count), rows = new Uint32Array(count), means = new Float32Array(3 * count);
    const records = new Uint32Array(4 * count), own = each === 0 ? null : new Uint8Array(each * count).fill(128);
    const firstRow = this.#rows, fresh: number[] = [];
    let at = 0;
    good.forEach((b, i) => {
      const chunk = blocks.chunk[b], from = each * (blocks.start[b] - blocks.start[run.first]);
      if (this.#rowOf[chunk] < 0) {
        this.#rowOf[chunk] = this.#rows++;
        fresh.push(chunk);
      }
      this.firstSlot[b] = this.gaussians + at;
      records.set(parts[i].records, 4 * at);
      parts[i].needs.forEach((needs, k) => {
        if (needs.length > 0) this.#waiting.push({ slot: this.firstSlot[b] + k, block: b, needs });
      });
      if (harmonics !== null) own?.set(harmonics.subarray(from, from + each * blocks.size(b)), each * at);
      for (let k = 0; k < blocks.size(b); k++, at++) {
        ids[at] = blocks.firstId[b] + k;
        rows[at] = this.#rowOf[chunk];
        decodeMean(records, at, blocks.rows, chunk, layout, means);
      }
    });
    const chunks = new Float32Array(8 * fresh.length), chunkLevels = new Uint8Array(2 * fresh.length);
    const boxes = new Float32Array(6 * fresh.length);
    fresh.forEach((chunk, k) => {
      chunks.set(blocks.rows.subarray(8 * chunk, 8 * chunk + 8), 8 * k);
      boxes.set(blocks.boxes.subarray(6 * chunk, 6 * chunk + 6), 6 * k);
      chunkLevels.set(blocks.levels.subarray(2 * chunk, 2 * chunk + 2), 2 * k);
    });
    const first = this.gaussians;
    this.gaussians += count;
    return { ...this.#empty(), first, ids, records, rows, means, firstRow, chunks, boxes, chunkLevels, harmonics: own };
  }

  /** Return the batch of a run of items. One that makes no sense is lost, and `lose` is called. */
  addTerms(run: Run, data: Uint8Array, lose: (error: unknown) => void): Batch {
    const { blocks, held } = this, start = blocks.termStart!, firstTerm = this.terms;
    const owners: number[] = [], terms: number[] = [];
    for (let item = run.first; item < run.end; item++) {
      const block = item % blocks.count;
      if (held.records[block] !== HELD) continue;
      held.terms[item] = LOST;
      try {
        const bytes = data.subarray(start[item] - start[run.first], start[item + 1] - start[run.first]);
        const own = blocks.terms(item, bytes);
        for (const k of own.owners) owners.push(this.firstSlot[block] + k);
        for (const bits of own.terms) terms.push(bits);
        held.terms[item] = HELD;
      } catch (error) {
        lose(error);
      }
    }
    this.terms += owners.length;
    return { ...this.#empty(), firstTerm, terms: Uint32Array.from(terms), owners: Uint32Array.from(owners) };
  }

  /**
   * Return a batch with what is replaced by now, given what the cell sees; null where nothing is. `whole`: all that the
   * cell sees of the highest level is here, so of what it sees nothing has to wait for lower levels, or for what is out
   * of sight.
   */
  sweep(seen: Uint8Array, whole = false): Batch | null {
    const gone: number[] = [], left: Replaced[] = [];
    for (const each of this.#waiting) {
      let some = whole && seen[each.block] === 1, all = true;
      for (const b of each.needs) {
        if (this.held.records[b] === HELD) some = true;
        else if (seen[b] === 1 && !(whole && this.blocks.last(b) < this.blocks.top)) all = false;
      }
      if (some && all) gone.push(each.slot);
      else left.push(each);
    }
    if (gone.length === 0) return null;
    this.#waiting = left;
    this.replaced += gone.length;
    return { ...this.#empty(), gone: Uint32Array.from(gone).sort() };
  }

  #empty(): Batch {
    const none = (): Uint32Array => new Uint32Array(0);
    return {
      first: this.gaussians, ids: none(), records: none(), rows: none(), means: new Float32Array(0),
      firstRow: this.#rows,
      chunks: new Float32Array(0), boxes: new Float32Array(0), chunkLevels: new Uint8Array(0), firstTerm: this.terms,
      terms: none(), owners: none(),
      gone: none(),
      harmonics: null,
    };
  }
}
