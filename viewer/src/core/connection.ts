// A client of a server over sockets that break: says what it holds, acknowledges at once, and comes back by itself.
// Sockets and time are given to it, so it runs in a Worker and in tests.
import { sequenceOf } from "./batch.ts";
import { Receiver } from "./receiver.ts";
import { type Clock as Ticking, Meter } from "./traffic.ts";
import type { Pose, SourceEvents, SourceState, View } from "./types.ts";
import { ack, bye, ERROR, FAULTS, hello, isPose, isView, parseError, poseAt, ProtocolError, tokenOf } from "./wire.ts";
import type { Reach } from "./wire.ts";

/** What this needs of a WebSocket. */
export interface Socket {
  binaryType: string;
  readonly bufferedAmount: number;
  onopen: ((event: never) => void) | null;
  onmessage: ((event: MessageEvent) => void) | null;
  onclose: ((event: CloseEvent) => void) | null;
  send(data: Uint8Array<ArrayBuffer>): void;
  close(code?: number): void;
}

/** Time and chance. */
export interface Clock extends Ticking {
  wall(): number; // milliseconds, also while the machine sleeps
  random(): number;
}

/** Where to stream from, and how. */
export interface ConnectionOptions {
  url: string;
  token: string | null;
  reach: Reach;
  mostBytes: number;
}

const OPEN_MS = 10_000; // most time to connect, and from there to WELCOME
const FIRST_WAIT_MS = 100, LONGEST_WAIT_MS = 5_000;
const STEADY_MS = 5_000; // a stream that lasts this long was a good one
const POSE_MS = 66, STILL_MS = 1_000; // between poses: moving, and at rest
const VIEW_MS = 1000; // how long HELLO waits for the view: a page that begins to draw is slow to say it
const RESIZE_MS = 400; // how long a view rests before the server is asked anew
const QUIET_MS = 700; // without a batch, and three round trips: the pose has what it needs
const EMPTY_MS = 3_000; // the same, where nothing at all has come
const ASLEEP_MS = 30_000; // a timer this late: the machine slept, and the connection with it
const MOST_MESSAGE = 64 << 20;
const MOST_BUFFERED = 1 << 16; // of poses that the link does not carry
const MOST_BAD = 3; // batches in a row that break the protocol
const ANOTHER_VERSION = "The server speaks another version of the protocol; reload the page, or update what is older";
const USUAL: View = { left: 1, right: 1, up: 0.75, down: 0.75 };
const AGAIN: ReadonlySet<number> = /* @__PURE__ */ new Set([FAULTS.tooMany, FAULTS.flood, FAULTS.late, FAULTS.internal, FAULTS.ending]);

/** One client of one address, until `close`. */
export class Connection {
  receiver: Receiver | null = null;
  readonly #options: ConnectionOptions;
  readonly #events: SourceEvents;
  readonly #connect: (url: string) => Socket;
  readonly #clock: Clock;
  readonly #meter: Meter;
  readonly #timers = new Map<string, () => void>();
  #socket: Socket | null = null;
  #phase: "waiting" | "opening" | "open" | "greeted" | "streaming" | "ended" = "waiting";
  #state: SourceState["kind"] | "" = "";
  #view: View | null = null;
  #asked: View | null = null; // the view of the last HELLO
  #pose: Pose | null = null;
  #isNewPose = false;
  #posedAt = -Infinity;
  #greetedAt = 0;
  #roundTrip = 0; // from HELLO to WELCOME, milliseconds
  #wait = FIRST_WAIT_MS;
  #bad = 0;
  #isDoubted = false; // the server refused the holdings once
  #saidHoldings = false;
  #reconnects = -1;
  #wallAt = 0;

  constructor(options: ConnectionOptions, events: SourceEvents, connect: (url: string) => Socket, clock: Clock) {
    this.#options = options;
    this.#events = events;
    this.#connect = connect;
    this.#clock = clock;
    this.#meter = new Meter(clock, (bytes, rate) => this.#report(bytes, rate));
  }

