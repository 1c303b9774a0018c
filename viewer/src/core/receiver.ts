// The state of one client: messages in, batches to draw out. A batch is checked in full before any of it is kept.
import { CHUNK_BYTES, parseBatch } from "./batch.ts";
import type { Sections } from "./batch.ts";
import { add, has, remove } from "./bits.ts";
import { writeBox } from "./boxes.ts";
import { addChunks, noChunks, rowsOf } from "./chunks.ts";
import type { Chunks } from "./chunks.ts";
import { readRecords, readTerms } from "./coding.ts";
import { parseWelcome } from "./header.ts";
import { holdings } from "./roaring.ts";
import { decodeMean, recordLayout } from "./tables.ts";
import type { RecordLayout } from "./tables.ts";
import type { Batch, Header } from "./types.ts";
import { FAULTS, ProtocolError } from "./wire.ts";

/** Most bytes that sets and tables of a scene may take before its first Gaussian. */
export const MOST_BYTES = 2 ** 29;

/** The state of one client of one scene. */
export class Receiver {
  readonly about: Header;
  /** Gaussians and terms that have come, and Gaussians that have come and are replaced. */
  gaussians = 0;
  terms = 0;
  replaced = 0;
  #skipped = 0; // Gaussians replaced before they came
  #came = 0; // Gaussians and terms that came, those that are forgotten too: they number slots
  #cameTerms = 0;
  #sequence = 0;
  #chunks: Chunks = noChunks();
  readonly #layout: RecordLayout;
  readonly #slots: Uint32Array; // of each Gaussian, from 1; 0 if it has not come
  readonly #sent: Uint32Array; // packed sets
  readonly #sentTerms: Uint32Array;
  readonly #gone: Uint32Array;
  #owners: Uint32Array | null = null; // of each term; null where nothing is ever evicted

  /** Raises ProtocolError if the message is no WELCOME, or its scene needs more than `mostBytes`. */
  constructor(welcome: Uint8Array, mostBytes = MOST_BYTES, evicts = false) {
    this.about = parseWelcome(welcome);
    const { gaussians, terms, colors } = this.about, ownerBytes = evicts ? 4 * terms : 0;
    const needed = 5 * gaussians + Math.floor(terms / 4) + ownerBytes;
    if (needed > mostBytes) {
      const sizes = `${Math.ceil(needed / 1e6)} MB before its first Gaussian, more than ${Math.ceil(mostBytes / 1e6)}`;
      throw new ProtocolError(`WELCOME: this scene needs ${sizes}`, FAULTS.tooLarge);
    }
    this.#layout = recordLayout(colors.variant);
    this.#slots = new Uint32Array(gaussians);
    this.#sent = new Uint32Array(Math.ceil(gaussians / 32));
    this.#gone = new Uint32Array(Math.ceil(gaussians / 32));
    this.#sentTerms = new Uint32Array(Math.ceil(terms / 32));
    if (evicts) this.#owners = new Uint32Array(terms);
  }

  /** The number that the next batch must have. */
  get next(): number {
    return this.#sequence + 1;
  }

  /** Whether every Gaussian has come or is replaced, and every term has come. */
  get isWhole(): boolean {
    return this.gaussians + this.#skipped === this.about.gaussians && this.terms === this.about.terms;
  }

