"""Place the furniture in the rooms, and list the lamps with their light."""

from __future__ import annotations

from gsvis.scene.flat.charts import Chart, Look, box, disc, ellipsoid, move, plain, rectangle, tube
from gsvis.scene.flat.furniture import (
    armchair,
    bed,
    bookcase,
    chair,
    curtain,
    cushion,
    floor_lamp,
    pendant,
    pot,
    round_table,
    sofa,
    table,
    table_lamp,
)
from gsvis.scene.flat.light import Lamp
from gsvis.scene.flat.materials import cloth, marble, rug, stripes, tiles, wood
from gsvis.scene.flat.pictures import abstract, framed, hills, waves
from gsvis.scene.flat.plan import HEIGHT
from gsvis.scene.flat.plants import bush, palm, tree

__all__ = ["furniture", "lamps"]

WALNUT = wood((0.40, 0.27, 0.18), gloss=0.05)
PALE = wood((0.76, 0.62, 0.46), gloss=0.045, seed=3)
DARK = wood((0.20, 0.15, 0.12), gloss=0.05, seed=5)
WHITE = plain((0.92, 0.91, 0.89), gloss=0.05, texel=0.02)
CLAY = plain((0.72, 0.42, 0.30), texel=0.015)
CREAM = plain((0.90, 0.86, 0.77), gloss=0.06, texel=0.015)
SLATE = plain((0.28, 0.33, 0.36), gloss=0.06, texel=0.015)
STEEL = plain((0.66, 0.67, 0.68), gloss=0.30, texel=0.015)
BLACK = plain((0.045, 0.045, 0.05), gloss=0.09, texel=0.02)
SILVERED = plain((0.02, 0.02, 0.02), gloss=0.85, texel=0.03)
LINEN = cloth((0.90, 0.88, 0.83), seed=2)
WARM = (0.9, 0.66, 0.42)

SEA = waves((0.14, 0.32, 0.42), (0.80, 0.84, 0.80), 2)
DUSK = hills((0.52, 0.66, 0.76), ((0.62, 0.66, 0.70), (0.40, 0.50, 0.52), (0.26, 0.36, 0.34), (0.17, 0.22, 0.18)), 3)
DAWN = hills((0.88, 0.72, 0.62), ((0.80, 0.60, 0.52), (0.62, 0.42, 0.42), (0.40, 0.28, 0.34)), 6)
SHAPES = abstract((0.92, 0.88, 0.78), ((0.78, 0.40, 0.26), (0.17, 0.27, 0.33), (0.86, 0.68, 0.34)), 4)
ROUNDS = abstract((0.85, 0.84, 0.80), ((0.30, 0.42, 0.36), (0.74, 0.56, 0.48), (0.16, 0.17, 0.19)), 8)


def furniture() -> list[Chart]:
    """Return the charts of everything that stands in the rooms."""
    return [*_living(), *_kitchen(), *_dining(), *_bedroom(), *_hall(), *_study(), *_bath()]


def lamps() -> tuple[Lamp, ...]:
    """Return the lamps that are switched on."""
    return (
        Lamp((0.55, 3.85, 1.50), WARM),
        Lamp((7.9, 2.75, 1.62), (2.0, 1.5, 0.95)),
        Lamp((0.95, 8.3, 0.98), (0.40, 0.28, 0.17)),
        Lamp((3.35, 8.3, 0.98), (0.40, 0.28, 0.17)),
        Lamp((5.6, 5.05, 2.30), (0.9, 0.75, 0.56)),
        Lamp((8.6, 5.05, 2.30), (0.9, 0.75, 0.56)),
        Lamp((4.75, 8.2, 1.12), (0.8, 0.58, 0.34)),
        Lamp((8.7, 7.1, 2.45), (0.8, 0.72, 0.6), 0.12),
    )


def _mat(x: float, y: float, wide: float, deep: float, look: Look) -> list[Chart]:
    """Return a rug with its center at (x, y)."""
    return box((x - wide / 2, y - deep / 2, 0.0), (x + wide / 2, y + deep / 2, 0.012), look)