  /** Connect, and stay connected. */
  start(): void {
    this.#wallAt = this.#clock.wall();
    this.#open();
  }

  /** Take where the eye is; poses go out when they change, at most 15 a second, and every second. */
  setPose(pose: Pose): void {
    if (!isPose(pose)) return;
    const [now, before] = [pose, this.#pose].map((p) => p && [...p.position, ...p.rotation]);
    if (before?.every((value, k) => value === now?.[k])) return;
    this.#pose = { position: [...pose.position], rotation: [...pose.rotation] };
    this.#isNewPose = true;
    this.#sayPose();
  }

  /**
   * Take what the eye sees. HELLO has the view, so a wider one needs a new connection, which keeps all that is held.
   */
  setView(view: View): void {
    if (!isView(view)) return;
    this.#view = { ...view };
    if (this.#phase === "open") this.#greet();
    if (this.#phase === "greeted" || this.#phase === "streaming") {
      this.#later("resize", RESIZE_MS, () => this.#resize());
    }
  }

  /** Try again now, instead of waiting. */
  retry(): void {
    if (this.#phase === "waiting") this.#open();
  }

  /** The device is on a network again: what was open is likely dead. */
  renew(): void {
    if (this.#phase === "ended") return;
    this.#drop();
    this.#open();
  }

  /** Leave. */
  close(): void {
    if (this.#phase === "ended") return;
    this.#drop();
    this.#end();
    this.#meter.stop();
  }

  #open(): void {
    this.#phase = "opening";
    this.#cancel("again");
    if (this.#state !== "streaming" && this.#state !== "complete") this.#say({ kind: "connecting" });
    let socket: Socket;
    try {
      socket = this.#connect(this.#options.url);
    } catch (error) {
      this.#fail(`The browser does not connect to ${hostOf(this.#options.url)}: ${(error as Error).message}`);
      return;
    }
    this.#socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      if (socket !== this.#socket) return;
      this.#phase = "open";
      if (this.#view !== null) this.#greet();
      else this.#later("view", VIEW_MS, () => this.#greet());
    };
    socket.onmessage = (event) => {
      if (socket === this.#socket) this.#hear(event.data as unknown);
    };
    socket.onclose = (event) => {
      if (socket === this.#socket) this.#lose(this.#reasonOf(event));
    };
    this.#later("open", OPEN_MS, () => this.#lose(this.#silence()));
  }

  /** Send the token, HELLO and the pose. */
  #greet(): void {
    this.#cancel("view");
    const held = this.receiver?.holdings() ?? new Uint8Array(0);
    this.#asked = this.#view ?? USUAL;
    this.#saidHoldings = held.length > 0;
    this.#phase = "greeted";
    this.#greetedAt = this.#clock.now();
    if (this.#options.token !== null) this.#send(tokenOf(this.#options.token));
    this.#send(hello(this.#asked, this.#options.reach, this.#saidHoldings ? this.receiver?.about.identity : "", held));
    this.#isNewPose = true;
    this.#posedAt = -Infinity;
    this.#sayPose();
  }

  /** Take in a message of the server. */
  #hear(data: unknown): void {
    try {
      if (!(data instanceof ArrayBuffer)) throw new ProtocolError("message: expected bytes, got text");
      if (data.byteLength > MOST_MESSAGE) {
        throw new ProtocolError(`message: expected at most ${MOST_MESSAGE} bytes, got ${data.byteLength}`);
      }
      const message = new Uint8Array(data);
      this.#meter.add(message.length);
      if (message[0] === ERROR) this.#hearError(message);
      else if (this.#phase === "streaming") this.#hearBatch(message);
      else this.#hearWelcome(message);
    } catch (error) {
      this.#refuse(error as Error);
    }
  }

  #hearWelcome(message: Uint8Array): void {
    if (this.#phase !== "greeted") throw new ProtocolError("message: expected nothing before HELLO, got some");
    const isKept = this.receiver !== null && this.receiver.resume(message);
    if (!isKept) this.receiver = new Receiver(message, this.#options.mostBytes, this.#options.reach.memory > 0);
    this.#send(ack(0));
    this.#phase = "streaming";
    this.#roundTrip = this.#clock.now() - this.#greetedAt;
    this.#isDoubted = false;
    this.#reconnects++;
    this.#cancel("open");
    this.#later("steady", STEADY_MS, () => { this.#wait = FIRST_WAIT_MS; });
    this.#events.header((this.receiver as Receiver).about, !isKept);
    if (this.#state !== "complete") this.#say({ kind: "streaming" });
    this.#settle();
    this.#meter.report();
    if (this.#view !== null) this.#later("resize", RESIZE_MS, () => this.#resize());
  }

  #hearBatch(message: Uint8Array): void {
    const receiver = this.receiver as Receiver;
    // before the work of decoding: the server measures the link
    if (sequenceOf(message) === receiver.next) this.#send(ack(receiver.next));
    const batch = receiver.receive(message);
    this.#bad = 0;
    this.#wait = FIRST_WAIT_MS;
    this.#events.batch(batch);
    this.#say({ kind: "streaming" });
    this.#settle();
    this.#meter.touch();
  }

  #hearError(message: Uint8Array): void {
    const { code, line } = parseError(message);
    const isOfHoldings = code === FAULTS.malformed || code === FAULTS.tooLarge;
    if (isOfHoldings && this.#phase === "greeted" && this.#saidHoldings && !this.#isDoubted) {
      this.#isDoubted = true; // perhaps it is the holdings that the server cannot read: begin with nothing, once
      this.receiver = null;
      this.#lose(line);
    } else if (AGAIN.has(code)) {
      if (code === FAULTS.flood) this.#wait = LONGEST_WAIT_MS;
      this.#lose(line || "The server ended the connection.");
    } else {
      this.#fail(`${code === FAULTS.version ? ANOTHER_VERSION : "The server refuses this viewer"}: ${line}`, code);
    }
  }

  /** Close a connection whose server breaks the protocol; some such errors no further try can heal. */
  #refuse(error: Error): void {
    if (!(error instanceof ProtocolError)) {
      this.#fail(
        error instanceof RangeError ? "This scene is too large for the memory of this device."
          : `The viewer failed: ${error.message}`
      );
    } else if (error.code === FAULTS.version || error.code === FAULTS.tooLarge) {
      this.#fail(error.code === FAULTS.version ? `${ANOTHER_VERSION}: ${error.message}` : error.message, error.code);
    } else if (++this.#bad >= MOST_BAD) {
      this.#fail(`The server sends what this viewer does not understand: ${error.message}`, error.code);
    } else {
      this.#lose(error.message);
    }
  }

  /** Drop a connection and try again after a while. */
  #lose(message: string): void {
    this.#drop();
    this.#phase = "waiting";
    const wait = this.#wait * (0.5 + 0.5 * this.#clock.random());
    this.#wait = Math.min(2 * this.#wait, LONGEST_WAIT_MS);
    this.#say({ kind: "waiting", seconds: wait / 1000, message });
    this.#later("again", wait, () => this.#open());
  }

  #fail(message: string, code?: number): void {
    this.#drop();
    this.#end();
    this.#say(code === undefined ? { kind: "failed", message } : { kind: "failed", message, code });
  }

  #end(): void {
    this.#phase = "ended";
    for (const name of [...this.#timers.keys()]) this.#cancel(name);
  }

  /** Let go of the socket; a server that still listens hears BYE. */
  #drop(): void {
    const socket = this.#socket;
    if (socket === null) return;
    if (this.#phase === "greeted" || this.#phase === "streaming") this.#send(bye());
    this.#socket = null;
    socket.onopen = socket.onmessage = socket.onclose = null;
    try {
      socket.close(1000);
    } catch { /* it was never open */ }
    for (const name of ["open", "view", "pose", "quiet", "steady", "resize", "asleep"]) this.#cancel(name);
  }

  #send(data: Uint8Array<ArrayBuffer>): void {
    try {
      this.#socket?.send(data);
    } catch { /* it is closing: `onclose` says so */ }
  }

  /** Send the pose if it is due, and look again when it will be. */
  #sayPose(): void {
    const pose = this.#pose, socket = this.#socket, now = this.#clock.now();
    this.#lookAtClock();
    if (pose === null || socket === null || (this.#phase !== "greeted" && this.#phase !== "streaming")) return;
    const due = this.#posedAt + (this.#isNewPose ? POSE_MS : STILL_MS);
    if (now >= due && socket.bufferedAmount <= MOST_BUFFERED) {
      const isFirst = this.#posedAt === -Infinity;
      this.#send(poseAt(now, pose));
      this.#isNewPose = false;
      this.#posedAt = now;
      if (isFirst && this.#phase === "streaming") this.#settle();
    }
    const next = Math.max(this.#posedAt + (this.#isNewPose ? POSE_MS : STILL_MS) - now, 1);
    this.#later("pose", Number.isFinite(next) ? next : STILL_MS, () => this.#sayPose());
  }

  /** Begin anew after the machine has slept. */
  #lookAtClock(): void {
    const wall = this.#clock.wall(), passed = wall - this.#wallAt;
    this.#wallAt = wall;
    if (passed > ASLEEP_MS && this.#phase === "streaming") this.#later("asleep", 0, () => this.renew());
  }

  /** Ask anew if the view sees well beyond what HELLO said, or much less. */
  #resize(): void {
    const view = this.#view, asked = this.#asked;
    if (view === null || asked === null) return;
    const more = Math.max(...(["left", "right", "up", "down"] as const).map((side) => view[side] - asked[side]));
    const area = (of: View) => (of.left + of.right) * (of.up + of.down);
    if (more > 0.01 || area(view) < 0.5 * area(asked)) this.renew();
  }

  /** Say `complete` once nothing more has come for a while; `streaming` holds until then. */
  #settle(): void {
    const quiet = (this.receiver?.gaussians === 0 ? EMPTY_MS : QUIET_MS) + 3 * this.#roundTrip;
    if (this.receiver?.isWhole) this.#say({ kind: "complete" });
    else if (this.#posedAt > -Infinity) this.#later("quiet", quiet, () => this.#say({ kind: "complete" }));
  }

  #say(state: SourceState): void {
    if (state.kind === this.#state && state.kind !== "waiting") return;
    this.#state = state.kind;
    this.#events.state(state);
  }

  #report(bytes: number, rate: number): void {
    const { receiver } = this;
    this.#events.traffic({
      bytes, rate, gaussians: receiver?.gaussians ?? 0, terms: receiver?.terms ?? 0,
      replaced: receiver?.replaced ?? 0, reconnects: Math.max(this.#reconnects, 0),
    });
  }

  #reasonOf(event: CloseEvent): string {
    if (event.reason) return `The server ended the connection: ${event.reason.slice(0, 120)}`;
    if (event.code === 1012) return "The server restarts.";
    return this.#phase === "opening" ? this.#silence() : "The connection to the server was lost.";
  }

  /** Return the line for no answer: to a page, a server that is absent looks like one that refuses it. */
  #silence(): string {
    const also = this.#reconnects < 0 ? ", or does not let this page in" : "";
    return `${hostOf(this.#options.url)} does not answer${also}.`;
  }

  /** Do work after some time, once, instead of what was to be done under this name. */
  #later(name: string, milliseconds: number, work: () => void): void {
    this.#cancel(name);
    this.#timers.set(name, this.#clock.after(milliseconds, () => {
      this.#timers.delete(name);
      work();
    }));
  }

  #cancel(name: string): void {
    this.#timers.get(name)?.();
    this.#timers.delete(name);
  }
}

function hostOf(url: string): string {
  return new URL(url).host;
}
