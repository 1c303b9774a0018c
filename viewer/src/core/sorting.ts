// All Gaussians that have arrived, as the sort Worker keeps them: records, rows, ids, and which have been replaced. It
// culls chunks, sorts what is left back to front, and gives everything back when the GPU has lost it.
import { Budget } from "./budget.ts";
import { axesOf, sameCamera } from "./camera.ts";
import { decodeMean, recordLayout } from "./tables.ts";
import type { RecordLayout } from "./tables.ts";
import type { Batch, Camera } from "./types.ts";

const PAGE = 1 << 16;
const GONE = 0xffffffff;
const NEAR = 0.01;
const REACH = 3.33; // standard deviations at which the most opaque Gaussian falls below 1/255
const DIGIT = 14; // bits of one of the two passes of a sort
const MOST_KEY = 2 ** (2 * DIGIT) - 1;
const NEAR_BITS = new Uint32Array(Float32Array.of(NEAR).buffer)[0];

interface Page {
  records: Uint32Array; // (4 PAGE)
  rows: Uint32Array; // (PAGE), GONE for those replaced
  ids: Uint32Array;
  slots: Uint32Array | null; // null: slots are places
  means: Float32Array | null; // (3 PAGE) centers, where the chunk is logarithmic
  labels: Uint32Array | null;
}

/** Pixels of a picture, and levels of quality, outside of which nothing is drawn. */
export interface Region {
  left: number;
  top: number;
  right: number;
  bottom: number;
  levels: number; // bits of the levels that are drawn
  most?: number; // Gaussians that are drawn; all by default
  lowered?: boolean; // opacities are lowered to make up for the blur; matters where `most` is given
}

export class SortedScene {
  readonly hsl: boolean;
  readonly hasLabels: boolean; // of sets of harmonics
  readonly #layout: RecordLayout;
  pages: Page[] = [];
  count = 0; // places in use
  gone = 0;
  chunks = new Float32Array(8 * 256);
  boxes = new Float32Array(6 * 256);
  levels = new Uint8Array(2 * 256);
  widest = new Uint16Array(256); // largest log-scale in each chunk so far
  sizes = new Uint16Array(256); // Gaussians of each chunk that have arrived
  rowCount = 0;
  terms: Uint32Array = new Uint32Array(0);
  owners: Uint32Array = new Uint32Array(0);
  termCount = 0;
  renumbered = false;
  #classes = new Uint8Array(0); // of each chunk: 1 if it may be seen, 2 if it is logarithmic too
  // Of each chunk: depth of its origin, and of one step along x, y, z; of a logarithmic one, those of the origin of the
  // scene and of a unit.
  #depths = new Float32Array(0);
  #keys = new Uint32Array(0);
  #places = new Uint32Array(0);
  #within = new Uint32Array(0);
  #found = 0; // sorted so far for #camera
  #done = 0; // places looked at for #camera
  #classed = 0; // chunks classified for #camera
  #camera: Camera | null = null;
  #region: Region | null = null;
  readonly #budget = new Budget();

  constructor(variant: "rgb" | "hsl", hasLabels = false) {
    this.hsl = variant === "hsl";
    this.#layout = recordLayout(variant);
    this.hasLabels = hasLabels;
  }

  /** Add what has arrived; slots need not follow each other, but must rise. */
  append(batch: Batch): void {
    this.#appendChunks(batch);
    const count = batch.ids.length;
    if (count && batch.first !== this.count && !this.renumbered) this.#number();
    for (let from = 0; from < count; ) {
      const at = this.count % PAGE, take = Math.min(PAGE - at, count - from);
      if (at === 0) this.pages.push(this.#newPage());
      const page = this.pages[this.pages.length - 1];
      page.records.set(batch.records.subarray(4 * from, 4 * (from + take)), 4 * at);
      page.rows.set(batch.rows.subarray(from, from + take), at);
      this.#place(page, at, at + take);
      page.ids.set(batch.ids.subarray(from, from + take), at);
      if (page.slots) for (let k = 0; k < take; k++) page.slots[at + k] = batch.first + from + k;
      if (page.labels && batch.labels) page.labels.set(batch.labels.subarray(from, from + take), at);
      this.count += take;
      from += take;
    }
    this.#widen(batch);
    if (batch.owners.length) this.#appendTerms(batch);
    for (const slot of batch.gone) this.remove(slot);
  }

  #newPage(): Page {
    return {
      records: new Uint32Array(4 * PAGE), rows: new Uint32Array(PAGE), ids: new Uint32Array(PAGE),
      slots: this.renumbered ? new Uint32Array(PAGE) : null, means: null,
      labels: this.hasLabels ? new Uint32Array(PAGE) : null,
    };
  }

