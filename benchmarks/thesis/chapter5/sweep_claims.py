"""Claims of the thesis about the curves of Figures 5.6, 5.10 and 5.17 to 5.22, and how they are judged."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from benchmarks.common.results import Row
from benchmarks.thesis.chapter5.contests import GEOMETRIC as GEO
from benchmarks.thesis.chapter5.contests import MULTI_START as RMS
from benchmarks.thesis.chapter5.contests import NON_ROBUST as NON
from benchmarks.thesis.chapter5.contests import PERTURBATION as PBW
from benchmarks.thesis.chapter5.contests import ZERO_CURVES as ZC
from benchmarks.thesis.claims import Claim, verdict

STEADY = 2.0
"""Ratio of a curve's largest error to its smallest, up to which we call it steady."""
ANY, TAINTED = (-1.0, 1e9), (1e-9, 1e9)
"""All levels, and those at which some of the F's are corrupted."""
BUT_ZC, BUT_RMS, BUT_PBW = (RMS, PBW, GEO, NON), (PBW, GEO, NON), (ZC, RMS, GEO, NON)


@dataclass(frozen=True, slots=True)
class CurveClaim:
    """A claim of the thesis about the curves of a plot.

    `kind` is how it is judged: "below": `method` has less error than each of `others` at each level, by factor `limit`
    if there is one; "steady": its largest error over the levels is at most twice its smallest; "rising": its last error
    is more than twice its first; "falling": its last error is less than its first; "under", "over": its errors lie
    below `limit`, or not.
    """

    part: str
    says: str
    kind: str
    method: str
    others: Sequence[str] = ()
    levels: tuple[float, float] = ANY
    limit: float = 0.0
    column: str = "e_focal"


CLAIMS = (
    CurveClaim("5.6a", "Multi-Start holds a reasonable error (here: under 20 %)", "under", RMS, limit=20),
    CurveClaim("5.6a", "the non-robust method degrades as soon as there are outliers", "rising", NON),
    CurveClaim("5.6a", "the Geometric method performs best", "below", GEO, (RMS, NON), TAINTED),
    CurveClaim("5.6b", "Multi-Start stays at about 18 % (here: under 25 %)", "under", RMS, limit=25),
    CurveClaim("5.6b", "the Geometric method degrades like the non-robust one", "rising", GEO),
    CurveClaim("5.6b", "at low deviations Multi-Start is worse than both", "below", GEO, (RMS,), (0, 10)),
    CurveClaim("5.10a", "the non-robust method is off by 50 % or more", "over", NON, (), TAINTED, 50),
    CurveClaim("5.10a", "Geometric is best, at about 7 % (here: under 10 %)", "under", GEO, limit=10),
    CurveClaim("5.10a", "the error of Perturbation does not depend on the outliers", "steady", PBW, (), TAINTED),
    CurveClaim("5.10a", "Perturbation is slightly worse than Geometric", "below", GEO, (PBW,), TAINTED),
    CurveClaim("5.10b", "Perturbation is better than Geometric and non-robust", "below", PBW, (GEO, NON), TAINTED),
    CurveClaim("5.17a", "Zero Curves has a very low error (here: under 5 %)", "under", ZC, limit=5),
    CurveClaim("5.17b", "Zero Curves is rather accurate (here: under 10 %)", "under", ZC, limit=10),
    CurveClaim("5.18a", "Zero Curves is the best of the proposed methods", "below", ZC, (RMS, PBW), TAINTED),
    CurveClaim("5.18a", "Geometric is better than Perturbation and Multi-Start", "below", GEO, (PBW, RMS), TAINTED),
    CurveClaim(
        "5.18b", "Zero Curves beats Multi-Start, Geometric and non-robust", "below", ZC, (RMS, GEO, NON), TAINTED
    ),
    CurveClaim("5.18b", "so does Perturbation", "below", PBW, (RMS, GEO, NON), TAINTED),
    CurveClaim("5.18c", "Multi-Start finds the center worst", "below", ZC, (RMS,), column="e_OC"),
    CurveClaim("5.18d", "Multi-Start finds the center worst", "below", ZC, (RMS,), column="e_OC"),
    CurveClaim("5.19a", "Zero Curves is best up to six outlying F's of ten", "below", ZC, BUT_ZC, (1, 6)),
    CurveClaim("5.19a", "at eight it is not", "below", GEO, (ZC,), (8, 8)),
    CurveClaim("5.19a", "Geometric is steady", "steady", GEO),
    CurveClaim(
        "5.19b", "on Wadham Zero Curves beats Perturbation, Geometric and non-robust", "below", ZC, BUT_RMS, TAINTED
    ),
    CurveClaim("5.19b", "so does Multi-Start", "below", RMS, BUT_RMS, TAINTED),
    *(
        CurveClaim(f"5.20 {name}", *said)
        for name in ("Castle-P19", "Fountain-P11")
        for said in (
            ("Perturbation is best without outlying F's", "below", PBW, BUT_PBW, (0, 0)),
            ("the error of Multi-Start does not depend on the outlying F's", "steady", RMS),
            ("Zero Curves is best with up to six outlying F's of 21", "below", ZC, BUT_ZC, (1, 6)),
        )
    ),
    CurveClaim("5.21a", "Perturbation is best at the higher noise levels", "below", PBW, BUT_PBW, (1.5, 9)),
    CurveClaim("5.21a", "Zero Curves performs poorly there", "below", NON, (ZC,), (1.5, 9)),
    CurveClaim("5.21b", "Zero Curves finds the center best at all levels", "below", ZC, BUT_ZC, column="e_OC"),
    CurveClaim("5.22a", "Zero Curves gets better with more frames", "falling", ZC),
    CurveClaim("5.22a", "so does Perturbation", "falling", PBW),
    CurveClaim("5.22b", "Zero Curves is ten times as fast as Multi-Start", "below", ZC, (RMS,), limit=10, column="ms"),
)


