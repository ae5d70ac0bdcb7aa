"""A thousand photos of a video, as a user types it: pairs, photos placed, accuracy, time and memory up to the scene.

    python -m benchmarks.many.thousand DATA --cache CACHE

kitchen1000 of DATA, within 6 GB. Some of its frames are copies of the one before; they are kept. A run that is stopped
goes on with the same command, and the seconds of finished stages are those of the manifest.
"""

import json
from pathlib import Path

from benchmarks.cameras.score import read_models, true_photos
from benchmarks.common.command_line import new_parser
from benchmarks.common.processes import module_command, run_command
from benchmarks.common.results import RESULTS, Row, document, table, write
from benchmarks.corpus.score import offset_figures

NAME, MEMORY_GB = "kitchen1000", 6
ABOUT = (
    f"`sfm-app run --until scene --max-memory {MEMORY_GB} --keep-low-quality` on {NAME}, 640 x 480, with two workers, "
    "beside a camera that is fixed to the same rig. Of pairs: share of all pairs that were matched. Minutes, CPU "
    "seconds and most memory of any stage, with all processes, are those of the manifest."
)
COLUMNS = ("photos", "of pairs", "placed", "models", "parts", "joins", "joins dropped", "fx",
           "median center cm", "90 % center cm", "minutes", "CPU s", "MB", "failed")  # fmt: skip


def measure(data: Path, out: Path) -> Row:
    """Run the program, and return what came out.

    Args:
        data: folder with the set.
        out: folder of the run.
    """
    photos, truth = data / NAME / "images", data / NAME / "cameras.json"
    code, last = run_command(
        module_command(
            "sfm_app", "run", str(photos), "-o", str(out), "--until", "scene", "--keep-low-quality", "--max-memory",
            str(MEMORY_GB), "--workers", "2",
        )
    )  # fmt: skip
    count = sum(1 for _ in photos.iterdir())
    row: Row = {"method": "sfm-app", "photos": count}
    if code != 0:
        return row | {"failed": last}
    stages = json.loads((out / "manifest.json").read_text(encoding="utf-8"))["stages"]
    scene, (camera,) = stages["scene"]["counts"], stages["intrinsics"]["counts"]["cameras"].values()
    row |= {"of pairs": stages["match_graph"]["counts"]["matched_pairs"] / (count * (count - 1) / 2)}
    row |= {"placed": scene["registered"], "models": 1 + len(scene["other_models"])}
    for group in scene.get("parts", [])[:1]:
        row |= {
            "parts": len(group["parts"]),
            "joins": len(group["joins"]),
            "joins dropped": len(group["dropped_joins"]),
        }
    row |= {"fx": camera["fx"]} | offset_figures(read_models(out), true_photos(truth, ()))
    row |= {"minutes": sum(stage["seconds"] for stage in stages.values()) / 60.0}
    row |= {"CPU s": sum(stage["cpu_seconds"] for stage in stages.values())}
    return row | {"MB": max(stage["peak_mb"] for stage in stages.values())}


def main() -> None:
    """Measure, and write the results."""
    parser = new_parser("many.thousand", __doc__)
    parser.add_argument("data", type=Path, help=f"folder with {NAME}")
    parser.add_argument("--cache", type=Path, required=True, help="keeps the run")
    parser.add_argument("--results", type=Path, default=RESULTS)
    args = parser.parse_args()
    rows = [measure(args.data, args.cache / "thousand")]
    page = f"# A thousand photos\n\n{ABOUT}\n\n{table(rows, COLUMNS)}"
    write(args.results, "many-thousand", document("many", ABOUT, {"memory, GB": MEMORY_GB}, {}, rows), page)
    print(page)


if __name__ == "__main__":
    main()
