"""COLMAP's SIFT features and raw matches, on CPU, without its geometric verification; see `features.py`."""

import math
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from sfm_app.colmap.backend import json_options, pycolmap, run_with_progress
from sfm_app.colmap.database import open_database, panorama_names
from sfm_app.colmap.processes.enlarged_features import find_as_needed
from sfm_app.colmap.processes.panorama_features import extract_panoramas
from sfm_app.colmap.processes.worker_process import FeatureTask, ProgressReporter, SiftOption, report, serve
from sfm_app.numerical import Json
from sfm_app.progress import Progress
from sfm_app.settings import MatchSettings

PLAIN = re.compile(r"[!-~]+")
"""Names that COLMAP reads from a list as they are: ASCII without blanks."""


def work(task: FeatureTask) -> None:
    """Find features of photos, match pairs of photos, and report the effective options."""
    do_task(task, ProgressReporter(), report)


def do_task(task: FeatureTask, progress: Progress, tell: Callable[..., None]) -> None:
    """Find features of photos, and match pairs of photos.

    Args:
        task: what to do.
        progress: shows a bar.
        tell: called with the options in force, as `extraction` or `matching`.
    """
    database, photo_dir, names = Path(task["database"]), Path(task["photos"]), task["names"]
    options = MatchSettings.model_validate(task["options"])
    masks = Path(task["masks"]) if task["masks"] else None
    reader = pycolmap.ImageReaderOptions()
    if masks is not None:
        reader.mask_path = masks
    if names:
        extraction = extraction_options(options, task["sift"], task["workers"])
        panoramas = panorama_names(database)
        extract_panoramas(
            database, photo_dir, [name for name in names if name in panoramas], masks, extraction, progress
        )
        plain = [name for name in names if name not in panoramas]
        if plain and task["sift"]:
            extract(database, photo_dir, plain, reader, extraction, progress)
        elif plain:
            how = reader, extraction, options.enlarge_below

            def call(token: pycolmap.CancellationToken) -> None:
                find_as_needed(database, photo_dir, plain, how, token)

            _run_with_progress(call, database, *_counter(database, plain), progress)
        tell(extraction=json_options(extraction.todict()))
    pairs = None if task["pairs"] is None else [(int(a), int(b)) for a, b in task["pairs"]]
    if pairs != []:
        tell(matching=match(database, options, task["workers"], pairs, progress))


def extraction_options(
    options: MatchSettings, sift: Mapping[str, SiftOption], workers: int
) -> pycolmap.FeatureExtractionOptions:
    """Return COLMAP's options for finding features.

    Args:
        options: largest photo size and largest number of features.
        sift: options of COLMAP's SIFT, by name.
        workers: threads.
    """
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = options.max_image_size_px
    extraction.num_threads = workers
    extraction.use_gpu = False
    extraction.sift.max_num_features = options.max_features
    for name, value in sift.items():
        setattr(extraction.sift, name, value)
    return extraction


def extract(
    database: Path,
    photo_dir: Path,
    names: Sequence[str],
    reader: pycolmap.ImageReaderOptions,
    extraction: pycolmap.FeatureExtractionOptions,
    progress: Progress,
) -> None:
    """Find SIFT features of all photos.

    Args:
        database: holds the photos; keypoints are entered.
        photo_dir: folder with the photos.
        names: names of the photos.
        reader: COLMAP's options for reading photos and masks.
        extraction: see `extraction_options`.
        progress: shows a bar.
    """

    def call(token: pycolmap.CancellationToken) -> None:
        pycolmap.extract_features(
            database, photo_dir, list(names), reader_options=reader, extraction_options=extraction,
            device=pycolmap.Device.cpu, cancellation_token=token,
        )  # fmt: skip

    _run_with_progress(call, database, *_counter(database, names), progress)


def _counter(database: Path, names: Sequence[str]) -> tuple[Callable[[pycolmap.Database], int], tuple[str, int]]:
    """Return what counts the photos that have keypoints, and what a bar shows."""
    wanted = set(names)
    with open_database(database) as before:
        ids = [image.image_id for image in before.read_all_images() if image.name in wanted]
    return lambda reader: sum(reader.exists_keypoints(photo) for photo in ids), ("features", len(ids))


