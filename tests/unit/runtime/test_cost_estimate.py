"""What a run will cost: it grows as it should, and it is kept within the memory that is allowed."""

import math
import re

import pytest

from sfm_app.meshing.refinement import MOST_KEPT_PX
from sfm_app.pipeline import NAMES
from sfm_app.runtime import cost_estimate
from sfm_app.runtime.cost_estimate import cache_gb, choose_plan, largest_photo_megapixels, make_plan
from sfm_app.settings import Settings
from sfm_app.types import Photo

STAGES = NAMES[1:]
DRAFT = Settings.from_mapping({"quality": "draft"})


def photos(count, width=4000, height=3000):
    return [Photo(f"{number}.jpg", width, height, "") for number in range(count)]


def test_a_run_is_put_into_one_line():
    text = make_plan(photos(200), Settings(), 2).text(STAGES)
    cost = r"about \d+ minutes or more; \d+\.\d GB with 2 workers"
    assert re.fullmatch(rf"200 photos, 6000 pairs: {cost}", text) and len(text) <= 74  # and an indent
    assert " or more" not in make_plan(photos(200), Settings(), 2).text(["match_graph"])
    assert make_plan(photos(2), DRAFT, 1).text(["files"]).split(": ")[1].startswith("a minute at most; ")
    assert make_plan(photos(8), Settings(), 2).text(STAGES).split(": ")[1].startswith("a minute or two; ")


@pytest.mark.parametrize(("count", "low", "high"), [(10, 1, 5), (100, 20, 45), (200, 60, 150)])
def test_minutes_are_those_of_the_benchmark_to_a_factor(count, low, high):
    every = Settings.from_mapping({"matching": {"pairs": "all"}})
    assert low < make_plan(photos(count), every, 2).minutes(STAGES) < high


def test_all_pairs_and_nothing_else_grow_as_the_square():
    every = Settings.from_mapping({"matching": {"pairs": "all"}})
    once, twice = (make_plan(photos(count), every, 2).core_seconds for count in (1000, 2000))
    growth = {name: twice[name] / once[name] for name in STAGES}
    assert all(3.5 < growth[name] < 4.1 for name in ("match_graph", "view_graph", "intrinsics"))
    assert all(growth[name] <= 2.0 for name in ("scene", "depth_maps", "mesh", "texture"))


def test_chosen_pairs_grow_with_the_photos():
    once, twice = (make_plan(photos(count), Settings(), 2).core_seconds for count in (1000, 2000))
    assert all(twice[name] <= 2.001 * once[name] for name in STAGES)


def test_a_draft_is_cheaper():
    normal, draft = (make_plan(photos(50), settings, 2) for settings in (Settings(), DRAFT))
    assert draft.minutes(STAGES) < 0.5 * normal.minutes(STAGES)
    assert draft.peak_mb(STAGES) < normal.peak_mb(STAGES)


def test_workers_are_as_many_as_the_memory_holds():
    chosen = [choose_plan(photos(20), Settings(), 16, limit, STAGES) for limit in (math.inf, 6000, 3000, 100)]
    assert chosen[0].workers == 16 > chosen[1].workers > chosen[2].workers >= chosen[3].workers == 1
    assert all(plan.peak_mb(STAGES) <= limit for plan, limit in zip(chosen[1:3], (6000, 3000), strict=True))


def test_small_photos_need_little():
    assert make_plan(photos(11, 640, 480), Settings(), 2).peak_mb(STAGES) < 1700


@pytest.mark.parametrize(("limit_gb", "low", "high"), [(1, 2, 2), (1.8, 12, 24), (3, 120, 240)])
def test_photos_may_be_as_large_as_one_worker_can_paint_with(limit_gb, low, high):
    largest = largest_photo_megapixels(1000 * limit_gb)
    assert low <= largest <= high
    side = int((1e6 * largest) ** 0.5)
    if largest > 2:
        assert make_plan(photos(10, side, side), DRAFT, 1, 1000 * limit_gb).memory_mb["texture"] <= 1000 * limit_gb


def test_fusion_keeps_what_is_left():
    assert [cache_gb(limit) for limit in (500, 3500, math.inf)] == [0.25, 2.0, 64.0]


def test_two_hundred_photos_of_twelve_megapixels_need_no_more_than_eight_gigabytes():
    plan = choose_plan(photos(200), Settings(), 8, 8000, STAGES)
    assert plan.peak_mb(STAGES) <= 8000 and plan.workers >= 2
    assert 3000 < make_plan(photos(200), Settings(), 2).memory_mb["mesh"] < 8000


def test_the_estimate_knows_how_many_photos_the_refinement_holds():
    assert cost_estimate.REFINED_AT_ONCE_MP * 1e6 == MOST_KEPT_PX


def test_finer_features_cost_minutes_by_pixels_and_workers():
    sizes = [(1200, 1600)] * 23
    alone, two = (cost_estimate.finer_minutes(sizes, Settings(), workers) for workers in (1, 2))
    assert 2.0 < alone < 4.0 and two == pytest.approx(alone / 2)
    capped = Settings.model_validate({"matching": {"max_image_size_px": 800}})
    assert cost_estimate.finer_minutes(sizes, capped, 1) == pytest.approx(alone / 4)


@pytest.mark.parametrize(
    ("minutes", "text"),
    [(0.5, "a minute at most"), (1.4, "a minute or two"), (2.6, "about 3 minutes"), (13.0, "about 15 minutes")],
)
def test_expected_minutes_are_rounded_in_words(minutes, text):
    assert cost_estimate.minutes_text(minutes) == text
