// What has come of a static scene, as the batches that a renderer takes: slots, rows of chunks, and terms. A Gaussian or
// a term that comes again is left out.
import type { ChunkRows, Piece } from "./static-pieces.ts";
import { decodeMean, recordLayout } from "./tables.ts";
import type { RecordLayout } from "./tables.ts";
import type { Batch, Header } from "./types.ts";

const NONE = -1;
const MOST_TERMS = 256; // of a Gaussian

export class Arrivals {
  gaussians = 0;
  terms = 0;
  readonly rows: ChunkRows = new Map();
  readonly #slotOf: Int32Array; // of each Gaussian
  readonly #rowOf = new Map<number, number>(); // number of the row of each chunk that was sent
  readonly #single = new Set<number>(); // terms that came one by one
  readonly #layout: RecordLayout;

  constructor(header: Header) {
    this.#slotOf = new Int32Array(header.gaussians).fill(NONE);
    this.#layout = recordLayout(header.colors.variant);
  }

  /** Return the batch of what is new in a piece. */
  add(piece: Piece): Batch {
    const kept: number[] = [], fresh: number[] = [], first = this.gaussians, firstRow = this.#rowOf.size;
    piece.ids.forEach((id, i) => {
      if (this.#slotOf[id] !== NONE) return;
      this.#slotOf[id] = this.gaussians++;
      kept.push(i);
      const start = piece.starts[piece.chunkOf[i]];
      if (this.#rowOf.has(start)) return;
      this.#rowOf.set(start, this.#rowOf.size);
      fresh.push(start);
    });
    const count = kept.length;
    const batch: Batch = {
      first, ids: new Uint32Array(count), records: new Uint32Array(4 * count), rows: new Uint32Array(count),
      means: new Float32Array(3 * count), firstRow, chunks: new Float32Array(8 * fresh.length),
      boxes: new Float32Array(6 * fresh.length), chunkLevels: new Uint8Array(2 * fresh.length),
      labels: piece.labels === null ? null : new Uint32Array(count), ...this.#addTerms(piece),
      gone: new Uint32Array(0),
    };
    fresh.forEach((start, k) => {
      const { row, box } = this.rows.get(start)!;
      batch.chunks.set(row, 8 * k);
      batch.boxes.set(box, 6 * k);
    });
    kept.forEach((i, at) => {
      const start = piece.starts[piece.chunkOf[i]];
      batch.ids[at] = piece.ids[i];
      batch.rows[at] = this.#rowOf.get(start)!;
      batch.records.set(piece.records.subarray(4 * i, 4 * i + 4), 4 * at);
      decodeMean(batch.records, at, this.rows.get(start)!.row, 0, this.#layout, batch.means);
      if (batch.labels !== null) batch.labels[at] = piece.labels![i];
    });
    return batch;
  }

  /** Return the terms of a piece that are new and belong to Gaussians that are here. */
  #addTerms(piece: Piece): Pick<Batch, "firstTerm" | "terms" | "owners"> {
    const firstTerm = this.terms, owners: number[] = [], terms: number[] = [], isSingle = piece.ids.length > 0;
    piece.owners.forEach((id, i) => {
      const key = MOST_TERMS * id + piece.numbers[i];
      if (this.#slotOf[id] === NONE || this.#single.has(key)) return;
      if (isSingle) this.#single.add(key);
      owners.push(this.#slotOf[id]);
      terms.push(piece.terms[2 * i], piece.terms[2 * i + 1]);
    });
    this.terms += owners.length;
    return { firstTerm, terms: Uint32Array.from(terms), owners: Uint32Array.from(owners) };
  }
}
