"use strict";

// The walk of gsvis.color.epsilon.Staircase, step for step; a test runs both with the same answers.
class Staircase {
  constructor(rule) {
    this.rule = rule;
    this.rung = rule.first;
    this.visited = [];
    this.answers = [];
    this.reversals = [];
    this.stuck = 0;
  }

  get epsilon() { return this.rule.rungs[this.rung]; }
  get needed() { return this.rule.discard + this.rule.reversals; }
  get isStuck() { return this.stuck >= this.rule.stuck; }

  get finished() {
    return this.reversals.length >= this.needed || this.isStuck || this.answers.length >= this.rule.max_trials;
  }

  answer(detected) {
    const rule = this.rule, trial = this.answers.length, last = rule.rungs.length - 1;
    if (trial && detected !== this.answers[trial - 1]) this.reversals.push(trial);
    this.visited.push(this.rung);
    this.answers.push(detected);
    this.stuck = this.rung === (detected ? last : 0) ? this.stuck + 1 : 0;
    const turned = this.reversals.length;
    const size = turned < rule.coarse.length ? rule.coarse[turned] : 1;
    this.rung = Math.min(Math.max(this.rung + (detected ? size : -rule.up_steps * size), 0), last);
  }

  result() {
    const rule = this.rule, last = rule.rungs.length - 1;
    let counted = this.reversals.slice(rule.discard);
    counted = counted.slice(counted.length % 2);
    const at = counted.map((trial) => this.visited[trial]);
    const atBound = at.filter((rung) => rung === 0 || rung === last).length;
    let reason = "converged";
    if (this.isStuck) reason = "stuck";
    else if (this.reversals.length < this.needed) reason = "too few";
    else if (atBound > rule.most_at_bound * at.length) reason = "at a bound";
    let epsilon = this.epsilon, error = null;
    if (at.length && !this.isStuck) {
      const logarithms = at.map((rung) => Math.log(rule.rungs[rung]));
      epsilon = Math.exp(mean(logarithms));
      error = standardError(logarithms, rule.down_step);
    }
    const trials = this.visited.map((rung, trial) => [rule.rungs[rung], this.answers[trial]]);
    return { epsilon, standard_error: error, converged: reason === "converged", reason, trials };
  }
}

function mean(values) { return values.reduce((sum, value) => sum + value, 0) / values.length; }

function standardError(values, step) {
  const pairs = [];
  for (let i = 0; i + 1 < values.length; i += 2) pairs.push((values[i] + values[i + 1]) / 2);
  const n = pairs.length, middle = mean(pairs);
  if (n < 4) return null;
  const batch = Math.round(Math.sqrt(n)), squares = [];
  for (let i = 0; i + batch <= n; i++) squares.push((mean(pairs.slice(i, i + batch)) - middle) ** 2);
  return Math.sqrt((batch / (n - batch)) * mean(squares) + step ** 2 / 12);
}

function shuffled(count) {
  const order = Array.from({ length: count }, (_, i) => i);
  for (let i = count - 1; i > 0; i--) {
    const j = Math.floor(Math.random() * (i + 1));
    [order[i], order[j]] = [order[j], order[i]];
  }
  return order;
}

class Test {
  constructor(data) {
    this.data = data;
    this.staircase = new Staircase(data.rule);
    this.views = [];
    this.sides = [];
    this.queue = [];
    this.odd = null; // "A" or "B": the one that differs; null between trials
  }

  async show() {
    const { pictures, reference, approximations } = this.data;
    if (!this.queue.length) this.queue = shuffled(reference.length);
    const view = this.queue.pop(), odd = Math.random() < 0.5 ? "A" : "B";
    const same = reference[view], other = approximations[view][this.staircase.rung];
    const shown = { reference: same, A: odd === "A" ? other : same, B: odd === "B" ? other : same };
    await Promise.all(Object.entries(shown).map(([name, picture]) => {
      const image = byId("image-" + name);
      image.src = this.data.prefix + pictures[picture];
      return image.decode();
    }));
    this.views.push(view);
    this.sides.push(odd);
    byId("trial").textContent = "Trial " + (this.staircase.answers.length + 1);
    byId("progress").value = this.staircase.reversals.length;
    byId("pictures").classList.remove("blank");
    setTimeout(() => { this.odd = odd; }, 150); // no answer before the pictures were seen
  }

