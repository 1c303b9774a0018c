// The page's end of a stream: what reaches the Worker, and what reaches the page.
import assert from "node:assert/strict";
import { test } from "node:test";
import type { NetworkOrder as Order } from "../src/core/network.host.ts";
import { staticSource } from "../src/core/static-source.ts";
import { streamSource } from "../src/core/stream-source.ts";
import type { StreamOptions } from "../src/core/stream-source.ts";
import type { SourceState } from "../src/core/types.ts";
import type { Report } from "../src/core/worker-source.ts";

class FakeWorker {
  readonly orders: Order[] = [];
  ended = 0;
  onmessage: ((event: MessageEvent<Report>) => void) | null = null;
  onerror: ((event: ErrorEvent) => void) | null = null;

  postMessage(order: Order): void {
    this.orders.push(order);
  }

  terminate(): void {
    this.ended++;
  }
}

function begin(url: string, options: StreamOptions = {}): {
  worker: FakeWorker; states: SourceState[]; source: ReturnType<typeof streamSource>
} {
  const worker = new FakeWorker(), states: SourceState[] = [];
  const source = streamSource(url, { worker: () => worker as unknown as Worker, ...options });
  source.start({ header: () => {}, batch: () => {}, state: (state) => states.push(state), traffic: () => {} });
  return { worker, states, source };
}

const urlOf = (worker: FakeWorker) => worker.orders[0]?.kind === "start" ? worker.orders[0].options.url : "";
const pose = (x: number) => ({
  position: [x, 0, 0] as [number, number, number], rotation: [1, 0, 0, 0] as [number, number, number, number],
});

test("addresses of pages become addresses of sockets", () => {
  for (const [url, expected] of [
    ["http://a.example/stream/x", "ws://a.example/stream/x"],
    ["https://a.example/prefix/stream?q=1#view", "wss://a.example/prefix/stream?q=1"],
    ["wss://a.example:444/stream", "wss://a.example:444/stream"],
  ]) assert.equal(urlOf(begin(url).worker), expected);
  for (const bad of ["/stream", "javascript:alert(1)", "file:///x", "http://[", ""]) {
    const { worker, states } = begin(bad);
    assert.equal(states[0].kind, "failed");
    assert.deepEqual(worker.orders, []);
  }
  assert.equal(begin("ws://a/", { token: "no\nlines" }).states[0].kind, "failed");
});

test("what is said before the start is not lost, and the same pose goes once", () => {
  const worker = new FakeWorker(), source = streamSource("ws://a/", { worker: () => worker as unknown as Worker });
  source.pose(pose(1));
  source.pose(pose(2));
  source.view({ left: 1, right: 1, up: 1, down: 1 });
  source.start({ header: () => {}, batch: () => {}, state: () => {}, traffic: () => {} });
  source.pose(pose(2));
  source.pose(pose(3));
  assert.deepEqual(worker.orders.map((order) => order.kind), ["start", "pose", "view", "pose"]);
  assert.deepEqual(worker.orders.flatMap((order) => (order.kind === "pose" ? order.pose.position[0] : [])), [2, 3]);
});

test("a Worker that does not start or fails is said once; after the end nothing is said", () => {
  const states: SourceState[] = [];
  const none = streamSource("ws://a/", { worker: () => { throw new Error("no Workers here"); } });
  none.start({ header: () => {}, batch: () => {}, state: (state) => states.push(state), traffic: () => {} });
  assert.match(states[0].kind === "failed" ? states[0].message : "", /no Workers here/);
  const first = begin("ws://a/");
  first.worker.onerror?.({ message: "SyntaxError" } as ErrorEvent);
  first.worker.onerror?.({ message: "again" } as ErrorEvent);
  assert.deepEqual(first.states, [{ kind: "failed", message: "The network Worker failed: SyntaxError" }]);
  const second = begin("ws://a/");
  second.source.close();
  second.worker.onmessage?.({ data: { kind: "state", state: { kind: "complete" } } } as MessageEvent<Report>);
  assert.deepEqual(second.states, []);
  assert.equal(second.worker.orders.at(-1)?.kind, "close");
  second.source.pose(pose(1));
  assert.equal(second.worker.orders.at(-1)?.kind, "close");
});

test("a Worker ends with its source: when it breaks, and when it has given up", () => {
  const broken = begin("ws://a/");
  broken.worker.onerror?.({ message: "out of memory" } as ErrorEvent);
  assert.equal(broken.worker.ended, 1);
  for (const make of [streamSource, staticSource]) {
    const worker = new FakeWorker(), states: SourceState[] = [];
    const source = make("http://a.example/x/", { worker: () => worker as unknown as Worker });
    source.start({ header: () => {}, batch: () => {}, state: (state) => states.push(state), traffic: () => {} });
    const say = (state: SourceState) => worker.onmessage?.({ data: { kind: "state", state } } as MessageEvent<Report>);
    say({ kind: "waiting", seconds: 1, message: "lost" });
    assert.deepEqual(worker.orders.map((order) => order.kind), ["start"]);
    say({ kind: "failed", message: "no scene" });
    source.pose(pose(1));
    say({ kind: "complete" });
    source.close();
    assert.deepEqual(worker.orders.map((order) => order.kind), ["start", "close"]);
    assert.deepEqual(states.map((state) => state.kind), ["waiting", "failed"]);
  }
});
