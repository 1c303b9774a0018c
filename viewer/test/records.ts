// For tests/viewer: `records WELCOME BATCH` prints the records of Gaussians and of terms that a batch holds, in words.
import { readFileSync } from "node:fs";
import { Receiver } from "../src/core/receiver.ts";

const [welcome, batch] = process.argv.slice(2, 4).map((path) => new Uint8Array(readFileSync(path)));
const { records, terms } = new Receiver(welcome).receive(batch);
process.stdout.write(JSON.stringify({ records: [...records], terms: [...terms] }));
