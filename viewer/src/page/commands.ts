// What buttons and keys do: names, keys and icons of everything that the page can be asked for.

import type { Actions } from "./actions.ts";
import { text } from "./words.ts";

/** What the page offers; states are asked whenever something has changed. */
export interface Commands {
  explains(): boolean; // what is for engineers is offered
  inspecting(): boolean;
  toggleInspecting(): void;
  authors(): boolean; // who looks may edit the settings
  authorShown(): boolean;
  toggleAuthor(): void;
  optionsShown(): boolean;
  toggleOptions(): void;
  statisticsShown(): boolean;
  toggleStatistics(): void;
  share(): void;
  savePicture(): void;
  cellsKnown(): boolean;
  toggleCells(): void;
  nextPaint(): void;
  goHome(): void;
  views(): number;
  stepView(by: number): void;
  nextMode(): void;
  animated(): boolean;
  togglePlaying(): void;
  toggleTheme(): void;
  toggleBare(): void;
  vrOffered(): boolean;
  vrOn(): boolean;
  toggleVr(): void;
  help(): void;
  toggleFull(): void;
}

export function defineActions(actions: Actions, page: Commands): void {
  const several = (): boolean => page.views() > 1;
  const all = [
    {
      id: "inspect", label: text("action.inspect"), key: "i", icon: "inspect", pressed: page.inspecting,
      available: page.explains,
      run: page.toggleInspecting,
    },
    { id: "options", label: text("action.options"), key: "o", icon: "options", pressed: page.optionsShown, run: page.toggleOptions },
    {
      id: "author", label: text("action.author"), key: "n", icon: "author", available: page.authors,
      pressed: page.authorShown, run: page.toggleAuthor,
    },
    {
      id: "statistics", label: text("action.statistics"), key: "t", icon: "statistics", pressed: page.statisticsShown,
      available: page.explains,
      run: page.toggleStatistics,
    },
    { id: "share", label: text("action.share"), key: "c", icon: "share", run: page.share },
    { id: "picture", label: text("action.picture"), key: "p", icon: "picture", run: page.savePicture },
    { id: "paint", label: text("action.paint"), key: "g", available: page.explains, run: page.nextPaint },
    { id: "cells", label: text("action.cells"), key: "b", available: () => page.explains() && page.cellsKnown(), run: page.toggleCells },
    { id: "home", label: text("action.home"), key: "r", icon: "home", run: page.goHome },
    {
      id: "previous", label: text("action.previous"), key: ",", icon: "back", available: several, run: () => page.stepView(-1),
    },
    { id: "next", label: text("action.next"), key: ".", icon: "next", available: several, run: () => page.stepView(1) },
    {
      id: "play", label: text("action.play"), key: "k", icon: "play", available: page.animated,
      run: page.togglePlaying,
    },
    { id: "mode", label: text("action.mode"), key: "m", run: page.nextMode },
    { id: "full", label: text("action.full"), key: "f", icon: "full", available: () => document.fullscreenEnabled === true,
      pressed: () => document.fullscreenElement !== null, run: page.toggleFull },
    {
      id: "vr", label: text("action.vr"), key: "v", icon: "headset", available: page.vrOffered, pressed: page.vrOn,
      run: page.toggleVr,
    },
    { id: "theme", label: text("action.theme"), key: "l", run: page.toggleTheme },
    { id: "hide", label: text("action.hide"), key: "x", run: page.toggleBare },
    { id: "help", label: text("action.help"), key: "?", icon: "help", run: page.help },
  ] as const;
  for (const action of all) actions.add(action);
}
