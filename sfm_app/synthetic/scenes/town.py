"""A town of streets in a grid, with houses on both sides; some houses stand in several streets.

Streets are those of `town_walk`: along x and z at multiples of PITCH_M, around `blocks` blocks in each direction, with
a ring of blocks outside, so that every street has houses on both sides; a house stands across each end of a street.
"""

from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np

from sfm_app.errors import ConfigError
from sfm_app.synthetic.scenes.bodies import Body, SyntheticScene
from sfm_app.synthetic.scenes.strewn import join_copies
from sfm_app.synthetic.town.houses import DEPTH_M, house
from sfm_app.synthetic.town.streets import street_things, town_ground
from sfm_app.synthetic.town_walk import BLOCK_M, PITCH_M, STREET_M

Random = np.random.Generator
WIDTHS_M = (6, 7, 8, 9, 10, 11)
"""Widths of houses, chosen by hand; any length from 6 on is a sum of them."""
COPIES = 4
"""Streets in which a look-alike stands at most; chosen by hand."""


@dataclass(frozen=True, slots=True)
class HousePlace:
    """Where a house stands."""

    model: int
    """Which house; look-alikes have the same number."""
    width: float
    sides: tuple[bool, bool]
    """Whether it has fronts towards its own -x and +x, too."""
    to: tuple[float, float, float]
    """Middle of its front, on the ground."""
    turn_deg: float
    """About y; the front faces +z before."""
    street: tuple[int, int]
    """Street that it stands in: direction, 0 for x and 1 for z, and number."""


@dataclass(frozen=True, slots=True)
class _Row:
    """A row of houses, by the middle of its front."""

    to: tuple[float, float, float]
    turn_deg: float
    length: float
    street: tuple[int, int]
    sides: tuple[bool, bool] = (False, False)
    """Whether its ends have fronts towards its own -x and +x, too."""
    is_end: bool = False
    """Whether it stands across the end of its street."""


def town(blocks: int = 2, look_alikes: float = 0.1, seed: int = 0) -> SyntheticScene:
    """Return the scene; it is photographed from its streets.

    Args:
        blocks: of the town along each side, without the outer ring.
        look_alikes: share of houses that stand in several streets, the same in shape and texture.
        seed: same seed, same town.

    Raises:
        ConfigError: a value is out of range.
    """
    places = defaultdict(list)
    for place in plan_houses(blocks, look_alikes, seed):
        places[place.model].append(place)
    rng = np.random.default_rng([seed, 732])
    bodies = town_ground(blocks, rng)
    for row in _rows(blocks):
        if not row.is_end:
            things = street_things(row.length, rng)
            bodies += [Body(body.shape.move(row.to, row.turn_deg), body.material) for body in things]
    for model in sorted(places):
        bodies += place_house(places[model], np.random.default_rng([seed, 733, model]))
    return SyntheticScene("town", tuple(bodies), to_light=(0.5, 0.75, 0.35), sky=0.8, bounced=0.3)


def place_house(places: list[HousePlace], rng: Random) -> list[Body]:
    """Return the bodies of one house in all its places.

    Args:
        places: of the same model.
        rng: same state, same house.
    """
    return [
        Body(join_copies([body.shape.move(place.to, place.turn_deg) for place in places]), body.material)
        for body in house(places[0].width, places[0].sides, rng)
    ]


def plan_houses(blocks: int, look_alikes: float, seed: int) -> tuple[HousePlace, ...]:
    """Return where the houses of a town stand, and which of them are the same.

    Args:
        blocks: of the town along each side, without the outer ring.
        look_alikes: share of houses that stand in several streets; less where too few have equal widths.
        seed: same seed, same plan.

    Raises:
        ConfigError: a value is out of range.
    """
    if blocks < 1 or not 0 <= look_alikes <= 1:
        raise ConfigError("synthetic town: blocks or look_alikes is out of range")
    rng = np.random.default_rng([seed, 734])
    places: list[HousePlace] = []
    for row in _rows(blocks):
        places += _fill_row(row, len(places), rng)
    return tuple(_repeat_houses(places, round(look_alikes * len(places)), rng))


