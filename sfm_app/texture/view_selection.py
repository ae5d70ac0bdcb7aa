"""Choice of one photo per triangle, with good views and few seams.

A Markov random field over the triangles (Lempitsky & Ivanov, CVPR 2007; Waechter et al., ECCV 2014): the unary cost of
a triangle grows with the loss of detail, and an edge between different photos costs its length. Solved by sequential
tree-reweighted message passing (Kolmogorov, PAMI 2006), then improved triangle by triangle.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import areas
from sfm_app.jit import kernel
from sfm_app.texture.sightings import NONE, Facets, IntArray, Sightings


@dataclass(frozen=True, slots=True)
class SelectionOptions:
    """Costs of the random field, and the effort of its solution."""

    candidates: int = 8
    """Number of best photos considered for each triangle."""
    price_of_detail: float = 0.35
    """Cost of a photo with 1/e of the best photo's score, relative to 1 for a seam as long as the triangle's edge."""
    max_loss: float = 3.0
    """Upper bound of the loss, the natural logarithm of the best score over the photo's score."""
    rounds: int = 12
    """Rounds of message passing, and most rounds of the final improvement."""


OPTIONS = SelectionOptions()


def choose_photos(sightings: Sightings, mesh: Facets) -> IntArray:
    """Choose the photo of each triangle, (T,), among its views with a positive score; -1 for none."""
    triangles, candidates = sightings.triangles, min(OPTIONS.candidates, sightings.photos)
    labels, values = np.full((triangles, candidates), NONE, np.int32), np.zeros((triangles, candidates), np.float32)
    # the best photos of each triangle; ties go to the lower index
    usable = sightings.face_rows[sightings.score[sightings.face_rows] > 0]
    order = usable[np.lexsort((-sightings.score[usable], sightings.face[usable]))]
    face = sightings.face[order]
    rank = np.arange(len(face)) - np.searchsorted(face, face)
    best = rank < candidates
    at = face[best], rank[best]
    labels[at], values[at] = sightings.photo[order[best]], sightings.score[order[best]]
    loss = np.log(np.maximum(values[:, :1], 1e-30) / np.maximum(values, 1e-30))
    corners, spacing = mesh.vertices[mesh.faces], max(mesh.spacing, 1e-300)
    # square root of each triangle's area relative to an equilateral one with median edges
    size = np.sqrt(areas(mesh.vertices, mesh.faces) / (np.sqrt(3.0) / 4.0 * spacing**2))[:, None]
    cost = (OPTIONS.price_of_detail * size * np.minimum(loss, OPTIONS.max_loss)).astype(np.float32)
    # (T, 3) lengths of the edges from corner k to k + 1, in median edge lengths
    price = np.asarray(np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2) / spacing, np.float32)
    # (T, 3) the column of each triangle in its neighbor's row of `neighbors`
    own = np.arange(triangles)[:, None, None]
    back = np.asarray(np.argmax(mesh.neighbors[mesh.neighbors] == own, axis=2), np.int32)
    # (T, 3, candidates) the column of the labels of each neighbor among those of the triangle, -1 for none
    same = np.empty((triangles, 3, candidates), np.int8)
    for column in range(candidates):
        label = np.where(mesh.neighbors == NONE, NONE, labels[mesh.neighbors, column])
        match = (labels[:, None] == label[..., None]) & (label != NONE)[..., None]
        same[..., column] = np.where(match.any(axis=2), match.argmax(axis=2), NONE)
    chosen = np.full(triangles, NONE, np.int32)
    messages = np.zeros((triangles, 3, candidates), np.float32)
    for _ in range(OPTIONS.rounds):
        for forward in (True, False):
            _pass_messages(labels, cost, (mesh.neighbors, back, same), price, messages, forward)
    _decode(labels, cost, mesh.neighbors, price, messages, chosen)
    for _ in range(OPTIONS.rounds):
        if not _improve(labels, cost, mesh.neighbors, price, chosen):
            break
    return chosen


@kernel
def _pass_messages(
    labels: IntArray,
    cost: NDArray[np.float32],
    beside: tuple[IntArray, IntArray, NDArray[np.int8]],
    price: NDArray[np.float32],
    messages: NDArray[np.float32],
    forward: bool,
) -> None:
    """Pass messages once; messages[f, k] is the message from neighbor k of f about the labels of f."""
    neighbors, back, same = beside
    triangles, count = labels.shape
    belief, rest = np.empty(count), np.empty(count)
    for step in range(triangles):
        f = step if forward else triangles - 1 - step
        before = after = 0
        for k in range(3):
            before += NONE < neighbors[f, k] < f
            after += neighbors[f, k] > f
        share = 1.0 / max(before, after, 1)
        for m in range(count):
            belief[m] = cost[f, m] + messages[f, 0, m] + messages[f, 1, m] + messages[f, 2, m]
        for k in range(3):
            g = neighbors[f, k]
            if g == NONE or (g > f) != forward or labels[f, 0] == NONE or labels[g, 0] == NONE:
                continue
            least = np.inf
            for m in range(count):
                rest[m] = share * belief[m] - messages[f, k, m]
                if labels[f, m] != NONE:
                    least = min(least, rest[m])
            lowest = np.inf
            for n in range(count):
                value, m = least + price[f, k], same[f, k, n]
                if m != NONE:
                    value = min(value, rest[m])
                messages[g, back[f, k], n] = value
                lowest = min(lowest, value)
            for n in range(count):
                messages[g, back[f, k], n] -= lowest


@kernel
def _decode(
    labels: IntArray, cost: NDArray[np.float32], neighbors: IntArray, price: NDArray[np.float32],
    messages: NDArray[np.float32], chosen: IntArray,
) -> None:  # fmt: skip
    """Choose labels in order, given the previous labels and the messages from later triangles."""
    for f in range(len(labels)):
        least = np.inf
        for m in range(labels.shape[1]):
            if labels[f, m] == NONE:
                continue
            value = cost[f, m]
            for k in range(3):
                g = neighbors[f, k]
                if g > f:
                    value += messages[f, k, m]
                elif g != NONE and chosen[g] != NONE and chosen[g] != labels[f, m]:
                    value += price[f, k]
            if value < least:
                least = value
                chosen[f] = labels[f, m]


@kernel
def _improve(
    labels: IntArray, cost: NDArray[np.float32], neighbors: IntArray, price: NDArray[np.float32], chosen: IntArray
) -> int:
    """Give every triangle the best label, given those of its neighbors; return how many changed."""
    changed = 0
    for f in range(len(labels)):
        least, best = np.inf, chosen[f]
        for m in range(labels.shape[1]):
            if labels[f, m] == NONE:
                continue
            value = float(cost[f, m])
            for k in range(3):
                g = neighbors[f, k]
                if g != NONE and chosen[g] != NONE and chosen[g] != labels[f, m]:
                    value += price[f, k]
            if value < least:
                least, best = value, labels[f, m]
        if best != chosen[f]:
            chosen[f] = best
            changed += 1
    return changed
