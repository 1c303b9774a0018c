"""The rows of docs/results.md about what people do with a scene: stream, edit, look at it; see results_rows.py."""

from __future__ import annotations

from results_pages import Row, Section

__all__ = ["USE"]

_WIRE = "a Gaussian with id, rows of chunks and the message, at 10 Mbit/s"

USE = (
    Section(
        "Does streaming help a viewer?",
        "streaming",
        (
            Row(
                "QoE of a step less the best rival's, nika at 1, 3, 10, 30 Mbit/s, lower end of 95%?",
                (
                    "streaming_rivals: the same, lower end of its interval, 1 Mbit/s, nika",
                    "streaming_rivals: the same, lower end of its interval, 3 Mbit/s, nika",
                    "streaming_rivals: the same, lower end of its interval, 10 Mbit/s, nika",
                    "streaming_rivals: the same, lower end of its interval, 30 Mbit/s, nika",
                ),
                ours="{0:.2f}, {1:.2f}, {2:.3f}, {3:.2f}",
                peer="LapisGS-like layers",
                target="> 0",
            ),
            Row(
                "Outside of cells, bytes until 35 dB over those of the nearest cell's set (rooms, showroom)? At an idle"
                " link's end, which share of records?",
                (
                    "nothing_withheld: rooms, outside: bytes until 35 dB, against the nearest cell's set, median",
                    "nothing_withheld: showroom, outside: bytes until 35 dB, against the nearest cell's set, median",
                    "nothing_withheld: showroom, outside: least share of records at the end",
                ),
                ours="{0:.2f}, {1:.2f}; {2:.0%}",
                target="≤ 1; 100%",
                verdict="missed in the showroom",
            ),
            Row(
                "How near does what a client ends with come to the scene, nika and showroom, 12 unseen views, worst?",
                (
                    "client_ends: nika, every record: mean",
                    "client_ends: nika, every record: worst view",
                    "client_ends: showroom, every record: mean",
                    "client_ends: showroom, every record: worst view",
                ),
                ours="{0:.1f}, {1:.1f} dB; {2:.1f}, {3:.1f} dB",
                target="≥ 48, 50 dB; worst 6 below",
            ),
            Row(
                "How many viewers at 10 Mbit/s does a core serve, and two; how long do a cold plan and a tick take?",
                (
                    "abr_planning: cells see 100%, fov-first: cold, median",
                    "abr_planning: showroom: 50 clients, a tick of one, mean",
                    "abr_planning: showroom, fov-first: cold, median",
                    "server_load: 60 viewers: viewers by CPU",
                    "server_processes: viewers of two processes over those of one",
                ),
                ours="{3:.0f}, two {4:.1f} times; {0:.0f}, {2:.0f} ms; {1:.1f} ms",
                target="≥ 60, 1.8 times; ≤ 10, 0.5 ms",
            ),
            Row(
                "Bytes of a Gaussian on disk, terms included, visible sets not: showroom, nika?",
                (
                    "disk_size: a Gaussian with its terms, target SOG, showroom",
                    "disk_size: a Gaussian with its terms, target SOG, nika",
                ),
                ours="{0:.2f}, {1:.1f}; three levels",
                peer="SOG, one level: 11.92, 23.4",
                target="< SOG",
            ),
            Row(
                "Bytes of a Gaussian on the wire, showroom and nika; there coarse?",
                (
                    f"group_codec: showroom3, as they are: {_WIRE}",
                    f"group_codec: nika1, as they are: {_WIRE}",
                    f"group_codec: showroom3, coarse: {_WIRE}",
                    f"group_codec: nika1, coarse: {_WIRE}",
                    "group_codec: showroom3, coarse: against the records as they are, mean view",
                    "group_codec: nika1, coarse: against the records as they are, mean view",
                ),
                ours="{0:.1f}, {1:.1f}; {2:.1f}, {3:.1f} ({4:.1f}, {5:.1f} dB)",
                target="≤ 10",
            ),
            Row(
                "How many records are sent twice; how far is a simulation from a real exchange, in bytes?",
                (
                    "streaming: records sent twice, all scenes",
                    "shaped_link: cooked_3gp/norway_bus_1: largest difference in bytes, from 2 s on",
                ),
                ours="{0:g}; {1:.1%} at most",
                target="0; ≤ 10%",
            ),
        ),
    ),
    Section(
        "Does editing keep what matters?",
        "edit",
        (
            Row(
                "What of floaters, fog and interior put in does `clean` find, at least: built-in scenes, real ones?",
                (
                    "clean: built-in scenes: least recall of floaters",
                    "clean: built-in scenes: least recall of fog",
                    "clean: built-in scenes: least recall of interior",
                    "clean: real scenes: least recall of floaters",
                    "clean: real scenes: least recall of fog",
                    "clean: real scenes: least recall of interior",
                ),
                ours="{0:.2f}, {1:.2f}, {2:.2f}; real {3:.2f}, {4:.2f}, {5:.2f}",
                target="≥ 0.95",
            ),
            Row(
                "How long does `clean` take for 1 M Gaussians, quiet and beside a busy process, and how much memory?",
                (
                    "clean: 1,000,000 Gaussians: time on a quiet machine",
                    "clean: 1,000,000 Gaussians: time beside one busy process on two cores",
                    "clean: 1,000,000 Gaussians: peak memory",
                ),
                ours="{0:.0f}, {1:.0f} s, {2:.2f} GB",
                target="≤ 60 s, ≤ 2 GB",
            ),
        ),
    ),
    Section(
        "Does it scale beyond the memory?",
        "world",
        (
            Row(
                "What does a world of 12 M cost, one cell a tile; of 108 M a district, and its exponent against 1.4 M?",
                (
                    "world_large: processor time",
                    "world_large: peak PSS",
                    "world_district: largest worker, RSS",
                    "world_district: exponent of all",
                    "world_district: exponent of spaces",
                    "world_district: exponent of packages",
                    "clean_nine_copies: exponent of processor time of clean",
                ),
                ours="{0:.0f} core min, {1:.1f} GB; {2:.1f} GB a worker; ≥ {3:.2f}, spaces {4:.2f}, packages {5:.2f},"
                " clean {6:.2f}",
                target="≤ 480 (4 hours of two), 6 GB; 4 GB, 1.05 each",
                verdict="missed",
            ),
            Row(
                "A walk over borders against one package, two real flats and a built-in street: bytes, frames lost?",
                (
                    "world_walk_real: bytes of the walk over those of one package",
                    "world_walk_real: frames below 35 dB that one package does not have",
                    "world_walk_real: Gaussians that came twice",
                    "world_walk: bytes of the walk over those of one package",
                    "world_walk: frames below 35 dB that one package does not have",
                    "world_walk: Gaussians that came twice",
                ),
                ours="{0:.3f}, {1:.0f} below 35 dB, {2:.0f} sent twice; {3:.3f}, {4:.0f}, {5:.0f}",
                target="≤ 1.03, 0, 0",
            ),
            Row(
                "A server of 101.5 M Gaussians with 20 viewers: memory; first image of one viewer after a package's?",
                (
                    "world_serving: RSS of its server with 20 viewers, peak",
                    "world_serving: first image of 20 dB, one viewer: world minus package",
                    "world_serving: the same, 20 viewers at once",
                ),
                ours="{0:.2f} GB; {1:.2f} s ({2:.2f} s with 20 at once)",
                target="≤ 2 GB, 0.2 s",
            ),
            Row(
                "How far apart are a dry run and its world, worst of held-out worlds: time, peak memory, bytes?",
                (
                    "world_estimate: processor time, the larger over the smaller, worst of all",
                    "world_estimate: peak PSS, the larger over the smaller, worst of all",
                    "world_estimate: bytes of the world, the larger over the smaller, worst of all",
                ),
                ours="{0:.2f}, {1:.2f}, {2:.2f} times",
                target="≤ 1.3",
            ),
            Row(
                "Do commands keep to `--max-memory`: the peak of any over the least that it accepts?",
                (
                    "max_memory: peak over the least limit, pvs",
                    "max_memory: peak over the least limit, prepare",
                    "max_memory: peak over the least limit, color",
                ),
                ours="at most {0:.2f} (`prepare` {1:.2f}, `color` {2:.2f})",
                target="≤ 1",
            ),
        ),
    ),
    Section(
        "Can it be looked at in a browser?",
        "viewer",
        (
            Row(
                "How soon does the page show showroom, on loopback, without a GPU? Its bytes, beside a client's?",
                (
                    "viewer_load: first picture",
                    "viewer_load: complete",
                    "viewer_bytes: largest difference in bytes, from 1 s on",
                ),
                ours="first picture {0:.2f} s, all of 9.5 MB {1:.2f} s, quiet; {2:.0%} at 10 Mbit/s",
                target="≤ 1 s, 1.5 s, 10%",
            ),
            Row(
                "How soon has a static site of showroom come for a view of 20 and 35 dB, at 30 ms and 30 Mbit/s?",
                (
                    "static_seconds: chromium, 30 ms, 30 Mbit/s, first view: 20 dB",
                    "static_seconds: chromium, 30 ms, 30 Mbit/s, first view: 35 dB",
                    "static_seconds: chromium, 30 ms, 30 Mbit/s, eyes in cells: 20 dB",
                    "static_seconds: chromium, 30 ms, 30 Mbit/s, eyes in cells: 35 dB",
                ),
                ours="first view {0:.1f}, {1:.1f} s; eyes in cells {2:.1f}, {3:.1f} s; one visit an eye, quiet",
                peer="form 3: 29 s, more than 70 s",
                target="≤ 1.5, 3 s",
            ),
            Row(
                "Does a visitor who walks by the keys for 500 minutes pass a wall: two rooms, flat, showroom?",
                (
                    "walls: wall passes, builtin:two_rooms",
                    "walls: wall passes, builtin:flat",
                    "walls: wall passes, showroom, LOD 2",
                ),
                ours="{0:.0f}, {1:.0f}, {2:.0f} passes",
                target="0",
            ),
        ),
    ),
)
