// Pieces of a static scene, which hold Gaussians and terms (docs/static.md): where they end, and what is in them.
import { hasBox, writeBox } from "./boxes.ts";
import { readRecords, readTerms } from "./coding.ts";
import { Columns, damaged, inflate } from "./static-tables.ts";
import { labelBytes } from "./static-sets.ts";
import { recordLayout } from "./tables.ts";
import type { Header } from "./types.ts";

const HEAD = 24, CHUNK = 34; // bytes of the head, and of the row of a chunk
const MOST_PIECE = 1 << 24;

/** The content of a piece. */
export interface Piece {
  ids: Uint32Array; // (G) of Gaussians, rising
  records: Uint32Array; // (4 G)
  chunkOf: Uint32Array; // (G) place in `starts`
  starts: Uint32Array; // (C) first id of each chunk
  owners: Uint32Array; // (M) ids of Gaussians
  numbers: Uint32Array; // (M) which of the terms of its Gaussian each is
  terms: Uint32Array; // (2 M)
  labels: Uint32Array | null; // (G), as in `Batch`
}

/** Rows of chunks, by the id of the first Gaussian. */
export type ChunkRows = Map<number, { row: Float32Array; bits: number; box: Float32Array }>;

/** Return the bytes that a piece takes, given its beginning; 0 if there is too little of it. `where` names it in errors. */
export function pieceBytes(data: Uint8Array, where: string): number {
  if (data.length < HEAD) return 0;
  const [head, , , , records, terms] = sizesOf(data), bytes = HEAD + head + records + terms;
  if (bytes > MOST_PIECE) throw damaged(where);
  return bytes;
}

function sizesOf(data: Uint8Array): number[] {
  const view = new DataView(data.buffer, data.byteOffset, HEAD);
  return [0, 4, 8, 12, 16, 20].map((at) => view.getUint32(at, true));
}

/** Return the content of a piece; the rows of its chunks are added to `rows`. `where` names it in errors. */
export async function readPiece(
  data: Uint8Array, header: Header, rows: ChunkRows, where: string,
): Promise<Piece> {
  if (data.length < HEAD || pieceBytes(data, where) !== data.length) throw damaged(where);
  const [head, g, c, m, recordBytes] = sizesOf(data), code = header.code!;
  const width = labelBytes(header.harmonics), size = CHUNK * c + g + 5 * m + width * g;
  if (g > header.gaussians || c > g || m > header.terms) throw damaged(where);
  const packed = await inflate(data.subarray(HEAD, HEAD + head), size, where);
  if (packed.length !== size) throw damaged(where);
  const columns = new Columns(packed, c);
  const { starts, counts, table, bits } = readChunks(columns, c, header, rows, where);
  const ids = new Uint32Array(g), chunkOf = new Uint32Array(g), skips = columns.next(1, g);
  let at = 0;
  for (let k = 0; k < c; k++) {
    for (let i = 0, id = starts[k] - 1; i < counts[k] && at < g; i++, at++) {
      ids[at] = id = id + 1 + skips[at];
      chunkOf[at] = k;
    }
  }
  const owners = Uint32Array.from(columns.sums(4, m)), over = columns.next(1, m);
  const numbers = over.slice();
  for (let i = 1; i < m; i++) if (owners[i] === owners[i - 1]) numbers[i] += numbers[i - 1] + 1;
  const labels = header.harmonics && Uint32Array.from(columns.next(width, g)), sets = header.harmonics?.sets ?? 0;
  const records = readRecords(
    data.slice(HEAD + head, HEAD + head + recordBytes), ids, chunkOf, { table, bits }, code,
  );
  const terms = readTerms(data.slice(HEAD + head + recordBytes), owners, code);
  const isWrong = at !== g || ids.some((id, i) => id >= header.gaussians || (i > 0 && id <= ids[i - 1])) ||
    owners.some((id, i) => id >= header.gaussians || (i > 0 && id < owners[i - 1])) ||
    labels?.some((label) => label >= sets);
  if (!records || !terms || isWrong) throw damaged(where);
  return { ids, records, chunkOf, starts, owners, numbers, terms, labels };
}

/** Return the rows of the chunks of a piece; those that it leaves out are taken from `rows`, the others added. */
function readChunks(
  columns: Columns, c: number, header: Header, rows: ChunkRows, where: string,
): { starts: Uint32Array; counts: Uint32Array; table: Float32Array<ArrayBuffer>; bits: Uint16Array<ArrayBuffer> } {
  const starts = Uint32Array.from(columns.sums(4)), counts = columns.next(1).map((value) => value + 1);
  const floats = [0, 1, 2, 3, 4, 5].map(() => new Float32Array(columns.next(4).buffer));
  const lows = columns.next(2), bits = Uint16Array.from(columns.next(2)), strides = columns.next(1);
  const table = new Float32Array(8 * c), most = recordLayout(header.colors.variant).position;
  for (let k = 0; k < c; k++) {
    const row = table.subarray(8 * k, 8 * k + 8), known = rows.get(starts[k]);
    if (strides[k] === 0) {
      if (known === undefined) throw damaged(where);
      row.set(known.row);
      bits[k] = known.bits;
      continue;
    }
    for (let axis = 0; axis < 3; axis++) [row[axis], row[4 + axis]] = [floats[axis][k], floats[3 + axis][k]];
    row[3] = lows[k] - (1 << 15);
    row[7] = strides[k];
    if (!hasBox(table, k, bits[k], most)) throw damaged(where);
    if (known === undefined) {
      const box = new Float32Array(6);
      writeBox(row, 0, bits[k], box, 0);
      rows.set(starts[k], { row: row.slice(), bits: bits[k], box });
    }
  }
  return { starts, counts, table, bits };
}
