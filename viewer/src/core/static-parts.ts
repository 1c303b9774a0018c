// Bytes of the files of a static scene: HTTP ranges with retries, whole files from servers without ranges, or files
// held in memory.
import type { StaticFile } from "./static-scene.ts";

/** Why bytes are not to be had. `missing` and `cut` are for good; the scene goes on without them. */
export class PartError extends Error {
  constructor(readonly kind: "missing" | "cut", message: string) {
    super(message);
  }
}

export interface Parts {
  /** Return the content of scene.json. */
  scene(): Promise<string>;
  /** Return bytes [start, end) of a file. */
  read(file: StaticFile, start: number, end: number): Promise<Uint8Array>;
  /** Whether reading a part of a file costs no more than its bytes. */
  readonly ranges: boolean;
}

/** What reading reports: bytes as they come, and waits of a link that is down. */
export interface PartEvents {
  bytes(count: number): void;
  waiting(seconds: number, message: string): void;
  resumed(): void;
}

interface HttpOptions {
  fetch?: typeof fetch;
  sleep?: (seconds: number) => Promise<void>;
  random?: () => number;
}

const TRIES = 4; // of a server that answers with errors, or cuts
const LONGEST = 20; // seconds between tries

/** Files below an address. */
export class HttpParts implements Parts {
  ranges = true;
  #known = false; // whether a range has been asked for
  #probe: Promise<unknown> = Promise.resolve();
  readonly #whole = new Map<string, Promise<Uint8Array>>();
  readonly #redirect: RequestRedirect;
  readonly #fetch: typeof fetch;
  readonly #sleep: (seconds: number) => Promise<void>;
  readonly #random: () => number;
  #down = 0; // requests that wait for the link

  constructor(
    private readonly base: string, private readonly events: PartEvents, private readonly stop: AbortSignal,
    options: HttpOptions = {},
  ) {
    // A link names addresses of this origin alone, so this origin leads nowhere else.
    this.#redirect = base.startsWith(`${globalThis.location?.origin}/`) ? "manual" : "follow";
    this.#fetch = options.fetch ?? ((input, init) => fetch(input, init));
    this.#sleep = options.sleep ?? ((seconds) => new Promise((done) => { setTimeout(done, 1000 * seconds); }));
    this.#random = options.random ?? Math.random;
  }

