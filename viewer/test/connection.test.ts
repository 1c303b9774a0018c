// A client over sockets that break: what it says and when, and what it does with servers that refuse, fail or lie.
import assert from "node:assert/strict";
import { test } from "node:test";
import { batches, bytesOf, changed, hex, reworded, Stage, vector, welcome } from "./fakes.ts";

const HELLO = 1, POSE = 2, ACK = 3, BYE = 4, TOKEN = 5;
const POSES: [number, number, number][] = [[-1.5, -1, 0.25], [0, -1, 0.25], [1.5, -1, 0.25]];
const here = { position: POSES[0], rotation: [1, 0, 0, 0] as [number, number, number, number] };
const kindOf = (stage: Stage): string => stage.state.kind;
const errorOf = (code: number, line: string) => Uint8Array.of(131, code, line.length, 0, ...Buffer.from(line));

test("the recorded exchange, with a connection that breaks", () => {
  const stage = new Stage(), { connection, clock } = stage;
  connection.start();
  stage.socket.open();
  assert.equal(hex(stage.socket.said[0]), vector.steps[0].bytes);
  connection.setPose(here);
  stage.socket.hear(welcome);
  for (const [k, batch] of batches.slice(0, 2).entries()) {
    stage.socket.hear(batch);
    assert.deepEqual([...stage.socket.of(ACK).at(-1) as Uint8Array], [3, 0, 0, 0, k + 1, 0, 0, 0]);
  }
  stage.socket.break();
  clock.advance(5000);
  assert.equal(stage.sockets.length, 2);
  stage.socket.open();
  const hellos = vector.steps.filter((step) => step.bytes.startsWith("01")).map((step) => step.bytes);
  assert.equal(hex(stage.socket.said[0]), hellos[1]);
  stage.socket.hear(welcome);
  stage.socket.hear(batches[2]);
  assert.deepEqual(stage.headers.map(({ fresh }) => fresh), [true, false]);
  assert.deepEqual(
    stage.batches.map((batch) => batch.ids.length),
    vector.steps.filter((s) => s.gaussians).map((s) => s.gaussians?.length),
  );
  connection.close();
  assert.deepEqual([...stage.socket.said.at(-1) as Uint8Array], [4, 0, 0, 0]);
  assert.equal(stage.socket.closed, 1000);
  clock.advance(60_000);
  assert.equal(stage.sockets.length, 2);
  assert.equal(stage.traffic.at(-1)?.reconnects, 1);
});

test("the pose follows HELLO at once, then at most 16 a second, and every second at rest", () => {
  const stage = new Stage(), { connection, clock } = stage;
  connection.setPose(here);
  connection.start();
  stage.socket.open();
  assert.deepEqual(stage.socket.said.map((message) => message[0]), [HELLO, POSE]);
  stage.socket.hear(welcome);
  for (let k = 1; k <= 120; k++) {
    clock.advance(1000 / 60);
    connection.setPose({ ...here, position: [k, 0, 0] });
  }
  const moving = stage.socket.of(POSE).length;
  assert.ok(moving >= 25 && moving <= 33, `${moving}`);
  clock.advance(100);
  const last = stage.socket.of(POSE).at(-1) as Uint8Array;
  assert.equal(new DataView(last.buffer).getFloat32(8, true), 120);
  const before = stage.socket.of(POSE).length;
  clock.advance(10_000);
  assert.equal(stage.socket.of(POSE).length - before, 10);
  stage.socket.bufferedAmount = 1e6; // a link that carries nothing
  clock.advance(10_000);
  assert.equal(stage.socket.of(POSE).length - before, 10);
});

test("poses and views that are none are not sent", () => {
  const stage = new Stage().begin();
  for (const position of [
    [NaN, 0, 0], [Infinity, 0, 0], [1e39, 0, 0],
  ] as [number, number, number][]) stage.connection.setPose({ ...here, position });
  stage.connection.setPose({ ...here, rotation: [0, 0, 0, 0] });
  stage.connection.setView({ left: -1, right: 1, up: 1, down: 1 });
  stage.connection.setView({ left: NaN, right: 1, up: 1, down: 1 });
  stage.clock.advance(5000);
  assert.equal(stage.socket.of(POSE).length, 0);
  assert.equal(stage.sockets.length, 1);
});