def _living() -> list[Chart]:
    """Return the charts of the living room."""
    teal = cloth((0.24, 0.42, 0.44), seed=4)
    rust = cloth((0.74, 0.42, 0.26), seed=6)
    mustard = cloth((0.82, 0.64, 0.28), seed=7)
    persian = rug((3.0, 2.1), (0.52, 0.16, 0.14), (0.16, 0.22, 0.34), (0.86, 0.76, 0.58))
    found = _mat(2.45, 2.15, 3.0, 2.1, persian)
    found += move(sofa(2.3, cloth((0.70, 0.68, 0.64), seed=3), (rust, mustard, teal)), (2.45, 3.78, 0.0), 180.0)
    found += move(table(1.15, 0.62, 0.42, WALNUT, WALNUT), (2.45, 2.35, 0.0))
    found += move(box((-0.15, -0.1, 0.0), (0.15, 0.1, 0.03), plain((0.75, 0.30, 0.22))), (2.15, 2.38, 0.42), 20.0)
    found += move(box((-0.13, -0.09, 0.0), (0.13, 0.09, 0.025), plain((0.85, 0.80, 0.68))), (2.15, 2.38, 0.45), -8.0)
    found += move(bush(0.30, 3, CREAM), (2.75, 2.4, 0.42))
    found.append(tube((2.5, 2.2, 0.42), 0.09, (0.035, 0.04), SLATE))
    found += move(armchair(mustard, teal), (4.65, 2.0, 0.0), 75.0)
    found += move(armchair(teal, rust), (0.95, 0.85, 0.0), -38.0)
    found += move(floor_lamp(1.65), (0.55, 3.85, 0.0))
    found += move(tree(1.95, 1, CREAM), (0.45, 3.37, 0.0))
    found += move(palm(1.35, 2, CLAY), (2.9, 0.38, 0.0))
    found += move(bookcase(1.05, 2.15, 0.30, WALNUT, 6, 1), (5.9, 3.66, 0.0), 90.0)
    found += move(framed(1.15, 0.78, DUSK), (2.1, 4.28, 1.62), 180.0)
    found += move(framed(0.46, 0.62, SHAPES, frame=(0.70, 0.55, 0.34)), (3.22, 4.28, 1.68), 180.0)
    found += move(framed(0.40, 0.40, ROUNDS), (3.80, 4.28, 1.58), 180.0)
    found += move(table(1.1, 0.36, 0.55, PALE, DARK), (5.66, 0.62, 0.0), 90.0)
    found += move(box((-0.45, -0.02, 0.06), (0.45, 0.02, 0.60), BLACK, faces="xXyYZ"), (5.74, 0.62, 0.56), 90.0)
    found += move(framed(0.5, 0.66, DAWN), (0.02, 0.66, 1.6), -90.0)
    sheer = stripes(((0.88, 0.85, 0.78), (0.84, 0.81, 0.74)), (0.09, 0.03), texel=0.02)
    for left in (0.28, 2.55, 2.98, 5.12):
        found += move(curtain(0.38, 2.42, sheer, 4.0), (left, 0.09, 0.06))
    for left in (0.92, 3.12):
        found += move(curtain(0.40, 2.42, sheer, 4.0), (0.09, left, 0.06), 90.0)
    return found + _rail((0.2, 0.09), (5.6, 0.09)) + _rail((0.09, 0.85), (0.09, 3.6))


def _rail(first: tuple[float, float], last: tuple[float, float]) -> list[Chart]:
    """Return a curtain rail between two points."""
    low = (first[0] - 0.012, first[1] - 0.012, 2.47)
    high = (last[0] + 0.012, last[1] + 0.012, 2.495)
    return box(low, high, DARK, rounded=0.011, faces="xXyYzZ")


