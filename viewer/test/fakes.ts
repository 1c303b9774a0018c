// A socket and a clock that tests move by hand, and the messages of the recorded exchange.
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { Connection } from "../src/core/connection.ts";
import type { Clock, ConnectionOptions, Socket } from "../src/core/connection.ts";
import type { Batch, Header, SourceState, Traffic } from "../src/core/types.ts";

export interface Step {
  from: string; bytes: string; gaussians?: number[]; terms?: number[]; dropped?: number[]; gone?: number[];
  evicted?: number[]
}
export interface Vector { eye: [number, number, number]; steps: Step[]; drawn: Record<string, number[] | number[][]> }

const read = (name: string) => JSON.parse(readFileSync(join(process.cwd(), "../tests/stream", name), "utf8")) as Vector;
/** The recorded exchange, and the one of a client with little memory. */
export const vector = read("vector.json"), evicting = read("vector_memory.json");
export const bytesOf = (step: Step) => new Uint8Array(Buffer.from(step.bytes, "hex"));
export const isBatch = (step: Step) => step.from === "server" && step.gaussians !== undefined;
export const hex = (bytes: Uint8Array) => Buffer.from(bytes).toString("hex");
export const welcome = bytesOf(vector.steps[1]);
export const batches = vector.steps.filter(isBatch).map(bytesOf);

/** Return the bytes with some of them replaced. */
export function changed(bytes: Uint8Array, at: number, ...values: number[]): Uint8Array {
  const out = bytes.slice();
  out.set(values, at);
  return out;
}

/** Return a WELCOME whose JSON has other text of the same length. */
export function reworded(from: string, to: string): Uint8Array {
  const text = Buffer.from(welcome).toString("latin1");
  if (!text.includes(from) || from.length !== to.length) throw new Error(`no ${from}, or ${to} is not as long`);
  return new Uint8Array(Buffer.from(text.replace(from, to), "latin1"));
}

export class FakeClock implements Clock {
  time = 0;
  asleep = 0;
  private readonly due: { at: number; work: () => void }[] = [];

  now(): number {
    return this.time;
  }

  wall(): number {
    return 1e12 + this.time + this.asleep;
  }

  after(milliseconds: number, work: () => void): () => void {
    const entry = { at: this.time + milliseconds, work };
    this.due.push(entry);
    return () => {
      if (this.due.includes(entry)) this.due.splice(this.due.indexOf(entry), 1);
    };
  }

  random(): number {
    return 1;
  }

  /** Let time pass, and do what becomes due. */
  advance(milliseconds: number): void {
    const end = this.time + milliseconds;
    for (;;) {
      const next = this.due.filter((entry) => entry.at <= end).sort((a, b) => a.at - b.at)[0];
      if (next === undefined) break;
      this.due.splice(this.due.indexOf(next), 1);
      this.time = Math.max(this.time, next.at);
      next.work();
    }
    this.time = end;
  }
}

export class FakeSocket implements Socket {
  binaryType = "";
  bufferedAmount = 0;
  onopen: ((event: never) => void) | null = null;
  onmessage: ((event: MessageEvent) => void) | null = null;
  onclose: ((event: CloseEvent) => void) | null = null;
  readonly said: Uint8Array[] = [];
  closed: number | null = null;

  send(data: Uint8Array<ArrayBuffer>): void {
    this.said.push(data.slice());
  }

  close(code = 0): void {
    this.closed = code;
  }

  /** The connection opens. */
  open(): void {
    this.onopen?.(undefined as never);
  }

  /** The server says something. */
  hear(data: Uint8Array | string): void {
    this.onmessage?.({ data: typeof data === "string" ? data : data.slice().buffer } as MessageEvent);
  }

  /** The connection breaks. */
  break(code = 1006, reason = ""): void {
    this.onclose?.({ code, reason } as CloseEvent);
  }

  /** What the client has said of a kind. */
  of(kind: number): Uint8Array[] {
    return this.said.filter((message) => message[0] === kind);
  }
}

/** A connection with fakes around it, and what it has reported. */
export class Stage {
  readonly clock = new FakeClock();
  readonly sockets: FakeSocket[] = [];
  readonly batches: Batch[] = [];
  readonly headers: { header: Header; fresh: boolean }[] = [];
  readonly states: SourceState[] = [];
  readonly traffic: Traffic[] = [];
  readonly connection: Connection;

  constructor(options: Partial<ConnectionOptions> = {}) {
    const all = {
      url: "ws://example.org/stream", token: null, reach: { margin: 0.125, near: 0.0625, memory: 0 }, mostBytes: 2 ** 29,
      ...options,
    };
    this.connection = new Connection(all, {
      header: (header, fresh) => this.headers.push({ header, fresh }),
      batch: (batch) => this.batches.push(batch),
      state: (state) => this.states.push(state),
      traffic: (traffic) => this.traffic.push(traffic),
    }, () => {
      const socket = new FakeSocket();
      this.sockets.push(socket);
      return socket;
    }, this.clock);
    this.connection.setView({ left: 1, right: 1, up: 0.75, down: 0.75 });
  }

  /** The socket in use. */
  get socket(): FakeSocket {
    return this.sockets[this.sockets.length - 1];
  }

  get state(): SourceState {
    return this.states[this.states.length - 1];
  }

  /** Start and be welcomed. */
  begin(): this {
    this.connection.start();
    return this.meet();
  }

  /** Let the newest socket open and be welcomed. */
  meet(message: Uint8Array = welcome): this {
    this.socket.open();
    this.socket.hear(message);
    return this;
  }
}