  /** Return the holdings for a HELLO; no bytes if nothing has come. */
  holdings(): Uint8Array<ArrayBuffer> {
    if (this.gaussians + this.#skipped === 0) return new Uint8Array(0);
    return holdings(this.about.gaussians, this.about.terms, [this.#sent, this.#sentTerms, this.#gone]);
  }

  /** Accept the WELCOME of a new connection; false if it is of another scene, which needs a new receiver. */
  resume(welcome: Uint8Array): boolean {
    if (parseWelcome(welcome).identity !== this.about.identity) return false;
    this.#sequence = 0;
    return true;
  }

  /** Decode a BATCH, keep it, and return what is new. Raises ProtocolError, and changes nothing, if it does not fit. */
  receive(message: Uint8Array): Batch {
    const s = parseBatch(message, this.about);
    const refuse = (what: string): never => {
      throw new ProtocolError(`BATCH ${s.sequence}: ${what}`);
    };
    if (s.sequence !== this.next) refuse(`expected number ${this.next}`);
    if (s.evicted.length && !this.#owners) refuse("expected none evicted");
    this.#check(s, refuse);
    const chunks = addChunks(this.#chunks, ...this.#unknown(s), this.about, refuse);
    const rows = rowsOf(s.gaussians, chunks, refuse);
    const code = this.about.code;
    if (code === null) throw new Error("a WELCOME has a code");
    const records = readRecords(s.records, s.gaussians, rows, chunks, code);
    const terms = readTerms(s.termRecords, s.owners, code);
    if (records === null || terms === null) return refuse("expected records, got other bytes");
    return this.#enter(s, chunks, rows, records, terms);
  }

  /** Return the chunks whose rows are new, and these rows. One comes again when all of its chunk was evicted. */
  #unknown(s: Sections): [Uint32Array, Uint8Array] {
    const { starts } = this.#chunks, fresh: number[] = [];
    let at = 0; // both rise
    s.chunks.forEach((start, k) => {
      while (at < starts.length && starts[at] < start) at++;
      if (starts[at] !== start) fresh.push(k);
    });
    if (fresh.length === s.chunks.length) return [s.chunks, s.rows];
    const rows = new Uint8Array(CHUNK_BYTES * fresh.length);
    fresh.forEach((k, i) => rows.set(s.rows.subarray(CHUNK_BYTES * k, CHUNK_BYTES * (k + 1)), CHUNK_BYTES * i));
    return [s.chunks = Uint32Array.from(fresh, (k) => s.chunks[k]), s.rows = rows];
  }

  /** Forget Gaussians and their terms; return the slots of those that were drawn. */
  #forget(ids: Uint32Array): Uint32Array {
    if (ids.length === 0) return ids;
    const out = new Set(ids), owners = this.#owners!;
    owners.forEach((owner, term) => {
      if (!has(this.#sentTerms, term) || !out.has(owner)) return;
      remove(this.#sentTerms, term);
      this.terms--;
    });
    const drawn = ids.filter((id) => {
      const [came, gone] = [has(this.#sent, id), has(this.#gone, id)];
      if (came) this.gaussians--;
      if (gone && came) this.replaced--;
      if (gone && !came) this.#skipped--;
      remove(this.#sent, id);
      remove(this.#gone, id);
      return came && !gone;
    });
    return drawn.map((id) => this.#slots[id] - 1);
  }

  /** Raise unless what is evicted is held, ids are new, terms have a Gaussian, and no Gaussian is replaced twice. */
  #check(s: Sections, refuse: (what: string) => never): void {
    const evicted = new Set(s.evicted);
    const sent = (id: number) => has(this.#sent, id) && !evicted.has(id);
    const replaced = (id: number) => has(this.#gone, id) && !evicted.has(id);
    for (const id of s.evicted) {
      if (!has(this.#sent, id) && !has(this.#gone, id)) refuse(`expected to evict what is held, got ${id}`);
    }
    for (const id of s.gaussians) {
      if (sent(id)) refuse(`expected each Gaussian once, got ${id} again`);
      if (replaced(id)) refuse(`expected no Gaussian that is replaced, got ${id}`);
    }
    for (const id of s.terms) {
      if (has(this.#sentTerms, id) && !(this.#owners && evicted.has(this.#owners[id]))) {
        refuse(`expected each term once, got ${id} again`);
      }
    }
    for (const id of s.gone) if (replaced(id)) refuse(`expected each replaced Gaussian once, got ${id} again`);
    let at = 0; // owners and ids rise
    for (const owner of s.owners) {
      while (at < s.gaussians.length && s.gaussians[at] < owner) at++;
      if (!sent(owner) && s.gaussians[at] !== owner) {
        refuse(
          `expected terms of Gaussians that have come, got one of ${owner}`
        );
      }
    }
  }

  /** Keep a checked batch and return what is new in it. */
  #enter(
    s: Sections, chunks: Chunks, rows: Uint32Array, records: Uint32Array, terms: Uint32Array,
  ): Batch {
    const left = this.#forget(s.evicted), firstRow = this.#chunks.starts.length;
    const g = s.gaussians.length, first = this.#came, firstTerm = this.#cameTerms;
    const means = new Float32Array(3 * g);
    for (let i = 0; i < g; i++) {
      decodeMean(records, i, chunks.table, rows[i], this.#layout, means);
      this.#slots[s.gaussians[i]] = first + i + 1;
      add(this.#sent, s.gaussians[i]);
    }
    s.terms.forEach((id, i) => {
      add(this.#sentTerms, id);
      if (this.#owners) this.#owners[id] = s.owners[i];
    });
    for (const id of s.gone) add(this.#gone, id);
    const gone = s.gone.filter((id) => has(this.#sent, id)).map((id) => this.#slots[id] - 1);
    const chunkLevels = new Uint8Array(2 * s.chunks.length), boxes = new Float32Array(6 * s.chunks.length);
    for (let k = 0; k < s.chunks.length; k++) {
      chunkLevels.set(
        s.rows.subarray(CHUNK_BYTES * k + 29, CHUNK_BYTES * k + 31), 2 * k,
      );
    }
    for (let k = 0, row = firstRow; k < s.chunks.length; k++, row++) {
      writeBox(chunks.table, row, chunks.bits[row], boxes, k);
    }
    this.#chunks = chunks;
    this.#sequence = s.sequence;
    this.gaussians += g;
    this.#came += g;
    this.terms += s.terms.length;
    this.#cameTerms += s.terms.length;
    this.replaced += gone.length;
    this.#skipped += s.gone.length - gone.length;
    return {
      first, ids: s.gaussians, records, rows, means, firstRow, chunks: chunks.table.slice(8 * firstRow),
      boxes, chunkLevels,
      firstTerm, terms, owners: s.owners.map((id) => this.#slots[id] - 1), gone: joined(gone, left), labels: null,
    };
  }
}

/** Return the slots of both, rising. */
function joined(some: Uint32Array, others: Uint32Array): Uint32Array {
  return others.length === 0 ? some : Uint32Array.of(...some, ...others).sort();
}