  /** Decode the centers of those places of a page whose chunk is logarithmic. */
  #place(page: Page, from: number, to: number): void {
    for (let i = from; i < to; i++) {
      if (!(this.chunks[8 * page.rows[i] + 4] < 0)) continue;
      page.means ??= new Float32Array(3 * PAGE);
      decodeMean(page.records, i, this.chunks, page.rows[i], this.#layout, page.means);
    }
  }

  /** From here on slots are no longer places. */
  #number(): void {
    this.renumbered = true;
    this.pages.forEach((page, k) => { page.slots = Uint32Array.from({ length: PAGE }, (_, i) => k * PAGE + i); });
  }

  #appendChunks(batch: Batch): void {
    const rows = batch.chunks.length / 8, total = batch.firstRow + rows;
    if (total > this.widest.length) {
      const room = Math.max(total, this.widest.length * 2);
      const chunks = new Float32Array(8 * room), levels = new Uint8Array(2 * room), boxes = new Float32Array(6 * room);
      const widest = new Uint16Array(room), sizes = new Uint16Array(room);
      chunks.set(this.chunks);
      boxes.set(this.boxes);
      levels.set(this.levels);
      widest.set(this.widest);
      sizes.set(this.sizes);
      Object.assign(this, { chunks, boxes, levels, widest, sizes });
    }
    this.chunks.set(batch.chunks, 8 * batch.firstRow);
    this.boxes.set(batch.boxes, 6 * batch.firstRow);
    this.levels.set(batch.chunkLevels, 2 * batch.firstRow);
    this.rowCount = Math.max(this.rowCount, total);
  }

  /** Raise the largest log-scale of the chunks of a batch. A chunk that grows may have been culled wrongly before. */
  #widen(batch: Batch): void {
    const { records, rows } = batch, widest = this.widest, seen = this.#classes;
    for (let i = 0; i < rows.length; i++) {
      const a = records[4 * i + 1], b = records[4 * i + 2], c = records[4 * i + 3];
      const s = this.hsl
        ? Math.max(((a >>> 29) | (b << 3)) & 255, ((b >>> 26) | (c << 6)) & 255, (c >>> 23) & 255)
        : Math.max(a >>> 23, b >>> 23, c >>> 23);
      const row = rows[i];
      this.sizes[row]++;
      if (s > widest[row]) {
        widest[row] = s;
        if (row < seen.length && seen[row] === 0) this.#camera = null;
      }
    }
  }

  #appendTerms(batch: Batch): void {
    const count = batch.owners.length, total = this.termCount + count;
    if (total > this.owners.length) {
      const room = Math.max(total, Math.ceil(this.owners.length * 1.5));
      const terms = new Uint32Array(2 * room), owners = new Uint32Array(room);
      terms.set(this.terms.subarray(0, 2 * this.termCount));
      owners.set(this.owners.subarray(0, this.termCount));
      Object.assign(this, { terms, owners });
    }
    this.terms.set(batch.terms, 2 * this.termCount);
    this.owners.set(batch.owners, this.termCount);
    this.termCount = total;
  }

  slotAt(place: number): number {
    const page = this.pages[Math.floor(place / PAGE)];
    return page.slots ? page.slots[place % PAGE] : place;
  }

  idAt(place: number): number {
    return this.pages[Math.floor(place / PAGE)].ids[place % PAGE];
  }

  /** Return the place of a slot, -1 if it is not here. */
  placeOf(slot: number): number {
    if (!this.renumbered) return slot < this.count ? slot : -1;
    let low = 0, high = this.count;
    while (low < high) {
      const middle = (low + high) >>> 1;
      if (this.slotAt(middle) < slot) low = middle + 1;
      else high = middle;
    }
    return low < this.count && this.slotAt(low) === slot ? low : -1;
  }

  remove(slot: number): void {
    const place = this.placeOf(slot);
    if (place < 0) return;
    const rows = this.pages[Math.floor(place / PAGE)].rows;
    if (rows[place % PAGE] === GONE) return;
    rows[place % PAGE] = GONE;
    this.gone += 1;
    if (place < this.#done) this.#camera = null;
  }

  /** Mark the chunks of which something may be seen, and prepare the depths of their Gaussians. */
  #classify(camera: Camera, region: Region, first: number): void {
    const { fx, fy, cx, cy, width, height } = camera, r = axesOf(camera), [ex, ey, ez] = camera.position;
    const slopeX = Math.max(cx, width - cx) / fx + (0.15 * width) / fx,
      slopeY = Math.max(cy, height - cy) / fy + (0.15 * height) / fy;
    const wide = REACH * fx * Math.hypot(1, slopeX), high = REACH * fy * Math.hypot(1, slopeY);
    const planes = [
      [fx, 0, cx - region.left + REACH, wide], [-fx, 0, region.right - cx + REACH, wide],
      [0, fy, cy - region.top + REACH, high], [0, -fy, region.bottom - cy + REACH, high], [0, 0, 1, 0],
    ].map(
      ([a, b, c, d]) => [
        a * r[0] + b * r[3] + c * r[6], a * r[1] + b * r[4] + c * r[7], a * r[2] + b * r[5] + c * r[8], d,
      ],
    );
    const { chunks, boxes, widest, levels } = this;
    for (let row = first; row < this.rowCount; row++) {
      const k = 8 * row, curved = chunks[k + 4] < 0, [x, y, z, hx, hy, hz] = boxes.subarray(6 * row, 6 * row + 6);
      const size = 2 ** ((chunks[k + 3] + widest[row] * chunks[k + 7]) / 64);
      const own = (2 << levels[2 * row + 1]) - (1 << levels[2 * row]);
      let shown = (own & region.levels) !== 0;
      for (let p = 0; shown && p < 5; p++) {
        const [a, b, c, d] = planes[p];
        const most = a * ((a > 0 ? hx : x) - ex) + b * ((b > 0 ? hy : y) - ey) + c * ((c > 0 ? hz : z) - ez);
        shown = most + d * size >= (p === 4 ? NEAR : 0);
      }
      this.#classes[row] = shown ? (curved ? 2 : 1) : 0;
      this.#depths[4 * row] = curved
        ? -r[6] * ex - r[7] * ey - r[8] * ez : r[6] * (x - ex) + r[7] * (y - ey) + r[8] * (z - ez);
      for (let i = 0; i < 3; i++) this.#depths[4 * row + 1 + i] = r[6 + i] * (curved ? 1 : chunks[k + 4 + i]);
    }
  }

  /** Look at all places from `first` on and append keys and places of those that may be seen. */
  #collect(first: number): void {
    const classes = this.#classes, depths = this.#depths, hsl = this.hsl, keys = this.#keys, places = this.#places;
    const floats = new Float32Array(keys.buffer);
    let found = this.#found;
    const begin = found;
    for (let place = first; place < this.count; ) {
      const page = this.pages[Math.floor(place / PAGE)], { rows, records, means } = page;
      const start = place % PAGE, end = Math.min(PAGE, this.count - (place - start)), base = place - start;
      for (let i = start; i < end; i++) {
        const row = rows[i];
        if (row === GONE || classes[row] === 0) continue;
        const d = 4 * row;
        let x = 0, y = 0, w = 0;
        if (classes[row] === 2) {
          [x, y, w] = [means![3 * i], means![3 * i + 1], means![3 * i + 2]];
        } else {
          const a = records[4 * i + 1], b = records[4 * i + 2], c = records[4 * i + 3];
          if (hsl) [x, y, w] = [(a >>> 8) & 8191, (b >>> 5) & 8191, (c >>> 2) & 8191];
          else [x, y, w] = [a & 16383, b & 16383, c & 16383];
        }
        const z = depths[d] + depths[d + 1] * x + depths[d + 2] * y + depths[d + 3] * w;
        if (z <= NEAR) continue;
        floats[found] = z;
        places[found++] = base + i;
      }
      place = base + end;
    }
    for (let i = begin; i < found; i++) {
      const key = keys[i] - NEAR_BITS; // floats above 0 are ordered like their bits; 28 of these reach a million
      keys[i] = key > MOST_KEY ? 0 : MOST_KEY - key;
    }
    this.#found = found;
    this.#done = this.count;
  }

  #reserveChunks(): void {
    if (this.#classes.length >= this.rowCount) return;
    const room = Math.ceil(this.rowCount * 1.25), classes = new Uint8Array(room), depths = new Float32Array(4 * room);
    classes.set(this.#classes);
    depths.set(this.#depths);
    this.#classes = classes;
    this.#depths = depths;
  }

  /** Make room for the Gaussians of all chunks that may be seen; keep what is found so far. */
  #reserve(): void {
    let most = 0;
    for (let row = 0; row < this.rowCount; row++) if (this.#classes[row]) most += this.sizes[row];
    if (this.#keys.length >= most) return;
    const room = Math.ceil((most * 1.05) / 4096) * 4096, keys = new Uint32Array(room), places = new Uint32Array(room);
    keys.set(this.#keys.subarray(0, this.#found));
    places.set(this.#places.subarray(0, this.#found));
    this.#keys = keys;
    this.#places = places;
    this.#within = new Uint32Array(room);
  }

  /** Return the places of what may be seen, farthest first, and their number; `room` is used if it is large enough. */
  sort(camera: Camera, region: Region, room: Uint32Array | null, unit = 2048): { order: Uint32Array; count: number } {
    const old = this.#camera, same = old !== null && sameCamera(old, camera) && sameRegion(this.#region, region);
    this.#reserveChunks();
    if (!same) this.#found = this.#done = 0;
    this.#classify(camera, region, same ? this.#classed : 0);
    this.#classed = this.rowCount;
    this.#reserve();
    this.#collect(this.#done);
    this.#camera = camera;
    this.#region = region;
    const count = this.#found, needed = Math.max(1, Math.ceil(count / unit)) * unit;
    const fits = room && room.length >= needed && room.length <= 2 * needed + 65536;
    const order = fits ? room : new Uint32Array(Math.ceil((needed * 1.1) / unit) * unit);
    this.#distribute(order, count);
    const { most = Infinity } = region;
    return { order, count: count > most ? this.#budget.choose(this, order, count, camera, region, most) : count };
  }

  /** Sort by the lower, then by the upper half of the keys. */
  #distribute(order: Uint32Array, count: number): void {
    const keys = this.#keys, places = this.#places, within = this.#within, buckets = 2 ** DIGIT, mask = buckets - 1;
    const low = new Uint32Array(buckets + 1), high = new Uint32Array(buckets + 1);
    for (let i = 0; i < count; i++) {
      const key = keys[i];
      low[(key & mask) + 1]++;
      high[(key >>> DIGIT) + 1]++;
    }
    for (let k = 0; k < buckets; k++) {
      low[k + 1] += low[k];
      high[k + 1] += high[k];
    }
    for (let i = 0; i < count; i++) within[low[keys[i] & mask]++] = i;
    for (let j = 0; j < count; j++) {
      const i = within[j];
      order[high[keys[i] >>> DIGIT]++] = places[i];
    }
  }

  /** Call `visit` for all Gaussians that may be seen in a region: its record, the index in it, chunk and place. */
  each(
    camera: Camera, region: Region, visit: (records: Uint32Array, i: number, row: number, place: number) => void,
  ): void {
    this.#reserveChunks();
    this.#camera = null;
    this.#classify(camera, region, 0);
    for (let place = 0; place < this.count; place++) {
      const page = this.pages[Math.floor(place / PAGE)], i = place % PAGE, row = page.rows[i];
      if (row !== GONE && this.#classes[row]) visit(page.records, i, row, place);
    }
  }

  /** Drop what was replaced, number places anew, and return everything as batches whose `first` is a place. */
  compact(): { batches: Batch[]; slots: Uint32Array | null } {
    if (this.gone) this.#squeeze();
    this.#camera = null;
    this.#keys = this.#places = this.#within = new Uint32Array(0);
    this.#found = this.#done = 0;
    const none = new Uint32Array(0), nothing = { ids: none, means: new Float32Array(0), gone: none };
    const batches: Batch[] = [{
      ...nothing, first: 0, records: none, rows: none, labels: null, firstRow: 0,
      chunks: this.chunks.slice(0, 8 * this.rowCount), boxes: new Float32Array(0),
      chunkLevels: this.levels.slice(0, 2 * this.rowCount),
      firstTerm: 0, terms: none, owners: none,
    }];
    const empty = new Float32Array(0);
    const rest = { ...nothing, firstRow: this.rowCount, chunks: empty, boxes: empty, chunkLevels: new Uint8Array(0) };
    this.pages.forEach((page, k) => {
      const used = Math.min(PAGE, this.count - k * PAGE);
      batches.push({
        ...rest, first: k * PAGE, records: page.records.slice(0, 4 * used), rows: page.rows.slice(0, used),
        ids: page.ids.slice(0, used), labels: page.labels ? page.labels.slice(0, used) : null,
        firstTerm: 0, terms: none, owners: none,
      });
    });
    for (let from = 0; from < this.termCount; from += PAGE) {
      const to = Math.min(from + PAGE, this.termCount), owners = this.owners.slice(from, to);
      batches.push({
        ...rest, first: this.count, records: none, rows: none, labels: null, firstTerm: from,
        terms: this.terms.slice(2 * from, 2 * to), owners,
      });
    }
    const slots = this.renumbered ? Uint32Array.from({ length: this.count }, (_, place) => this.slotAt(place)) : null;
    return { batches, slots };
  }

  /** Close the gaps of what was replaced. */
  #squeeze(): void {
    const old = this.pages, total = this.count, rows = this.rowCount;
    if (!this.renumbered) this.#number();
    this.pages = [];
    this.count = this.gone = 0;
    for (let place = 0; place < total; place++) {
      const from = old[Math.floor(place / PAGE)], i = place % PAGE;
      if (from.rows[i] === GONE) continue;
      const at = this.count % PAGE;
      if (at === 0) this.pages.push(this.#newPage());
      const page = this.pages[this.pages.length - 1];
      for (let k = 0; k < 4; k++) page.records[4 * at + k] = from.records[4 * i + k];
      page.rows[at] = from.rows[i];
      this.#place(page, at, at + 1);
      page.ids[at] = from.ids[i];
      if (page.slots && from.slots) page.slots[at] = from.slots[i];
      if (page.labels && from.labels) page.labels[at] = from.labels[i];
      this.count += 1;
    }
    this.rowCount = rows;
    this.sizes.fill(0);
    for (let place = 0; place < this.count; place++) {
      this.sizes[this.pages[Math.floor(place / PAGE)].rows[place % PAGE]]++;
    }
    let kept = 0;
    for (let t = 0; t < this.termCount; t++) {
      if (this.placeOf(this.owners[t]) < 0) continue;
      this.terms[2 * kept] = this.terms[2 * t];
      this.terms[2 * kept + 1] = this.terms[2 * t + 1];
      this.owners[kept++] = this.owners[t];
    }
    this.termCount = kept;
  }
}

function sameRegion(a: Region | null, b: Region): boolean {
  return !!a && a.left === b.left && a.top === b.top && a.right === b.right && a.bottom === b.bottom &&
    a.levels === b.levels && a.most === b.most;
}