def _repeat_houses(places: list[HousePlace], count: int, rng: Random) -> list[HousePlace]:
    """Return the places with look-alikes in `count` of them."""
    repeated = list(places)
    for group in _equal_widths(places, rng):
        alike = group[:count]
        if len(alike) > 1:
            count -= len(alike)
            for k in alike:
                repeated[k] = replace(places[k], model=alike[0])
    return repeated


def _fill_row(row: _Row, first: int, rng: Random) -> list[HousePlace]:
    """Return houses side by side along a row; their models are numbered from `first` on."""
    widths: list[int] = []
    while (left := round(row.length) - sum(widths)) > 0:
        fitting = [width for width in WIDTHS_M if left == width or left - width >= WIDTHS_M[0]]
        widths.append(int(rng.choice(fitting)))
    start, turn = -row.length / 2, np.radians(row.turn_deg)
    found = []
    for k, width in enumerate(widths):
        x = start + width / 2
        to = (row.to[0] + x * float(np.cos(turn)), 0.0, row.to[2] - x * float(np.sin(turn)))
        sides = row.sides[0] and k == 0, row.sides[1] and k == len(widths) - 1
        found.append(HousePlace(first + k, width, sides, to, row.turn_deg, row.street))
        start += width
    return found


def _equal_widths(places: list[HousePlace], rng: Random) -> list[list[int]]:
    """Return groups of places of houses with equal widths, without fronts at their sides, each in another street."""
    free = [k for k in rng.permutation(len(places)).tolist() if not any(places[k].sides)]
    groups: list[list[int]] = []
    for k in free:
        for group in groups:
            streets = {places[other].street for other in group}
            if len(group) < COPIES and places[group[0]].width == places[k].width and places[k].street not in streets:
                group.append(k)
                break
        else:
            groups.append([k])
    return groups


def _rows(blocks: int) -> list[_Row]:
    """Return all rows: on the sides of blocks where streets are, and across the ends of streets."""
    half, found = STREET_M / 2, []
    for i in range(-1, blocks + 1):
        for j in range(-1, blocks + 1):
            found += _block_rows(i, j, blocks)
    low, high = half - PITCH_M, PITCH_M * blocks + half + BLOCK_M
    for line in range(blocks + 1):
        across = PITCH_M * line
        found += [
            _Row((low, 0.0, across), 90.0, STREET_M, (0, line), is_end=True),
            _Row((high, 0.0, across), -90.0, STREET_M, (0, line), is_end=True),
            _Row((across, 0.0, low), 0.0, STREET_M, (1, line), is_end=True),
            _Row((across, 0.0, high), 180.0, STREET_M, (1, line), is_end=True),
        ]
    return found


def _block_rows(i: int, j: int, blocks: int) -> list[_Row]:
    """Return the rows of a block; those along x have the houses at the corners."""
    x, z = (PITCH_M * k + STREET_M / 2 for k in (i, j))
    west, east, south, north = (0 <= k <= blocks for k in (i, i + 1, j, j + 1))
    start, end = z + DEPTH_M * south, z + BLOCK_M - DEPTH_M * north
    along = (x + BLOCK_M / 2, (start + end) / 2)
    found = []
    if south:
        found.append(_Row((along[0], 0.0, z), 180.0, BLOCK_M, (0, j), (east, west)))
    if north:
        found.append(_Row((along[0], 0.0, z + BLOCK_M), 0.0, BLOCK_M, (0, j + 1), (west, east)))
    if west:
        found.append(_Row((x, 0.0, along[1]), -90.0, end - start, (1, i)))
    if east:
        found.append(_Row((x + BLOCK_M, 0.0, along[1]), 90.0, end - start, (1, i + 1)))
    return found