def _kitchen() -> list[Chart]:
    """Return the charts of the kitchen."""
    front = plain((0.36, 0.46, 0.43), gloss=0.04, texel=0.02)
    stone = marble((0.86, 0.85, 0.83), (0.52, 0.50, 0.49))
    metro = tiles((0.93, 0.93, 0.91), (0.70, 0.69, 0.66), (0.2, 0.1), bond=0.5, vary=0.03)
    found = _cupboards((6.05, 0.0, 0.0), 6, 0.60, front, stone)
    found += move(_cupboards((-0.6, 0.0, 0.0), 3, 0.60, front, stone), (10.0, 1.25, 0.0), 90.0)
    found.append(rectangle((9.98, 0.008, 0.92), (-3.93, 0.0, 0.0), (0.0, 0.0, 0.2), metro))
    found.append(rectangle((9.992, 0.6, 0.92), (0.0, 1.9, 0.0), (0.0, 0.0, 0.62), metro, side=-1.0))
    found += box(
        (9.35, 2.62, 0.02), (9.97, 3.26, 1.95), plain((0.80, 0.81, 0.82), gloss=0.10, texel=0.02), rounded=0.02
    )
    found += box((9.33, 2.68, 0.75), (9.345, 2.71, 1.25), STEEL, faces="xyYzZ")
    found += box((9.62, 0.70, 1.55), (9.995, 1.15, 2.25), front, faces="xyYzZ")
    found += box((9.62, 1.78, 1.55), (9.995, 2.5, 2.25), front, faces="xyYzZ")
    found += box((9.55, 1.18, 1.62), (9.995, 1.75, 1.72), STEEL, faces="xyYzZ")
    found += box((9.44, 1.2, 0.90), (9.93, 1.75, 0.925), BLACK)
    found += box((7.55, 0.10, 0.905), (8.25, 0.50, 0.925), STEEL)
    found += box((7.62, 0.15, 0.926), (8.18, 0.45, 0.928), SLATE, faces="Z")
    found += [
        tube((7.9, 0.075, 0.92), 0.26, (0.014, 0.012), STEEL),
        *box((7.89, 0.07, 1.16), (7.91, 0.26, 1.18), STEEL, faces="xXyYzZ"),
    ]
    found += move(bush(0.26, 5, CLAY), (8.62, 0.10, 1.13)) + move(bush(0.22, 6, CREAM), (7.32, 0.10, 1.13))
    for i, look in enumerate((CLAY, CREAM, SLATE)):
        found += [
            tube((6.3 + 0.13 * i, 0.22, 0.92), 0.17 - 0.02 * i, (0.05, 0.05), look),
            disc((6.3 + 0.13 * i, 0.22, 1.09 - 0.02 * i), 0.05, PALE),
        ]
    found += [
        tube((9.68, 1.48, 0.925), 0.14, (0.10, 0.10), plain((0.70, 0.22, 0.16), gloss=0.08)),
        disc((9.68, 1.48, 1.065), 0.1, SLATE),
    ]
    found += box((8.9, 0.12, 0.92), (9.3, 0.16, 1.2), PALE)
    return found


def _cupboards(corner: tuple[float, float, float], count: int, wide: float, front: Look, top: Look) -> list[Chart]:
    """Return a row of kitchen cupboards along +x, their backs at y = 0."""
    x, y, z = corner
    found = box((x, y, z), (x + count * wide, y + 0.54, z + 0.10), DARK)
    found += box((x, y, z + 0.10), (x + count * wide, y + 0.58, z + 0.87), front)
    found += box((x - 0.01, y, z + 0.87), (x + count * wide + 0.01, y + 0.62, z + 0.905), top, faces="xXyYzZ")
    for i in range(count):
        left = x + i * wide + 0.008
        found += box((left, y + 0.58, z + 0.12), (left + wide - 0.016, y + 0.60, z + 0.855), front, faces="xXYzZ")
        found += box(
            (left + 0.2, y + 0.615, z + 0.78), (left + wide - 0.216, y + 0.628, z + 0.795), STEEL, faces="xXYzZ"
        )
    return found


def _dining() -> list[Chart]:
    """Return the charts of the dining area."""
    x = 7.9
    y = 2.75
    found = move(round_table(0.58, 0.75, PALE, WHITE), (x, y, 0.0))
    for yaw in (20.0, 112.0, 200.0, 290.0):
        found += move(move(chair(DARK, cloth((0.70, 0.52, 0.30), seed=8)), (0.0, -0.62, 0.0)), (x, y, 0.0), yaw)
    found += move(pendant(0.92, 0.24, plain((0.20, 0.34, 0.33), gloss=0.05, texel=0.015)), (x, y, HEIGHT))
    found += [tube((x, y, 0.75), 0.07, (0.08, 0.14), CREAM)]
    for i, color in enumerate(((0.86, 0.50, 0.16), (0.80, 0.24, 0.16), (0.62, 0.68, 0.22))):
        found.append(
            ellipsoid((x - 0.05 + 0.05 * i, y + 0.05 * (i % 2), 0.83), (0.042, 0.042, 0.042), plain(color, texel=0.01))
        )
    found += move(framed(0.55, 0.75, ROUNDS, frame=(0.75, 0.6, 0.4)), (7.3, 4.28, 1.6), 180.0)
    found += move(framed(0.55, 0.75, SEA, frame=(0.75, 0.6, 0.4)), (8.05, 4.28, 1.6), 180.0)
    found += move(table(1.5, 0.36, 0.78, PALE, DARK), (7.65, 4.1, 0.0))
    found += move(bush(0.4, 8, CREAM), (7.1, 4.1, 0.78)) + move(pot(0.08, 0.3, SLATE), (8.2, 4.1, 0.78))
    return found + move(palm(1.2, 9, CLAY), (9.6, 3.9, 0.0))


