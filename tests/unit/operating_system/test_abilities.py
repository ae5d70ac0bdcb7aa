"""Which system has what, and what tests take away."""

import pytest

from sfm_app.operating_system import VARIABLE, Ability, find_abilities, lacks, missing_abilities


@pytest.mark.parametrize(
    ("platform", "has", "misses"),
    [
        ("linux", Ability.CONTAINERS, None),
        ("darwin", Ability.GROUPS, Ability.CORES),
        ("win32", Ability.LINKS, Ability.CLOSED_INPUT),
        ("freebsd14", Ability.CLOSED_INPUT, Ability.CONTAINERS),
    ],
)
def test_every_system_has_its_own(platform, has, misses):
    found = find_abilities(platform, {})

    assert has in found and misses not in found


def test_what_is_named_is_taken_away():
    found = find_abilities("linux", {VARIABLE: "links, process groups,"})

    assert set(Ability) - found == {Ability.LINKS, Ability.GROUPS}
    assert find_abilities("linux", {VARIABLE: ",".join(Ability)}) == frozenset()


def test_what_is_misspelled_is_refused():
    with pytest.raises(ValueError, match="lnks"):
        find_abilities("linux", {VARIABLE: "lnks"})


def test_what_is_missing_can_be_said(without):
    before = missing_abilities()
    without(Ability.LINKS)

    assert lacks(Ability.LINKS) and set(missing_abilities()) == {*before, "links"}
