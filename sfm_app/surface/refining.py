"""The refinement of a surface before simplification, and its fine shape for the normal map."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.perspective import LargerViews
from sfm_app.files import load_arrays, replace_atomically
from sfm_app.geometry.triangles import number_vertices
from sfm_app.meshing.agreement import RefinePhoto
from sfm_app.meshing.refinement import Refinement, refine
from sfm_app.numerical import FAILURES, error_reason
from sfm_app.settings import MeshSettings
from sfm_app.stereo import View, rank_neighbors
from sfm_app.tasks import Spread
from sfm_app.types import Surface

PARTNERS = 3
"""Photos with which each is compared. Chosen on `ornament`: with 2 the F-score at 0.05 % is 0.6 lower, with 4 it is 0.6
higher."""

Partners = Mapping[str, Sequence[str]]
"""Names of the photos for comparison with each one, best first."""


@dataclass(frozen=True, slots=True)
class Originals:
    """Folders of the photos of a run."""

    model_dir: Path
    """COLMAP model of the photos."""
    photo_dir: Path
    mask_dir: Path | None

    def read(self, views: Sequence[View], max_side_px: int, spread: Spread = map) -> list[RefinePhoto]:
        """Return the photos without distortion, in the order of the views."""
        larger = LargerViews(self.model_dir, self.photo_dir, self.mask_dir, views, max_side_px)
        photos, known = larger.photos, dict[str, RefinePhoto]()

        for rendered in spread(lambda number: list(larger.render(photos[number])), range(len(photos))):
            known |= {photo.posed.name: photo for photo in rendered}
        return [known[view.name] for view in views]


def rank_partners(views: Sequence[View]) -> Partners:
    """Return the names of the photos for comparison with each one, best first."""
    ranked = rank_neighbors(views, 2 * PARTNERS)
    return {view.name: [views[k].name for k in best] for view, best in zip(views, ranked, strict=True)}


def refine_surface(
    surface: Surface, originals: Originals, views: Sequence[View], partners: Partners, options: MeshSettings,
    spread: Spread = map,
) -> Refinement:  # fmt: skip
    """Return a surface with the detail of the photos; a BackendError says that a photo cannot be read."""
    photos = originals.read(views, options.max_image_size_px, spread)
    number = {view.name: k for k, view in enumerate(views)}
    chosen = [[number[name] for name in partners[view.name] if name in number][:PARTNERS] for view in views]
    try:
        return refine(surface, photos, chosen, 20 * options.faces, spread)  # by hand
    except FAILURES as err:  # the surface exists without refinement
        return Refinement(surface, (), f"the computation failed: {error_reason(err)}")


@dataclass(frozen=True, slots=True, eq=False)
class FineShape:
    """Triangles without colors, in single precision."""

    vertices: NDArray[np.float32]
    """(V, 3) in the frame of the scene."""
    faces: NDArray[np.int32]
    """(T, 3) vertex indices, counter-clockwise seen from outside."""

    @classmethod
    def from_surface(cls, surface: Surface) -> "FineShape":
        """Return the shape of a surface."""
        return cls(surface.vertices.astype(np.float32), surface.faces.astype(np.int32))

    @classmethod
    def load(cls, path: Path) -> "FineShape":
        """Read what `save_fine` wrote."""
        stored = load_arrays(path)
        return cls(stored["vertices"], stored["faces"])

    def select(self, keep: NDArray[np.bool_]) -> "FineShape":
        """Return the marked triangles (T,) with the vertices that they use."""
        used, faces = number_vertices(self.faces[keep])
        return FineShape(self.vertices[used], faces.astype(np.int32))


def save_fine(parts: Iterable[FineShape], path: Path) -> None:
    """Write parts of a surface as one, atomically."""
    vertices, faces, count = [np.empty((0, 3), np.float32)], [np.empty((0, 3), np.int32)], 0
    for part in parts:
        vertices.append(part.vertices)
        faces.append(part.faces + np.int32(count))
        count += len(part.vertices)
    with replace_atomically(path) as beside:
        np.savez(beside, vertices=np.concatenate(vertices), faces=np.concatenate(faces))