def match(
    database: Path,
    options: MatchSettings,
    workers: int,
    pairs: Sequence[tuple[int, int]] | None,
    progress: Progress,
) -> dict[str, Json]:
    """Match pairs of photos, and return the effective options.

    Args:
        database: holds the keypoints; matches are entered.
        options: largest ratio of descriptor distances.
        workers: threads.
        pairs: ids of the photos of each pair; None for every photo with every other.
        progress: shows a bar.
    """
    matching = pycolmap.FeatureMatchingOptions()
    matching.skip_geometric_verification = True
    matching.num_threads = workers
    matching.use_gpu = False
    matching.sift.max_ratio = options.max_ratio
    if pairs is not None:
        _match_pairs(database, matching, pairs, progress)
        return json_options(matching.todict())

    def call(token: pycolmap.CancellationToken) -> None:
        pycolmap.match_exhaustive(
            database, matching_options=matching, device=pycolmap.Device.cpu, cancellation_token=token
        )

    def count_finished(reader: pycolmap.Database) -> int:
        return int(reader.num_matched_image_pairs())

    with open_database(database) as reader:
        photos = reader.num_images()
    _run_with_progress(call, database, count_finished, ("matching", math.comb(photos, 2)), progress)
    return json_options(matching.todict())


def _match_pairs(
    database: Path,
    matching: pycolmap.FeatureMatchingOptions,
    pairs: Sequence[tuple[int, int]],
    progress: Progress,
) -> None:
    """Match pairs of photos.

    COLMAP's lists end names at blanks. Where a name has any, a copy of the database is matched in which photos are
    named by ids.
    """
    with open_database(database) as reader:
        names = {image.image_id: image.name for image in reader.read_all_images()}
    if all(PLAIN.fullmatch(name) for name in names.values()):
        with tempfile.TemporaryDirectory(dir=database.parent, prefix=".matching") as folder:
            _match_listed(database, matching, [(names[a], names[b]) for a, b in pairs], Path(folder), progress)
        return
    _match_in_copy(database, matching, pairs, progress)


def _match_in_copy(
    database: Path,
    matching: pycolmap.FeatureMatchingOptions,
    pairs: Sequence[tuple[int, int]],
    progress: Progress,
) -> None:
    with tempfile.TemporaryDirectory(dir=database.parent, prefix=".matching") as folder:
        copy = Path(folder) / database.name
        shutil.copyfile(database, copy)
        with open_database(copy) as renamed:
            renamed.clear_two_view_geometries()
            renamed.clear_matches()
            for image in renamed.read_all_images():
                image.name = str(image.image_id)
                renamed.update_image(image)
        _match_listed(copy, matching, [(str(a), str(b)) for a, b in pairs], Path(folder), progress)
        with open_database(copy) as found:
            rows = {pair: found.read_matches(*pair) for pair in pairs}
    with open_database(database) as target:
        for pair in (pair for pair in pairs if not target.exists_matches(*pair)):
            target.write_matches(*pair, rows[pair])


def _match_listed(
    database: Path,
    matching: pycolmap.FeatureMatchingOptions,
    pairs: Sequence[tuple[str, str]],
    folder: Path,
    progress: Progress,
) -> None:
    """Match pairs of photos by name; the folder gets a list of them."""
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = folder / "pairs.txt"
    pairing.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="ascii", newline="\n")
    with open_database(database) as reader:
        before = int(reader.num_matched_image_pairs())

    def call(token: pycolmap.CancellationToken) -> None:
        pycolmap.match_image_pairs(
            database, matching_options=matching, pairing_options=pairing, device=pycolmap.Device.cpu,
            cancellation_token=token,
        )  # fmt: skip

    def count_finished(reader: pycolmap.Database) -> int:
        return int(reader.num_matched_image_pairs()) - before

    _run_with_progress(call, database, count_finished, ("matching", len(pairs)), progress)


def _run_with_progress(
    call: Callable[[pycolmap.CancellationToken], None],
    database: Path,
    done: Callable[[pycolmap.Database], int],
    what: tuple[str, int],
    progress: Progress,
) -> None:
    """Run a COLMAP call, and show its progress as read from the database.

    The reader is COLMAP's own SQLite, opened once before the call: a second SQLite in the process (Python's) would drop
    the locks of the first whenever it closes the file, and COLMAP would abort.
    """
    with open_database(database) as reader:
        run_with_progress(call, lambda: done(reader), *what, progress)


if __name__ == "__main__":
    serve(work)