test("waits grow to five seconds, and begin anew after a good stream", () => {
  const stage = new Stage();
  stage.connection.start();
  const waits: number[] = [];
  for (let k = 0; k < 9; k++) {
    stage.socket.break();
    if (stage.state.kind === "waiting") waits.push(stage.state.seconds);
    stage.clock.advance(5000);
  }
  assert.deepEqual(waits, [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5, 5, 5]);
  stage.meet();
  stage.socket.break(); // welcomed, but no batch: not a good one yet
  assert.equal(stage.state.kind === "waiting" && stage.state.seconds, 5);
  stage.clock.advance(5000);
  stage.meet().socket.hear(batches[0]);
  stage.socket.break(1012);
  assert.deepEqual(stage.state, { kind: "waiting", seconds: 0.1, message: "The server restarts." });
  stage.connection.retry();
  assert.equal(stage.state.kind, "connecting");
});

test("a server that accepts and says nothing is left after ten seconds", () => {
  const stage = new Stage();
  stage.connection.start();
  stage.clock.advance(10_000);
  assert.equal(
    stage.state.kind === "waiting" && stage.state.message, "example.org does not answer, or does not let this page in.",
  );
  stage.clock.advance(100);
  stage.socket.open();
  stage.clock.advance(10_000);
  assert.equal(stage.states.filter(({ kind }) => kind === "waiting").length, 2);
});

test("a token goes first", () => {
  const stage = new Stage({ token: "secret" });
  stage.connection.start();
  stage.socket.open();
  assert.deepEqual(stage.socket.said.map((message) => message[0]), [TOKEN, HELLO]);
  assert.equal(hex(stage.socket.said[0]), "05000600" + Buffer.from("secret").toString("hex"));
});

test("what no further try can heal fails, with words for people and the code", () => {
  for (const [message, code, words] of [
    [errorOf(4, "a token is needed"), 4, /a token is needed/],
    [errorOf(2, "HELLO: expected version 3, got 2"), 2, /another version.*reload/],
    [changed(welcome, 1, 4), 2, /another version.*expected version 3, got 4/],
    [reworded('"gaussians":300,', '"gaussians":2e8,'), 3, /needs 1001 MB/],
  ] as const) {
    const stage = new Stage();
    stage.connection.start();
    stage.meet(message);
    const { state } = stage;
    assert.ok(state.kind === "failed", JSON.stringify(state));
    assert.equal(state.code, code);
    assert.match(state.message, words);
    stage.clock.advance(60_000);
    assert.equal(stage.sockets.length, 1);
  }
});

test("a server that is full, late or ending is asked again", () => {
  for (const code of [5, 6, 7, 8, 9]) {
    const stage = new Stage().begin();
    stage.socket.hear(errorOf(code, "later"));
    assert.equal(stage.state.kind === "waiting" && stage.state.message, "later");
    stage.clock.advance(5000);
    assert.equal(stage.sockets.length, 2);
  }
});

test("text, noise and cut messages end the connection; three bad answers in a row end it for good", () => {
  for (const bad of [
    "text", new Uint8Array(0), Uint8Array.of(7), welcome.slice(0, 100), changed(welcome, 12, 99), batches[0],
  ]) {
    const stage = new Stage();
    stage.connection.start();
    for (let k = 0; k < 3; k++) {
      stage.socket.open();
      stage.socket.hear(bad);
      stage.clock.advance(5000);
    }
    assert.equal(stage.state.kind, "failed");
    assert.equal(stage.sockets.length, 3);
  }
});

test("a bad batch changes nothing, and the next connection holds what was held", () => {
  const stage = new Stage().begin();
  stage.socket.hear(batches[0]);
  const held = hex(stage.connection.receiver?.holdings() as Uint8Array);
  stage.socket.hear(batches[0]); // once more
  assert.equal(stage.state.kind, "waiting");
  assert.equal(stage.socket.of(BYE).length, 1);
  stage.clock.advance(200);
  stage.socket.open();
  assert.equal(hex(stage.socket.said[0].slice(72)), held);
  stage.socket.hear(welcome);
  stage.socket.hear(changed(batches[1], 4, 1));
  assert.equal(stage.batches.length, 2);
});

test("another scene begins with nothing", () => {
  const stage = new Stage().begin();
  stage.socket.hear(batches[0]);
  stage.socket.break();
  stage.clock.advance(200);
  const identity = stage.headers[0].header.identity;
  stage.meet(reworded(identity, identity.replace(/^./, (digit) => (digit === "0" ? "1" : "0"))));
  assert.deepEqual(stage.headers.map(({ fresh }) => fresh), [true, true]);
  stage.socket.hear(batches[0]);
  assert.equal(stage.batches[1].first, 0);
});