  choose(choice) {
    if (this.odd === null) return;
    const detected = choice === this.odd;
    this.odd = null;
    this.staircase.answer(detected);
    byId("pictures").classList.add("blank");
    // A gray moment between trials: a change of picture would tell by its flicker.
    setTimeout(() => (this.staircase.finished ? this.end() : this.show().catch(failed)), 350);
  }

  end() {
    const found = this.staircase.result(), count = found.trials.length;
    const right = found.trials.filter((trial) => trial[1]).length;
    byId("found").textContent = found.epsilon.toPrecision(3);
    byId("spread").textContent = found.standard_error === null ? "" : "one standard error: "
      + (found.epsilon * Math.exp(-found.standard_error)).toPrecision(3) + " to "
      + (found.epsilon * Math.exp(found.standard_error)).toPrecision(3);
    byId("count").textContent = String(count);
    byId("right").textContent = Math.round((100 * right) / count) + "% right";
    byId("verdict").textContent = VERDICTS[found.reason](found.epsilon);
    byId("test").hidden = true;
    byId("result").hidden = false;
    byId("result-title").focus();
    byId("json").textContent = this.saved(found);
  }

  saved(found) {
    const { up_steps, stuck, most_at_bound, rungs, first, ...rule } = this.data.rule;
    const screen = {
      width: window.screen.width, height: window.screen.height, device_pixel_ratio: window.devicePixelRatio,
      picture_width: this.width,
    };
    const provenance = {
      ...this.data.provenance, note: byId("note").value.trim(), screen, views: this.views, sides: this.sides,
    };
    return JSON.stringify({ format: "gsvis-epsilon", version: 1, ...found, rule, provenance }, null, 1);
  }
}

const VERDICTS = {
  converged: (epsilon) => "Your answers settled. Where changes of a color up to " + epsilon.toPrecision(2) + " (of 1, from"
    + " black to white) are left out, you can tell in three of four trials; with smaller ones you mostly guess.",
  stuck: () => "Your answers ran to the end of the ladder, so this is no threshold, only a bound of it.",
  "too few": () => "Your answers did not settle within the trials there are; treat the figure as a rough one.",
  "at a bound": () => "Many answers lie at the end of the ladder, so this is no threshold, only a bound of it.",
};

const byId = (id) => document.getElementById(id);

function failed(error) { byId("trial").textContent = "This browser cannot show the pictures: " + error.message; }

function prepare() {
  const data = JSON.parse(byId("data").textContent);
  let test = null;
  const start = () => {
    test = new Test(data);
    byId("intro").hidden = byId("result").hidden = true;
    byId("test").hidden = false;
    byId("progress").max = test.staircase.needed;
    byId("test").scrollIntoView();
    test.show().then(() => { test.width = byId("image-A").getBoundingClientRect().width; }).catch(failed);
  };
  byId("start").addEventListener("click", start);
  byId("again").addEventListener("click", start);
  for (const side of ["A", "B"]) byId("choose-" + side).addEventListener("click", () => test.choose(side));
  document.addEventListener("keydown", (event) => {
    if (byId("test").hidden || event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
    const side = { a: "A", b: "B", arrowleft: "A", arrowright: "B" }[event.key.toLowerCase()];
    if (!side) return;
    event.preventDefault();
    test.choose(side);
  });
  byId("note").addEventListener("input", () => { byId("json").textContent = test.saved(test.staircase.result()); });
  byId("save").addEventListener("click", () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([byId("json").textContent + "\n"], { type: "application/json" }));
    link.download = "epsilon.json";
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  });
}

if (typeof document !== "undefined") prepare();
else module.exports = { Staircase };
