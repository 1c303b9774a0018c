// How long the page's receiver takes over a batch: node batch-time.mjs WELCOME BATCH REPEATS, files of the messages'
// bytes. Prints milliseconds of each call as JSON.
import { readFileSync } from "node:fs";
import { Receiver } from "../src/core/receiver.ts";

const [welcome, batch] = process.argv.slice(2, 4).map((path) => new Uint8Array(readFileSync(path)));
const found: number[] = [];
for (let k = 0; k < Number(process.argv[4]); k++) {
  const receiver = new Receiver(welcome), start = performance.now();
  receiver.receive(batch);
  found.push(performance.now() - start);
}
console.log(JSON.stringify(found));
