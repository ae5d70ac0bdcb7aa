"""Photo sets on which the program's constants were chosen, by group: results on these sets are biased in its favor.

A group names every set it has seen, whether a constant was fitted to it or only checked on it. Where nothing is
written down, all sets available at the time are named. Whoever chooses a constant on a set adds the set here.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from benchmarks.common.results import Row

STRECHA = ("fountain-P11", "castle-P19", "Herz-Jesus-P8")
WITH_TRUTH = (*STRECHA, "temple16", "merton1", "reichstag10", "lund-door12")
FIRST_EIGHT = (*WITH_TRUTH, "kermit11")
"""All sets that existed when this table was requested."""


class Group(NamedTuple):
    """Constants that were chosen together."""

    modules: tuple[str, ...]
    """Modules of sfm_app that define them."""
    sets: tuple[str, ...]
    """Photo sets that they were chosen or checked on."""
    also: str
    """Other data that they were chosen on."""
    source: str
    """Where this is documented, or that it is not."""


GROUPS: Mapping[str, Group] = {
    "fundamental matrices: scales, samples, stopping": Group(
        ("fundamental",), STRECHA, "synthetic pairs of thesis 4.8, pairs with two motions",
        "benchmarks/README.md, The parts alone; merton1 and temple16 were never tuned on",
    ),
    "chance, degeneracy, watermarks": Group(
        ("fundamental.a_contrario", "fundamental.degeneracy"), FIRST_EIGHT,
        "rendered planes, panoramas and logos", "docs/algorithms/lev-ransac.md: looked at on all real sets",
    ),
    "photos left out, bare photos": Group(
        ("photos", "estimation.diagnosis"), FIRST_EIGHT, "rendered walls", "docs/algorithms/mapping.md",
    ),
    "self-calibration: consensus, weights, priors, verdict": Group(
        ("selfcal",), FIRST_EIGHT, "rendered walks, lenses and orbits; synthetic calibrations",
        "docs/algorithms/zero-curves.md; sets are not written down",
    ),
    "relative poses, loops, guided pairs": Group(
        ("posegraph",), WITH_TRUTH, "", "docs/algorithms/relative-poses.md",
    ),
    "mapping: seeds, choice of the model, joins, hypotheses": Group(
        ("mapping", "colmap.mapping", "colmap.tasks"), FIRST_EIGHT, "",
        "docs/algorithms/mapping.md; sets are not written down",
    ),
    "bundle adjustment: priors, misfit, settling": Group(
        ("bundle.normal_equations", "bundle.lens_evidence", "colmap.bundle"), WITH_TRUTH, "",
        "docs/algorithms/bundle-adjustment.md; rendered folders only checked it",
    ),
    "upright: cues, lines, roll": Group(
        ("frame",),
        FIRST_EIGHT, "the rendered courtyard, statue, facade and corner", "frame/up_direction.py",
    ),
    "votes that a camera must keep, pairs that are listened to": Group(
        ("selfcal.zero_curves",), (*FIRST_EIGHT, "fox50", "kitchen25", "oats23", "books21"), "",
        "docs/algorithms/zero-curves.md, 2; without fox50 the bound would be the same",
    ),
    "one camera, several, or each its own; letterbox": Group(
        ("selfcal.other_cameras", "selfcal.priors", "photos.probe"),
        ("reichstag10",), "120 random scenes of cameras",
        "docs/algorithms/zero-curves.md, 6; the random scenes alone give the same thresholds",
    ),
    "when a focal counts as known: its deviation, its lead and the votes it wins": Group(
        ("selfcal.consensus",), (), "benchmarks.trouble, seeds 0 to 180, 1000 to 1035 and 2000 to 2139",
        "consensus_peak.py; seeds 3000 to 3199 were run afterwards",
    ),
    "two cameras of one size": Group(
        ("selfcal.other_cameras", "selfcal.groups"), ("kitchen25",),
        "120 random scenes; trouble.py, seeds 0 to 64",
        "docs/algorithms/zero-curves.md, 6; the photo sets only checked it",
    ),
    "finer features": Group(
        ("mapping.feature_retry", "built_in"), ("dinoSparseRing",), "",
        "docs/algorithms/mapping.md; six other sets, thinned out, only checked it",
    ),
    "a camera for each photo in mapping, scale that hangs on few points": Group(
        ("mapping.hypotheses", "mapping.splits"),
        ("temple16", "dinoSparseRing", "castle-P19"), "trouble.py, seeds 0 to 180 and 1000 to 1031",
        "docs/algorithms/mapping.md; the photo sets chose only when a scale is called open",
    ),
    "look-alikes": Group(
        ("posegraph.look_alikes",), ("oats23", "books21", "kitchen1000"), "",
        "docs/algorithms/look-alikes.md; either of the first two finds the other, every 15th photo of the third",
    ),
    "starts of poses, pairs on a plane, passes, other focals": Group(
        ("posegraph.pair_pose", "posegraph.graph", "mapping.hypotheses"), ("dinoSparseRing", "kitchen25"), "",
        "docs/algorithms/relative-poses.md, mapping.md; castle-P19, fountain-P11, temple16 as before",
    ),
    "depth, surface, texture (no figure of this table)": Group(
        ("stereo", "meshing", "texture"), (*STRECHA, "temple16", "kermit11"), "the rendered statue, facade and corner",
        "docs/algorithms/surface.md; surface-fresh.md has other rendered scenes",
    ),
}  # fmt: skip


def seen_sets() -> tuple[str, ...]:
    """List every set that some constant was chosen on."""
    return tuple(dict.fromkeys(name for group in GROUPS.values() for name in group.sets))


def unseen_rows(rows: Sequence[Row], sets: Sequence[str]) -> list[Row]:
    """Return the rows whose set, changed or not, is none of these."""
    return [row for row in rows if row["photos"].partition(" ")[0] not in sets]


def groups_table(rows: Sequence[Row]) -> list[Row]:
    """Return, per group, the sets it has seen, and how many bars our runs meet on the sets it has not seen."""
    found = []
    for name, group in GROUPS.items():
        judged = [row for row in unseen_rows(rows, group.sets) if row.get("bar met")]
        found.append(
            {
                "constants": name,
                "stand in": ", ".join(group.modules),
                "chosen on": ", ".join(group.sets) or "no photo set",
                "also on": group.also,
                "as said in": group.source,
                "bars met on sets not seen": f"{sum(row['bar met'] == 'yes' for row in judged)} of {len(judged)}",
            }
        )
    return found