test("holdings that the server does not accept are given up once", () => {
  const stage = new Stage().begin();
  stage.socket.hear(batches[0]);
  stage.socket.break();
  stage.clock.advance(200);
  stage.socket.open();
  assert.ok(stage.socket.said[0].length > 72);
  stage.socket.hear(errorOf(1, "HELLO: bad holdings"));
  assert.equal(stage.state.kind, "waiting");
  stage.clock.advance(200);
  stage.socket.open();
  assert.equal(stage.socket.said[0].length, 72);
  stage.socket.hear(errorOf(1, "HELLO: bad"));
  assert.equal(stage.state.kind, "failed");
});

test("a wider view is asked for over a new connection, without a word to the user", () => {
  const stage = new Stage();
  stage.connection.setPose(here);
  stage.begin().socket.hear(batches[0]);
  const words = stage.states.length;
  stage.connection.setView({ left: 1, right: 1, up: 0.74, down: 0.75 });
  stage.clock.advance(500);
  assert.equal(stage.sockets.length, 1);
  for (const width of [1.1, 1.2, 1.5]) {
    stage.connection.setView({ left: width, right: width, up: 0.75, down: 0.75 });
    stage.clock.advance(100);
  }
  assert.equal(stage.sockets.length, 1);
  stage.clock.advance(400);
  assert.equal(stage.sockets.length, 2);
  assert.equal(stage.sockets[0].of(BYE).length, 1);
  stage.meet();
  assert.equal(new DataView(stage.socket.said[0].buffer).getFloat32(8, true), 1.5);
  assert.ok(stage.socket.said[0].length > 72);
  assert.deepEqual(stage.states.slice(words).filter(({ kind }) => kind !== "streaming" && kind !== "complete"), []);
});

test("complete is said when nothing more comes, and streaming when something does", () => {
  const stage = new Stage().begin();
  stage.clock.advance(3000);
  assert.equal(kindOf(stage), "streaming"); // no pose: the server sends nothing
  stage.connection.setPose(here);
  stage.socket.hear(batches[0]);
  stage.clock.advance(600);
  assert.equal(kindOf(stage), "streaming");
  stage.clock.advance(200);
  assert.equal(kindOf(stage), "complete");
  stage.socket.hear(batches[1]);
  assert.equal(kindOf(stage), "streaming");
});

test("a slow link has more time before complete is said", () => {
  const stage = new Stage(), { clock } = stage;
  stage.connection.setPose(here);
  stage.connection.start();
  stage.socket.open();
  clock.advance(1000); // a round trip
  stage.socket.hear(welcome);
  clock.advance(5900);
  assert.equal(kindOf(stage), "streaming");
  stage.socket.hear(batches[0]);
  clock.advance(3600);
  assert.equal(kindOf(stage), "streaming");
  clock.advance(200);
  assert.equal(kindOf(stage), "complete");
});

test("after a sleep of the machine the connection is made anew", () => {
  const stage = new Stage();
  stage.connection.setPose(here);
  stage.begin().clock.asleep = 3_600_000;
  stage.clock.advance(1500);
  assert.equal(stage.sockets.length, 2);
});

test("traffic is reported with its rate, which falls to 0", () => {
  const stage = new Stage().begin();
  stage.socket.hear(batches[0]);
  stage.clock.advance(300);
  const busy = stage.traffic.at(-1);
  assert.equal(busy?.bytes, welcome.length + batches[0].length);
  assert.ok((busy?.rate ?? 0) > 0);
  assert.equal(busy?.gaussians, stage.batches[0].ids.length);
  stage.clock.advance(5000);
  assert.equal(stage.traffic.at(-1)?.rate, 0);
});

test("the rate falls to 0 also when the connection is lost", () => {
  const stage = new Stage().begin();
  stage.socket.hear(batches[0]);
  stage.clock.advance(300);
  assert.ok((stage.traffic.at(-1)?.rate ?? 0) > 0);
  stage.socket.break();
  stage.clock.advance(5000);
  assert.equal(stage.traffic.at(-1)?.rate, 0);
});

test("a bug in what listens is reported, not swallowed", () => {
  const stage = new Stage().begin();
  (stage.batches as { push: unknown }).push = () => { throw new TypeError("oops"); };
  stage.socket.hear(bytesOf(vector.steps.find((step) => step.gaussians) as never));
  assert.equal(stage.state.kind === "failed" && stage.state.message, "The viewer failed: oops");
});