  async scene(): Promise<string> {
    return this.#attempt("scene.json", async () => {
      const answer = await this.#ask("scene.json", {}, "no-cache");
      return new TextDecoder().decode(await this.#body(answer));
    });
  }

  async read(file: StaticFile, start: number, end: number): Promise<Uint8Array> {
    if (end <= start) return new Uint8Array(0);
    if (end > file.bytes) throw new PartError("cut", `${file.name}: expected ${file.bytes} bytes, asked for ${end}`);
    if (start === 0 && end === file.bytes) return this.#readWhole(file);
    if (this.ranges && !this.#known) {
      const first = this.#probe.then(() => this.#known || !this.ranges ? undefined : this.#readRange(file, start, end));
      this.#probe = first.catch(() => undefined); // the others wait until it is known whether ranges work
      const found = await first;
      if (found !== undefined) return found;
    }
    if (this.ranges) return this.#readRange(file, start, end);
    return (await this.#readWhole(file)).slice(start, end);
  }

  #readWhole(file: StaticFile): Promise<Uint8Array> {
    const found = this.#whole.get(file.name);
    if (found !== undefined) return found;
    const made = this.#attempt(file.name, async () => {
      const data = await this.#body(await this.#ask(file.name, {}));
      if (data.length !== file.bytes) {
        throw new PartError("cut", `${file.name}: expected ${file.bytes} bytes, got ${data.length}`);
      }
      return data;
    });
    this.#whole.set(file.name, made);
    made.catch(() => this.#whole.delete(file.name)); // it may be asked for again
    return made;
  }

  async #readRange(file: StaticFile, start: number, end: number): Promise<Uint8Array> {
    const found = await this.#attempt(file.name, async () => {
      const answer = await this.#ask(file.name, { Range: `bytes=${start}-${end - 1}` });
      const data = await this.#body(answer);
      this.#known = true;
      if (answer.status !== 206) {
        this.ranges = false;
        if (data.length !== file.bytes) {
          throw new PartError("cut", `${file.name}: expected ${file.bytes} bytes, got ${data.length}`);
        }
        this.#whole.set(file.name, Promise.resolve(data));
        return data.slice(start, end);
      }
      const said = /^bytes (\d+)-(\d+)\/(\d+|\*)$/.exec(answer.headers.get("content-range") ?? "");
      const other = said !== null && Number(said[1]) !== start; // a file cut behind these bytes is good enough
      if (data.length !== end - start || other) {
        throw new PartError(
          "cut",
          `${file.name}: expected bytes ${start} to ${end} of ${file.bytes}, ` +
            `got ${said?.[0] ?? `${data.length} bytes`}`,
        );
      }
      return data;
    });
    return found;
  }

  async #ask(name: string, headers: Record<string, string>, cache: RequestCache = "default"): Promise<Response> {
    const answer = await this.#fetch(
      new URL(name, this.base).href, { headers, cache, signal: this.stop, credentials: "same-origin", redirect: this.#redirect },
    );
    if (answer.ok) return answer;
    await answer.body?.cancel();
    const message = `${name}: the server answers ${answer.status || "a redirect"}`;
    const again = answer.status >= 500 || answer.status === 408 || answer.status === 429;
    if (!again) throw new PartError(answer.status === 416 ? "cut" : "missing", message);
    throw new Retry(message, Number(answer.headers.get("retry-after")) || 0);
  }

  async #body(answer: Response): Promise<Uint8Array> {
    const data = new Uint8Array(await answer.arrayBuffer());
    this.events.bytes(data.length);
    return data;
  }

  /** Try until it works: a link that is down for ever, a server that errs or cuts a few times, what is missing once. */
  async #attempt<T>(name: string, work: () => Promise<T>): Promise<T> {
    let errors = 0, waited = false;
    try {
      for (let tries = 0; ; tries++) {
        try {
          return await work();
        } catch (error) {
          if (this.stop.aborted) throw error;
          const cut = error instanceof PartError && error.kind === "cut", failed = error instanceof Retry;
          if (error instanceof PartError && !cut) throw error;
          if ((cut || failed) && ++errors >= TRIES) throw cut ? error : new PartError("missing", error.message);
          const seconds = Math.min(
            LONGEST,
            Math.max(failed ? error.seconds : 0, 0.25 * 2 ** Math.min(tries, 10)) * (0.75 + 0.5 * this.#random()),
          );
          if (!cut && !failed) {
            if (!waited) [waited, this.#down] = [true, this.#down + 1];
            this.events.waiting(seconds, `${name}: no connection`);
          }
          await this.#sleep(seconds);
        }
      }
    } finally {
      if (waited && --this.#down === 0) this.events.resumed();
    }
  }
}

class Retry extends Error {
  constructor(message: string, readonly seconds: number) {
    super(message);
  }
}

/** Files that the page itself holds. */
export class HeldParts implements Parts {
  readonly ranges = true;

  constructor(private readonly files: ReadonlyMap<string, Blob>, private readonly events: PartEvents) {}

  async scene(): Promise<string> {
    return this.#find("scene.json").text();
  }

  async read(file: StaticFile, start: number, end: number): Promise<Uint8Array> {
    const found = this.#find(file.name);
    if (found.size !== file.bytes) {
      throw new PartError("cut", `${file.name}: expected ${file.bytes} bytes, got ${found.size}`);
    }
    const data = new Uint8Array(await found.slice(start, end).arrayBuffer());
    this.events.bytes(data.length);
    return data;
  }

  #find(name: string): Blob {
    const found = this.files.get(name);
    if (found === undefined) throw new PartError("missing", `${name}: the page does not hold it`);
    return found;
  }
}
