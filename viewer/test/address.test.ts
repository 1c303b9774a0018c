// Which addresses a page opens: no spelling of a link leads to another origin, and no token leaves its own.

import assert from "node:assert/strict";
import test from "node:test";
import { permitOf, readAddress } from "../src/page/address.ts";
import { locate } from "../src/page/scene.ts";

const PAGE = "https://here.example/view/scene?token=secret";
const NONE = { scene: null, content: null, settings: null, origins: null };
const ELSEWHERE = [
  "ws://other.example/stream", "wss://other.example/stream", "https://other.example/s/", "http://here.example/s/",
  "//other.example/s/", "///other.example/s/", "\\\\other.example/s/", "/\\other.example/s/", "https:\\\\other.example/s/",
  "https:/\\other.example/s/", "ws:other.example/stream", "WS://OTHER.example/stream", " wss://other.example/stream",
  "\twss://other.example/stream", "w\nss://other.example/stream", "https://here.example@other.example/s/",
  "https://here.example:secret@other.example/s/", "https://user@here.example/s/", "https://user:word@here.example/s/",
  "https://here.example:8443/s/", "wss://here.example:1/stream", "https://here.example.other.example/s/",
  "https://here.example%2eother.example/s/", "https://other.example#here.example/", "https://other.example?here.example/",
  "https://here.example\u3002other.example/s/", "https://\u24d7ere.example.other/s/", "ws://here.example/stream",
  "file:///etc/passwd", "data:application/json,{}", "blob:https://other.example/1", "blob:https://here.example/1",
  "javascript:alert(1)", "filesystem:https://here.example/a", "ftp://here.example/s/", "https://[::1]/s/",
  "https://0x7f000001/s/", "https://here.example./s/",
];

const linked = (key: string, value: string): string => `${PAGE}&${key}=${encodeURIComponent(value)}`;

test("no link makes a page open another origin, whether it streams or reads files", () => {
  for (const metas of [NONE, { ...NONE, content: "scene/" }, { ...NONE, scene: "scene" }]) {
    for (const address of ELSEWHERE) {
      assert.equal(readAddress(linked("content", address), metas).scene, null, address);
      assert.equal(readAddress(linked("settings", address), metas).settings, null, address);
    }
  }
});

test("a page opens its own origin in every spelling", () => {
  for (const address of ["scene/", "/scene/", "../scene/", "wss://here.example/stream/a", "https://here.example:443/s/"]) {
    const found = readAddress(linked("content", address), NONE).scene;
    assert.equal(new URL(found!.url).host, "here.example", address);
  }
  assert.equal(readAddress(linked("settings", "own.json"), NONE).settings, "https://here.example/view/own.json");
});

test("whoever wrote the page names other origins, and what a page holds itself; the token goes to none of them", () => {
  const metas = { ...NONE, origins: "https://other.example http://third.example:81" };
  for (const address of ["wss://other.example/stream", "//other.example/s/", "ws://third.example:81/stream"]) {
    const found = readAddress(linked("content", address), metas).scene!.url;
    assert.ok(!permitOf(PAGE)(found), address); // what takes the token
  }
  assert.equal(readAddress(linked("content", "ws://other.example/stream"), metas).scene, null);
  assert.ok(permitOf(PAGE)("wss://here.example/stream"));
  assert.ok(!permitOf(PAGE)("inline:"));
  const held = readAddress(PAGE, { scene: "a", content: "inline:", settings: "data:application/json,{}" });
  assert.match(held.settings!, /^data:/);
});

test("a path of a page never becomes a host", () => {
  for (const path of ["//other.example/view/a", "///other.example/view/a", "//other.example//view/a"]) {
    const found = readAddress(`https://here.example${path}`, NONE).scene!;
    assert.equal(new URL(found.url).host, "here.example", path);
    assert.equal(new URL(found.root!).host, "here.example", path);
  }
  const plain = readAddress("https://here.example/prefix/view/a/", NONE).scene!;
  assert.deepEqual([plain.root, plain.url], ["https://here.example/prefix/", "wss://here.example/prefix/stream/a"]);
});

test("what a server says of a scene does not lead elsewhere either", async () => {
  const before = globalThis.fetch, scene = readAddress("https://here.example/view/a", NONE).scene!;
  try {
    for (const key of ["stream", "static"]) {
      for (const address of ELSEWHERE) {
        const rows = { scenes: [{ name: "a", [key]: address }] };
        globalThis.fetch = async () => new Response(JSON.stringify(rows));
        const { scene: found } = await locate(scene, permitOf(PAGE, null));
        assert.equal(new URL(found.url).host, "here.example", address);
      }
    }
  } finally {
    globalThis.fetch = before;
  }
});
