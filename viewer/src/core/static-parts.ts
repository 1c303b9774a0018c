// Bytes of the files of a static scene: by HTTP with retries, or files held in memory.

/** Why bytes are not to be had. `missing` and `cut` are for good; the scene goes on without them. */
export class PartError extends Error {
  constructor(readonly kind: "missing" | "cut", message: string) {
    super(message);
  }
}

export interface Parts {
  /** Return the content of scene.json. */
  scene(): Promise<string>;
  /** Return a file of so many bytes; `take`, if given, gets its pieces as they come. */
  read(name: string, bytes: number, take?: (data: Uint8Array) => void): Promise<Uint8Array>;
  /** Ask for files before anybody reads them. */
  ahead?(names: readonly string[]): void;
  /** Return whether a file was asked for ahead and is not read yet. */
  isAhead?(name: string): boolean;
  /** Stop a file that was asked for ahead: nobody reads it. */
  drop?(name: string): void;
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

const SCENE = "scene.json";
const TRIES = 4; // of a server that answers with errors, or cuts
const LONGEST = 20; // seconds between tries
const MOST_JSON = 16 << 20;

/** Files below an address. */
export class HttpParts implements Parts {
  readonly #redirect: RequestRedirect;
  readonly #fetch: typeof fetch;
  readonly #sleep: (seconds: number) => Promise<void>;
  readonly #random: () => number;
  readonly #early = new Map<string, Promise<Response>>(); // answers to what was asked for ahead
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
    return this.#attempt(SCENE, async () => {
      const answer = await this.#ask(SCENE);
      return new TextDecoder().decode(await this.#body(answer, MOST_JSON));
    });
  }

  async read(name: string, bytes: number, take?: (data: Uint8Array) => void): Promise<Uint8Array> {
    let given = 0; // bytes that `take` has
    return this.#attempt(name, async () => {
      const data = await this.#body(await this.#ask(name), bytes, (some, at) => {
        const fresh = some.subarray(Math.max(given - at, 0));
        given += fresh.length;
        if (fresh.length > 0) take?.(fresh);
      });
      if (data.length !== bytes) throw new PartError("cut", `${name}: expected ${bytes} bytes, got ${data.length}`);
      return data;
    });
  }

  ahead(names: readonly string[]): void {
    for (const name of names) {
      const answer = this.#request(name);
      answer.catch(() => undefined); // whoever reads the file sees it, and tries again
      this.#early.set(name, answer);
    }
  }

  isAhead(name: string): boolean {
    return this.#early.has(name);
  }

  drop(name: string): void {
    void this.#early.get(name)?.then(({ body }) => body?.cancel()).catch(() => undefined);
    this.#early.delete(name);
  }

  #request(name: string): Promise<Response> {
    const cache = name === SCENE ? "no-cache" : "default";
    return this.#fetch(
      new URL(name, this.base).href, { cache, signal: this.stop, credentials: "same-origin", redirect: this.#redirect },
    );
  }

  async #ask(name: string): Promise<Response> {
    const early = this.#early.get(name);
    this.#early.delete(name);
    const answer = await (early ?? this.#request(name));
    if (answer.ok) return answer;
    await answer.body?.cancel();
    const message = `${name}: the server answers ${answer.status || "a redirect"}`;
    const again = answer.status >= 500 || answer.status === 408 || answer.status === 429;
    if (!again) throw new PartError("missing", message);
    throw new Retry(message, Number(answer.headers.get("retry-after")) || 0);
  }

  /** Return the body of an answer, at most one byte more than `most`; `take` gets its pieces and where they lie. */
  async #body(answer: Response, most: number, take?: (data: Uint8Array, at: number) => void): Promise<Uint8Array> {
    const reader = answer.body?.getReader(), pieces: Uint8Array[] = [];
    let size = 0;
    while (reader !== undefined && size <= most) {
      const { done, value } = await reader.read();
      if (done) break;
      this.events.bytes(value.length);
      if (size + value.length <= most) take?.(value, size);
      pieces.push(value);
      size += value.length;
    }
    if (size > most) await reader?.cancel();
    const data = new Uint8Array(size);
    let at = 0;
    for (const piece of pieces) {
      data.set(piece, at);
      at += piece.length;
    }
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
  constructor(private readonly files: ReadonlyMap<string, Blob>, private readonly events: PartEvents) {}

  async scene(): Promise<string> {
    return this.#find("scene.json").text();
  }

  async read(name: string, bytes: number, take?: (data: Uint8Array) => void): Promise<Uint8Array> {
    const data = new Uint8Array(await this.#find(name).arrayBuffer());
    if (data.length !== bytes) throw new PartError("cut", `${name}: expected ${bytes} bytes, got ${data.length}`);
    this.events.bytes(data.length);
    take?.(data);
    return data;
  }

  #find(name: string): Blob {
    const found = this.files.get(name);
    if (found === undefined) throw new PartError("missing", `${name}: the page does not hold it`);
    return found;
  }
}