def _bedroom() -> list[Chart]:
    """Return the charts of the bedroom."""
    wool = stripes(
        ((0.80, 0.76, 0.68), (0.36, 0.42, 0.48), (0.80, 0.76, 0.68), (0.72, 0.50, 0.40)), (0.30, 0.05, 0.08, 0.05)
    )
    found = _mat(2.15, 6.6, 2.9, 1.7, wool)
    duvet = stripes(((0.82, 0.83, 0.85), (0.62, 0.68, 0.74)), (0.11, 0.05))
    found += move(bed(1.6, 2.05, LINEN, duvet, PALE), (2.15, 8.54, 0.0), 180.0)
    for x in (0.95, 3.35):
        found += box((x - 0.24, 8.14, 0.05), (x + 0.24, 8.58, 0.48), PALE)
        found += box((x - 0.2, 8.12, 0.27), (x + 0.2, 8.14, 0.45), WHITE, faces="xXyzZ")
        found += move(table_lamp(0.52, CREAM), (x, 8.3, 0.48))
    found += _wardrobe()
    found += move(table(1.2, 0.42, 0.80, PALE, DARK), (1.3, 4.66, 0.0))
    found += move(framed(0.7, 0.9, SILVERED.paint, frame=(0.72, 0.58, 0.36), mat=0.0), (1.3, 4.44, 1.42))
    found.append(rectangle((1.62, 4.456, 1.0), (-0.64, 0.0, 0.0), (0.0, 0.0, 0.84), SILVERED))
    found += move(bush(0.34, 11, SLATE), (0.9, 4.66, 0.80)) + move(pot(0.06, 0.2, CLAY), (1.7, 4.64, 0.80))
    found += move(framed(0.5, 0.5, DAWN, frame=(0.9, 0.9, 0.88)), (1.7, 8.58, 1.75), 180.0)
    found += move(framed(0.5, 0.5, SEA, frame=(0.9, 0.9, 0.88)), (2.6, 8.58, 1.75), 180.0)
    heavy = cloth((0.52, 0.58, 0.62), seed=12, texel=0.02)
    for left in (5.12, 7.55):
        found += move(curtain(0.42, 2.42, heavy, 4.0), (0.09, left, 0.06), 90.0)
    found += _rail((0.09, 5.05), (0.09, 8.05))
    return found + move(tree(1.5, 4, CLAY, 30), (0.45, 5.0, 0.0))


def _wardrobe() -> list[Chart]:
    """Return a wardrobe."""
    found = box((3.5, 6.25, 0.0), (4.08, 8.05, 2.25), WHITE, faces="xyYZ")
    for i in range(3):
        low = 6.27 + 0.593 * i
        found += box((3.48, low, 0.06), (3.5, low + 0.583, 2.2), WHITE, faces="xyYzZ")
        found += box((3.46, low + 0.5, 1.0), (3.472, low + 0.515, 1.25), STEEL, faces="xyYzZ")
    return found


def _hall() -> list[Chart]:
    """Return the charts of the hall."""
    runner = rug((4.2, 0.72), (0.20, 0.28, 0.36), (0.66, 0.30, 0.22), (0.88, 0.80, 0.64), 4)
    found = _mat(7.3, 5.06, 4.2, 0.72, runner)
    for x in (5.6, 8.6):
        globe = plain((1.0, 0.95, 0.86), glow=3.0, texel=0.02)
        found += [
            ellipsoid((x, 5.05, 2.53), (0.15, 0.15, 0.11), globe),
            tube((x, 5.05, 2.63), 0.07, (0.06, 0.06), STEEL),
        ]
    found += move(table(1.0, 0.30, 0.80, WALNUT, DARK), (9.82, 5.06, 0.0), 90.0)
    found += move(framed(0.62, 0.95, SEA, frame=(0.72, 0.58, 0.36), mat=0.0), (9.98, 5.06, 1.5), 90.0)
    found += move(bush(0.36, 13, CREAM), (9.82, 4.78, 0.80)) + move(table_lamp(0.42, SLATE), (9.82, 5.38, 0.80))
    for i, art in enumerate((DAWN, SHAPES, DUSK, ROUNDS)):
        found += move(framed(0.42, 0.56, art, frame=(0.12, 0.12, 0.12)), (6.75 + 0.62 * i, 4.44, 1.55))
    found += box((4.25, 5.32, 0.0), (4.6, 5.68, 0.45), WALNUT)
    found += box((6.55, 5.67, 1.65), (7.65, 5.695, 1.75), WALNUT, faces="xXyzZ")
    for i, color in enumerate(((0.20, 0.26, 0.34), (0.62, 0.50, 0.36), (0.45, 0.18, 0.16))):
        coat = cushion(
            (6.78 + 0.36 * i, 5.59, 1.22), (0.20, 0.09, 0.44 - 0.06 * i), cloth(color, seed=20 + i), power=2.4
        )
        found.append(coat)
    return found


