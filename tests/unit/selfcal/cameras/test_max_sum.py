"""Places that are nearly always the best, and always where the graph is a tree."""

from itertools import combinations, product

import numpy as np

from sfm_app.selfcal.groups import best_places


def value_of(places, own, between):
    gain = sum(own[k, place] for k, place in enumerate(places))
    return gain + sum(table[places[i], places[j]] for (i, j), table in between.items())


def icm(own, between):
    places = list(np.argmax(own, axis=1))
    for _ in range(20):
        for k in range(len(places)):
            trials = [[*places[:k], g, *places[k + 1 :]] for g in range(own.shape[1])]
            places = max(trials, key=lambda trial: value_of(trial, own, between))
    return value_of(places, own, between)


def test_best_places_are_nearly_always_the_best():
    exact = lower = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        own, count = rng.uniform(0, 1, (4, 4)), 4
        between = {edge: rng.uniform(0, 1.5, (4, 4)) for edge in combinations(range(count), 2) if rng.random() < 0.8}
        best = max(value_of(places, own, between) for places in product(range(4), repeat=count))
        value = value_of(best_places(own, between), own, between)
        assert value <= best + 1e-12
        exact += value > best - 1e-9
        lower += value < icm(own, between) - 1e-9
    assert exact >= 32
    assert lower == 0


def test_best_places_of_a_chain_are_the_best():
    for seed in range(10):
        rng = np.random.default_rng(seed)
        own, between = rng.uniform(size=(5, 4)), {(k, k + 1): rng.uniform(0, 2, (4, 4)) for k in range(4)}
        best = max(product(range(4), repeat=5), key=lambda places: value_of(places, own, between))
        assert tuple(best_places(own, between)) == best


def test_without_pairs_every_camera_takes_its_own_best():
    assert best_places(np.array([[0, 1.0, 0], [2, 1, 0]]), {}).tolist() == [1, 0]
