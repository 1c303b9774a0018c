// What the GPU holds of a scene: records as they came, rows of chunks, terms as linked lists, tables, and the colors
// found.
import { harmonicBytes, harmonicTexels, packSets, packTables, type PackedTables } from "./colors.ts";
import { GrowingTexture, ROW } from "./textures.ts";
import type { Batch, Header } from "./types.ts";

/** Return the bytes on the GPU that each Gaussian takes, without its terms. */
export function bytesOfGaussian({ gaussians, harmonics, terms }: Header): number {
  const sets = harmonics ? 4 + (16 * harmonicTexels(harmonics) * harmonics.sets) / Math.max(gaussians, 1) : 0;
  return 16 + 8 + 8 + (terms ? 4 : 0) + sets;
}

export class Store {
  readonly header: Header;
  readonly tables: PackedTables;
  readonly records: GrowingTexture;
  readonly links: GrowingTexture; // row of the chunk and, in its upper 8 bits, the mark; slot
  readonly chunks: GrowingTexture;
  readonly heads: GrowingTexture; // first term of each Gaussian, from 1; 0 for none
  readonly terms: GrowingTexture; // bits, next term from 1
  readonly labels: GrowingTexture; // the set of harmonics of each Gaussian
  readonly sets: GrowingTexture;
  readonly colors: GrowingTexture;
  readonly tableTexture: WebGLTexture;
  count = 0;
  termCount = 0;
  marks: Uint8Array | null = null; // of all Gaussians of the scene, by id
  slots: Uint32Array | null = null; // null: places are slots
  readonly stale = new Set<number>(); // rows of Gaussians whose colors are to be found
  readonly #gl: WebGL2RenderingContext;
  readonly #limit: number; // rows of a texture
  readonly #changed = new Set<number>(); // rows of heads that the GPU lacks
  readonly #lowest: number[] = []; // of the labels in each row of Gaussians
  readonly #highest: number[] = [];
  #firsts: Uint32Array = new Uint32Array(0);

