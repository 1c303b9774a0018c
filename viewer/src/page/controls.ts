// Small controls that several parts of the page use: buttons of actions, switches, choices, sliders.

import type { Actions } from "./actions.ts";
import { make, on, setText } from "./dom.ts";
import { icon } from "./icons.ts";
import type { IconName } from "./icons.ts";
import { text } from "./words.ts";

export function actionButton(actions: Actions, id: string, withLabel = false): HTMLButtonElement {
  const action = actions.get(id);
  const hint = action.key ? text("action.hint", { label: action.label, key: keyName(action.key) }) : action.label;
  const button = make("button", { type: "button", class: withLabel ? "text" : "tool", title: hint, "data-action": id });
  if (action.icon) button.append(icon(action.icon));
  if (withLabel) button.append(action.label);
  else button.setAttribute("aria-label", action.label);
  if (action.key && action.key !== "?") button.setAttribute("aria-keyshortcuts", action.key.toUpperCase());
  on(button, "click", () => actions.run(id));
  actions.watch(() => {
    button.hidden = action.available?.() === false;
    if (action.pressed) button.setAttribute("aria-pressed", String(action.pressed()));
  });
  return button;
}

export function keyName(key: string): string {
  return key.length === 1 ? key.toUpperCase() : key;
}

export interface Choice<T extends string> {
  value: T;
  label: string;
  icon?: IconName;
}

/** Radio buttons that look like one control. `refresh` shows the choice of `current` again. */
export function choices<T extends string>(
  name: string, label: string, options: readonly Choice<T>[], current: () => T, choose: (value: T) => void,
  look = "segments",
): { element: HTMLFieldSetElement; refresh(): void } {
  const inputs = options.map(
    (option) => make("input", { type: "radio", name, value: option.value, id: `${name}-${option.value}` }),
  );
  const element = make("fieldset", { class: look }, make("legend", {}, label));
  options.forEach((option, i) => {
    on(inputs[i], "change", () => choose(option.value));
    const text = make("span", {}, option.label);
    const shown = make(
      "label", { for: inputs[i].id, title: option.label }, option.icon ? icon(option.icon) : null, text,
    );
    element.append(inputs[i], shown);
  });
  const refresh = (): void => inputs.forEach((input) => (input.checked = input.value === current()));
  refresh();
  return { element, refresh };
}

/** A switch with a label and a line below it. */
export function toggle(
  label: string, text: string, current: () => boolean, change: (on: boolean) => void,
): { element: HTMLLabelElement; refresh(): void } {
  const input = make("input", { type: "checkbox", role: "switch" });
  on(input, "change", () => change(input.checked));
  const element = make(
    "label", { class: "switch" }, make("span", {}, label, text ? make("small", {}, text) : null), input,
  );
  const refresh = (): void => void (input.checked = current());
  refresh();
  return { element, refresh };
}

interface Scale {
  low: number;
  high: number;
  step: number;
  text(value: number): string;
}

export function slider(
  id: string, label: string, scale: Scale, current: () => number, change: (value: number) => void,
): { element: HTMLDivElement; refresh(): void } {
  const input = make("input", { type: "range", id, min: scale.low, max: scale.high, step: scale.step });
  const output = make("output", { for: id });
  const refresh = (): void => {
    input.value = String(current());
    input.setAttribute("aria-valuetext", scale.text(current()));
    setText(output, scale.text(current()));
  };
  on(input, "input", () => {
    change(Number(input.value));
    refresh();
  });
  refresh();
  return { element: make("div", { class: "slider" }, make("label", { for: id }, label), output, input), refresh };
}