def _study() -> list[Chart]:
    """Return the charts of the study."""
    found = move(table(1.5, 0.7, 0.74, PALE, WHITE), (5.5, 8.2, 0.0))
    found += move(box((-0.32, -0.015, 0.10), (0.32, 0.015, 0.50), BLACK, faces="xXyYzZ"), (5.45, 8.38, 0.74), 0.0)
    found += move([tube((0.0, 0.0, 0.0), 0.12, (0.10, 0.02), STEEL)], (5.45, 8.38, 0.74))
    found += move(box((-0.22, -0.07, 0.0), (0.22, 0.07, 0.02), SLATE), (5.45, 8.08, 0.74))
    found += move(table_lamp(0.48, CLAY), (4.75, 8.2, 0.74)) + move(bush(0.28, 15, CREAM), (6.05, 8.34, 0.74))
    found += move(
        armchair(cloth((0.44, 0.25, 0.18), seed=31), cloth((0.85, 0.76, 0.58), seed=32)), (6.75, 6.35, 0.0), 60.0
    )
    found += move(chair(DARK, cloth((0.30, 0.38, 0.36), seed=33)), (5.5, 7.55, 0.0), 0.0)
    for i in range(2):
        found += move(bookcase(1.15, 2.3, 0.30, WALNUT, 7, 40 + i), (4.22, 6.65 + 1.17 * i, 0.0), -90.0)
    carpet = rug((1.8, 1.3), (0.24, 0.32, 0.28), (0.62, 0.26, 0.18), (0.84, 0.74, 0.54), 11)
    found += _mat(5.75, 6.95, 1.8, 1.3, carpet)
    found += move(framed(0.8, 0.56, DUSK, frame=(0.55, 0.42, 0.26)), (7.28, 7.55, 1.65), 90.0)
    found += move(framed(0.42, 0.56, SHAPES, frame=(0.55, 0.42, 0.26)), (7.28, 6.75, 1.65), 90.0)
    return found + move(tree(1.7, 7, SLATE, 34), (6.95, 8.2, 0.0))


def _bath() -> list[Chart]:
    """Return the charts of the bathroom."""
    white = plain((0.95, 0.95, 0.94), gloss=0.09, texel=0.02)
    found = box((9.25, 6.9, 0.0), (9.98, 8.58, 0.56), white, rounded=0.05)
    found += [rectangle((9.32, 6.98, 0.565), (0.6, 0.0, 0.0), (0.0, 1.52, 0.0), plain((0.80, 0.88, 0.90), gloss=0.10))]
    found += box((7.42, 6.5, 0.45), (7.92, 7.4, 0.80), PALE) + box((7.42, 6.5, 0.80), (7.94, 7.4, 0.84), white)
    found += [
        ellipsoid((7.68, 6.95, 0.86), (0.2, 0.26, 0.09), white),
        tube((7.5, 6.95, 0.84), 0.2, (0.014, 0.012), STEEL),
    ]
    found.append(rectangle((7.425, 6.55, 1.15), (0.0, 0.8, 0.0), (0.0, 0.0, 0.9), SILVERED))
    found += box((7.42, 6.53, 1.13), (7.435, 7.37, 1.15), STEEL) + box((7.42, 6.53, 2.05), (7.435, 7.37, 2.07), STEEL)
    found += box((7.6, 8.0, 0.0), (7.98, 8.35, 0.40), white, rounded=0.08)
    found += box((7.58, 8.33, 0.35), (8.0, 8.55, 0.80), white, rounded=0.04)
    found += _mat(8.6, 7.5, 0.9, 0.6, stripes(((0.88, 0.87, 0.84), (0.30, 0.48, 0.54)), (0.10, 0.05)))
    for i, color in enumerate(((0.82, 0.48, 0.36), (0.90, 0.86, 0.76))):
        towel = cushion((9.3 + 0.36 * i, 5.86, 1.3), (0.15, 0.03, 0.32), cloth(color, seed=50 + i), power=4.0)
        found.append(towel)
    globe = plain((1.0, 0.97, 0.9), glow=3.0, texel=0.02)
    found += [ellipsoid((8.7, 7.1, 2.62), (0.2, 0.2, 0.07), globe)]
    return found + move(bush(0.34, 17, CLAY), (9.15, 8.72, 1.4))