def judge_claims(found: Mapping[str, Sequence[Row]]) -> list[Claim]:
    """Judge the claims about these plots, given the rows of each."""
    return [_judge(found[said.part], said) for said in CLAIMS if said.part in found]


def value(rows: Sequence[Row], method: str, x: float, column: str) -> float:
    """Return a figure of one method at one level; NaN where there is none."""
    held = next((row[column] for row in rows if row["method"] == method and row["x"] == x), None)
    return float("nan") if held is None else float(held)


def _judge(rows: Sequence[Row], said: CurveClaim) -> Claim:
    names = (said.method, *said.others)
    missing = [name for name in names if not any(row["method"] == name for row in rows)]
    levels = [x for x in sorted({row["x"] for row in rows}) if said.levels[0] <= x <= said.levels[1]]
    if missing or not levels:
        return Claim(said.part, said.says, "not measured", f"missing: {', '.join(missing) or 'such levels'}")
    lines = {name: [value(rows, name, x, said.column) for x in levels] for name in names}
    unit = "ms" if said.column == "ms" else "%"
    listed = "; ".join(f"{name} {', '.join(f'{v:.3g}' for v in line)} {unit}" for name, line in lines.items())
    numbers = f"at {', '.join(f'{x:g}' for x in levels)}: {listed}"
    own, *others = lines.values()
    return Claim(said.part, said.says, verdict(check_levels(said, own, others)), numbers)


def check_levels(said: CurveClaim, own: Sequence[float], others: Sequence[Sequence[float]] = ()) -> list[bool]:
    """Check the claim at each level, or once for the whole curve; NaN never holds."""
    match said.kind:
        case "below":
            factor = said.limit or 1.0
            return [all(factor * mine < other[k] for other in others) for k, mine in enumerate(own)]
        case "under":
            return [mine < said.limit for mine in own]
        case "over":
            return [mine >= said.limit for mine in own]
        case "steady":
            return [max(own) <= STEADY * min(own)]
        case "rising":
            return [own[-1] > STEADY * own[0]]
        case "falling":
            return [own[-1] < own[0]]
    raise ValueError(f"no such kind of claim: {said.kind}")
