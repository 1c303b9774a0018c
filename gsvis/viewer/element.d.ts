export type Point = [number, number, number];
export type Mode = "orbit" | "fly" | "walk";
export type Quality = "auto" | "low" | "medium" | "high";
/** A view, in the frame and units of the scene. `fov`: degrees from the lower to the upper border. */
export interface SceneView {
    eye: Point;
    to: Point;
    fov?: number;
    mode?: Mode;
}
/** A point in the element: CSS pixels from its upper left corner, and scene units along the axis of the camera. */
export interface ScenePlace {
    x: number;
    y: number;
    depth: number;
}
/** The Gaussian with the largest weight at a pixel. */
export interface ScenePick {
    id: number;
    position: Point;
    depth: number;
    weight: number;
    opacity: number;
}
/** The element. Its events are `ready`, `progress`, `pose`, `pick`, `hotspot`, `animation` and `error`, with a `detail` each. */
export declare class GsvisViewerElement extends HTMLElement {
    #private;
    static readonly observedAttributes: readonly string[];
    constructor();
    connectedCallback(): void;
    disconnectedCallback(): void;
    attributeChangedCallback(name: string, before: string | null, now: string | null): void;
    get src(): string;
    set src(address: string);
    get settings(): string;
    set settings(address: string);
    get poster(): string;
    set poster(address: string);
    get noui(): boolean;
    set noui(bare: boolean);
    get mode(): Mode | null;
    set mode(mode: Mode | null);
    get quality(): Quality;
    set quality(quality: Quality);
    get budget(): number | null;
    set budget(gaussians: number | null);
    get eye(): Point | null;
    set eye(point: Point | null);
    get to(): Point | null;
    set to(point: Point | null);
    get up(): Point | null;
    set up(point: Point | null);
    /** Fly to a view; what it leaves out stays as it is. `jump` goes there at once. */
    flyTo(view: Partial<SceneView>, options?: {
        jump?: boolean;
    }): Promise<void>;
    /** Return where a point of the scene is drawn, perhaps outside of the picture; null behind the eye. */
    project(point: Point): Promise<ScenePlace | null>;
    /** Return the Gaussian at a point of the element, null where none is. Needs the trust of the page; see embed.md. */
    pick(x: number, y: number): Promise<ScenePick | null>;
    /** Return the picture as PNG. Needs the trust of the page. */
    screenshot(): Promise<Blob>;
    /** Play the animation of the settings, from where it is. */
    play(): Promise<void>;
    pause(): Promise<void>;
    /** Go to a second of the animation; it plays on if it plays. */
    seek(seconds: number): Promise<void>;
    /** Show another page or scene; resolves with its first picture. */
    load(src: string): Promise<void>;
}
declare global {
    interface HTMLElementTagNameMap {
        "gsvis-viewer": GsvisViewerElement;
    }
}