  constructor(gl: WebGL2RenderingContext, header: Header) {
    this.#gl = gl;
    this.#limit = gl.getParameter(gl.MAX_TEXTURE_SIZE) as number;
    this.header = header;
    this.tables = packTables(header);
    this.records = new GrowingTexture(gl, "RGBA32UI");
    this.links = new GrowingTexture(gl, "RG32UI");
    this.chunks = new GrowingTexture(gl, "RGBA32UI");
    this.heads = new GrowingTexture(gl, "R32UI");
    this.terms = new GrowingTexture(gl, "RGBA32UI");
    this.labels = new GrowingTexture(gl, "R32UI");
    this.sets = new GrowingTexture(gl, "RGBA32UI");
    this.colors = new GrowingTexture(gl, "RG32UI");
    for (const texture of this.#all()) texture.reserve(1);
    const { texels, rows } = this.tables;
    this.tableTexture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.tableTexture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RG32F, 1024, rows);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 1024, rows, gl.RG, gl.FLOAT, texels);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  }

  #all(): GrowingTexture[] {
    return [this.records, this.links, this.chunks, this.heads, this.terms, this.labels, this.sets, this.colors];
  }

  get bytes(): number {
    return this.#all().reduce((sum, texture) => sum + texture.bytes, 0);
  }

  /** Gaussians that the largest textures of this device hold. */
  get most(): number {
    return ROW * this.#limit;
  }

  get viewDependent(): boolean { return this.termCount > 0 || this.header.harmonics !== null; }

  /** Return the place of a slot, -1 if it is not here. */
  placeOf(slot: number): number {
    const { slots, count } = this;
    if (!slots) return slot < count ? slot : -1;
    let low = 0, high = count;
    while (low < high) {
      const middle = (low + high) >>> 1;
      if (slots[middle] < slot) low = middle + 1;
      else high = middle;
    }
    return low < count && slots[low] === slot ? low : -1;
  }

  /** Add a batch. `kept`: it comes from the Worker, and `first` is a place. */
  append(batch: Batch, kept = false): void {
    if (batch.chunks.length) this.#appendChunks(batch);
    const count = batch.ids.length || batch.records.length / 4;
    if (count) this.#appendGaussians(batch, count, kept);
    const room = ROW * this.#limit - this.termCount;
    if (batch.owners.length && batch.owners.length <= room) this.#appendTerms(batch); // else base colors stay
  }

  #appendChunks(batch: Batch): void {
    const rows = batch.chunks.length / 8, values = batch.chunks.slice(), levels = batch.chunkLevels;
    for (let k = 0; k < rows; k++) values[8 * k + 7] += 256 * (levels[2 * k] + 16 * levels[2 * k + 1]);
    this.chunks.reserve(2 * (batch.firstRow + rows), 2 * this.header.chunks);
    this.chunks.write(2 * batch.firstRow, new Uint32Array(values.buffer));
  }

  #appendGaussians(batch: Batch, count: number, kept: boolean): void {
    const from = this.count, to = from + count, most = this.header.gaussians;
    if (!kept && (this.slots || batch.first !== from)) this.#appendSlots(batch.first, count);
    const room = this.header.plain ? Math.min(most, this.most) : to; // so that nothing is copied to a larger texture
    for (const texture of [this.records, this.links, this.colors]) texture.reserve(Math.max(room, to), most);
    this.records.write(from, batch.records);
    const links = new Uint32Array(2 * count), slots = kept ? this.slots : null, { marks } = this;
    for (let k = 0; k < count; k++) {
      links[2 * k] = batch.rows[k] + (marks ? (marks[batch.ids[k]] << 24) >>> 0 : 0);
      links[2 * k + 1] = slots ? slots[from + k] : batch.first + k;
    }
    this.links.write(from, links);
    if (batch.labels) {
      this.labels.reserve(Math.max(room, to), most);
      this.labels.write(from, batch.labels);
      this.#note(from, batch.labels);
    }
    this.count = to;
    for (let row = Math.floor(from / ROW); row * ROW < to; row++) this.stale.add(row);
  }

  /** Add sets of harmonics, from number `first` on; those beyond the largest texture leave base colors. */
  addSets(first: number, sets: Uint8Array): void {
    const { harmonics, plain } = this.header;
    if (!harmonics) return;
    const texels = harmonicTexels(harmonics), own = plain ? 16 * texels : harmonicBytes(harmonics);
    const end = texels * (first + sets.length / own), all = texels * harmonics.sets;
    if (end > ROW * this.#limit) return;
    this.sets.reserve(plain ? Math.min(all, ROW * this.#limit) : end, all);
    this.sets.write(
      texels * first, plain ? new Uint32Array(sets.buffer, sets.byteOffset, sets.length / 4) : packSets(sets, harmonics),
    );
    const last = end / texels - 1;
    this.#lowest.forEach((lowest, row) => { if (lowest <= last && this.#highest[row] >= first) this.stale.add(row); });
  }

  /** Remember which labels each row has, so that sets that come later make no other colors stale. */
  #note(from: number, labels: Uint32Array): void {
    const lowest = this.#lowest, highest = this.#highest;
    for (let k = 0; k < labels.length; k++) {
      const row = Math.floor((from + k) / ROW), label = labels[k];
      if (!(lowest[row] <= label)) lowest[row] = label;
      if (!(highest[row] >= label)) highest[row] = label;
    }
  }

  #appendSlots(first: number, count: number): void {
    const from = this.count, old = this.slots;
    if (!old || old.length < from + count) {
      const slots = new Uint32Array(Math.ceil((from + count) * 1.25));
      for (let k = 0; k < from; k++) slots[k] = old ? old[k] : k;
      this.slots = slots;
    }
    for (let k = 0; k < count; k++) this.slots![from + k] = first + k;
  }

  #appendTerms(batch: Batch): void {
    const count = batch.owners.length, data = new Uint32Array(4 * count), room = this.records.rows * ROW;
    if (this.#firsts.length < room) {
      const firsts = new Uint32Array(room);
      firsts.set(this.#firsts);
      this.#firsts = firsts;
    }
    this.heads.reserve(room);
    this.terms.reserve(this.termCount + count, this.header.terms);
    for (let k = 0, marked = -1; k < count; k++) {
      const place = this.placeOf(batch.owners[k]);
      if (place < 0) continue; // not drawn: out of memory, or gone since
      data[4 * k] = batch.terms[2 * k];
      data[4 * k + 1] = batch.terms[2 * k + 1];
      data[4 * k + 2] = this.#firsts[place];
      this.#firsts[place] = this.termCount + k + 1;
      const row = Math.floor(place / ROW);
      if (row === marked) continue;
      marked = row;
      this.#changed.add(row);
      this.stale.add(row);
    }
    this.terms.write(this.termCount, data);
    this.termCount += count;
  }

  /** Bring the heads of lists that have changed to the GPU. */
  flush(): void {
    if (this.#changed.size === 0) return;
    for (const row of this.#changed) this.heads.write(row * ROW, this.#firsts.subarray(row * ROW, (row + 1) * ROW));
    this.#changed.clear();
  }

  dispose(): void {
    for (const texture of this.#all()) texture.dispose();
    this.#gl.deleteTexture(this.tableTexture);
  }
}
