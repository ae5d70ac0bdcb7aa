"""One grid index for every camera, so that what the cameras are worth alone and in pairs has a large sum.

Max-sum message passing is Pearl's (1988).
"""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

MESSAGE_ROUNDS, DAMPING = 30, 0.5
"""Most rounds of max-sum message passing, and the share of the previous message that a new one keeps. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""


def best_places(own: FloatArray, between: dict[tuple[int, int], FloatArray]) -> IndexArray:
    """Choose a grid index for every camera so that the sum over cameras and over pairs of cameras is large.

    Damped max-sum message passing (Pearl 1988; exact on trees), then coordinate ascent. Ascent also starts from the
    best index of each camera by itself, which messages on loops do not always outdo.

    Args:
        own, between: (C, G) value of each camera by itself; (G, G) value of two cameras i < j together, by (i, j).
    """
    tables = {(i, j): table for (i, j), table in between.items()} | {(j, i): t.T for (i, j), t in between.items()}
    messages = {edge: np.zeros(own.shape[1]) for edge in tables}
    for _ in range(MESSAGE_ROUNDS):
        belief = own.copy()
        for (_, to), message in messages.items():
            belief[to] += message
        for (source, to), table in tables.items():
            new = np.max((belief[source] - messages[to, source])[:, None] + table, axis=0)
            messages[source, to] = DAMPING * messages[source, to] + (1.0 - DAMPING) * (new - np.max(new))
    belief = own.copy()
    for (_, to), message in messages.items():
        belief[to] += message
    ends = [_ascend_coordinates(np.argmax(start, axis=1), own, tables) for start in (belief, own)]
    return max(ends, key=lambda places: _total_gain(places, own, between))


def _ascend_coordinates(places: IndexArray, own: FloatArray, tables: dict[tuple[int, int], FloatArray]) -> IndexArray:
    """Give every camera in turn its best index, with the others fixed, until none changes."""
    places = places.astype(np.int64)
    for _ in range(MESSAGE_ROUNDS):
        before = places.copy()
        for camera in range(len(places)):
            value = own[camera].copy()
            for (source, to), table in tables.items():
                if to == camera:
                    value += table[places[source]]
            places[camera] = int(np.argmax(value))
        if np.array_equal(places, before):
            break
    return places


def _total_gain(places: IndexArray, own: FloatArray, between: dict[tuple[int, int], FloatArray]) -> float:
    shared = sum(float(table[places[i], places[j]]) for (i, j), table in between.items())
    return float(np.sum(own[np.arange(len(places)), places])) + shared
