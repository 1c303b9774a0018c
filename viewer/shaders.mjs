// Programs of the GPU travel without comments, indentation and long names; none of them means anything around them.
const TYPES = "float|int|uint|bool|[ui]?vec[234]|mat3|Chunk|struct";

/** Return the source of `shaders.ts` with what stands in its templates made short. */
export function shorten(source) {
  const plain = source.replace(/[ \t]*\/\/.*$/gm, "").replace(/^[ \t]+/gm, "");
  const kept = new Set([...plain.matchAll(/\b(?:uniform|in|out) \w+ ([\w, ]+)[;[]/g)].flatMap(([, names]) => names.split(", ")));
  const names = new Map();
  for (const [, name] of plain.matchAll(new RegExp(`\\b(?:${TYPES}) (\\w{4,})`, "g"))) {
    if (!kept.has(name) && !names.has(name) && name !== "main") names.set(name, `_${names.size.toString(36)}`);
  }
  return overTemplates(plain, (text) => text
    .replace(/\b[A-Za-z]\w{3,}/g, (name) => names.get(name) ?? name)
    .replace(/ ?([=*<>?]|[<>=!+*]=|&&|\|\||[-+/:,;({]) /g, "$1").replace(/([;{},]) ?\n/g, "$1").replace(/\b0(\.\d)/g, "$1"));
}

/** Apply `work` to the texts of template literals, not to the code inside and around them. */
function overTemplates(source, work) {
  const inside = []; // kinds of the braces and templates that are open
  let out = "", text = "";
  for (let k = 0; k < source.length; k++) {
    const letter = source[k], last = inside.at(-1), opens = last === "`" && source.startsWith("${", k);
    if (last === "`" && !opens && letter !== "`") {
      text += letter;
      continue;
    }
    out += work(text) + (opens ? "${" : letter);
    text = "";
    if (opens) k += inside.push("{") && 1;
    else if (letter === "`") last === "`" ? inside.pop() : inside.push("`");
    else if (letter === "{") inside.push("{");
    else if (letter === "}") inside.pop();
  }
  return out;
}
