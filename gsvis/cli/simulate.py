"""`gsvis simulate`: simulate what a viewer sees while scenes arrive over a link; compare two baselines."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsvis._extras import has, remedy_of
from gsvis.cli import version
from gsvis.cli.arguments import Simulate
from gsvis.cli.memory import check_simulation
from gsvis.cli.options import command_line, config_of, naming, refuse, values_of
from gsvis.cli.targets import check_exists, check_report
from gsvis.cli.terminal import Status, facts, print_json, say, show
from gsvis.errors import FormatError
from gsvis.io.poses import is_recording, load_path
from gsvis.io.sources import check_source
from gsvis.package.manifest import MANIFEST
from gsvis.package.original import Original, find_original, load_original, own_file
from gsvis.package.package import Package
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.paths import HeadPath
from gsvis.world.world import World, is_world

if TYPE_CHECKING:
    from gsvis.abr import BandwidthTrace
    from gsvis.simulate.visits import Place

__all__ = ["run_simulate"]

_MBIT = 10.0


def run_simulate(command: Simulate) -> None:
    """Simulate sessions: read, play, watch, write the report, print tables or JSON."""
    _check(command)
    check_report(command.out)
    walk = load_path(command.path)
    trace = _trace(command)
    originals = _originals(command)
    with Status() as status:
        document = _write_report(command, walk, trace, originals, status)
    from gsvis.report.session_page import content_remarks

    if command.output.json:
        for remark in content_remarks(document):
            say(remark)
        print_json(document)
    else:
        show(
            *_tables(document),
            *(f" {remark}" for remark in content_remarks(document)),
            *([] if has("matplotlib") else [f" Plots need matplotlib: {remedy_of('matplotlib')}."]),
            f" Report: {Path(command.out) / 'report.html'}",
        )


def _check(command: Simulate) -> None:
    """Raise if arguments contradict each other, or an input is missing or cannot be opened."""
    if not command.package:
        raise ValueError("PACKAGE: expected at least one package, got none")
    if command.link.trace is not None:
        refuse(command, ["mbit"], "with --trace")
    for name, given in (("scene", command.scene), ("whole_file", command.whole_file)):
        if name == "scene" and len(command.package) == 1 and is_world(command.package[0]):
            continue  # a world is made of several scenes
        if given and len(given) != len(command.package):
            spelled = "--" + name.replace("_", "-")
            raise ValueError(f"{spelled}: expected one for each package, {len(command.package)}, got {len(given)}")
    check_exists(*command.whole_file, command.link.trace, command.path)
    for scene in command.scene:
        check_source(scene, command.lod)


def _originals(command: Simulate) -> list[Original]:
    """Return the scene that each package or world was made from, before any is read; check the memory for all."""
    found = []
    sizes = []
    for k, package in enumerate(command.package):
        size, provenance = _manifest_of(package)
        sizes.append(size)
        found.append(find_original(package, provenance, _given(command, k)))
    scenes = [scene for original in found for scene in original.scenes]
    any_world = any(is_world(package) for package in command.package)
    try:
        check_simulation(sizes, scenes, command.max_memory, any_world)
    except (ValueError, FormatError, OSError) as error:
        if command.scene or not scenes:
            raise
        # Nobody named these scenes: the package is compared with itself where they cannot be used.
        check_simulation(sizes, [], command.max_memory, any_world)
        remark = f"the scene it was made from is not read: {error}"
        return [replace(each, scenes=(), remark=remark) if each.scenes else each for each in found]
    return found


def _given(command: Simulate, place: int) -> list[tuple[str, int | None]]:
    """Return the scenes of a package, or all of a world, that --scene names."""
    scenes = command.scene if len(command.package) == 1 else command.scene[place : place + 1]
    return [(scene, command.lod) for scene in scenes]


def _manifest_of(path: str) -> tuple[int, dict[str, Any]]:
    """Return the number of Gaussians and the provenance of a package or of a world, by its manifest."""
    if is_world(path) or (Path(path).is_dir() and not (Path(path) / MANIFEST).is_file()):
        m = World.open(path).manifest
        return sum(m.node(k).gaussians for k in range(len(m))), m.provenance
    with Package.open(path) as package:
        return len(package), package.manifest.info.provenance


def _trace(command: Simulate) -> BandwidthTrace:
    """Return the bandwidth of the link over time."""
    from gsvis.abr import BandwidthTrace, load_trace

    return load_trace(command.link.trace) if command.link.trace else BandwidthTrace.constant(command.link.mbit or _MBIT)


def _kind_of_link(command: Simulate) -> str:
    """Return what the link is; "recorded" only of a log of a device, because any text can be written by a program."""
    if command.link.trace is None:
        return "a constant link"
    logged = Path(command.link.trace).suffix.lower() in (".csv", ".gz")
    return "a recorded link" if logged else f"the link of {Path(command.link.trace).name}"


def _kind_of_walk(command: Simulate) -> str:
    """Return what the path is; "recorded" only of a recording of a person."""
    return "a recorded path" if is_recording(command.path) else f"the path of {Path(command.path).name}"


def _write_report(
    command: Simulate, walk: HeadPath, trace: BandwidthTrace, originals: list[Original], status: Status
) -> dict[str, Any]:
    """Simulate all visits and write the report; return its document."""
    from gsvis.abr import AbrConfig
    from gsvis.report.session_document import Simulation
    from gsvis.report.session_report import write_session_report
    from gsvis.simulate import Link, ViewingConfig
    from gsvis.simulate.visits import simulate_visits

    link = Link(trace, command.link.round_trip / 1000.0)
    shown = command.viewing
    config = config_of(ViewingConfig, shown, fine=min(3.0, shown.seconds), every=min(shown.every, shown.seconds))
    with ExitStack() as opened:
        visits = simulate_visits(
            _places(command, walk, originals, opened, status),
            walk,
            link,
            config,
            count=command.visits,
            abr=AbrConfig(policy=command.sending.policy, fill=not command.sending.no_fill),
            seed=command.seed,
            progress=status,
        )
    simulation = Simulation(
        visits,
        link,
        command_line(command),
        version(),
        {name: _plain(value) for name, value in values_of(command).items() if name not in ("json", "debug")},
        dict(status.seconds),
        _kind_of_walk(command),
        _kind_of_link(command),
    )
    return write_session_report(command.out, simulation, progress=status)


def _places(
    command: Simulate, walk: HeadPath, originals: list[Original], opened: ExitStack, status: Status
) -> list[Place]:
    """Open all packages and worlds; return them as places to simulate visits in."""
    status("reading", 0, len(command.package))
    places = []
    for k, folder in enumerate(command.package):
        whole = command.whole_file[k] if command.whole_file else None
        reference, remark = load_original(originals[k], bool(command.scene))
        own = own_file(originals[k]) if reference is not None else None
        with naming(whole_file="--whole-file"):
            place = _open_place(folder, walk, opened, command, reference, whole)
        places.append(replace(place, remark=_spell_remark(place, remark), own_file=own))
        status("reading", k + 1, len(command.package))
    return places


def _spell_remark(place: Place, remark: str) -> str:
    """Return a remark on the reference, with what to do where the package is compared with itself."""
    if not place.against:
        return remark
    return f"{remark}; compared with {place.against}: name the scene with --scene" if remark else remark


def _open_place(
    folder: str, walk: HeadPath, opened: ExitStack, command: Simulate, reference: Gaussians | None, whole: str | None
) -> Place:
    """Open a package or a world to simulate visits in."""
    terms = command.sending.terms
    if is_world(folder):
        from gsvis.world.place import open_place  # seldom needed

        given: Any = {"as_is": command.no_retarget, "seed": command.seed, "terms": terms}
        return open_place(folder, walk, reference=reference, whole_file=whole, **given)
    from gsvis.simulate.visits import Place

    package = opened.enter_context(Package.open(folder))
    return Place.open(package, reference=reference, whole_file=whole, as_is=command.no_retarget, terms=terms)


def _plain(value: Any) -> Any:
    """Return a tuple as a list, for JSON; any other value as it is."""
    return list(value) if isinstance(value, tuple) else value


def _tables(document: dict[str, Any]) -> list[Any]:
    """Return one line about the link, and a table of figures for each visit."""
    from gsvis.report.session_page import describe_eyes, format_figures

    link = document["link"]
    text = f"{link['trace']}, {link['mean_mbit_per_s']:.2f} Mbit/s, {1000 * link['round_trip']:g} ms"
    parts: list[Any] = [f" {document['title']}", f" Link: {text} there and back."]
    for visit in document["visits"]:
        header, rows = format_figures(visit["systems"])
        parts += [facts(visit["title"], rows, header), f" {describe_eyes(visit)}"]
    return parts
