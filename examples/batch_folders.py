#!/usr/bin/env python3
"""Reconstruct many folders of photos, one after the other: python examples/batch_folders.py FOLDERS OUT [OPTIONS]

FOLDERS holds a folder of photos for each model. OUT gets a folder with the same name for each, and table.csv, which is
written anew after every folder. OPTIONS are those of `sfm-app run`, such as --quality draft.

A folder that fails does not stop the others: the table has the reason. Run it again after a break, after a failure or
with more photos: what is done takes seconds. A wrong option stops it at once.
"""

import argparse
import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

COLUMNS = ("folder", "state", "photos", "placed", "focal_px", "deviation_px", "triangles", "seconds", "reason")
WRONG_SETTING = 2
"""Exit code of sfm-app."""


def main() -> int:
    """Reconstruct every folder; return 1 if one of them failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("options", nargs=argparse.REMAINDER)
    given = parser.parse_args()
    names = list_folders(given.folders, given.out)
    if not names:
        parser.error(f"{given.folders} holds no folders of photos")

    table = given.out / "table.csv"
    rows = read_rows(table)
    for number, name in enumerate(names, start=1):
        rows[name] = reconstruct(given.folders / name, given.out / name, given.options)
        write_rows(table, rows)
        said = ", ".join(f"{key} {value}" for key, value in rows[name].items() if key != "folder" and value != "")
        print(f"[{number}/{len(names)}] {name}: {said}", flush=True)
    return int(any(rows[name]["state"] == "failed" for name in names))


def list_folders(folders: Path, out: Path) -> list[str]:
    """Return the names of the folders of photos, in order."""
    found = folders.iterdir() if folders.is_dir() else ()
    return sorted(p.name for p in found if p.is_dir() and p.name[0] != "." and p.resolve() != out.resolve())


def reconstruct(photos: Path, out: Path, options: list[str]) -> dict[str, Any]:
    """Return what came of one folder, as a row of the table.

    Each folder has a process of its own: whatever happens to it, its memory is free again and the next one begins.
    """
    command = [sys.executable, "-m", "sfm_app", "run", str(photos), "-o", str(out), "--json", "--quiet", *options]
    done = subprocess.run(command, capture_output=True, text=True, encoding="utf-8", check=False)
    if done.returncode == WRONG_SETTING:  # for every folder
        raise SystemExit(done.stderr.strip())
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
        reason = errors[-1].removeprefix("error: ") if errors else f"ended with code {done.returncode}"
        return {"folder": photos.name, "state": "failed", "reason": reason}
    found = json.loads(done.stdout)
    return {"folder": photos.name, "state": "done", **figures(found)}


def figures(found: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a run that the table has, from what --json prints."""
    scene = found.get("scene", {})  # a run may end earlier: --until intrinsics
    camera = next(iter(scene.get("cameras", {}).values()), None)  # the one with the most photos
    return {
        "photos": found["photos"]["usable"] + len(found["photos"]["unusable"]),
        "placed": scene.get("registered", ""),
        "focal_px": round(camera["K"][0][0], 1) if camera else "",
        "deviation_px": round(camera["deviations"].get("fx", float("nan")), 1) if camera else "",
        "triangles": found.get("mesh", {}).get("triangles", ""),
        "seconds": round(sum(found["seconds"].values()), 1),
    }


def read_rows(table: Path) -> dict[str, dict[str, Any]]:
    """Return the rows of an earlier time, by folder."""
    if not table.exists():
        return {}
    with table.open(encoding="utf-8", newline="") as file:
        return {row["folder"]: dict(row) for row in csv.DictReader(file)}


def write_rows(table: Path, rows: dict[str, dict[str, Any]]) -> None:
    """Write the table; a break leaves the old one or the new one."""
    table.parent.mkdir(parents=True, exist_ok=True)
    part = table.with_suffix(".part")
    with part.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows.values())
    part.replace(table)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit("interrupted; the same command goes on")
